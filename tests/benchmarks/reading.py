"""What reading costs, beside uncompressed .npz files: python -m tests.benchmarks.reading [SHARD]

Prints CPU time of a batch of random rows, all fields and the points of one kind alone: of the same
instances as a shard, as one .npz an instance and as a shard read through h5py. They take turns, so
that a busy machine slows all alike. Without SHARD, of a made-up one with the default counts.
"""

import argparse
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from articugen.recipe import Sampling
from articugen.store.shards import Shard, open_shard, write_shard
from tests.instances import SMALL, hinged_box

BATCH = 18
TURNS = 15

Batch = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.reading")
    parser.add_argument("shard", nargs="?", type=Path, help="of at least 18 instances")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = asked.shard or _made_up(Path(folder))
        with open_shard(path) as shard, h5py.File(path, locking=False) as plain:
            for names in (sorted(shard.fields), ["surface_points", "surface_part"]):
                seconds = measured(shard, plain, names, Path(folder))
                what = "all fields" if len(names) > 2 else " and ".join(names)
                print(f"{BATCH} random rows, {what}:")  # noqa: T201
                for way, spent in seconds.items():
                    ratio = spent / seconds["npz"]
                    print(f"  {way:10} {1e3 * spent:6.1f} ms of CPU, {ratio:.2f} of npz")  # noqa: T201


def measured(shard: Shard, plain: h5py.File, names: list[str], folder: Path) -> dict[str, float]:
    """The median CPU seconds of each way to read a batch."""
    rows = np.random.default_rng(0).permutation(len(shard))[:BATCH]
    for row in rows:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            np.savez(folder / f"{row}.npz", **{n: shard.read(n, int(row)) for n in shard.fields})

    def from_npz() -> Batch:
        found: dict[str, list[Any]] = {name: [] for name in names}
        for row in rows:
            with np.load(folder / f"{row}.npz") as file:
                for name in names:
                    found[name].append(file[name])
        return {name: np.stack(arrays) for name, arrays in found.items()}

    ways: dict[str, Callable[[], Batch]] = {
        "npz": from_npz,
        "articugen": lambda: shard.batch(rows, names),
        "h5py": lambda: {n: np.stack([plain[n][row] for row in rows]) for n in names},  # type: ignore[index]
    }
    expected = from_npz()
    for read in ways.values():
        for name, array in read().items():
            np.testing.assert_array_equal(array, expected[name])
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(TURNS):
        for way, read in ways.items():
            began = time.process_time()
            read()
            seconds[way].append(time.process_time() - began)
    return {way: statistics.median(spent) for way, spent in seconds.items()}


def _made_up(folder: Path) -> Path:
    recipe = SMALL.model_copy(update={"sampling": Sampling(partial_resolution=64)})
    states = np.random.default_rng(0).uniform(0.0, (1.7, 0.3), (2 * BATCH, 2))
    rows = hinged_box([(float(angle), float(slide)) for angle, slide in states], recipe=recipe)
    about = {"category": "box", "split": "train", "recipe": "", "recipe_sha256": "", "seed": 0}
    write_shard(folder / "train-00000.h5", rows, about | {"articugen_version": "0"})
    return folder / "train-00000.h5"


if __name__ == "__main__":
    main()
