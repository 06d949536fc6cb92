"""A data set on the disk: sound ones are left in peace, each kind of damage is found."""

import copy
import hashlib
import io
import json
import os
import re
from fnmatch import fnmatch
from functools import reduce
from operator import getitem
from pathlib import Path

import command_line
import h5py
import numpy as np
import pytest
import test_manifest
from instances import SMALL, changed, edited, hinged_box
from PIL import Image
from python_process import ended
from rich.markup import escape
from rich.table import Table
from rich.text import Text
from test_manifest import STATES, attributes, key, keys, make, manifest_of, records_in

import articugen as ag
from articugen.cli import saying
from articugen.core.errors import CorruptShard
from articugen.core.files import partial_name
from articugen.core.ledger import LEDGER
from articugen.pictures import layout
from articugen.store.manifest import MANIFEST_NAME
from articugen.store.outcome import Outcome, Rejection
from articugen.store.writer import write_shard
from articugen.verify import dataset as verification
from articugen.verify.dataset import Report, verify
from tests.chaos.corruptions import leaves, set_attributes

complete, folder = test_manifest.complete, test_manifest.folder


def found(report: Report) -> set[tuple[str, str]]:
    assert report.ok is not bool(report.findings)
    assert all("\n" not in str(finding) for finding in report.findings)
    return {(finding.shard, finding.check) for finding in report.findings}


def with_manifest(folder: Path, edit) -> None:
    data = json.loads((folder / MANIFEST_NAME).read_text())
    edit(data)
    (folder / MANIFEST_NAME).write_text(json.dumps(resealed(data)))


def resealed(manifest: dict) -> dict:
    """With the digest that docs/format.md describes, as one would compute it without us."""
    rest = {name: value for name, value in manifest.items() if name != "manifest_sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    return rest | {"manifest_sha256": hashlib.sha256(text.encode()).hexdigest()}


@pytest.mark.parametrize("jobs", [1, 2])
def test_sound_data_set(complete, jobs):
    told = []
    report = verify(complete, jobs=jobs, on_shard=told.append)
    assert report == Report((), 3, 6)
    assert told == ["test-00000.h5", "train-00000.h5", "train-00001.h5"]


def test_a_terminal_of_few_letters_is_told_as_well(complete):
    done = ended("-m", "articugen", "verify", complete, PYTHONIOENCODING="latin-1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("? ")


def test_nothing_is_changed(complete):
    before = {p.name: p.read_bytes() for p in complete.iterdir()}
    verify(complete)
    assert {p.name: p.read_bytes() for p in complete.iterdir()} == before


def test_no_manifest(folder):
    (folder / MANIFEST_NAME).unlink()
    assert found(verify(folder)) == {("", "manifest")}


def test_unfinished_run(folder):
    with records_in(folder) as records:
        records.begin(["train-00000.h5"])
        assert found(verify(folder)) == {("", "manifest"), ("", "unfinished")}


def test_what_killed_runs_left_is_named_with_the_cure(folder):
    (folder / LEDGER).mkdir()
    part = partial_name("train-00000.h5")
    (folder / part).write_bytes(b"half")
    report = verify(folder)
    assert found(report) == {("", "unfinished"), (part, "leftover")}
    assert all(f"articugen clean {folder}" in str(finding) for finding in report.findings)


def test_strays_are_named_and_pictures_are_welcome(folder):
    (folder / "sheet.png").write_bytes(b"drawn")
    (folder / "report.html").write_text("<p>")
    assert verify(folder).ok
    strays = ["notes.txt", ".hidden", "train-00000.h5.bak", "a\nb", os.fsdecode(b"\xff.bin")]
    for name in strays:
        (folder / name).write_text("x")
    os.mkfifo(folder / "fifo.png")
    (folder / "train").mkdir()
    (folder / "link.png").symlink_to("sheet.png")
    strays += ["fifo.png", "train", "link.png"]
    report = verify(folder)
    assert found(report) == {(name, "surplus") for name in strays}
    assert all(str(finding).isprintable() for finding in report.findings)


HOSTILE = "\x1b]0;owned\x07\x1b[2J\x9b31m\r\u202e[/red]"


def test_what_a_file_says_moves_no_cursor(folder):
    """As a terminal would take it: our own colours are all that may begin with an escape."""

    def edit(data):
        data["licence"] = HOSTILE
        data["rejected"][0]["reason"] = HOSTILE
        data["versions"][HOSTILE] = HOSTILE

    with_manifest(folder, edit)
    (folder / "[red]\x1b[2J").write_text("x")
    for command in ("verify", "inspect", "merge", "clean"):
        done = command_line.run(command, folder, color=True)
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        output = re.sub(r"\x1b\[[0-9;]*m", "", done.output)
        assert output.replace("\n", "").isprintable(), ascii(output)
        assert command in ("merge", "clean") or "\\x1b]0;owned" in "".join(output.split())


@pytest.mark.parametrize(
    ("where", "value"),
    [
        (("timings", "seconds"), 1e300),
        (("objects", 0, "instances"), 10**30),
        (("objects", 0, "instances"), 10**9),
        (("source",), "/etc"),
        (("source",), "a\0b"),
        (("category",), "../../x"),
        (("recipe",), "[" * 50_000),
        (("objects", 0, "key", "object_id"), "../../x"),
        (("machine", "cores"), 10**30),
    ],
)
def test_whatever_a_manifest_says_ends_in_a_report(folder, where, value):
    """With a right digest. Opening it takes no memory for instances that it only claims."""

    def edit(data):
        reduce(getitem, where[:-1], data)[where[-1]] = value
        if where[-1] == "instances":
            data["shards"][0]["instances"] = value
        data["recipe_sha256"] = hashlib.sha256(data["recipe"].encode()).hexdigest()
        if where[-1] == "seconds":
            data["timings"]["instances_per_second"] = value

    with_manifest(folder, edit)
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    for more in ([], ["--repair"], ["--replay", "1"]):
        done = command_line.run("verify", folder, "-j", 1, *more)
        assert isinstance(done.exception, SystemExit | None), done.exception
    if where[-1] == "instances":
        with pytest.raises(CorruptShard, match="65536"):
            ag.open(folder)
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def test_a_picture_takes_the_place_of_a_link(folder):
    """Data sets come with pictures, and the command that is suggested draws over them."""
    (outside := folder.parent / "outside").write_text("precious")
    (folder / "sheet.png").symlink_to(outside)
    layout.save(Image.new("RGB", (4, 4)), folder / "sheet.png")
    assert outside.read_text() == "precious"
    assert (folder / "sheet.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("terminal", [True, False])
def test_a_console_spells_out_whatever_is_printed(terminal):
    file = io.StringIO()
    console = saying.Terminal(file=file, force_terminal=terminal, width=300, highlight=False)
    table = Table(HOSTILE.replace("[/red]", ""))
    table.add_row(Text(HOSTILE, "red"))
    console.print(table, Text(f"{HOSTILE}\n\tsecond line"))
    console.print(escape(HOSTILE), soft_wrap=True)
    output = re.sub(r"\x1b\[[0-9;]*m", "", file.getvalue())
    assert output.replace("\n", "").isprintable()
    assert output.count("\\x1b]0;owned") == 4
    assert "second line" in output.splitlines()[-2]


def test_a_folder_of_links_is_a_data_set_as_well(complete, tmp_path):
    for path in complete.iterdir():
        (tmp_path / path.name).symlink_to(path)
    assert verify(tmp_path).ok


def changes(value):
    """(what was done, what is there then) for one leaf; REMOVED where it is gone."""
    yield "removed", REMOVED
    yield from (("retyped", other) for other in (None, [], {}, [value]) if other != value)
    if isinstance(value, str):
        yield "retyped", 1
        yield "changed", value + "x"
        yield "changed", value[:-1] + ("0" if value[-1] != "0" else "1")
        yield "changed", ""
    elif value is None:
        yield "retyped", 1
        yield "changed", "0" * 40
    else:
        yield "retyped", str(value)
        yield "changed", value + 1
        yield "changed", -1 - value
        yield "changed", 3 * value + 1e-3 if isinstance(value, float) else 3 * value + 1


REMOVED = object()

ONLY_THE_DIGEST = (
    "articugen_version", "commit", "versions.*", "machine.*", "timings.peak_memory_bytes",
    "timings.workers", "objects.*.notes.*", "objects.*.seconds", "*ed.*.reason", "*ed.*.key.ref",
    "*ed.*.key.object_id", "*ed.*.key.split",
)  # fmt: skip
"""Leaves that nothing else in the folder tells of; `key.*` only of what was rejected or skipped."""


def edited_manifests(manifest: dict):
    for path in leaves(manifest):
        *way, last = path
        for what, value in changes(reduce(getitem, path, manifest)):
            other = copy.deepcopy(manifest)
            where = reduce(getitem, way, other)
            if value is REMOVED:
                del where[last]
            else:
                where[last] = value
            yield ".".join("*" if isinstance(p, int) else p for p in path), what, other


@pytest.fixture
def small(tmp_path):
    """An object that was made, one that was rejected, one that was skipped."""
    outcomes = [make(tmp_path, keys()[0], "train-00000.h5"), make(tmp_path, keys()[-1], "")]
    still = Rejection(key=key("box-9", "test"), reason="no joint moves")
    manifest_of([*outcomes, Outcome(skipped=still)]).write(tmp_path)
    assert verify(tmp_path).ok
    return tmp_path


def test_every_edit_of_a_manifest_is_found(small):
    """Each leaf changed, retyped, removed; nobody has computed the digest anew."""
    manifest = json.loads((small / MANIFEST_NAME).read_text())
    count = 0
    for path, what, other in edited_manifests(manifest):
        (small / MANIFEST_NAME).write_text(json.dumps(other))
        report = verify(small)
        assert found(report) == {("", "manifest")}, (path, what)
        count += 1
    assert count > 250


def test_edits_with_a_new_digest_are_found_by_what_else_is_known(small, monkeypatch):
    monkeypatch.setattr(verification, "_geometry_findings", lambda *_: ())  # of the shards alone
    manifest = json.loads((small / MANIFEST_NAME).read_text())
    missed, known = set(), set()
    for path, what, other in edited_manifests(manifest):
        if path == "manifest_sha256":
            continue
        (small / MANIFEST_NAME).write_text(json.dumps(resealed(other)))
        (missed if verify(small).ok else known).add((path, what))
    assert {path for path, _ in missed} == {
        path for path, _ in missed | known if any(fnmatch(path, only) for only in ONLY_THE_DIGEST)
    }
    assert {what for path, what in missed if path.startswith(("timings", "objects.*.seconds"))} == {
        "changed"
    }


def test_edits_of_whole_entries_are_found(folder):
    """A rejected object that is left out is a line that only the digest misses."""

    def check(edit, *, seal):
        manifest = json.loads((folder / MANIFEST_NAME).read_text())
        before = copy.deepcopy(manifest)
        edit(manifest)
        (folder / MANIFEST_NAME).write_text(json.dumps(resealed(manifest) if seal else manifest))
        ok = verify(folder).ok
        (folder / MANIFEST_NAME).write_text(json.dumps(before))
        return not ok

    for name in ("objects", "shards"):
        for edit in (lambda m: m[name].pop(), lambda m: m[name].append(m[name][0])):  # noqa: B023
            assert check(edit, seal=True)
    assert check(lambda m: m["rejected"].pop(), seal=False)
    assert check(lambda m: m["rejected"].append(m["rejected"][0]), seal=True)
    assert check(lambda m: m["rejected"][0]["key"].update(m["objects"][0]["key"]), seal=True)
    for recipe in ("{}", "null", SMALL.model_copy(update={"padding": 0.2}).text()):
        digest = hashlib.sha256(recipe.encode()).hexdigest()
        assert check(lambda m: m.update(recipe=recipe, recipe_sha256=digest), seal=True)  # noqa: B023


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


def add_scores(path: Path) -> None:
    """What docs/format.md shows: data of one's own, in a group that is left alone."""
    with h5py.File(path, "r+") as shard:
        shard["user/score"] = np.linspace(0.0, 1.0, len(shard["state_index"]))


def test_what_users_add_is_left_alone_and_told_of(folder):
    add_scores(folder / "train-00000.h5")
    report = verify(folder)
    assert report == Report((), 3, 6, ("train-00000.h5",))
    with records_in(folder) as records:  # a run has nothing to do, and replaces nothing
        assert [records.why(k) for k in keys()] == [None] * 4
        assert records.is_complete(keys())
    with h5py.File(folder / "train-00000.h5") as shard:
        assert shard["user/score"][:].tolist() == [0.0, 1.0]
    done = command_line.run("verify", folder)
    assert "1 with a group 'user', which was not checked" in " ".join(done.output.split())
    with h5py.File(folder / "train-00000.h5", "r+") as shard:
        del shard["user"]  # the file is no longer what it was, and nothing explains it
    assert found(verify(folder)) == {("train-00000.h5", "checksum")}


@pytest.mark.parametrize(
    ("alter", "checks"),
    [
        (lambda f: f["surface_part"].__setitem__((0, 0), 2), {"checksum", "content"}),
        (lambda f: f.move("near_label", "user/near_label"), {"checksum", "schema"}),
        (lambda f: f.__delitem__("occupancy_8"), {"checksum", "content"}),
        (lambda f: set_attributes(f, licence="mine"), {"checksum", "attributes"}),
        (lambda f: f.create_group("mine"), {"checksum", "schema"}),
    ],
    ids=["a label", "a field moved", "an optional field", "an attribute", "another group"],
)
def test_a_group_of_ones_own_excuses_nothing_else(folder, alter, checks):
    add_scores(folder / "train-00000.h5")
    with h5py.File(folder / "train-00000.h5", "r+") as shard:
        alter(shard)
    report = verify(folder)
    assert {check for _, check in found(report)} >= checks
    assert report.extended == ()
    if checks != {"checksum", "attributes"}:
        with records_in(folder) as records:
            assert "is missing or altered" in (records.why(keys()[0]) or "")


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


def _remade(folder: Path, rows, about) -> None:
    """A data set of one shard, of these instances: files and digests in order."""
    for path in folder.glob("*.h5"):
        path.unlink()
    record = write_shard(folder / "train-00000.h5", rows, about)
    manifest_of([Outcome.of_shard(key(), record, input_sha256="f" * 64)]).write(folder)


@pytest.mark.parametrize(
    "attribute",
    ["category", "source", "licence", "split", "seed", "recipe", "recipe_sha256", "generator"],
)
def test_shard_of_another_data_set(folder, attribute):
    other = {"seed": 5, "split": "another"}.get(attribute, "{}")
    about = attributes(key()) | {attribute: other}
    _remade(folder, hinged_box(STATES), about)
    assert found(verify(folder)) == {("train-00000.h5", "attributes")}


def test_fault_in_an_intact_file(folder):
    """All digests in order, the geometry not: what a fault of the generator looks like."""
    rows = list(hinged_box(STATES))
    rows[1] = edited(rows[1], "joint_state", lambda q: q + 1e-5)
    rows[0] = changed(rows[0], scale=np.nan)
    _remade(folder, rows, attributes(key()))
    report = verify(folder)
    told = {(f.object_id, f.state_index, f.check) for f in report.findings}
    assert ("box-0", 1, "motion") in told
    assert ("box-0", 0, "numbers") in told


def test_object_in_two_splits(folder):
    with records_in(folder) as records:
        outcomes = [o for k in keys() if (o := records.finished(k))]
    twice = key("box-0", "test")
    manifest_of([*outcomes, make(folder, twice, "test-00001.h5")]).write(folder)
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
