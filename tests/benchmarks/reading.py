"""What reading costs, beside uncompressed .npz files: python -m tests.benchmarks.reading [DATA]

Prints CPU time of a batch of random rows, all fields and the points of one kind alone: of the same
instances as a shard, as one .npz an instance and as a shard read through h5py. They take turns, so
that a busy machine slows all alike. Without DATA, of a made-up one with the default counts.

Then batches as a learner takes them, of 4,096 surface points in the unit frame and their labels:
instances a second of one core, from a warm page cache.

Last a whole set from its first row to its last, points and labels of each, beside what
`export --to parquet` and `--to webdataset` make of it, where `datasets` and `webdataset` are
installed: seconds until the first row is there, then rows a second.
"""

import argparse
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import articugen
from articugen.core.recipe import Sampling
from articugen.core.records import dequantize
from articugen.store.dataset import open as open_data_set
from articugen.store.shards import Shard, open_shard
from articugen.store.writer import write_shard
from tests.instances import SMALL, hinged_box

BATCH = 18
TURNS = 15

POINTS = 4096
LEARNT = ("surface_points", "surface_part")

Batch = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.reading")
    parser.add_argument("data", nargs="?", type=Path, help="a set with 18 instances in a shard")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = min(asked.data.glob("train-*.h5")) if asked.data else _made_up(Path(folder))
        with open_shard(path) as shard, h5py.File(path, locking=False) as plain:
            for names in (sorted(shard.fields), ["surface_points", "surface_part"]):
                seconds = measured(shard, plain, names, Path(folder))
                what = "all fields" if len(names) > 2 else " and ".join(names)
                print(f"{BATCH} random rows, {what}:")  # noqa: T201
                for way, spent in seconds.items():
                    ratio = spent / seconds["npz"]
                    print(f"  {way:10} {1e3 * spent:6.1f} ms of CPU, {ratio:.2f} of npz")  # noqa: T201
        for stored in (POINTS, 2 * POINTS):
            (own := Path(folder) / str(stored)).mkdir()
            path = _made_up(own, surface_points=stored, grids=(8,))
            seconds = as_learnt(path, own)
            print(f"{BATCH} random rows as float32, {POINTS} of {stored} surface points, labels:")  # noqa: T201
            for way, spent in seconds.items():
                ratio = spent / seconds["npz"]
                print(f"  {way:10} {BATCH / spent:6,.0f} instances/s, {ratio:.2f} of npz's time")  # noqa: T201
        in_order(asked.data or path, Path(folder))


def as_learnt(path: Path, folder: Path) -> dict[str, float]:
    """The median CPU seconds of a batch of some points, as floats, of random rows."""
    data = open_data_set(path)
    files = [folder / f"{n}.npz" for n in range(len(data))]
    for file, row in zip(files, data, strict=True):
        np.savez(file, **{name: row.stored(name) for name in LEARNT})

    def from_npz() -> Batch:
        rng = np.random.default_rng(0)
        points, part = [], []
        for n in rng.choice(len(files), BATCH, replace=False):
            with np.load(files[n]) as file:
                stored, label = (file[name] for name in LEARNT)
            if len(label) > POINTS:
                some = rng.choice(len(label), POINTS, replace=False, shuffle=False)
                stored, label = stored[some], label[some]
            points.append(stored.astype(np.float32) / np.float32(65535) - np.float32(0.5))
            part.append(label)
        return {"surface_points": np.stack(points), "surface_part": np.stack(part)}

    def from_shard() -> Batch:
        return data.batch(BATCH, LEARNT, points=POINTS, rng=0)

    ours, theirs = from_shard(), from_npz()
    assert {n: (a.shape, a.dtype) for n, a in ours.items()} == {
        n: (a.shape, a.dtype) for n, a in theirs.items()
    }
    return _medians({"npz": from_npz, "articugen": from_shard})


def in_order(data: Path, folder: Path) -> None:
    """Print the CPU seconds, of all threads, until the first row of a set is there, and how many
    rows follow in a second: points as float32 in the unit frame, and labels."""
    ways: dict[str, Callable[[], Iterator[tuple[Any, Any]]]] = {
        "articugen": lambda: (
            (row.surface.points, row.surface.part) for row in open_data_set(data).split("train")
        )
    }
    articugen.export(data, "parquet", folder / "parquet", split="train")
    articugen.export(data, "webdataset", folder / "tar", split="train")
    if find_spec("datasets"):
        datasets = import_module("datasets")

        def from_parquet(*, streaming: bool) -> Iterator[tuple[Any, Any]]:
            rows = datasets.load_dataset(
                "parquet", data_files=str(folder / "parquet" / "data" / "*.parquet"),
                split="train", streaming=streaming, cache_dir=str(folder / "cache"),
                columns=list(LEARNT),
            ).with_format("numpy")  # fmt: skip
            return ((np.float32(dequantize(row[LEARNT[0]])), row[LEARNT[1]]) for row in rows)

        datasets.disable_progress_bars()
        ways["datasets, first time"] = partial(from_parquet, streaming=False)
        ways["datasets, cached"] = partial(from_parquet, streaming=False)
        ways["datasets, streaming"] = partial(from_parquet, streaming=True)
    if find_spec("webdataset"):
        webdataset = import_module("webdataset")
        tars = sorted(map(str, (folder / "tar").glob("*.tar")))
        ways["webdataset"] = lambda: (
            tuple(sample["npz"][name] for name in LEARNT)  # type: ignore[misc]
            for sample in webdataset.WebDataset(tars, shardshuffle=False).decode()
        )
    print("A set in order, points and labels:")  # noqa: T201
    for way, read in ways.items():
        began = time.process_time()
        rows = read()
        points, part = next(rows)
        first = time.process_time() - began
        assert points.dtype == np.float32
        assert len(points) == len(part)
        count = sum(1 for _ in rows)
        rate = count / (time.process_time() - began - first)
        print(f"  {way:20} first row after {1e3 * first:6.1f} ms, then {rate:7,.0f} rows/s")  # noqa: T201


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
    return _medians(ways)


def _medians(ways: dict[str, Callable[[], Batch]]) -> dict[str, float]:
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(TURNS):
        for way, read in ways.items():
            began = time.process_time()
            read()
            seconds[way].append(time.process_time() - began)
    return {way: statistics.median(spent) for way, spent in seconds.items()}


def _made_up(folder: Path, **sampling: Any) -> Path:
    ask = Sampling(partial_resolution=64, **sampling)
    recipe = SMALL.model_copy(update={"sampling": ask})
    states = np.random.default_rng(0).uniform(0.0, (1.7, 0.3), (2 * BATCH, 2))
    rows = hinged_box([(float(angle), float(slide)) for angle, slide in states], recipe=recipe)
    about = {"category": "box", "split": "train", "recipe": "", "recipe_sha256": "", "seed": 0}
    write_shard(folder / "train-00000.h5", rows, about | {"articugen_version": "0"})
    return folder / "train-00000.h5"


if __name__ == "__main__":
    main()
