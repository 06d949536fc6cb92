"""Data sets from end to end: the same bytes whoever makes them, resumed, planned, refused."""

import errno
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from instances import assert_same
from python_process import printed
from trouble import small_disk

import articugen
from articugen.core import content
from articugen.core.errors import (
    ArticugenError,
    InvalidRecipe,
    MachineFault,
    NotOfCategory,
)
from articugen.core.ledger import LEDGER
from articugen.core.recipe import Articulation, Recipe, Sampling, ViewSettings, load_recipe
from articugen.instance import articulation
from articugen.instance.make import make_instance
from articugen.instance.preparing import prepare
from articugen.meshes import read as meshes
from articugen.pipeline import door
from articugen.pipeline.job import Job
from articugen.pipeline.options import ObjectReport
from articugen.pipeline.plan import Plan
from articugen.pipeline.run import started
from articugen.sources import readers
from articugen.sources.source import open_source
from articugen.store import manifest as manifest_module
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.provenance import code_version
from articugen.store.shards import open_shard
from articugen.verify.dataset import verify

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

PACKAGE = Path(articugen.__file__).parent

NEVER_MADE = "it has not been made yet"


def job(out: Path, **changes: object) -> Job:
    return replace(Job("procedural", "eyeglasses", TINY, 0, out, 0), **changes)  # type: ignore[arg-type]


def made(job: Job) -> tuple[Manifest, list[ObjectReport]]:
    reports: list[ObjectReport] = []
    return door.make(job, replace=True, on_object=reports.append), reports


def planned(job: Job) -> Plan:
    with started(job) as run:
        return run.plan


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but the manifest, which has timings."""
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.name != MANIFEST_NAME}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def broken(monkeypatch: pytest.MonkeyPatch, object_id: str, error: Exception) -> None:
    """Have the resolving of one object raise `error`."""
    resolve = articulation.resolve

    def resolved(obj, *given, **settings):
        if obj.object_id == object_id:
            raise error
        return resolve(obj, *given, **settings)

    monkeypatch.setattr(articulation, "resolve", resolved)


def test_a_data_set_is_whole_and_holds_what_instance_makes(whole: Path) -> None:
    manifest = Manifest.read(whole)
    assert [s.name for s in manifest.shards] == ["test-00000.h5", *_train(3)]
    assert verify(whole).findings == ()
    ref = open_source("procedural").objects("eyeglasses", objects=4)[0]
    obj = articulation.resolve(readers.load(ref), TINY.articulation)
    prepared = prepare(obj, TINY, seed=0)
    entry = next(o for o in manifest.objects if o.key.object_id == ref.object_id)
    with open_shard(whole / entry.shard) as shard:
        assert len(shard) == entry.instances == 3
        for n in range(3):
            assert_same(shard.instance(n), make_instance(prepared, n))


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
def test_an_interrupted_run_goes_on_to_the_same_bytes(whole, tmp_path, jobs):
    out = tmp_path / "cut"
    cut = job(out, jobs=jobs)
    code = f"""
import os, signal
from pathlib import Path
from articugen.pipeline import door as api
from articugen.pipeline.job import Job
from articugen.core.recipe import Recipe
# A shell that runs the tests in the background has its children ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)
recipe = Recipe.model_validate_json({TINY.text()!r})
job = Job("procedural", "eyeglasses", recipe, 0, Path({str(out)!r}), {jobs})
def told(report):
    print(report.object_id, flush=True)
    os.killpg(0, signal.SIGINT)  # as Ctrl-C in a terminal: the workers get it too
api.make(job, on_object=told)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    said = process.communicate(timeout=240)  # patience: other work on the machine is no hang
    first = said[0].split("\n")[0]
    assert first, said
    assert process.returncode != 0
    assert not (out / MANIFEST_NAME).exists()
    assert (out / LEDGER).exists()
    assert_nobody_left(process.pid)

    tasks = planned(cut).tasks
    assert {task.why for task in tasks} == {NEVER_MADE}
    left = [task.ref.object_id for task in tasks]
    assert 0 < len(left) < 4
    assert first not in left
    manifest, reports = made(job(out))  # without workers; with two in test_chaos.py
    assert [r.object_id for r in reports if not r.reused] == left
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
    few = job(out, recipe=TINY.with_options(objects=2))
    manifest, _ = made(few)
    assert sorted(o.key.split for o in manifest.objects) == ["test", "train"]
    manifest, reports = made(job(out))
    assert sum(r.reused for r in reports) == 2
    assert manifest.content_sha256 == Manifest.read(whole).content_sha256
    assert verify(out).findings == ()


def test_a_plan_writes_nothing_and_says_that_nothing_is_made_yet(tmp_path: Path) -> None:
    found = planned(job(tmp_path / "new"))
    assert [task.why for task in found.tasks] == [NEVER_MADE] * 4
    assert found.instances == 12
    assert found.bytes > 0
    assert found.seconds > 0
    assert found.conflict is None
    assert not (tmp_path / "new").exists()


def test_nothing_is_done_again(whole: Path) -> None:
    before = {p.name: p.stat().st_mtime_ns for p in whole.iterdir()}
    assert planned(job(whole)).tasks == ()
    manifest, reports = made(job(whole))
    assert manifest == Manifest.read(whole)
    assert [r.reused for r in reports] == [True] * 4
    assert {p.name: p.stat().st_mtime_ns for p in whole.iterdir()} == before


def test_the_recipes_name_and_its_limit_of_rejects_change_no_object(whole: Path) -> None:
    other = TINY.model_copy(update={"name": "other", "max_rejected_fraction": 0.5})
    assert planned(job(whole, recipe=other)).tasks == ()


def test_a_changed_recipe_or_seed_is_why_all_are_made_again(mine: Path) -> None:
    more = TINY.model_copy(update={"padding": 0.2})
    found = planned(job(mine, recipe=more))
    assert {task.why for task in found.tasks} == {"the recipe has changed"}
    assert "4 shards of an earlier run will be replaced" in (found.conflict or "")
    found = planned(job(mine, seed=7))
    assert [task.why for task in found.tasks] == ["the seed was 0, is 7"] * 4
    manifest, _ = made(job(mine, seed=7))
    assert manifest.seed == 7
    assert planned(job(mine, seed=7)).tasks == ()
    assert verify(mine).findings == ()


PLANNED = """
from pathlib import Path
from articugen.pipeline.job import Job
from articugen.pipeline.run import started
from articugen.core.recipe import Recipe
from articugen.store.provenance import code_version
recipe = Recipe.model_validate_json({recipe!r})
with started(Job("procedural", "eyeglasses", recipe, 0, Path({out!r}), 0)) as run:
    found = run.plan
print(code_version(), len(found.done), len(found.tasks))
"""


def test_comments_and_new_files_make_no_data_stale(whole: Path, tmp_path: Path) -> None:
    copied = tmp_path / "articugen"
    shutil.copytree(PACKAGE, copied, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("recipes", "urdf_sources"):
        (tmp_path / name).symlink_to(PACKAGE.parent / name)
    with (copied / "fusion" / "kernels.py").open("a") as file:
        file.write("\n# a remark\n")
    (copied / "rendering" / "another.py").write_text("")
    code = PLANNED.format(recipe=TINY.text(), out=str(whole))
    version, *counts = printed("-c", code, folder=tmp_path).split()
    assert version != Manifest.read(whole).articugen_version == code_version()
    assert counts == ["4", "0"]


def test_other_code_that_makes_the_same_goes_on_with_what_is_there(mine, monkeypatch):
    (mine / "train-00001.h5").unlink()
    monkeypatch.setattr(manifest_module, "code_version", lambda: "9.9+other")
    manifest, reports = made(job(mine))
    assert sum(r.reused for r in reports) == 3
    assert manifest.articugen_version == "9.9+other"
    assert verify(mine).findings == ()


@pytest.mark.parametrize(
    ("table", "name", "told"),
    [("STAGES", "fusion", "fusion"), ("MODELS", "eyeglasses", "eyeglasses models")],
)
def test_a_raised_version_makes_data_again(whole, monkeypatch, table, name, told):
    now = getattr(content, table)[name]
    monkeypatch.setitem(getattr(content, table), name, now + 1)
    why = f"the code makes other data: it was {told} {now}, is {told} {now + 1}"
    assert [task.why for task in planned(job(whole)).tasks] == [why] * 4
    assert why in (planned(job(whole)).conflict or "")


def test_versions_of_bundled_models_decide_no_other_models(boxes, tmp_path, monkeypatch):
    before = [task.key for task in planned(job(tmp_path, source=str(boxes), category="box")).tasks]
    monkeypatch.setitem(content.MODELS, "box", 2)
    after = [task.key for task in planned(job(tmp_path, source=str(boxes), category="box")).tasks]
    assert after == before


def test_a_changed_model_is_made_again_alone(boxes: Path, tmp_path: Path) -> None:
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    made(ours)
    (boxes / "box2.urdf").write_text(BOX.format(size=3))
    found = planned(ours)
    assert [(t.ref.object_id, t.why) for t in found.tasks] == [("box2", "its source has changed")]
    made(ours)
    assert verify(ours.out).findings == ()


def test_a_folder_named_otherwise_is_the_same_and_another_folder_is_not(
    boxes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shards and manifest name the source and its licence, and must all name the same."""
    models = tmp_path / "models"
    shutil.move(boxes, models / "box")
    yaml = "{origin: us, licence: %s, frame: any, clip_to_limits: false, categories: {box: {}}}"
    (models / "source.yaml").write_text(yaml % "X")
    ours = job(tmp_path / "out", source=str(models), category="box", ids=("box0", "box1"))
    made(ours)
    monkeypatch.chdir(tmp_path)
    manifest, reports = made(replace(ours, source="models", ids=("box0", "box1", "box2")))
    assert [report.reused for report in reports] == [True, True, False]
    assert manifest.source == str(models)
    moved = replace(ours, source=str(shutil.copytree(models, tmp_path / "moved")))
    assert {t.why for t in planned(moved).tasks} == {f"the source was {models}, is {moved.source}"}
    with started(moved) as run, pytest.raises(ArticugenError, match="2 since the source"):
        run.check_replaces(replace=False, cure="")
    (models / "source.yaml").write_text(yaml % "Y")
    assert {t.why for t in planned(ours).tasks} == {"the licence was X, is Y"}
    made(ours)
    assert verify(ours.out).findings == ()


def test_planning_makes_nothing_of_meshes(boxes, tmp_path, monkeypatch):
    """They are digested, as sound models are when they are made; unsound ones are tried once."""
    mesh = '<mesh filename="lid.obj"/>'
    for k in range(4):
        model = BOX.format(size=1 + 0.1 * k).replace('<box size="1 1 0.1"/>', mesh)
        (boxes / f"box{k}.urdf").write_text(model)
    trimesh.creation.box((1.0, 1.0, 0.1)).export(boxes / "lid.obj")
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    with monkeypatch.context() as patch:
        patch.setattr(meshes, "checked", lambda *_: 1 / 0)
        keys = {task.ref.object_id: task.key.ref for task in planned(ours).tasks}
    manifest, _ = made(ours)
    assert {o.key.object_id: o.input_sha256 for o in manifest.objects} == keys
    (boxes / "lid.obj").write_text("v 0 0 0\nf 1 2 3\n")
    assert {task.why for task in planned(ours).tasks} == {"its source has changed"}
    with pytest.raises(ArticugenError, match="4 of 4 objects were rejected"):
        made(ours)
    assert planned(ours).tasks == ()


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
    ((box3, reason),) = [(r.key.object_id, r.reason) for r in manifest.rejected]
    assert box3 == "box3"
    assert str(boxes / "box3.urdf") in reason
    assert "'x'" in reason
    ((still, why),) = [(s.key.object_id, s.reason) for s in manifest.skipped]
    assert still == "still"
    assert "no joint moves" in why
    told = {r.object_id: (r.rejected, r.skipped) for r in reports if not r.shard}
    assert told == {"box3": (reason, None), "still": (None, why)}
    assert verify(ours.out).findings == ()

    before = (ours.out / MANIFEST_NAME).stat().st_mtime_ns
    assert made(ours)[0] == manifest  # what was rejected is not tried again
    assert (ours.out / MANIFEST_NAME).stat().st_mtime_ns == before
    (boxes / "box3.urdf").write_text(BOX.format(size=1.3))
    assert [task.ref.object_id for task in planned(ours).tasks] == ["box3"]
    manifest, _ = made(ours)
    assert (len(manifest.objects), len(manifest.rejected), len(manifest.skipped)) == (4, 0, 1)


def test_too_many_rejects_fail_the_run_and_keep_what_was_made(boxes: Path, tmp_path: Path) -> None:
    (boxes / "box1.urdf").write_text("<robot")
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    with pytest.raises(ArticugenError, match="1 of 4 objects were rejected, more than") as caught:
        made(ours)
    assert str(boxes / "box1.urdf") in str(caught.value)
    assert "\n" not in str(caught.value)
    manifest = Manifest.read(ours.out)
    assert (manifest.shortfall or "?") in str(caught.value)
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
    assert manifest.shortfall is None
    assert verify(ours.out).findings == ()
    assert contents(ours.out) == kept


def test_objects_without_area_are_rejected_and_such_parts_are_empty(boxes, tmp_path):
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


def test_faces_without_area_count_for_no_frame(boxes: Path, tmp_path: Path) -> None:
    ours, frames = job(tmp_path / "out", source=str(boxes), category="box", ids=("box0",)), []
    box = '<geometry><box size="1e-9 1e-9 1e-9"/></geometry>'
    for stray in ("", f'<visual><origin xyz="9 0 0"/>{box}</visual>'):
        model = BOX.format(size=1).replace("</link>", f"{stray}\n</link>", 1)
        (boxes / "box0.urdf").write_text(model)
        made(ours)
        row = articugen.open(ours.out)[0]
        frames.append((row.scale, *row.center))
    assert frames[0] == frames[1]
    assert verify(ours.out).findings == ()


def test_a_file_where_a_folder_must_be_stops_the_run_and_rejects_nothing(whole, tmp_path):
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(MachineFault, match="a file is in the way; move it away or"):
        made(job(tmp_path / "out"))
    (tmp_path / "out").unlink()
    assert [task.why for task in planned(job(tmp_path / "out")).tasks] == [NEVER_MADE] * 4
    assert made(job(tmp_path / "out"))[0].rejected == ()
    assert contents(tmp_path / "out") == contents(whole)


def test_a_disk_that_is_locked_meanwhile_stops_the_run_and_rejects_nothing(whole, tmp_path):
    def remount(how: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{how}", str(disk)], check=True)

    with small_disk(tmp_path / "disk", "20m") as disk:
        with pytest.raises(MachineFault, match=r"not written: the folder cannot be written to"):
            door.make(job(disk / "out"), on_object=lambda _: remount("ro"))
        remount("rw")
        assert len(planned(job(disk / "out")).tasks) == 3
        assert made(job(disk / "out"))[0].rejected == ()
        assert contents(disk / "out") == contents(whole)


def test_an_object_that_is_not_of_the_category_is_skipped_without_blame(
    boxes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    broken(monkeypatch, "box3", NotOfCategory("box3: a hob, it has no door"))
    manifest, reports = made(ours)
    assert [s.sentence for s in manifest.skipped] == ["box3: a hob, it has no door"]
    assert (len(manifest.objects), manifest.rejected, manifest.shortfall) == (3, (), None)
    assert [r.skipped for r in reports if not r.shard] == ["box3: a hob, it has no door"]
    assert verify(ours.out).findings == ()
    assert planned(ours).tasks == ()


def test_nothing_left_at_all_is_one_error(boxes, tmp_path, monkeypatch):
    monkeypatch.setattr(articulation, "resolve", lambda *_, **__: nothing_to_articulate())
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    for _ in range(2):
        with pytest.raises(ArticugenError, match="no object is left: 4 skipped, 0 rejected; the"):
            made(ours)
    assert len(Manifest.read(ours.out).skipped) == 4


def nothing_to_articulate() -> None:
    raise NotOfCategory("it has no lid")


@pytest.mark.parametrize(
    "error",
    [
        ValueError("could not convert"),
        OverflowError("too large"),
        RecursionError("too deep"),
        "\ud800".encode,
        OSError(errno.ENAMETOOLONG, "File name too long"),
    ],
    ids=["bad value", "overflow", "recursion", "encoding", "long name"],
)
def test_whatever_reading_one_object_raises_the_others_are_made(
    boxes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error
) -> None:
    read = readers.load

    def load(ref, **options):
        if ref.object_id == "box2":
            if callable(error):
                error()
            raise error
        return read(ref, **options)

    monkeypatch.setattr(readers, "load", load)
    ours = job(tmp_path / "out", source=str(boxes), category="box")
    with pytest.raises(ArticugenError, match=r"1 of 4 objects (failed|were rejected).* box2: "):
        made(ours)
    assert len(Manifest.read(ours.out).objects) == 3


def test_a_name_that_is_no_text_is_rejected_by_one_that_is(boxes: Path, tmp_path: Path) -> None:
    for name in (b"\xff\xfe", b"two\nlines"):
        shutil.copy(boxes / "box0.urdf", os.fsencode(boxes) + b"/" + name + b".urdf")
    recipe = TINY.model_copy(update={"max_rejected_fraction": 0.5, "objects": None})
    manifest, _ = made(job(tmp_path / "out", source=str(boxes), category="box", recipe=recipe))
    assert len(manifest.objects) == 4
    names = sorted(r.key.object_id for r in manifest.rejected)
    assert [name.rpartition("~")[0] for name in names] == ["\\udcff\\udcfe", "two lines"]
    assert all("its name is no plain text; rename it" in r.reason for r in manifest.rejected)
    assert Manifest.read(tmp_path / "out") == manifest


@pytest.mark.parametrize(
    "name", ["", ".", "..", "a/b", "-x", "a\0b", "../up", "a\nb", "a ", "\ud800", "x" * 101]
)
def test_names_that_are_no_categories_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidRecipe, match="cannot be a category's name"):
        job(tmp_path, category=name)
    with pytest.raises(InvalidRecipe, match="cannot be a category's name"):
        load_recipe(None, name)


def test_names_seeds_and_sources_that_no_file_could_hold_are_refused(tmp_path: Path) -> None:
    assert job(tmp_path, category="Trash can-2.b", seed=-(2**63))
    with pytest.raises(InvalidRecipe, match="the seed is"):
        job(tmp_path, seed=2**63)
    with pytest.raises(InvalidRecipe, match=r"models\\udcff: rename it"):
        job(tmp_path, source="models\udcff")
