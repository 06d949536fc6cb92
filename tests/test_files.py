"""Files: hostile ones are refused before they are read, ours are whole or not there."""

import errno
import os
import socket
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from command_line import run

from articugen.core import files
from articugen.core.errors import InvalidArgument, InvalidSource, MachineFault
from articugen.core.files import (
    UnfitFile,
    check_place,
    make_folder,
    partial_name,
    read_or_refuse,
    read_regular,
    room_at,
    whole_name,
    within,
    write_atomically,
    written_atomically,
)
from articugen.inspection.report.page import write_report
from articugen.instance.again import write_meshes
from articugen.pictures.contact_sheet import contact_sheet


def test_a_regular_file_is_read(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_regular(path, 5) == b"12345"
    link = tmp_path / "link"
    link.symlink_to(path)
    assert read_regular(link, 5) == b"12345"
    with pytest.raises(UnfitFile, match="symbolic link"):
        read_regular(link, 5, follow=False)
    with pytest.raises(UnfitFile, match="5 bytes, more than the 4 that it may have"):
        read_regular(path, 4)


@pytest.mark.parametrize("name", ["", "/x", "../x", "a/../../x", "a//x", "a/.", "a\0", "a/", "..."])
def test_names_that_lead_out_of_a_folder_are_refused(tmp_path, name):
    with pytest.raises(UnfitFile, match="is no name of a file in it"):
        within(tmp_path, name)


def test_a_path_goes_through_no_link_below_the_folder(tmp_path):
    (tmp_path / "real" / "a").mkdir(parents=True)
    folder = tmp_path / "named"
    folder.symlink_to("real")  # the folder itself was named
    assert within(folder, "a/b/..c") == folder / "a" / "b" / "..c"
    for link in ("a/link", "gone"):
        (folder / link).symlink_to(tmp_path if link == "a/link" else "nowhere")
        for name in (link, f"{link}/file"):
            with pytest.raises(UnfitFile, match=r"'(link|gone)' in it is a symbolic link"):
                within(folder, name)


def test_no_more_room_is_made_than_a_file_takes(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    tracemalloc.start()
    try:
        assert read_regular(path, 1 << 31) == b"12345"
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_no_refusal_moves_the_cursor_or_fills_the_screen():
    hostile = "a\x1b[2J\nb \u202e é \ud800"
    assert str(InvalidSource(hostile)) == "a\\x1b[2J\\nb \\u202e é \\ud800"
    assert str(InvalidArgument(hostile)) == str(InvalidSource(hostile))
    endless = str(InvalidSource("m.urdf: " + "x" * 10**6 + "; shorten it"))
    assert len(endless) < 2000
    assert endless.startswith("m.urdf: xx")
    assert endless.endswith("; shorten it")
    assert str(InvalidSource("zwei  Räume")) == "zwei  Räume"


def test_what_is_no_regular_file_is_refused_unopened(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "to_fifo").symlink_to("fifo")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
    kinds = {"fifo": "a FIFO", "to_fifo": "a FIFO", "socket": "a socket", "": "a folder"}
    for name, kind in kinds.items():
        with pytest.raises(UnfitFile, match=f"it is {kind}, not a regular file"):
            read_regular(tmp_path / name, 100)
    with pytest.raises(UnfitFile, match="a device"):
        read_regular(Path("/dev/zero"), 100)


def test_what_is_not_there_is_an_ordinary_error(tmp_path):
    (tmp_path / "round").symlink_to("round")
    for name in ("nothing", "round", "x" * 300):
        with pytest.raises(OSError, match=r"No such file|levels of symbolic|name too long") as told:
            read_regular(tmp_path / name, 100)
        assert not isinstance(told.value, UnfitFile)
    for name in ("a\0b", "\ud800"):
        with pytest.raises(UnfitFile, match="no file can have that name"):
            read_regular(Path(name), 100)


@pytest.mark.skipif(not Path("/proc/kallsyms").is_file(), reason="Linux only")
def test_what_cannot_be_read_is_refused_with_a_cure_and_a_broken_disk_is_none_of_its_faults(
    tmp_path, monkeypatch
):
    (tmp_path / "file").write_bytes(b"12345")
    assert read_or_refuse(tmp_path / "file", 5, InvalidSource, "mend it") == b"12345"
    for name, why in (("file", "5 bytes, more than the 4"), ("none", "No such file")):
        with pytest.raises(InvalidSource, match=f"{name}: cannot be read: {why}.*; mend it"):
            read_or_refuse(tmp_path / name, 4, InvalidSource, "mend it")

    def fails(*_args, **_more):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(files, "open_regular", fails)
    with pytest.raises(MachineFault, match="Input/output error; the disk or the network"):
        read_or_refuse(tmp_path / "file", 5, InvalidSource, "mend it")


def test_a_file_that_is_larger_than_it_says(tmp_path):
    with pytest.raises(UnfitFile, match="more than the 10 bytes"):
        read_regular(Path("/proc/kallsyms"), 10)


def test_each_write_has_a_temporary_name_of_its_own(tmp_path):
    one, other = partial_name("a.h5"), partial_name("a.h5")
    assert one != other
    assert whole_name(one) == whole_name(other) == "a.h5"
    for name in ("a.h5", ".a.h5.partial", ".a.h5.0123456.partial", "..01234567.partial"):
        assert whole_name(name) is None

    def look(temporary: Path) -> None:
        assert whole_name(temporary.name) == "a.h5"
        write_atomically(tmp_path / "a.h5", b"of another run")

    with written_atomically(tmp_path / "a.h5", check=look) as file:
        file.write(b"mine")
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.h5", b"mine")]


def test_nothing_is_written_through_links(tmp_path, monkeypatch):
    """Neither the temporary name nor the final one leads out of the folder."""
    mine = tmp_path / "mine.txt"
    mine.write_bytes(b"precious")
    (tmp_path / "a.h5").symlink_to(mine)
    write_atomically(tmp_path / "a.h5", b"new")
    assert not (tmp_path / "a.h5").is_symlink()
    monkeypatch.setattr(files.secrets, "token_hex", lambda _: "01234567")
    (tmp_path / ".b.h5.01234567.partial").symlink_to(mine)
    with pytest.raises(MachineFault, match="in the way"):
        write_atomically(tmp_path / "b.h5", b"new")
    assert mine.read_bytes() == b"precious"


def test_the_names_of_new_folders_are_synchronised(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(files, "sync", synced.append)
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    assert set(synced) == {tmp_path, tmp_path / "a"}
    make_folder(tmp_path / "a" / "b")
    assert len(synced) == 2


def test_a_file_where_a_folder_should_be_is_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(MachineFault, match="not written: a file is in the way"):
            make_folder(folder)


def test_where_nothing_can_be_written_no_work_is_begun(tmp_path, monkeypatch):
    """Whoever writes a file at the end looks first whether there is a place for it."""

    def work(*_, **__):
        raise AssertionError("worked first")

    for name in ("articugen.inspection.report.page.facts", "articugen.verify.replay.prepared_again",
                 "articugen.pictures.contact_sheet.chosen_of",
                 "articugen.discovery.objects.discover"):  # fmt: skip
        monkeypatch.setattr(name, work)
    (tmp_path / "a.html").mkdir()
    clouds = [tmp_path / "a.npy", tmp_path / "b.npy"]
    for cloud in clouds:
        np.save(cloud, np.zeros((9, 3)))
    for folder, cure in (("nowhere", "make it first"), ("a.npy", "a file is in the way")):
        place = tmp_path / folder
        for begin in (
            lambda place=place: write_report(tmp_path, [], place / "a.html"),
            lambda place=place: contact_sheet([], place / "a.png"),
            lambda place=place: write_meshes(tmp_path, "a", 0, 8, place / "a.ply", "material"),
        ):
            with pytest.raises(MachineFault, match=cure):
                begin()
        done = run("discover", *clouds, "--json", place / "joints.json")
        assert done.exit_code == 1
        assert cure in " ".join(done.stderr.split())
    with pytest.raises(MachineFault, match="a folder has that name"):
        write_report(tmp_path, [], tmp_path / "a.html")
    before = sorted(tmp_path.iterdir())
    check_place(tmp_path / "a.png")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no such file system")
def test_room_is_told_of_folders_to_come_and_not_of_disks_that_do_not_know(tmp_path):
    assert room_at(tmp_path / "not" / "yet") > 0
    with pytest.raises(OSError, match="not implemented"):
        room_at(Path("/proc"))
