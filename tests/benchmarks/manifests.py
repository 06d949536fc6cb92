"""What very many objects cost: python -m tests.benchmarks.manifests [--objects 1000000] [FOLDER]

Prints seconds of CPU, the memory held and the most that was taken, of writing, reading and opening
a manifest, of planning a share of a thousand, and of all records: each in a process of its own.
Objects are made up, 101 instances each; shards are there only where something looks at them.
"""

import argparse
import hashlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from articugen.core.ledger import Ledger
from articugen.core.place import Folder
from articugen.core.recipe import load_recipe
from articugen.pipeline.common import record_in, shard_names
from articugen.pipeline.job import Job, Share
from articugen.pipeline.plan import name_of_ref, objects_of
from articugen.pipeline.records import Records
from articugen.pipeline.run import common_plan, started
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source
from articugen.store.dataset import open as open_data_set
from articugen.store.manifest import Manifest, Timings
from articugen.store.outcome import Key, ObjectEntry, Outcome, ShardEntry

RANKS = 1000
CONTENT = b"a shard" * 100
CONTENT_SHA256 = hashlib.sha256(CONTENT).hexdigest()
"""Of all shards that are there."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.manifests")
    parser.add_argument("--objects", type=int, default=100_000)
    parser.add_argument("--step", choices=STEPS, help="of these alone, in this process")
    parser.add_argument("folder", nargs="?", type=Path)
    asked = parser.parse_args()
    if asked.step:
        print(STEPS[asked.step](asked.folder, asked.objects))  # noqa: T201
        return
    with tempfile.TemporaryDirectory(dir=asked.folder) as folder:
        for step in STEPS:
            command = [sys.executable, "-m", "tests.benchmarks.manifests", "--step", step]
            subprocess.run([*command, "--objects", str(asked.objects), folder], check=True)


def job(folder: Path, objects: int) -> Job:
    recipe = load_recipe("quick", "laptop").with_options(objects=objects, states=100)
    clips = open_source("procedural").clips
    recipe = recipe.for_source(clips_to_limits=clips)
    return Job("procedural", "laptop", recipe, 0, folder, 1)


def outcomes(job: Job, refs: Sequence[ObjectRef]) -> Iterator[Outcome]:
    """As if all had been made."""
    recipe_sha256, generator = (
        job.recipe.for_one_object().sha256(),
        refs[0].generator_by(job.recipe.text()),
    )
    for (split, object_id), shard in shard_names(map(name_of_ref, refs)).items():
        key = Key(
            split=split, object_id=object_id, ref=f"procedural/{object_id}", seed=job.seed,
            recipe_sha256=recipe_sha256, generator=generator,
        )  # fmt: skip
        content = hashlib.sha256(shard.encode()).hexdigest()
        made = ObjectEntry(
            key=key, input_sha256=content, shard=shard, instances=101, content_sha256=content,
            seconds=7.123456789,
        )  # fmt: skip
        entry = ShardEntry(name=shard, sha256=CONTENT_SHA256, bytes=len(CONTENT), instances=101)
        yield Outcome(made=made, shard=entry)


class Clock:
    """Tells of each thing that was done, once it was."""

    def __init__(self) -> None:
        self._said, self._last = list[str](), time.process_time()

    def __call__(self, what: str) -> None:
        now, self._last = self._last, time.process_time()
        held = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        line = f"{what:44} {self._last - now:7.1f} s {held / 1e9:6.2f} GB, peak {peak / 1e9:.2f}"
        self._said.append(line)

    def __str__(self) -> str:
        return "\n".join(self._said)


def write(folder: Path, objects: int) -> Clock:
    mine, tell = job(folder / "data", objects), Clock()
    refs = objects_of(mine, open_source(mine.source))
    tell("list the objects")
    done = list(outcomes(mine, refs))
    tell("(make up what became of them)")
    timings = Timings(seconds=1.0, instances_per_second=1.0, peak_memory_bytes=1, workers=1)
    manifest = Manifest.of(
        done, category=mine.category, source=mine.source, licence="MIT",
        recipe=mine.recipe.text(), seed=mine.seed, timings=timings,
    )  # fmt: skip
    tell("Manifest.of")
    mine.folder.mkdir()
    manifest.write(mine.folder)
    tell("Manifest.write")
    return tell


def read(folder: Path, objects: int) -> Clock:
    tell = Clock()
    manifest = Manifest.read(folder / "data")
    tell("Manifest.read")
    assert len(manifest.objects) == objects
    return tell


def opened(folder: Path, objects: int) -> Clock:
    tell = Clock()
    data = open_data_set(folder / "data")
    tell(f"ag.open, {len(data):,} instances")
    train = data.split("train")
    tell("data.split")
    assert len(train.objects) + len(data.split("test").objects) == objects
    tell("objects of both splits")
    return tell


def records(folder: Path, objects: int) -> Clock:
    """Of shares that have made everything, and the shards that two others look at."""
    mine, tell = job(folder / "ranks", objects), Clock()
    refs = objects_of(mine, open_source(mine.source))
    ledger = Ledger(Folder(mine.folder))
    share = replace(mine, share=Share(0, RANKS))
    ledger.agree(common_plan(share, refs, "").model_dump_json().encode())
    every = list(outcomes(mine, refs))
    for outcome in every:
        record_in(ledger, outcome)
    for outcome in (*every[7::RANKS], *every[7 :: RANKS - 1]):
        assert outcome.shard
        (mine.folder / outcome.shard.name).write_bytes(CONTENT)
    tell("record all objects")
    return tell


def plan_all(folder: Path, objects: int) -> Clock:
    """In an empty folder."""
    mine, tell = job(folder / "empty", objects), Clock()
    with started(mine) as run:
        assert len(run.plan.tasks) == objects
    tell("plan all in an empty folder")
    return tell


def plan_rank(folder: Path, objects: int, of: int = RANKS) -> Clock:
    mine, tell = job(folder / "ranks", objects), Clock()
    with started(replace(mine, share=Share(7, of))) as run:
        assert not run.plan.tasks
    tell(f"rank 7/{of} plans")
    return tell


def plain(folder: Path, objects: int) -> Clock:
    """What one process reads that is to make all of it."""
    tell = Clock()
    with Records(Folder(folder / "ranks")) as read:
        assert len(read.outcomes) == objects
    tell("read all records")
    return tell


STEPS: dict[str, Callable[[Path, int], Clock]] = {
    "write": write,
    "read": read,
    "open": opened,
    "plan all": plan_all,
    "records": records,
    "plan": plan_rank,
    "plan otherwise": partial(plan_rank, of=RANKS - 1),
    "plain": plain,
}


if __name__ == "__main__":
    main()
