"""Whether bundled objects are sound: python -m tests.benchmarks.objects [--quick]

Makes objects of each category of `procedural`, `procedural_varied` and `procedural_rough`
(`procedural_messy` has the solids of the first, written otherwise), writes them, reads them back
and looks at them closed, open and in between. Counts those that fail or have a solid that is not
closed, those whose parts are in one another anywhere (`crossings`: nothing is sampled), and those
that, closed, do not stand on the floor. Exit status 1 if there is any. --first and --category take
it in pieces.
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import partial
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from articugen.core.geometry import apply
from articugen.core.recipe import load_recipe
from articugen.core.seeding import generator
from articugen.instance.articulation import resolve
from articugen.procedural import build_model
from articugen.procedural.kit.writer import TRUTH_NAME, URDF_NAME, write_model
from articugen.procedural.truth import read_truth
from articugen.sources.source import open_source
from articugen.sources.urdf import load_urdf
from tests.procedural_truth import assert_sound, crossings, link_frames, object_id

SOURCES = ("procedural", "procedural_varied", "procedural_rough")
ON_THE_FLOOR = 1e-9
"""Metres."""

KINDS = ("fails", "collides", "off the floor")

Fault = tuple[str, str]
"""One of KINDS, and a sentence."""


def faults(source: str, category: str, index: int) -> list[Fault]:
    """What is wrong with one object."""
    name = object_id(category, index)
    with tempfile.TemporaryDirectory() as folder:
        try:
            return list(_faults(source, category, name, Path(folder)))
        except Exception as error:  # whatever it is, the others are to be counted too
            return [("fails", f"{source} {name}: {type(error).__name__}: {error}")]


def _faults(source: str, category: str, name: str, folder: Path) -> Iterator[Fault]:
    of = open_source(source)
    model = build_model(category, name, varied=of.file.varied)
    assert_sound(model)
    write_model(model, folder, object_id=name, category=category, messy=of.file.messy)
    obj = load_urdf(folder / URDF_NAME, object_id=name, category=category)
    truth = read_truth((folder / TRUTH_NAME).read_bytes())
    obj = resolve(
        obj,
        load_recipe(None, category, source).for_source(clips_to_limits=of.clips).articulation,
        movable=of.file.categories[category].movable,
    )
    upper = np.array([joint.upper for joint in obj.moving_joints])
    between = generator(0, name, "between").uniform(0.0, upper)
    for q in (0.0 * upper, upper, between):
        for (a, b), deep in crossings(obj, truth, q).items():
            yield "collides", f"{source} {name} at {q}: {a} is in {b}, {deep:.1e} m"
    T = link_frames(obj, 0.0 * upper)
    lowest = min(
        apply(T[k.name], k.mesh.vertices)[:, 2].min() for k in obj.links if len(k.mesh.vertices)
    )
    if of.file.messy:  # a sheet is drawn in the middle of the solid that it stands for
        lowest = min(lowest, truth._posed(T)[2][:, 0, 2].min())
    if abs(lowest) > ON_THE_FLOOR:
        yield "off the floor", f"{source} {name}: its lowest point is {lowest:.1e} m high"


def categories(source: str) -> list[str]:
    """Those that a source offers."""
    return list(open_source(source).file.categories)


def main() -> int:
    """Print each fault and a table of how many there are; 1 if there is any."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.objects")
    parser.add_argument("--objects", type=int, default=3000, help="so many of each category")
    parser.add_argument("--first", type=int, default=0, help="from this number on")
    parser.add_argument("--quick", action="store_true", help="20 of each")
    parser.add_argument("--source", action="append", help=f"one of {', '.join(SOURCES)}, not all")
    parser.add_argument("--category", action="append", help="this one, not all")
    parser.add_argument("--jobs", type=int, help="processes; by default one a core")
    asked = parser.parse_args()
    count = 20 if asked.quick else asked.objects
    console, table = Console(), Table("source", "category", "objects", *KINDS)
    total = 0
    with Pool(asked.jobs) as pool:
        for source in asked.source or SOURCES:
            for category in asked.category or categories(source):
                look = partial(faults, source, category)
                found = pool.imap(look, range(asked.first, asked.first + count), chunksize=8)
                bar = track(found, f"{source} {category}", count, console=console)
                number: Counter[str] = Counter()
                for one in bar:
                    number.update({kind for kind, _ in one})
                    for _, sentence in one:
                        console.print(sentence, markup=False, soft_wrap=True)
                table.add_row(source, category, str(count), *(str(number[kind]) for kind in KINDS))
                total += number.total()
    console.print(table)
    return min(total, 1)


if __name__ == "__main__":
    sys.exit(main())
