"""Data sets from end to end: the same bytes whoever makes them, resumed, planned, refused."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from articugen import articulation
from articugen.errors import ArticugenError, InvalidSource
from articugen.instance import make_instance, prepare
from articugen.journal import JOURNAL_NAME
from articugen.manifest import MANIFEST_NAME, Manifest
from articugen.pipeline import Job, ObjectReport, generate, plan
from articugen.recipe import Articulation, Recipe, Sampling, ViewSettings
from articugen.shards import open_shard
from articugen.sources import registry
from articugen.verify import verify

TINY = Recipe(
    name="tiny",
    articulation=Articulation(states=2, revolute_degrees=(0, 90)),
    views=ViewSettings(count=20, resolution=64),
    sampling=Sampling(
        grids=(8, 16),
        surface_points=256,
        uniform_points=256,
        near_points=256,
        partial_views=1,
        partial_points=64,
        partial_resolution=32,
    ),
    objects=4,
)

BOX = """<robot name="box">
  <link name="base"><visual><geometry><box size="{size} 1 0.2"/></geometry></visual></link>
  <link name="lid"><visual><origin xyz="0.5 0 0.2"/>
    <geometry><box size="1 1 0.1"/></geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="lid"/>
    <origin xyz="-0.5 0 0"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="2" effort="1" velocity="1"/></joint>
</robot>"""

NEVER_MADE = "it has not been made yet"


@pytest.fixture(scope="module", autouse=True)
def own_models(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Procedural models are written to a folder of these tests."""
    root = tmp_path_factory.mktemp("models")
    (root / "procedural").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ARTICUGEN_SOURCES", str(root))
        yield


def job(out: Path, **changes: object) -> Job:
    return replace(Job("procedural", "eyeglasses", TINY, 0, out, 0), **changes)  # type: ignore[arg-type]


def made(job: Job) -> tuple[Manifest, list[ObjectReport]]:
    reports: list[ObjectReport] = []
    return generate(job, reports.append), reports


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but the manifest, which has timings."""
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.name != MANIFEST_NAME}


@pytest.fixture(scope="module")
def whole(own_models: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four eyeglasses, seed 0, made in this process. Look, do not touch."""
    out = tmp_path_factory.mktemp("whole") / "eyeglasses"
    made(job(out))
    return out


@pytest.fixture
def mine(whole: Path, tmp_path: Path) -> Path:
    """A copy of it to do harm to."""
    shutil.copytree(whole, tmp_path / "mine")
    return tmp_path / "mine"


@pytest.fixture
def boxes(tmp_path: Path) -> Path:
    """A folder of plain URDFs: four boxes with lids, of different lengths."""
    folder = tmp_path / "boxes"
    folder.mkdir()
    for k in range(4):
        (folder / f"box{k}.urdf").write_text(BOX.format(size=1 + 0.1 * k))
    return folder


# --- what is made


def test_a_data_set_is_whole_and_holds_what_instance_makes(whole: Path) -> None:
    manifest = Manifest.read(whole)
    assert [s.name for s in manifest.shards] == ["test-00000.h5", *_train(3)]
    assert verify(whole).findings == ()
    ref = registry.object_refs("procedural", "eyeglasses", objects=4)[0]
    obj = articulation.resolve(registry.load(ref), TINY.articulation)
    prepared = prepare(obj, TINY, seed=0)
    entry = next(o for o in manifest.objects if o.key.object_id == ref.object_id)
    with open_shard(whole / entry.shard) as shard:
        assert len(shard) == entry.instances == 3
        for n in range(3):
            stored, fresh = shard.instance(n).arrays(), make_instance(prepared, n).arrays()
            assert stored.keys() == fresh.keys()
            for name, value in fresh.items():
                np.testing.assert_array_equal(stored[name], value, err_msg=name)


def _train(count: int) -> list[str]:
    return [f"train-{n:05d}.h5" for n in range(count)]


def test_two_workers_make_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    manifest, reports = made(job(tmp_path / "two", jobs=2))
    assert manifest.content_sha256 == Manifest.read(whole).content_sha256
    assert contents(tmp_path / "two") == contents(whole)
    assert manifest.timings.workers == 2
    assert sorted(r.object_id for r in reports) == [o.key.object_id for o in by_id(manifest)]


def by_id(manifest: Manifest):
    return sorted(manifest.objects, key=lambda o: o.key.object_id)


def test_another_seed_makes_other_data_of_the_same_objects(whole: Path, tmp_path: Path) -> None:
    first, other = Manifest.read(whole), made(job(tmp_path / "other", seed=1))[0]
    assert [o.key.object_id for o in first.objects] == [o.key.object_id for o in other.objects]
    digests = {o.content_sha256 for m in (first, other) for o in m.objects}
    assert len(digests) == 8


@pytest.mark.parametrize("jobs", [0, 2])
def test_an_interrupted_run_goes_on_to_the_same_bytes(
    whole: Path, tmp_path: Path, jobs: int
) -> None:
    out = tmp_path / "cut"
    cut = job(out, jobs=jobs)
    code = f"""
import os, signal
from pathlib import Path
from articugen.pipeline import Job, generate
from articugen.recipe import Recipe
recipe = Recipe.model_validate_json({TINY.text()!r})
job = Job("procedural", "eyeglasses", recipe, 0, Path({str(out)!r}), {jobs})
def told(report):
    print(report.object_id, flush=True)
    os.killpg(0, signal.SIGINT)  # as Ctrl-C in a terminal: the workers get it too
generate(job, told)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    said = process.communicate(timeout=60)
    first = said[0].split("\n")[0]
    assert first, said
    assert process.returncode != 0
    assert not (out / MANIFEST_NAME).exists()
    assert (out / JOURNAL_NAME).exists()
    assert_nobody_left(process.pid)

    tasks = plan(cut).tasks
    assert {task.why for task in tasks} == {NEVER_MADE}
    left = [task.ref.object_id for task in tasks]
    assert 0 < len(left) < 4
    assert first not in left
    manifest, reports = made(cut)
    assert [r.object_id for r in reports if not r.reused] == left or jobs > 1
    assert {r.object_id for r in reports if not r.reused} == set(left)
    assert manifest.content_sha256 == Manifest.read(whole).content_sha256
    assert contents(out) == contents(whole)


def assert_nobody_left(group: int) -> None:
    """No process of the group is alive a little later."""
    for _ in range(100):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    raise AssertionError("a worker outlives the run")


def test_objects_caps_the_number_and_more_are_added_later(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "growing"
    few = job(out, recipe=TINY.with_counts(objects=2))
    manifest, _ = made(few)
    assert sorted(o.key.split for o in manifest.objects) == ["test", "train"]
    manifest, reports = made(job(out))
    assert sum(r.reused for r in reports) == 2
    assert manifest.content_sha256 == Manifest.read(whole).content_sha256
    assert verify(out).findings == ()


# --- plans


def test_a_plan_writes_nothing_and_says_that_nothing_is_made_yet(tmp_path: Path) -> None:
    found = plan(job(tmp_path / "new"))
    assert [task.why for task in found.tasks] == [NEVER_MADE] * 4
    assert found.instances == 12
    assert found.bytes > 0
    assert found.seconds > 0
    assert found.conflict is None
    assert not (tmp_path / "new").exists()


def test_nothing_is_done_again(whole: Path) -> None:
    before = {p.name: p.stat().st_mtime_ns for p in whole.iterdir()}
    assert plan(job(whole)).tasks == ()
    manifest, reports = made(job(whole))
    assert manifest == Manifest.read(whole)
    assert [r.reused for r in reports] == [True] * 4
    assert {p.name: p.stat().st_mtime_ns for p in whole.iterdir()} == before


def test_the_recipes_name_and_its_limit_of_rejects_change_no_object(whole: Path) -> None:
    other = TINY.model_copy(update={"name": "other", "max_rejected_fraction": 0.5})
    assert plan(job(whole, recipe=other)).tasks == ()


def test_a_changed_recipe_or_seed_is_why_all_are_made_again(mine: Path) -> None:
    more = TINY.model_copy(update={"padding": 0.2})
    found = plan(job(mine, recipe=more))
    assert {task.why for task in found.tasks} == {"the recipe has changed"}
    assert "4 shards of an earlier run will be replaced" in (found.conflict or "")
    found = plan(job(mine, seed=7))
    assert [task.why for task in found.tasks] == ["the seed was 0, is 7"] * 4
    manifest, _ = made(job(mine, seed=7))
    assert manifest.seed == 7
    assert plan(job(mine, seed=7)).tasks == ()
    assert verify(mine).findings == ()


def test_a_missing_or_altered_shard_is_made_again(mine: Path, whole: Path) -> None:
    (mine / "train-00001.h5").unlink()
    damaged = bytearray((mine / "test-00000.h5").read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (mine / "test-00000.h5").write_bytes(damaged)
    found = plan(job(mine))
    assert {task.why for task in found.tasks} == {
        "its shard train-00001.h5 is missing or altered",
        "its shard test-00000.h5 is missing or altered",
    }
    _, reports = made(job(mine))
    assert sum(r.reused for r in reports) == 2
    assert contents(mine) == contents(whole)


def test_a_changed_model_is_made_again_alone(boxes: Path, tmp_path: Path) -> None:
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    made(ours)
    (boxes / "box2.urdf").write_text(BOX.format(size=3))
    found = plan(ours)
    assert [(t.ref.object_id, t.why) for t in found.tasks] == [("box2", "its source has changed")]
    made(ours)
    assert verify(ours.out).findings == ()


# --- what cannot be made


def test_plain_urdfs_are_made_and_a_broken_one_is_told_of(boxes: Path, tmp_path: Path) -> None:
    (boxes / "box3.urdf").write_text(
        BOX.format(size=1).replace('child link="lid"', 'child link="x"')
    )
    (boxes / "still.urdf").write_text(BOX.format(size=1).replace("revolute", "fixed"))
    recipe = TINY.model_copy(update={"objects": None, "max_rejected_fraction": 0.5})
    ours = job(tmp_path / "out", source=str(boxes), category="box", recipe=recipe)
    manifest, reports = made(ours)
    assert {o.key.object_id for o in manifest.objects} == {"box0", "box1", "box2"}
    assert {o.key.split for o in manifest.objects} == {"train", "test"}
    reasons = {r.key.object_id: r.reason for r in manifest.rejected}
    assert set(reasons) == {"box3"}
    assert str(boxes / "box3.urdf") in reasons["box3"]
    assert "'x'" in reasons["box3"]
    (still,) = manifest.skipped
    assert (still.key.object_id, "no joint moves" in still.reason) == ("still", True)
    told = {r.object_id: (r.rejected, r.shard, r.instances) for r in reports if r.rejected}
    assert told == {name: (reason, "", 0) for name, reason in reasons.items()}
    assert verify(ours.out).findings == ()

    before = (ours.out / MANIFEST_NAME).stat().st_mtime_ns
    assert made(ours)[0] == manifest  # what was rejected is not tried again
    assert (ours.out / MANIFEST_NAME).stat().st_mtime_ns == before
    (boxes / "box3.urdf").write_text(BOX.format(size=1.3))
    assert [task.ref.object_id for task in plan(ours).tasks] == ["box3"]
    mended = made(ours)[0]
    assert (mended.rejected, [r.key.object_id for r in mended.skipped]) == ((), ["still"])


def test_too_many_rejects_fail_the_run_and_keep_what_was_made(boxes: Path, tmp_path: Path) -> None:
    (boxes / "box1.urdf").write_text("<robot")
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    with pytest.raises(ArticugenError, match="1 of 4 objects were rejected, more than") as caught:
        made(ours)
    assert str(boxes / "box1.urdf") in str(caught.value)
    assert "\n" not in str(caught.value)
    manifest = Manifest.read(ours.out)
    assert manifest.shortfall in str(caught.value)
    assert len(manifest.objects) == 3
    assert [finding.check for finding in verify(ours.out).findings] == ["incomplete"]
    kept = contents(ours.out)
    with pytest.raises(ArticugenError, match="1 of 4 objects were rejected, more than"):
        made(ours)  # says the same, and does nothing
    assert Manifest.read(ours.out) == manifest
    patient = TINY.model_copy(update={"max_rejected_fraction": 0.25})
    manifest, reports = made(replace(ours, recipe=patient))
    assert [r.reused for r in reports] == [True] * 4
    assert len(manifest.rejected) == 1
    assert manifest.shortfall == ""
    assert verify(ours.out).findings == ()
    assert contents(ours.out) == kept


def test_objects_without_area_are_rejected_and_such_parts_are_empty(
    boxes: Path, tmp_path: Path
) -> None:
    speck = BOX.replace('size="1 1 0.1"', 'size="1e-9 1e-9 1e-9"')
    (boxes / "box0.urdf").write_text(speck.format(size=1))
    (boxes / "box1.urdf").write_text(speck.replace("{size} 1 0.2", "1e-9 1e-9 1e-9"))
    recipe = TINY.model_copy(update={"max_rejected_fraction": 0.25})
    ours = job(tmp_path / "out", source=str(boxes), category="box", recipe=recipe)
    manifest, _ = made(ours)
    assert {r.key.object_id: r.reason for r in manifest.rejected} == {
        "box1": "the object has no faces: those of its links have no area"
    }
    entry = next(o for o in manifest.objects if o.key.object_id == "box0")
    with open_shard(ours.out / entry.shard) as shard:
        assert not shard.instance(1).surface_part.any()


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ArticugenError, match="file/out") as caught:
        made(job(tmp_path / "file" / "out"))
    assert "\n" not in str(caught.value)
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    with pytest.raises(ArticugenError, match="cannot be written to; change its permissions"):
        made(job(tmp_path / "locked" / "out"))


def test_files_that_are_not_ours_are_left_alone(boxes: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "train-00000.h5").write_text("someone else's")
    with pytest.raises(ArticugenError, match="was not made by an earlier run here"):
        made(job(out, source=str(boxes), category="box"))
    assert (out / "train-00000.h5").read_text() == "someone else's"


def test_unknown_sources_and_categories_name_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InvalidSource, match="did you mean 'procedural'"):
        plan(job(tmp_path, source="procedurl"))
    with pytest.raises(InvalidSource, match="did you mean 'eyeglasses'"):
        plan(job(tmp_path, category="eyeglass"))
