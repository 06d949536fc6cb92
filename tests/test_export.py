"""Exports as such: whose folder it is, going on after a kill, what cannot be held, the command."""

import json
import shutil
import signal
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from command_line import run
from hypothesis import given
from hypothesis import strategies as st
from instances import hinged_box
from ppd_data import rewrite, shard
from python_process import ended

import articugen as ag
from articugen.core.errors import ArticugenError, InvalidArgument, MissingExtra
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.place import Folder
from articugen.export.items import Options, file_name
from articugen.export.parts import unique
from articugen.export.target import REPORT_NAME, Target, Written

BOXES = {"train": 2, "test": 1}


def files_in(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_an_export_is_whole_and_says_what_it_is(boxes, tmp_path):
    told = []
    done = ag.export(
        boxes, "ply", tmp_path / "out", on_item=lambda n, of, item: told.append((n, of, item.key))
    )
    assert told[0] == (1, 12, "train/box-0_0000")
    assert told[-1][:2] == (12, 12)
    report = json.loads((tmp_path / "out" / REPORT_NAME).read_text())
    files = files_in(tmp_path / "out")
    assert {file["name"] for file in report["files"]} == files.keys() - {REPORT_NAME}
    assert {file["name"]: file["bytes"] for file in report["files"]} == {
        name: len(data) for name, data in files.items() if name != REPORT_NAME
    }
    assert (done.files, done.left_out) == (len(files) - 1, ())
    again = ag.export(boxes, "ply", tmp_path / "out")
    assert (again.files, again.bytes) == (done.files, done.bytes)


def test_the_split_alone_and_some_instances_alone(boxes, tmp_path):
    ag.export(boxes, "ply", tmp_path / "test", split="test")
    assert len(list((tmp_path / "test").rglob("*.ply"))) == 4
    ag.export(ag.open(boxes)[:3], "ply", tmp_path / "some")
    assert len(list((tmp_path / "some").rglob("*.ply"))) == 3
    with pytest.raises(InvalidArgument, match="no split 'tset'; did you mean"):
        ag.export(boxes, "ply", tmp_path / "none", split="tset")


def test_a_killed_export_goes_on_to_the_same_bytes(boxes, tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    ag.export(boxes, "ply", whole)
    code = (
        "import os, signal, sys, articugen as ag\n"
        "def stop(done, items, item):\n"
        "    if done == 5: os.kill(os.getpid(), signal.SIGKILL)\n"
        "ag.export(sys.argv[1], 'ply', sys.argv[2], on_item=stop)"
    )
    assert ended("-c", code, boxes, cut, PYTHONPATH=".").returncode == -signal.SIGKILL
    assert len(list(cut.rglob("*.ply"))) == 5
    # what a kill in the middle of a write leaves: half a file, half a record, a file that was lost
    (cut / "train" / ".box-0_0001.ply.0123abcd.partial").write_bytes(b"ply")
    record = min((cut / LEDGER / "done").glob("train-box-0_0001.*"))
    record.write_bytes(record.read_bytes()[:-9])
    (cut / "train" / "box-0_0000.ply").write_bytes(b"cut")
    kept = (cut / "train" / "box-0_0002.ply").stat().st_mtime_ns
    ag.export(boxes, "ply", cut)
    assert files_in(cut) == files_in(whole)
    assert (cut / "train" / "box-0_0002.ply").stat().st_mtime_ns == kept


def test_what_an_export_leaves_that_is_cut_short_after_its_report_goes_with_the_next(
    boxes, tmp_path
):
    ag.export(boxes, "ply", tmp_path)
    whole = files_in(tmp_path)
    Ledger(Folder(tmp_path)).agree(b"{}")
    (tmp_path / f".{REPORT_NAME}.0123abcd.partial").write_text("{")
    ag.export(boxes, "ply", tmp_path)
    assert files_in(tmp_path) == whole


def test_a_folder_that_holds_something_else_is_refused(boxes, tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("all of it")
    with pytest.raises(ArticugenError, match=r"mine: holds something else \(thesis.tex\); choose"):
        ag.export(boxes, "ply", mine)
    assert files_in(mine) == {"thesis.tex": b"all of it"}
    ag.export(boxes, "ply", tmp_path / "ply", split="test")
    for other in ({"split": "train"}, {"to": "onet"}):
        with pytest.raises(ArticugenError, match="holds an export of other data"):
            ag.export(boxes, **{"to": "ply", "out": tmp_path / "ply", "split": "test", **other})
    (tmp_path / "file").write_text("")
    with pytest.raises(ArticugenError, match="a file is in the way"):
        ag.export(boxes, "ply", tmp_path / "file")
    (mine / "thesis.tex").rename(mine / REPORT_NAME)
    with pytest.raises(ArticugenError, match="holds an export of other data"):
        ag.export(boxes, "ply", mine)


@pytest.mark.parametrize(
    "record",
    [
        b"no json",
        b"[" * 100_000,
        b"[]",
        b'{"left_out": null}',
        b'{"left_out": null, "files": [{"name": "../secret", "bytes": 3, "sha256": ""}]}',
    ],
)
def test_a_record_that_is_not_ours_counts_for_nothing(boxes, tmp_path, record):
    out, whole = tmp_path / "out", tmp_path / "whole"
    (tmp_path / "secret").write_bytes(b"own")
    for folder in (out, whole):
        ag.export(boxes, "ply", folder, split="test")
    unfinish(out)
    Ledger(Folder(out)).record("test/box-2_0000", record)
    ag.export(boxes, "ply", out, split="test")
    assert files_in(out) == files_in(whole)
    assert (tmp_path / "secret").read_bytes() == b"own"


def test_no_link_in_the_folder_is_written_through(boxes, tmp_path):
    """Neither one that lies beside an empty ledger, nor one in the place of a folder of ours."""
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()
    out.mkdir()
    (out / LEDGER).mkdir()
    (out / "test").symlink_to(elsewhere)
    with pytest.raises(ArticugenError, match=r"out: holds something else \(test\)"):
        ag.export(boxes, "ply", out)
    (out / "test").unlink()
    ag.export(boxes, "ply", out, split="test")  # what a kill leaves after a part is no other folder
    whole = files_in(out)
    shutil.move(out / "test", elsewhere / "test")
    (out / "test").symlink_to(elsewhere / "test")
    unfinish(out)
    before = files_in(elsewhere)
    with pytest.raises(ArticugenError, match=r"out: not written: 'test' in it is a symbolic link"):
        ag.export(boxes, "ply", out, split="test")
    assert files_in(elsewhere) == before
    (out / "test").unlink()
    ag.export(boxes, "ply", out, split="test")
    assert files_in(out) == whole


def unfinish(folder: Path) -> None:
    """Make a finished export one that was cut short before its report."""
    report = json.loads((folder / REPORT_NAME).read_text())
    ledger = Ledger(Folder(folder))
    ledger.agree(json.dumps(report["about"]).encode())
    for file in report["files"]:
        if file["name"].endswith(".ply"):
            record = {"files": [file], "left_out": None}
            ledger.record(file["name"][:-4], json.dumps(record).encode())
    (folder / REPORT_NAME).unlink()


def test_two_exports_do_not_write_into_one_folder(boxes, tmp_path):
    def another(done, items, item):
        if done == 1:
            with pytest.raises(ArticugenError, match="another run is writing here"):
                ag.export(boxes, "ply", tmp_path / "out")

    ag.export(boxes, "ply", tmp_path / "out", on_item=another)


def test_what_a_format_does_not_take_is_refused(boxes, tmp_path):
    with pytest.raises(InvalidArgument, match="ply does not heed collision: it takes no option"):
        ag.export(boxes, "ply", tmp_path, collision=True)
    with pytest.raises(InvalidArgument, match="glb does not heed occupancy: it takes resolution"):
        ag.export(boxes, "glb", tmp_path, occupancy="material")
    with pytest.raises(InvalidArgument, match="occupancy is visible or material, not 'solid'"):
        ag.export(boxes, "onet", tmp_path, occupancy="solid")
    assert not files_in(tmp_path)


def test_what_a_format_cannot_hold_is_left_out_and_said(boxes, tmp_path):
    with pytest.raises(InvalidArgument, match=r"imnet can hold nothing of .*: box-0: 1024 uniform"):
        ag.export(boxes, "imnet", tmp_path / "imnet")
    rows = ag.open(boxes)
    without = [i for i, row in enumerate(rows) if row.object_id != "box-0" or row.state_index]
    done = ag.export(rows[without], "particulate", tmp_path / "out")
    assert done.left_out == ("box-0: its canonical pose, state 0, is not in the data",)
    assert ag.export(rows[without], "particulate", tmp_path / "out").left_out == done.left_out


def test_particulate_leaves_out_what_has_no_surface(tmp_path):
    path = shard(tmp_path / "train-00000.h5", hinged_box([(0.0, 0.0)], object_id="box-0"))
    names = ("surface_points", "surface_normals", "surface_part")
    rewrite(path, lambda rows: [replace(r, **{n: getattr(r, n)[:0] for n in names}) for r in rows])
    with pytest.raises(InvalidArgument, match=r"box-0: 0 surface points are stored"):
        ag.export(path, "particulate", tmp_path / "out")


def test_models_that_are_gone_name_the_cure(boxes, tmp_path):
    with pytest.raises(ArticugenError, match="take the parts from the stored grids, with --from"):
        ag.export(boxes, "glb", tmp_path / "glb")


def test_a_library_that_is_missing_is_named_before_a_file_is_written(boxes, tmp_path, monkeypatch):
    monkeypatch.setattr("articugen.export.run.find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"pip install 'articugen\[export\]'"):
        ag.export(boxes, "parquet", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["../../etc/passwd", "a b", "Schränke", "", "a/b", "x" * 300, "."])
def test_names_of_files_are_safe_and_tell_texts_apart(name):
    made = file_name(name)
    assert made not in ("", ".", "..")
    assert len(made.encode()) <= 80
    assert not set(made) & set("/\\. \0")
    assert made != file_name(name + "!")
    assert file_name("Schränke") == "Schränke"


@given(st.sets(st.text("ab/_-0\u00e4", max_size=6), min_size=2), st.booleans())
def test_no_two_texts_share_a_name(texts, again):
    if again:  # what others are called is hostile, too
        texts |= {file_name(text) for text in texts}
    assert len({file_name(text) for text in texts}) == len(texts)


def of_names(folder: Path, *names: tuple[str, str], states: Any = ((0.0, 0.0),)) -> Path:
    """A folder of shards with one object each, of a split and an id."""
    folder.mkdir()
    for number, (split, name) in enumerate(names):
        path = folder / f"{split}-{number:05d}.h5"
        shard(path, hinged_box(object_id=name, states=states), split=split)
    return folder


@pytest.mark.parametrize("to", ["onet", "npcs", "opalign", "particulate", "ply", "webdataset"])
def test_all_files_of_objects_whose_names_were_alike(tmp_path, to):
    data = of_names(tmp_path / "data", ("train", "a/b"), ("train", "a_b-c14cddc0"), ("test", "c"))
    done = ag.export(data, to, tmp_path / "out")
    rows = ag.open(data)
    names = {file_name(name) for name in rows.objects}
    assert len(names) == 3
    there = files_in(tmp_path / "out")
    assert done.files == len(there) - 1
    for name in names:
        assert any(name in path or name.encode() in text for path, text in there.items())


def alike() -> tuple[str, str]:
    """Two texts whose names are the same, by a digest of 32 bits that they share."""
    known: dict[str, str] = {}
    for odd in product(map(chr, range(0x2010, 0x205E)), repeat=3):
        text = "".join(odd)
        other = known.setdefault(file_name(text), text)
        if other != text:
            return other, text
    raise AssertionError("there is none")


def test_instances_that_would_be_called_alike_are_refused(boxes, tmp_path):
    out = tmp_path / "out"
    both = of_names(tmp_path / "both", ("test", "a"), ("train", "a"))
    with pytest.raises(InvalidArgument, match=r"'a' \(test\) and 'a' \(train\) would be called"):
        ag.export(both, "onet", out)
    one, other = alike()
    same = of_names(tmp_path / "same", ("train", one), ("train", other))
    with pytest.raises(InvalidArgument, match="would be called alike"):
        ag.export(same, "imnet", out)
    with pytest.raises(InvalidArgument, match="choose instances that are there once"):
        ag.export(ag.open(boxes)[[0, 1, 0]], "ply", out)
    assert not out.exists()


def test_processes_write_the_same_files(tmp_path):
    """An object of five has no canonical pose: it is left out, wherever that is noticed."""
    names = [("train", name) for name in "abcde"]
    rows = ag.open(of_names(tmp_path / "data", *names, states=((0.0, 0.0), (0.3, 0.2))))
    some = rows[[i for i in range(10) if i != 2]]
    assert rows[2].object_id == "b"
    alone, together = tmp_path / "alone", tmp_path / "together"
    notes = []
    for out, jobs in ((alone, 1), (together, 2)):
        done = ag.export(
            some, "glb", out, from_grids=True, jobs=jobs,
            on_item=lambda n, of, item: notes.append((n, of, item.key)),
        )  # fmt: skip
        assert len(done.left_out) == 1
        assert "b: its canonical pose, state 0, is not in the data" in done.left_out[0]
    assert files_in(alone) == files_in(together)
    assert len(list(alone.rglob("*.glb"))) == 4
    assert notes[:5] == notes[5:] == [(i + 1, 5, f"train/{name}") for i, name in enumerate("abcde")]


def test_two_items_with_one_file_are_refused(tmp_path):
    target = Target(tmp_path, {"format": "ply"}, Options())
    file = Written("train/a.ply", 3, "00")
    target.finished("a", [file], None)
    with pytest.raises(ArticugenError, match=r"a\.ply: two things would be called so; rename an"):
        target.finished("b", [file], None)
    with pytest.raises(ArticugenError, match="two things would be called so"):
        target.write("train/a.ply", b"ply")


def test_names_are_not_given_twice():
    assert unique(["door", "door", "door_2", "a\nb"]) == ("door", "door_2", "door_2_2", "a_b")


def test_the_command_exports_and_goes_on(boxes, tmp_path):
    out = tmp_path / "out"
    for _ in range(2):
        done = run("export", boxes, "--to", "ply", "--out", out, "--split", "test")
        assert done.exit_code == 0, done.output
        assert "out: 5 files" in done.output
    done = run("export", boxes, "--to", "ditto", "--out", tmp_path / "ditto")
    assert done.exit_code == 1
    assert "one joint alone moves, by 0.3 of its range, as in Ditto" in done.output
    rows = shutil.copytree(boxes, tmp_path / "box")
    (rows / "manifest.json").unlink()
    done = run("export", rows / "train-00000.h5", "--to", "ply", "--out", tmp_path / "shard")
    assert done.exit_code == 0, done.output


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["--to"], 0, "webdataset"),
        ([], 0, "webdataset"),
        (["data", "--to", "--out", "x"], 2, "name a format with --to; --to alone lists them"),
        (["data", "--to", "plz", "--out", "x"], 1, "no format 'plz'; did you mean 'ply'"),
        (["data", "--to", "ply"], 2, "name a folder with --out as well"),
        (["--to", "ply", "--out", "x"], 2, "name a data set as well"),
        (["nowhere", "--to", "ply", "--out", "x"], 1, "there is no such shard or folder"),
    ],
)
def test_the_command_says_what_is_missing(arguments, status, says):
    done = run("export", *arguments)
    assert (done.exit_code, says in done.output) == (status, True), done.output
    assert status == 0 or done.output.count("\n") == 1
