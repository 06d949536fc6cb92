"""A data set on the disk: sound ones are left in peace, each kind of damage is found."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from instances import SMALL, changed, edited, hinged_box
from test_manifest import STATES, TIMINGS, key, keys, make, run

from articugen.journal import Journal
from articugen.manifest import MANIFEST_NAME, Manifest, Outcome
from articugen.shards import write_shard
from articugen.verify import Report, verify


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "box"
    run(folder, keys())
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    return Path(shutil.copytree(sound, tmp_path / "box"))


def found(report: Report) -> set[tuple[str, str]]:
    assert report.ok is not bool(report.findings)
    assert all("\n" not in str(finding) for finding in report.findings)
    return {(finding.shard, finding.check) for finding in report.findings}


def with_manifest(folder: Path, edit) -> None:
    data = json.loads((folder / MANIFEST_NAME).read_text())
    edit(data)
    (folder / MANIFEST_NAME).write_text(json.dumps(data))


@pytest.mark.parametrize("jobs", [1, 2])
def test_sound_data_set(sound, jobs):
    told = []
    report = verify(sound, jobs=jobs, on_shard=told.append)
    assert report == Report((), 3, 6)
    assert told == ["test-00000.h5", "train-00000.h5", "train-00001.h5"]


def test_nothing_is_changed(sound):
    before = {p.name: p.read_bytes() for p in sound.iterdir()}
    verify(sound)
    assert {p.name: p.read_bytes() for p in sound.iterdir()} == before


def test_no_manifest(folder):
    (folder / MANIFEST_NAME).unlink()
    assert found(verify(folder)) == {("", "manifest")}


def test_unfinished_run(folder):
    with Journal(folder) as journal:
        journal.claim(["train-00000.h5"])
        assert found(verify(folder)) == {("", "manifest")}


def test_left_over_journal(folder):
    (folder / ".articugen-journal.jsonl").write_text('{"claims": []}\n')
    assert found(verify(folder)) == {("", "unfinished")}


def test_missing_and_surplus_shard(folder):
    (folder / "train-00001.h5").rename(folder / "train-00007.h5")
    assert found(verify(folder)) == {("train-00001.h5", "missing"), ("train-00007.h5", "surplus")}


@pytest.mark.parametrize("seed", range(8))
def test_flipped_bit(folder, seed):
    path = folder / "train-00000.h5"
    data = bytearray(path.read_bytes())
    data[int(np.random.default_rng(seed).integers(len(data)))] ^= 16
    path.write_bytes(data)
    report = verify(folder)
    assert ("train-00000.h5", "checksum") in found(report)
    assert {finding.shard for finding in report.findings} == {"train-00000.h5"}


def test_cut_short(folder):
    path = folder / "train-00000.h5"
    path.write_bytes(path.read_bytes()[:-100])
    shard = "train-00000.h5"
    assert found(verify(folder)) == {(shard, "checksum"), (shard, "schema")}


def test_shards_swapped(folder):
    a, b, c = (folder / name for name in ("train-00000.h5", "train-00001.h5", "x"))
    a.rename(c)
    b.rename(a)
    c.rename(b)
    assert {check for _, check in found(verify(folder))} == {"checksum", "content"}


def _remade(folder: Path, outcome: Outcome) -> None:
    """A manifest that tells of this outcome alone: files and digests in order."""
    recipe = SMALL.text()
    for path in folder.glob("*.h5"):
        if outcome.shard and path.name != outcome.shard.name:
            path.unlink()
    about = {"category": "box", "source": "tests", "licence": "MIT", "seed": 0}
    Manifest.of([outcome], recipe=recipe, timings=TIMINGS, **about).write(folder)


@pytest.mark.parametrize("attribute", ["category", "split", "seed", "recipe", "recipe_sha256"])
def test_shard_of_another_data_set(folder, attribute):
    about = {"category": "box", "split": "train", "recipe": SMALL.text(), "seed": 0}
    about |= {"recipe_sha256": SMALL.sha256(), "articugen_version": "1"}
    about |= {attribute: 5 if attribute == "seed" else "{}"}
    record = write_shard(folder / "train-00000.h5", hinged_box(STATES), about)
    _remade(folder, Outcome.of_shard(key(), record, input_sha256=""))
    assert found(verify(folder)) == {("train-00000.h5", "attributes")}


def test_fault_in_an_intact_file(folder):
    """All digests in order, the geometry not: what a fault of the generator looks like."""
    rows = list(hinged_box(STATES))
    rows[1] = edited(rows[1], "joint_state", lambda q: q + 1e-5)
    rows[0] = changed(rows[0], scale=np.nan)
    about = {"category": "box", "split": "train", "recipe": SMALL.text(), "seed": 0}
    about |= {"recipe_sha256": SMALL.sha256(), "articugen_version": "1"}
    record = write_shard(folder / "train-00000.h5", rows, about)
    _remade(folder, Outcome.of_shard(key(), record, input_sha256=""))
    report = verify(folder)
    told = {(f.object_id, f.state_index, f.check) for f in report.findings}
    assert ("box-0", 1, "motion") in told
    assert ("box-0", 0, "numbers") in told


def test_object_in_two_splits(folder):
    with Journal(folder) as journal:
        outcomes = [o for k in keys() if (o := journal.finished(k))]
    twice = key("box-0", "test")
    outcomes.append(make(folder, twice, "test-00001.h5"))
    about = {"category": "box", "source": "tests", "licence": "MIT", "seed": 0}
    Manifest.of(outcomes, recipe=SMALL.text(), timings=TIMINGS, **about).write(folder)
    report = verify(folder)
    assert [f.check for f in report.findings] == ["splits"]
    assert "is in test and in train" in str(report.findings[0])


def test_content_of_another_run(folder):
    """The file is the one recorded; the content it is said to have is not in it."""

    def edit(manifest):
        a, b = (manifest["objects"][i] for i in (1, 2))
        a["content_sha256"], b["content_sha256"] = b["content_sha256"], a["content_sha256"]
        objects = [
            (o["key"]["split"], o["key"]["object_id"], o["content_sha256"])
            for o in manifest["objects"]
        ]
        lines = sorted("\x1f".join(entry) for entry in objects)
        manifest["content_sha256"] = hashlib.sha256("\n".join(lines).encode()).hexdigest()

    with_manifest(folder, edit)
    assert found(verify(folder)) == {("train-00000.h5", "content"), ("train-00001.h5", "content")}
