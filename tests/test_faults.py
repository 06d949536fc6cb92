"""What is no fault of an object: disks, limits and processes that fail while a data set is made."""

import errno
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import test_pipeline
from python_process import NO_BYTECODE, ended
from test_pipeline import BOX, TINY, broken, contents, job, made, planned
from test_workers import alive, children
from trouble import obeying_permissions, small_disk

from articugen.core.errors import ArticugenError, InvalidSource, MachineFault
from articugen.pipeline import door
from articugen.pipeline.executors.local import Local
from articugen.pipeline.folder import is_temporary
from articugen.pipeline.options import ObjectReport
from articugen.pipeline.run import started
from articugen.sources import readers
from articugen.sources.fetch.target import LIST_NAME
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.verify.dataset import verify

whole, mine, boxes = test_pipeline.whole, test_pipeline.mine, test_pipeline.boxes


def test_a_fault_of_ours_ends_no_run_and_is_tried_again(boxes, tmp_path, monkeypatch):
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    with monkeypatch.context() as patch:
        broken(patch, "box1", ZeroDivisionError("by\nnought"))
        for _ in range(2):
            with pytest.raises(ArticugenError, match="1 of 4 objects failed through no fault"):
                made(ours)
            manifest = Manifest.read(ours.out)
            assert len(manifest.objects) == 3
            assert manifest.rejected == ()
            assert [f.sentence for f in manifest.failed] == [
                "box1: internal error, please report it: ZeroDivisionError: by nought"
            ]
            assert "tried again" in str(verify(ours.out).findings[0])
            found = planned(ours)
            assert [t.ref.object_id for t in found.tasks] == ["box1"]
            assert found.conflict is None  # --replace is not asked for
    manifest, reports = made(ours)
    assert sum(r.reused for r in reports) == 3
    assert (len(manifest.objects), manifest.failed, manifest.shortfall) == (4, (), None)
    assert verify(ours.out).findings == ()


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EIO, "it is broken"),
        OSError(errno.EMFILE, "too many"),
        OSError(errno.ENOTCONN, "no mount"),
        MemoryError(),
    ],
)
def test_what_a_reader_says_over_a_fault_of_the_machine_is_no_verdict(
    boxes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    read = readers.load

    def load(ref, **options):
        if ref.object_id == "box2":
            try:
                raise error
            except (OSError, MemoryError):
                raise InvalidSource("box2: cannot be read") from None
        return read(ref, **options)

    monkeypatch.setattr(readers, "load", load)
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    if isinstance(error, OSError):
        with pytest.raises(
            MachineFault, match=r"^(it is broken|no mount); the disk|^too many; raise"
        ):
            made(ours)
        return
    with pytest.raises(ArticugenError, match="box2: its worker ran out of memory"):
        made(ours)
    manifest = Manifest.read(ours.out)
    assert (len(manifest.objects), manifest.rejected, len(manifest.failed)) == (3, (), 1)


def test_a_fault_while_a_finished_shard_is_compared_leaves_it(mine, monkeypatch):
    """Too many files are open for a moment: nobody knows whether it is whole."""
    shard, opened = mine / "train-00000.h5", os.open
    with h5py.File(shard, "r+") as file:
        file.create_group("user")  # so that its digest is another
    before = shard.read_bytes()

    def full(path, *more, **how):
        if str(path).endswith(shard.name):
            raise OSError(errno.EMFILE, "too many", str(path))
        return opened(path, *more, **how)

    monkeypatch.setattr(os, "open", full)
    with pytest.raises(MachineFault, match="raise the limit of open files"), started(job(mine)):
        pass
    assert shard.read_bytes() == before


def test_who_began_before_the_folder_was_there_takes_nothing_of_another_run(whole, tmp_path):
    ours = job(tmp_path / "out", seed=1)
    with started(ours) as run:
        shutil.copytree(whole, tmp_path / "out")
        with pytest.raises(ArticugenError, match="another run was here meanwhile; run it again"):
            run.finish(ours.executor.of(ours, ""))
    assert contents(tmp_path / "out") == contents(whole)
    assert (tmp_path / "out" / MANIFEST_NAME).is_file()


def test_shards_without_a_manifest_are_none_to_write_over(mine, whole):
    (mine / MANIFEST_NAME).unlink()
    with pytest.raises(ArticugenError, match="was not made by an earlier run here; move it away"):
        made(job(mine))
    assert contents(mine) == contents(whole)


def test_models_that_were_fetched_are_no_data_set(tmp_path):
    (tmp_path / LIST_NAME).write_text("{}")
    with pytest.raises(ArticugenError, match="models were fetched into it; choose another"):
        made(job(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == [LIST_NAME]


def test_files_that_vanish_meanwhile_are_no_objects_fault(boxes: Path, tmp_path: Path) -> None:
    """As of a disk that is pulled out: nothing is rejected, and all is made once it is back."""
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    away = boxes.with_name("away")

    def pull_out(_: ObjectReport) -> None:
        if boxes.exists():
            boxes.rename(away)

    with pytest.raises(ArticugenError, match=r"3 of 4 objects failed .*, or are gone, since"):
        door.make(ours, on_object=pull_out)
    manifest = Manifest.read(ours.out)
    assert (len(manifest.objects), len(manifest.failed), manifest.rejected) == (1, 3, ())
    away.rename(boxes)
    manifest, reports = made(ours)
    assert (sum(r.reused for r in reports), len(manifest.objects)) == (1, 4)
    assert manifest.content_sha256 == made(replace(ours, out=tmp_path / "b"))[0].content_sha256


def test_what_changes_meanwhile_is_not_taken_for_what_was_planned(boxes, tmp_path):
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    before = {path: path.read_text() for path in boxes.iterdir()}

    def change(_: ObjectReport) -> None:
        (boxes / "box1.urdf").write_text(BOX.format(size=3))
        (boxes / "box2.urdf").write_text("<robot")

    with pytest.raises(ArticugenError, match="failed through no fault of theirs"):
        door.make(ours, on_object=change)
    failed = {each.key.object_id for each in Manifest.read(ours.out).failed}
    assert failed <= {"box1", "box2"}
    assert failed
    for path, text in before.items():
        path.write_text(text)
    manifest, _ = made(ours)
    assert manifest.content_sha256 == made(replace(ours, out=tmp_path / "b"))[0].content_sha256


def test_an_array_over_the_recipes_memory_is_the_objects_fault(boxes, tmp_path, monkeypatch):
    with pytest.raises(MemoryError) as caught:
        np.zeros(2**55, np.uint8)
    broken(monkeypatch, "box0", caught.value)
    recipe = TINY.model_copy(update={"max_rejected_fraction": 0.25})
    manifest, _ = made(job(tmp_path / "out", source=str(boxes), category="box", recipe=recipe))
    assert [r.over for r in manifest.rejected] == [("memory_per_object_mb", 4096.0)]
    assert "raise the recipe's memory_per_object_mb" in manifest.rejected[0].reason


FULL = """
import resource, sys
from pathlib import Path
from articugen.pipeline import door as api
from articugen.pipeline.job import Job
from articugen.core.recipe import Recipe
{before}
recipe = Recipe.model_validate_json({recipe!r})
api.make(Job("procedural", "eyeglasses", recipe, 0, Path({out!r}), {jobs}))
"""


def made_under(
    before: str, out: Path, jobs: int, *, begin: Sequence[str] = (), **environment: str
) -> str:
    """The last line that a run of its own says on stderr, under limits that `before` sets, or the
    `begin` of its command."""
    code = FULL.format(before=before, recipe=TINY.text(), out=str(out), jobs=jobs)
    done = ended("-c", code, seconds=60, begin=begin, **NO_BYTECODE | environment)
    return done.stderr.strip().split("\n")[-1]


def test_too_small_a_limit_of_files_stops_the_run_and_rejects_nothing(whole, tmp_path):
    out = tmp_path / "out"
    small = "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000,) * 2)"
    for jobs in (1, 0):  # shards over 20 kB cannot be written
        said = made_under(small, out, jobs)
        assert "articugen.core.errors.MachineFault: " in said
        assert "File too large" in said or "files may not grow so large" in said
        assert "finished objects are kept, the same command goes on after them" in said
    made(job(out))
    assert contents(out) == contents(whole)


def test_too_little_memory_rejects_nothing(whole: Path, tmp_path: Path) -> None:
    little = "resource.setrlimit(resource.RLIMIT_AS, (700_000_000,) * 2)"
    # Each thread of OpenBLAS takes some of it; where it is just too little, it tries for ever.
    said = made_under(little, tmp_path / "out", 1, OMP_NUM_THREADS="2")
    assert "MachineFault: " in said or "failed through no fault of theirs" in said
    made(job(tmp_path / "out"))
    assert contents(tmp_path / "out") == contents(whole)


def test_what_a_run_needs_is_compared_with_what_is_free(whole: Path, tmp_path: Path) -> None:
    """Far too little is refused before anything is written, too little told of; where the disk is
    full in the middle, both numbers are told, what is made is kept, and nothing half written."""
    more = dict.fromkeys(("surface_points", "uniform_points", "near_points"), 2560)
    many = TINY.with_options(objects=6, states=6)
    many = many.model_copy(update={"sampling": TINY.sampling.model_copy(update=more)})
    with small_disk(tmp_path / "disk", "200k") as disk:
        ours = job(disk / "out", recipe=many, jobs=2)
        both = r"about \d+\.\d MB on the disk, 0\.\d MB are free"
        with started(ours) as run, pytest.raises(MachineFault, match=both):
            run.finish(Local(0))
        assert not (disk / "out").exists()
    with small_disk(tmp_path / "larger", "1m") as disk:
        ours, told = replace(ours, out=disk / "out"), list[str]()
        with started(ours) as run:
            assert 1 << 20 < run.plan.bytes < 4 << 20
            both = r"the disk is full .* takes about \d\.\d MB, 0\.\d MB are free; finished objects"
            with pytest.raises(MachineFault, match=both):
                run.finish(Local(2), on_notice=told.append)
        assert "MB are free; free some space, choose another folder, or ask for fewer" in told[0]
        assert [p.name for p in (disk / "out").iterdir() if is_temporary(p.name)] == []
        subprocess.run(["mount", "-o", "remount,size=9m", str(disk)], check=True)
        with started(ours) as run:
            assert 0 < len(run.plan.done) < 6
            assert run.finish(Local(0)).manifest.shortfall is None
        assert verify(disk / "out").ok


def test_an_object_over_its_time_is_rejected_until_it_may_take_more(tmp_path: Path) -> None:
    long = TINY.with_options(objects=1, states=60).model_copy(update={"max_rejected_fraction": 1.0})
    hasty = job(
        tmp_path / "out", recipe=long.model_copy(update={"seconds_per_object": 1e-3}), jobs=1
    )
    with pytest.raises(ArticugenError, match="no object is left: 0 skipped, 1 rejected"):
        made(hasty)
    (rejected,) = Manifest.read(hasty.out).rejected
    assert rejected.over == ("seconds_per_object", 1e-3)
    assert "it takes too many seconds; raise the recipe's seconds_per_object" in rejected.reason
    assert planned(hasty).tasks == ()
    patient = replace(hasty, recipe=long, jobs=0)
    assert [task.why for task in planned(patient).tasks] == ["the recipe now allows it more"]
    assert len(made(patient)[0].objects) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_workers_of_a_killed_run_are_gone_before_the_next_begins(whole, tmp_path):
    out = tmp_path / "out"
    code = FULL.format(before="", recipe=TINY.text(), out=str(out), jobs=2)
    parent = subprocess.Popen([sys.executable, "-c", code])
    workers = children(parent.pid, 2)
    while not list(out.glob("*.h5")):
        assert parent.poll() is None
        time.sleep(0.01)
    parent.kill()
    parent.wait()
    inodes: dict[str, int] = {}

    def unchanged(report: ObjectReport) -> None:
        assert not any(map(alive, workers)), "an old worker lives on in a new run"
        if report.shard:
            inodes[report.shard] = (out / report.shard).stat().st_ino

    door.make(job(out), on_object=unchanged)  # at once: its lock waits for the last of them
    assert inodes == {p.name: p.stat().st_ino for p in out.glob("*.h5")}  # nobody overwrote one
    assert contents(out) == contents(whole)


def test_a_folder_without_permission_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    said = made_under("", tmp_path / "locked" / "out", 0, begin=obeying_permissions())
    assert "MachineFault: " in said
    assert "locked/out: not written: the folder cannot be written to; change its perm" in said
