"""Data sets with one thing wrong: `verify` must find it and name the file, `repair` undo it.

`python -m tests.chaos.corruptions` tries 500, each by a seed of its own.
"""

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from articugen.core.recipe import Recipe
from articugen.core.schema import CHECKED_ATTRIBUTES
from articugen.pipeline import door
from articugen.pipeline.job import Job
from articugen.store import croissant
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.verify.dataset import Report, verify
from articugen.verify.repair import repair

Rng = np.random.Generator
Corruption = Callable[[Path, Path, Rng], set[str]]
"""Does one thing to a folder, with another run's beside it; the files that are harmed."""

TRIALS, QUICK = 500, 40

RECIPE = Recipe.model_validate(
    {
        "name": "tiny",
        "objects": 3,
        "articulation": {"states": 1},
        "views": {"count": 20, "resolution": 64},
        "sampling": {"grids": [8], "surface_points": 256, "uniform_points": 256,
                     "near_points": 256, "partial_points": 64, "partial_resolution": 32},
    }
)  # fmt: skip


# --- bytes of any file


def bit_flipped(path: Path, rng: Rng) -> None:
    _flip(path, int(rng.integers(path.stat().st_size)), rng)


def _flip(path: Path, place: int, rng: Rng) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def cut_short(path: Path, rng: Rng) -> None:
    with path.open("r+b") as file:
        file.truncate(int(rng.integers(path.stat().st_size)))


def sector_lost(path: Path, rng: Rng) -> None:
    """Zeros where 512 bytes were, as a disk gives for what it cannot read."""
    data = bytearray(path.read_bytes())
    at = 512 * int(rng.integers(len(data) // 512))
    data[at : at + 512] = b"\0" * 512 if any(data[at : at + 512]) else b"\1" * 512
    path.write_bytes(data)


def lengthened(path: Path, rng: Rng) -> None:
    with path.open("ab") as file:
        file.write(rng.bytes(int(rng.integers(1, 2000))))


def deleted(path: Path, _: Rng) -> None:
    path.unlink()


# --- shards


def _shards(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.h5"))


def _a_shard(folder: Path, rng: Rng) -> Path:
    return _shards(folder)[int(rng.integers(len(_shards(folder))))]


def to_a_shard(do: Callable[[Path, Rng], None]) -> Corruption:
    def corrupt(folder: Path, _: Path, rng: Rng) -> set[str]:
        path = _a_shard(folder, rng)
        do(path, rng)
        return {path.name}

    return corrupt


def bit_of_an_index_flipped(path: Path, rng: Rng) -> None:
    """Outside of all chunks: names, shapes, attributes, trees, and bytes that nobody reads."""
    held = np.zeros(path.stat().st_size, bool)
    with h5py.File(path) as file:
        for dataset in file.values():

            def note(chunk: Any) -> None:
                held[chunk.byte_offset : chunk.byte_offset + chunk.size] = True

            dataset.id.chunk_iter(note)
    _flip(path, int(rng.choice(np.flatnonzero(~held))), rng)


def number_edited(path: Path, rng: Rng) -> None:
    """By HDF5 itself, so that all checksums in the file are right."""
    with h5py.File(path, "r+") as file:
        names = [n for n, d in file.items() if d.dtype.kind in "ui" and d.size]
        dataset = file[names[int(rng.integers(len(names)))]]
        place = tuple(int(rng.integers(size)) for size in dataset.shape)
        dataset[place] = dataset[place] ^ 1


def attribute_edited(path: Path, rng: Rng) -> None:
    with h5py.File(path, "r+") as file:
        known = json.loads(file.attrs[CHECKED_ATTRIBUTES])
        name = sorted(known)[int(rng.integers(len(known)))]
        set_attributes(file, **{name: known[name] + ("x" if isinstance(known[name], str) else 1)})


def set_attributes(file: h5py.File, **values: Any) -> None:
    """Give a shard other values of its attributes, stored as its writer stores them."""
    known = json.loads(file.attrs[CHECKED_ATTRIBUTES]) | values
    text = json.dumps(known, ensure_ascii=False, sort_keys=True).encode()
    fixed = h5py.string_dtype("utf-8", len(text))
    file.attrs.create(CHECKED_ATTRIBUTES, np.array(text, fixed), dtype=fixed)


def swapped(folder: Path, _: Path, rng: Rng) -> set[str]:
    a, b = (_shards(folder)[int(i)] for i in rng.choice(len(_shards(folder)), 2, replace=False))
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)
    return {a.name, b.name}


def another_twice(folder: Path, _: Path, rng: Rng) -> set[str]:
    a, b = (_shards(folder)[int(i)] for i in rng.choice(len(_shards(folder)), 2, replace=False))
    shutil.copyfile(a, b)
    return {b.name}


def of_another_run(folder: Path, other: Path, rng: Rng) -> set[str]:
    path = _a_shard(folder, rng)
    shutil.copyfile(other / path.name, path)
    return {path.name}


# --- what tells of them


def to_the(name: str, do: Callable[[Path, Rng], None]) -> Corruption:
    def corrupt(folder: Path, _: Path, rng: Rng) -> set[str]:
        do(folder / name, rng)
        return {name}

    return corrupt


def leaf_edited(path: Path, rng: Rng) -> None:
    """One value of a JSON file is another one."""
    told = json.loads(path.read_text())
    ways = list(leaves(told))
    *way, last = ways[int(rng.integers(len(ways)))]
    where = reduce(getitem, way, told)
    value = where[last]
    if value is None:
        where[last] = "x"
    else:
        where[last] = (
            value[:-1] + chr(ord(value[-1:] or "a") ^ 1) if isinstance(value, str) else value + 1
        )
    path.write_text(json.dumps(told, indent=1) + "\n")


def leaves(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Find the path of every leaf of plain JSON."""
    if isinstance(value, dict | list):
        inner = value.items() if isinstance(value, dict) else enumerate(value)
        for name, item in inner:
            yield from leaves(item, (*way, name))
    else:
        yield way


def entry_left_out(path: Path, rng: Rng) -> None:
    told = json.loads(path.read_text())
    entries = told[("objects", "shards")[int(rng.integers(2))]]
    del entries[int(rng.integers(len(entries)))]
    path.write_text(json.dumps(told, indent=1) + "\n")


def manifest_of_another_run(folder: Path, other: Path, _: Rng) -> set[str]:
    shutil.copyfile(other / MANIFEST_NAME, folder / MANIFEST_NAME)
    return {path.name for path in _shards(folder)}


DATA: dict[str, Corruption] = {
    "bit of a shard flipped": to_a_shard(bit_flipped),
    "bit of a shard's index flipped": to_a_shard(bit_of_an_index_flipped),
    "sector of a shard lost": to_a_shard(sector_lost),
    "shard cut short": to_a_shard(cut_short),
    "shard lengthened": to_a_shard(lengthened),
    "shard deleted": to_a_shard(deleted),
    "number in a shard edited": to_a_shard(number_edited),
    "attribute of a shard edited": to_a_shard(attribute_edited),
    "two shards swapped": swapped,
    "shard copied over another": another_twice,
    "shard of another run": of_another_run,
}
METADATA: dict[str, Corruption] = {
    "bit of the manifest flipped": to_the(MANIFEST_NAME, bit_flipped),
    "manifest cut short": to_the(MANIFEST_NAME, cut_short),
    "manifest deleted": to_the(MANIFEST_NAME, deleted),
    "value in the manifest edited": to_the(MANIFEST_NAME, leaf_edited),
    "entry of the manifest left out": to_the(MANIFEST_NAME, entry_left_out),
    "manifest of another run": manifest_of_another_run,
    "bit of croissant.json flipped": to_the(croissant.NAME, bit_flipped),
    "croissant.json cut short": to_the(croissant.NAME, cut_short),
    "value in croissant.json edited": to_the(croissant.NAME, leaf_edited),
}
CORRUPTIONS = DATA | METADATA


@dataclass(frozen=True)
class Trial:
    """One corruption: what it did to which files, what was found, and what a repair left.

    Attributes:
        same: whether the content hash is what it was, and nothing is found any more; None where no
            repair was tried.
    """

    fault: str
    number: int
    harmed: set[str]
    report: Report
    same: bool | None

    @property
    def found(self) -> bool:
        """Whether each file that was harmed is named."""
        said = [str(finding) for finding in self.report.findings]
        return all(any(name in sentence for sentence in said) for name in self.harmed)


def trials(work: Path, count: int, *, repaired: int) -> Iterator[Trial]:
    """`count` corruptions in turn of a small real data set, which is made in `work`; the first
    `repaired` of them are repaired."""
    sound, other = (_made(work / f"seed-{seed}", seed) for seed in (0, 1))
    assert verify(sound).ok
    content = Manifest.read(sound).content_sha256
    names = list(CORRUPTIONS)
    for number in range(count):
        fault = names[number % len(names)]
        folder = Path(shutil.copytree(sound, work / f"trial-{number}"))
        harmed = CORRUPTIONS[fault](folder, other, np.random.default_rng(number))
        report = verify(folder)
        same = _mended(folder, report) == content if number < repaired else None
        yield Trial(fault, number, harmed, report, same)
        shutil.rmtree(folder)


def _made(folder: Path, seed: int) -> Path:
    door.make(Job("procedural", "eyeglasses", RECIPE, seed, folder, 0))
    return folder


def _mended(folder: Path, report: Report) -> str | None:
    """The content hash of a data set that is whole again once it was repaired, or None."""
    done = tuple(repair(folder, report, jobs=0))
    if [(each.name, each.ok) for each in done] == [(MANIFEST_NAME, False)]:  # follow its advice
        assert "delete it and repair again" in done[0].done
        (folder / MANIFEST_NAME).unlink()
        tuple(repair(folder, verify(folder), jobs=0))
    return Manifest.read(folder).content_sha256 if verify(folder).ok else None


Row = tuple[str, int, int, int]


def rows(quick: bool) -> list[Row]:
    """(fault, times tried, times found and named, times repaired to the same content hash)."""
    count = QUICK if quick else TRIALS
    with tempfile.TemporaryDirectory() as work:
        tried = list(trials(Path(work), count, repaired=count))
    faults = {fault: [t for t in tried if t.fault == fault] for fault in CORRUPTIONS}
    return [
        (fault, len(some), sum(t.found for t in some), sum(t.same is True for t in some))
        for fault, some in faults.items()
    ]


def main() -> str | None:
    parser = argparse.ArgumentParser(prog="python -m tests.chaos.corruptions", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"try {QUICK} of the {TRIALS}")
    table = rows(parser.parse_args().quick)
    sys.stdout.write("| corruption | tried | found and named | repaired, hash equal |\n")
    sys.stdout.write("|---|---|---|---|\n")
    total = ("all", *(sum(numbers) for numbers in list(zip(*table, strict=True))[1:]))
    for row in [*table, total]:
        sys.stdout.write(f"| {' | '.join(map(str, row))} |\n")
    return None if len({*total[1:]}) == 1 else "not all were found and repaired"


if __name__ == "__main__":
    sys.exit(main())
