"""Folders of bundled models: whole, as they were made, and healed where they are not."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from articugen.core.content import MODELS
from articugen.core.errors import MachineFault
from articugen.procedural import cache, write_object
from articugen.procedural.cache import SEAL_NAME, is_sealed, stored

NAME = "eyeglasses_0000"
SMALL = {"object_id": "small_0000", "messy": False}


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def write_small(work: Path) -> None:
    (work / "a.obj").write_text("v 0 0 0\n")
    (work / "model.urdf").write_text("<robot/>")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a folder of the object must hold."""
    folder = tmp_path_factory.mktemp("whole") / NAME
    return contents(write_object("eyeglasses", NAME, folder).parent)


@pytest.fixture
def folder(whole: dict[str, bytes], tmp_path: Path) -> Path:
    """A whole folder of its own."""
    made = tmp_path / NAME
    made.mkdir()
    for name, data in whole.items():
        (made / name).write_bytes(data)
    return made


def alter_vertex(folder: Path) -> None:
    path = folder / "front.obj"
    path.write_text(path.read_text().replace("v 0.0", "v 0.1", 1))


def empty(folder: Path) -> None:
    (folder / "front.obj").write_bytes(b"")


def remove_mesh(folder: Path) -> None:
    (folder / "left_temple.obj").unlink()


def alter_truth(folder: Path) -> None:
    (folder / "solids.json").write_bytes((folder / "solids.json").read_bytes() + b" ")


def alter_urdf(folder: Path) -> None:
    path = folder / "model.urdf"
    path.write_text(path.read_text().replace("front.obj", "../other/front.obj"))


def pipe_for_mesh(folder: Path) -> None:
    remove_mesh(folder)
    os.mkfifo(folder / "left_temple.obj")


def link_for_mesh(folder: Path) -> None:
    (folder / "left_temple.obj").rename(folder.parent / "elsewhere.obj")
    (folder / "left_temple.obj").symlink_to(folder.parent / "elsewhere.obj")


def without_seal(folder: Path) -> None:
    (folder / SEAL_NAME).unlink()


def of_other_shapes(folder: Path) -> None:
    path = folder / SEAL_NAME
    seal = json.loads(path.read_text())
    assert seal["content_version"] == MODELS["eyeglasses"]
    path.write_text(json.dumps(seal | {"content_version": seal["content_version"] - 1}))


def deep_seal(folder: Path) -> None:
    (folder / SEAL_NAME).write_text("[" * 100_000)


def seal_of_names_elsewhere(folder: Path) -> None:
    (folder / SEAL_NAME).write_text('{"files": {"../../x": ""}}')


DAMAGES = [
    alter_vertex, empty, remove_mesh, alter_truth, alter_urdf, pipe_for_mesh, link_for_mesh,
    without_seal, of_other_shapes, deep_seal, seal_of_names_elsewhere,
]  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_what_is_not_as_it_was_made_is_made_again(
    folder: Path, whole: dict[str, bytes], damage
) -> None:
    damage(folder)
    assert write_object("eyeglasses", NAME, folder) == folder / "model.urdf"
    assert contents(folder) == whole


def test_a_whole_folder_is_left_alone(folder: Path, whole: dict[str, bytes]) -> None:
    before = {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}
    write_object("eyeglasses", NAME, folder)
    assert {p.name: p.stat().st_mtime_ns for p in folder.iterdir()} == before
    write_object("eyeglasses", NAME, folder, messy=True)
    assert contents(folder) != whole, "the messy object is another one"


def test_many_writers_of_one_object_leave_one_whole_object(tmp_path: Path) -> None:
    folder = tmp_path / "small_0000"
    folder.mkdir()
    (folder / SEAL_NAME).write_text("half a se")
    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(lambda _: stored(folder, SMALL, write_small), range(24)))
    assert set(paths) == {folder}
    assert is_sealed(folder, SMALL)
    assert [p.name for p in tmp_path.iterdir()] == [folder.name]


SLOW_WRITER = """
import sys, time
from pathlib import Path
from articugen.procedural.cache import stored
def write(work):
    (work / "a.obj").write_text("half")
    print(flush=True)
    time.sleep(60)
stored(Path(sys.argv[1]), {"object_id": "small_0000", "messy": False}, write)
"""


def test_what_a_killed_writer_left_goes_and_what_a_living_one_uses_stays(tmp_path: Path) -> None:
    folder = tmp_path / "small_0000"
    writers = [
        subprocess.Popen([sys.executable, "-c", SLOW_WRITER, str(folder)], stdout=subprocess.PIPE)
        for _ in range(2)
    ]
    try:
        for writer in writers:
            assert writer.stdout is not None
            writer.stdout.readline()
        writers[0].send_signal(signal.SIGKILL)
        writers[0].wait()
        assert len(list(tmp_path.iterdir())) == 2
        stored(folder, SMALL, write_small)
        assert is_sealed(folder, SMALL)
        left = [p for p in tmp_path.iterdir() if p != folder]
        assert len(left) == 1
        assert (left[0] / "a.obj").read_text() == "half"
    finally:
        for writer in writers:
            writer.kill()
            writer.communicate()


@contextmanager
def limited(kind: int, most: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(kind, (soft, hard))


def test_a_fault_of_the_machine_is_no_verdict_on_the_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # it would be cut short
    folder = tmp_path / NAME
    with (
        limited(resource.RLIMIT_FSIZE, 2000),
        pytest.raises(MachineFault, match=r"not written: files may not grow so large"),
    ):
        write_object("eyeglasses", NAME, folder)
    assert not list(tmp_path.iterdir())
    used = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 3
    with (
        limited(resource.RLIMIT_NOFILE, used - 1),
        pytest.raises(MachineFault, match=r"not written: Too many open files"),
    ):
        write_object("eyeglasses", NAME, folder)

    def starve(_: Path) -> None:
        bytearray(1 << 62)

    with pytest.raises(MachineFault, match="no memory is left; use fewer jobs"):
        stored(tmp_path / "small_0000", SMALL, starve)
    assert not list(tmp_path.iterdir())
    write_object("eyeglasses", NAME, folder)


@pytest.mark.skipif(not Path("/sys").is_dir(), reason="a folder that nobody can write to")
def test_where_the_checkout_is_read_only_models_are_kept_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "CACHE", tmp_path)
    folder = Path("/sys/articugen/small_0000")
    kept = stored(folder, SMALL, write_small)
    assert kept.is_relative_to(tmp_path)
    assert is_sealed(kept, SMALL)
    stamp = (kept / SEAL_NAME).stat().st_mtime_ns
    time.sleep(0.01)
    assert stored(folder, SMALL, write_small) == kept
    assert (kept / SEAL_NAME).stat().st_mtime_ns == stamp
