"""What `ag.stream` makes a second, and its memory: python -m tests.benchmarks.streaming [CATEGORY]

Each process makes its share, preparing included, after a first object that imports and warms up.
Prints every quarter how many instances were made, the rate of all processes by the clock and by
their CPU time, and the largest resident memory of a process then and so far.
"""

import argparse
import resource
import time
from collections.abc import Iterator
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import articugen as ag

QUARTERS = 4


class Quarter(NamedTuple):
    made: int
    seconds: float
    cpu_seconds: float
    megabytes: float
    peak: float


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.streaming")
    parser.add_argument("category", nargs="?", default="drawer")
    parser.add_argument("--source", default="procedural_varied")
    parser.add_argument("--instances", type=int, default=2720, help="of all processes")
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    count = asked.processes
    with get_context("spawn").Pool(count) as pool:
        given = [(asked.category, asked.source, asked.instances, k, count) for k in range(count)]
        for quarters in zip(*pool.starmap(_measured, given), strict=True):
            made = sum(q.made for q in quarters)
            rate = sum(q.made / q.seconds for q in quarters)
            cpu = sum(q.made / q.cpu_seconds for q in quarters)
            now, peak = max(q.megabytes for q in quarters), max(q.peak for q in quarters)
            print(f"{made:9,} made, {rate:4.0f}/s ({cpu:4.0f}/s of CPU), {now:4.0f} MB, ", end="")  # noqa: T201
            print(f"at most {peak:4.0f} MB a process")  # noqa: T201


def _measured(category: str, source: str, instances: int, k: int, of: int) -> list[Quarter]:
    """Return what one process measures, in each quarter of its share."""
    rows = ag.stream(category, source=source, share=f"{k}/{of}")
    each = rows.job.recipe.articulation.states + 1
    _run(rows, each)
    return [_run(rows, instances // QUARTERS // of) for _ in range(QUARTERS)]


def _run(rows: Iterator[ag.Row], count: int) -> Quarter:
    clock, cpu = time.perf_counter(), time.process_time()
    made = sum(1 for _ in islice(rows, count))
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    megabytes = pages * resource.getpagesize() / 2**20
    return Quarter(made, time.perf_counter() - clock, time.process_time() - cpu, megabytes, peak)


if __name__ == "__main__":
    main()
