"""What the command line asks for: python -m tests.benchmarks --help"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from articugen.procedural import CATEGORIES
from tests.benchmarks.dense import Dense
from tests.benchmarks.measure import Extent


@dataclass(frozen=True)
class Options:
    """What is measured, and where the report goes.

    Attributes:
        categories: of the bundled objects; `objects` of each, clean and messy.
        end_to_end: (category, objects, states) of the data set made by the command line.
        peers: whether peers are measured, too.
    """

    categories: tuple[str, ...]
    objects: int
    extent: Extent
    end_to_end: tuple[str, int, int]
    peers: bool
    quick: bool
    out: Path


def dense(quick: bool) -> Dense:
    return Dense(views=20, image=160, grid=64) if quick else Dense()


def parse(arguments: Sequence[str] | None = None) -> Options:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--objects", type=int, default=2, help="of each category")
    parser.add_argument("--states", type=int, default=3, help="random joint states an object")
    parser.add_argument("--runs", type=int, default=3, help="timed runs; slow peers run once")
    parser.add_argument("--no-peers", action="store_true", help="measure ours alone")
    parser.add_argument(
        "--quick", action="store_true",
        help="see that it works: two objects, one state, one run, no slow peers",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("benchmarks_out"), help="folder")
    asked = parser.parse_args(arguments)
    peers = not asked.no_peers
    if asked.quick:
        extent = Extent(states=1, runs=1, points=10_000, labels=50_000, slow_on=("laptop",))
        end_to_end = ("laptop", 2, 2)
        return Options(("laptop", "drawer"), 1, extent, end_to_end, peers, True, asked.out)
    extent = Extent(asked.states, asked.runs, 50_000, 625_000, ("laptop", "drawer"))
    end_to_end = ("laptop", 8, 100)
    return Options(CATEGORIES, asked.objects, extent, end_to_end, peers, False, asked.out)
