"""Damaged data sets made whole again from their sources, or left as they are with the reason."""

import json
import os
import shutil
import signal
from pathlib import Path

import h5py
import pytest
from command_line import run
from python_process import ended
from test_verify import add_scores
from trouble import held_by_another_run

import articugen as ag
from articugen.core import content
from articugen.core.errors import ArticugenError, CorruptShard, InvalidArgument
from articugen.core.ledger import LEDGER
from articugen.instance import make
from articugen.pipeline import door
from articugen.pipeline.job import Job
from articugen.store import chunks, croissant
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.writer import copy_user_group
from articugen.verify.dataset import Repair, Report, verify
from articugen.verify.invariants import Finding
from articugen.verify.repair import repair
from tests.chaos.corruptions import RECIPE

BOX = """<robot name="box">
  <link name="base"><visual><geometry><box size="{size} 1 0.2"/></geometry></visual></link>
  {lid}
</robot>"""
LID = """<link name="lid"><visual><origin xyz="0.5 0 0.2"/>
    <geometry><box size="1 1 0.1"/></geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="lid"/>
    <origin xyz="-0.5 0 0"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="2" effort="1" velocity="1"/></joint>"""
NO_LID = '<link name="lid"/><joint name="hinge" type="revolute"><parent link="base"/>'

SHARD = "train-00001.h5"
AGAIN = "made again from its source, to the same content"


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """Three boxes with lids and a broken one, as URDFs; and a data set of them."""
    root = tmp_path_factory.mktemp("boxes")
    (root / "models").mkdir()
    for k in range(3):
        (root / "models" / f"box{k}.urdf").write_text(BOX.format(size=1 + 0.1 * k, lid=LID))
    (root / "models" / "box3.urdf").write_text(BOX.format(size=1, lid=NO_LID))
    recipe = RECIPE.model_copy(update={"objects": None, "max_rejected_fraction": 0.5})
    made = Job(str(root / "models"), "box", recipe, seed=0, out=root / "made", jobs=0)
    assert len(door.make(made, replace=True).rejected) == 1
    return root


@pytest.fixture
def folder(boxes, tmp_path):
    """A copy of the data set to do harm to."""
    return Path(shutil.copytree(boxes / "made", tmp_path / "box"))


@pytest.fixture
def model(boxes):
    """The model of `SHARD`, to do harm to: put back afterwards."""
    entry = next(o for o in Manifest.read(boxes / "made").objects if o.shard == SHARD)
    path = boxes / "models" / f"{entry.key.object_id}.urdf"
    before = path.read_text()
    yield path
    path.write_text(before)


def damage(path: Path) -> None:
    """Cut it short by a byte."""
    path.write_bytes(path.read_bytes()[:-1])


def mended(folder: Path, **asked) -> tuple[Repair, ...]:
    done = tuple(repair(folder, verify(folder), jobs=0, **asked))
    assert all(str(each).isprintable() for each in done)
    return done


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_bad_shards_alone_are_made_again_to_the_same_bytes(folder):
    before, written = contents(folder), {p.name: p.stat().st_ino for p in folder.iterdir()}
    damage(folder / SHARD)
    (folder / "test-00000.h5").unlink()
    done = mended(folder)
    assert {each.name: each.done for each in done} == {SHARD: AGAIN, "test-00000.h5": AGAIN}
    assert all(each.ok for each in done)
    assert contents(folder) == before
    left = set(before) - {SHARD, "test-00000.h5"}
    assert {name: (folder / name).stat().st_ino for name in left} == {n: written[n] for n in left}
    assert mended(folder) == ()


def test_a_source_that_is_gone_or_changed_is_said_and_nothing_touched(folder, model):
    damage(folder / SHARD)
    before = contents(folder)
    model.write_text(model.read_text().replace("1 1 0.1", "1 1 0.2"))
    (changed,) = mended(folder)
    assert not changed.ok
    assert f"left as it is: {model.stem}: its source has changed; repair it where" in changed.done
    model.unlink()
    (gone,) = mended(folder)
    assert "left as it is: " in gone.done
    assert model.stem in gone.done
    assert contents(folder) == before


def test_other_code_or_other_numbers_replace_nothing(folder, monkeypatch):
    damage(folder / SHARD)
    before = contents(folder)
    with monkeypatch.context() as patch:
        patch.setitem(content.STAGES, "fusion", 9)
        (other_code,) = mended(folder)
    assert "the code makes other data: it was fusion 1, is fusion 9" in other_code.done
    with monkeypatch.context() as patch:
        patch.setattr(make, "FEWEST_SURFACE_POINTS", make.FEWEST_SURFACE_POINTS + 1)
        (other_numbers,) = mended(folder)
    assert "another content than the manifest records" in other_numbers.done
    assert not other_code.ok
    assert not other_numbers.ok
    assert contents(folder) == before


def with_other_versions(folder: Path) -> None:
    """As if it had been made with another numpy, on another kind of processor."""
    manifest = Manifest.read(folder)
    values = {name: getattr(manifest, name) for name in Manifest.model_fields}
    values |= {"versions": {**manifest.versions, "numpy": "1.0"}}
    values |= {"machine": {**manifest.machine, "architecture": "abacus"}}
    Manifest.sealed(**values).write(folder)


def test_what_may_explain_other_numbers_is_said(folder, monkeypatch):
    with_other_versions(folder)
    damage(folder / SHARD)
    monkeypatch.setattr(make, "FEWEST_SURFACE_POINTS", make.FEWEST_SURFACE_POINTS + 1)
    (done,) = mended(folder)
    assert "; it was made with numpy 1.0, processors abacus, here are numpy " in done.done


def test_replay_says_what_may_explain_other_numbers(folder, monkeypatch):
    with_other_versions(folder)
    monkeypatch.setattr(make, "FEWEST_SURFACE_POINTS", make.FEWEST_SURFACE_POINTS + 1)
    report = ag.verify(folder, replay=1, jobs=1)
    (found,) = (finding for finding in report.findings if finding.check == "replay")
    assert "made again, it differs in " in found.sentence
    assert "; it was made with numpy 1.0, processors abacus, here are numpy " in found.sentence


def test_another_file_of_the_same_content_is_recorded(folder, monkeypatch):
    before = Manifest.read(folder)
    damage(folder / SHARD)
    monkeypatch.setattr(chunks, "GZIP_LEVEL", 1)
    (done,) = mended(folder)
    assert "in a file of other bytes than before, which the manifest now records" in done.done
    after = Manifest.read(folder)
    assert after.content_sha256 == before.content_sha256
    assert [s.name for s in after.shards if s not in before.shards] == [SHARD]
    assert verify(folder).ok


def test_numbers_that_are_wrong_in_a_sound_file_stay_wrong(folder):
    """Making it again would give the same."""
    odd = Finding("zero level", "surface_points bound nothing", SHARD)
    before = contents(folder)
    assert list(repair(folder, Report((odd,), 3, 6), jobs=0)) == []
    assert contents(folder) == before


def scores(path: Path) -> list[float]:
    with h5py.File(path) as shard:
        return shard["user/score"][:].tolist()


def test_a_readable_group_of_ones_own_is_kept(folder):
    add_scores(folder / SHARD)
    with h5py.File(folder / SHARD, "r+") as shard:
        shard["surface_part"][0, 0] ^= 1
    (done,) = mended(folder)
    assert done.done == f"{AGAIN}, with the group 'user' that it had"
    assert scores(folder / SHARD) == [0.0, 1.0]
    report = verify(folder)
    assert report.ok
    assert report.extended == (SHARD,)


@pytest.mark.parametrize(
    "harm", ["unreadable file", "unreadable group", "link", "another object's"]
)
def test_a_group_that_cannot_be_kept_is_lost_only_if_asked(folder, harm):
    path = folder / SHARD
    add_scores(path)
    if harm == "unreadable file":
        path.write_bytes(b"\0" * 8 + path.read_bytes()[8:])
    elif harm == "unreadable group":
        with h5py.File(path) as shard:
            address = h5py.h5o.get_info(shard["user"].id).addr
        data = bytearray(path.read_bytes())
        data[address + 8] ^= 255
        path.write_bytes(data)
    elif harm == "link":
        with h5py.File(path, "r+") as shard:
            del shard["user"]
            shard["user"] = h5py.ExternalLink("/etc/passwd", "/")
    else:
        shutil.copyfile(path, folder / "test-00000.h5")
        path.unlink()
    before = contents(folder)
    refused = [each for each in mended(folder) if not each.ok]
    assert len(refused) == 1
    assert "add --drop-user" in refused[0].done
    assert (folder / refused[0].name).read_bytes() == before[refused[0].name]
    assert all(each.ok for each in mended(folder, drop_user=True))
    assert verify(folder).ok
    assert verify(folder).extended == ()


def test_a_repair_that_is_killed_has_lost_nothing(boxes, folder):
    for shard in folder.glob("*.h5"):
        damage(shard)
    code = f"""
import os, signal
from pathlib import Path
from articugen.verify.dataset import verify
from articugen.verify.repair import repair
folder = Path({str(folder)!r})
for _ in repair(folder, verify(folder), jobs=0):
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert ended("-c", code).returncode == -signal.SIGKILL
    left = {finding.shard for finding in verify(folder).findings}
    assert len(left) == 2
    assert {each.name for each in mended(folder)} == left
    assert contents(folder) == contents(boxes / "made")


def test_not_while_a_run_is_at_work_or_can_go_on(folder):
    damage(folder / SHARD)
    with held_by_another_run(folder), pytest.raises(ArticugenError, match="another run is writing"):
        mended(folder)
    (folder / MANIFEST_NAME).unlink()
    (folder / LEDGER).write_text("")
    before = contents(folder)
    (done,) = mended(folder)
    assert not done.ok
    assert "a run was cut short here; start it again" in done.done
    assert contents(folder) == before


def test_a_lost_manifest_is_made_again_and_proven(folder):
    before = Manifest.read(folder)
    (folder / MANIFEST_NAME).unlink()
    (done,) = mended(folder)
    assert "made again from 3 shards, 3 of them proven by making an instance again" in done.done
    after = Manifest.read(folder)
    assert after.content_sha256 == before.content_sha256
    assert after.shards == before.shards
    same = {"key", "input_sha256", "shard", "instances", "content_sha256", "notes"}
    for one, other in zip(before.objects, after.objects, strict=True):
        assert one.model_dump(include=same) == other.model_dump(include=same)
    assert verify(folder).ok


def edit(folder: Path, **values) -> None:
    path = folder / MANIFEST_NAME
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_what_an_edited_manifest_tells_is_kept_where_it_agrees(folder):
    before = Manifest.read(folder)
    edit(folder, seed=7)
    damage(folder / SHARD)
    rebuilt, again = mended(folder)
    assert "made again from 2 shards; what nothing else records" in rebuilt.done
    assert "taken from the damaged one" in rebuilt.done
    assert (again.name, again.done) == (SHARD, AGAIN)
    after = Manifest.read(folder)
    kept = {"objects", "shards", "rejected", "recipe", "seed", "shortfall", "content_sha256"}
    assert after.model_dump(include=kept) == before.model_dump(include=kept)
    assert verify(folder).ok


def test_a_lost_manifest_of_a_changed_model_is_not_made_up(folder, model):
    (folder / MANIFEST_NAME).unlink()
    model.write_text(model.read_text().replace("1 1 0.1", "1 1 0.2"))
    (done,) = mended(folder)
    assert not done.ok
    assert f"{model.stem}: made again, it differs in " in done.done
    assert not (folder / MANIFEST_NAME).exists()


def test_what_a_damaged_shard_held_is_not_made_up(folder):
    (folder / MANIFEST_NAME).unlink()
    damage(folder / SHARD)
    (done,) = mended(folder)
    assert f"what {SHARD} held is not known any more: move it away" in done.done
    assert {f.check for f in verify(folder).findings} == {"surplus"}


def test_shards_that_tell_too_little_are_one_sentence(folder, boxes, tmp_path):
    (folder / MANIFEST_NAME).unlink()
    shutil.copyfile(folder / SHARD, folder / "train-00009.h5")
    (twice,) = mended(folder)
    assert f"{SHARD} and train-00009.h5 both hold box" in twice.done
    other = Job(str(boxes / "models"), "box", RECIPE, 1, tmp_path / "other", 0, ids=("box0",))
    door.make(other, replace=True)
    (name,) = (path.name for path in other.out.glob("*.h5"))
    shutil.copyfile(other.out / name, folder / "train-00009.h5")
    (mixed,) = mended(folder)
    assert "are of different runs (by their seed)" in mixed.done
    for path in folder.glob("*.h5"):
        damage(path)
    (none,) = mended(folder)
    assert "no shard is whole that could show what the data set was" in none.done
    assert not any(each.ok for each in (twice, mixed, none))
    assert not (folder / MANIFEST_NAME).exists()


def test_a_manifest_of_another_run_costs_no_shard(folder, boxes, tmp_path):
    other = Job(str(boxes / "models"), "box", RECIPE, 1, tmp_path / "other", 0)
    door.make(other, replace=True)
    shutil.copyfile(other.out / MANIFEST_NAME, folder / MANIFEST_NAME)
    before = contents(folder)
    (done,) = mended(folder)
    assert not done.ok
    assert "bring back the right one, or delete it and repair again" in done.done
    assert contents(folder) == before


def test_a_fraction_that_means_the_same_is_found_and_written_again(folder):
    manifest = Manifest.read(folder)
    text = (folder / MANIFEST_NAME).read_text()
    entry = text.index('"seconds"', text.index('"objects"'))  # of the first object
    seconds = repr(manifest.objects[0].seconds)
    longer = seconds + "0" * (20 - len(seconds)) + "1"
    (folder / MANIFEST_NAME).write_text(text[:entry] + text[entry:].replace(seconds, longer, 1))
    assert Manifest.read(folder) == manifest
    (found,) = verify(folder).findings
    assert f"{longer} is not how it was written" in found.sentence
    (done,) = mended(folder)
    assert (done.name, done.done) == (MANIFEST_NAME, "written again")
    assert (folder / MANIFEST_NAME).read_text() == text


def test_what_lies_beside_a_manifest_may_be_worded_otherwise_by_other_code(folder):
    path = folder / croissant.NAME
    told = json.loads(path.read_text())
    path.write_text(json.dumps(told | {"description": "mine"}))
    assert [finding.check for finding in verify(folder).findings] == ["croissant"]
    manifest = Manifest.read(folder).model_copy(update={"articugen_version": "0.0+other"})
    assert croissant.fault(path.read_bytes(), manifest) is None
    told["distribution"][0]["contentSize"] = "1 B"
    assert croissant.fault(json.dumps(told).encode(), manifest)
    path.unlink()  # it decides nothing
    assert verify(folder).ok


def test_the_command_mends_and_says_what_it_did(folder, boxes):
    damage(folder / SHARD)
    found = run("verify", folder, "--jobs", 1)
    assert found.exit_code == 1
    assert f"articugen verify {folder} --repair" in " ".join(found.output.split())
    done = run("verify", folder, "--repair", "--jobs", 1)
    assert done.exit_code == 0
    assert f"{SHARD}: not the file that the manifest records" in done.output
    assert AGAIN in done.output
    assert "3 shards, 6 instances as they were made" in done.output
    assert contents(folder) == contents(boxes / "made")
    with pytest.raises(InvalidArgument, match="belongs to a repair"):
        ag.verify(folder, drop_user=True)


def test_a_report_has_what_was_mended(folder):
    os.truncate(folder / croissant.NAME, 3)
    told: list[Repair] = []
    report = ag.verify(folder, repair=True, jobs=1, on_repair=told.append)
    assert tuple(told) == report.repairs
    assert report.ok
    assert [(each.name, each.done) for each in report.repairs] == [
        (croissant.NAME, "written again")
    ]
    assert "croissant.json: it does not say of the data" in repr(report)


def test_only_a_file_that_has_grown_may_have_a_group_that_nobody_can_read(folder):
    """Nothing can be added to a file that is no larger than when it was written."""
    path, into = folder / SHARD, folder / "train-00000.h5"
    whole, size, refused = path.read_bytes(), path.stat().st_size, 0
    with h5py.File(path) as file:
        root = h5py.h5o.get_info(file.id).addr
    for place in range(root, root + 60, 6):
        data = bytearray(whole)
        data[place] ^= 255
        path.write_bytes(data)
        copy_user_group(path, into, size)
        try:
            copy_user_group(path, into, size - 1)
        except CorruptShard:
            refused += 1
    assert refused > 5
