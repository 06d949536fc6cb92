"""Names in a model's files lead to its own files alone; hash and limits of them."""

import errno
import os

import pytest
from test_meshes import SQUARE_OBJ, write
from trouble import unfit

from articugen.core.errors import InvalidSource, MachineFault
from articugen.meshes import model_files
from articugen.meshes.model_files import ModelFiles
from articugen.meshes.read import read_mesh
from articugen.sources import readers
from articugen.sources.source import load_path, open_source


@pytest.fixture
def model(tmp_path) -> ModelFiles:
    """robots/pkg/{package.xml, urdf/b.obj, meshes/a.obj} and robots/secret.obj; pkg is the root."""
    package = tmp_path / "robots" / "pkg"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    write(package / "package.xml", "<package><name>arm</name></package>")
    write(package / "meshes" / "a.obj", SQUARE_OBJ + "f 1 2 3\n")
    write(package / "urdf" / "b.obj", SQUARE_OBJ + "f 1 2 4\n")
    write(tmp_path / "robots" / "secret.obj", SQUARE_OBJ + "f 1 2 3\n")
    return ModelFiles(package / "urdf", package)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("../meshes/a.obj", "meshes/a.obj"),
        ("b.obj", "urdf/b.obj"),
        ("package://arm/meshes/a.obj", "meshes/a.obj"),
        ("package://pkg/meshes/a.obj", "meshes/a.obj"),
        ("package://meshes/a.obj", "meshes/a.obj"),
        ("/home/somebody/data/b.obj", "urdf/b.obj"),
        ("file:///home/somebody/data/b.obj", "urdf/b.obj"),
        ("../meshes/none.obj", None),
        ("/home/somebody/none.obj", None),
        ("package://arm/none.obj", None),
        ("../meshes", None),
    ],
)
def test_names_lead_to_files(model, name, found):
    assert model.find(name) == (found and model.root / found)
    assert model.find(str(model.root.parent / "secret.obj")) is None


def test_hash_depends_on_names_and_bytes_alone(model, tmp_path):
    a, b = model.root / "meshes" / "a.obj", model.root / "urdf" / "b.obj"
    orders = [ModelFiles(model.folder, model.root) for _ in range(2)]
    for files, paths in zip(orders, ([a, b], [b, a, b]), strict=True):
        for path in paths:
            files.read(path)
    assert orders[0].sha256() == orders[1].sha256()
    moved = tmp_path / "elsewhere"
    os.rename(model.root, moved)
    files = ModelFiles(moved / "urdf", moved)
    files.read(moved / "meshes" / "a.obj"), files.read(moved / "urdf" / "b.obj")
    assert files.sha256() == orders[0].sha256()
    swapped = ModelFiles(moved / "urdf", moved)
    (moved / "urdf" / "b.obj").rename(moved / "urdf" / "c.obj")
    swapped.read(moved / "meshes" / "a.obj"), swapped.read(moved / "urdf" / "c.obj")
    assert swapped.sha256() != orders[0].sha256()


def test_limits_on_size(tmp_path, monkeypatch):
    path = write(tmp_path / "m.obj", SQUARE_OBJ + "f 1 2 3\n" * 9)
    other = write(tmp_path / "n.obj", SQUARE_OBJ + "f 1 2 3\n")
    files = ModelFiles(tmp_path)
    monkeypatch.setattr(model_files, "MAX_MODEL_BYTES", 140)
    files.read(path), files.read(path)
    with pytest.raises(InvalidSource, match=r"n\.obj: with it the model's files have more than"):
        files.read(other)
    monkeypatch.setattr(model_files, "MAX_FILE_BYTES", 50)
    with pytest.raises(InvalidSource, match="more than the 50 that it may have; simplify it"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("a" * 256 + ".obj", "more than 255 bytes; shorten it"),
        ("\u00e4" * 200, "more than 255 bytes"),
        ("package://" + "a" * 300 + "/a.obj", "more than 255 bytes"),
        ("meshes/\0.obj", "is no name of a file"),
        ("meshes/\udcff.obj", "is no name of a file"),
        ("", "is no name of a file"),
        ("https://example.org/a.obj", "is on the network, and nothing is fetched; save it in"),
        ("model://arm/a.obj", "unknown kind, 'model'; use a relative path"),
        ("../../a.obj", "leads out of .*; copy the file into that folder"),
        (
            "package://nowhere/a.obj",
            "no folder above, up to .*/pkg, has a package.xml of the name 'nowhere'",
        ),
        ("package:///a.obj", "has no name of a package"),
        ("../" * 3000 + "a.obj", "leads out of"),
        *(
            (f"package://{name}", "package|leads out")
            for name in ("arm/../secret.obj", "../secret.obj", "robots/a")
        ),
        ("link.obj", "link"),
        ("package://arm/urdf/link.obj", "link"),
    ],
)
def test_a_refused_name_tells_who_uses_it_and_the_cure(model, name, problem):
    (model.folder / "link.obj").symlink_to(model.root.parent / "secret.obj")
    with pytest.raises(InvalidSource, match=problem) as caught:
        model.find(name, "m.urdf: link 'a'")
    message = str(caught.value)
    assert message.startswith("m.urdf: link 'a': file ")
    assert ";" in message
    assert len(message) < 700
    assert message.isprintable()


def test_only_regular_files_are_read(model):
    """And none is waited for: a FIFO has no writer, /dev/zero no end."""
    os.mkfifo(model.folder / "fifo.obj")
    (model.folder / "loop.obj").symlink_to("loop.obj")
    (model.folder / "closed.obj").symlink_to("b.obj")
    found = model.find("fifo.obj")
    assert found is not None
    with pytest.raises(InvalidSource, match="it is a FIFO, not a regular file; put a regular file"):
        model.read(found)
    with pytest.raises(InvalidSource, match=r"loop\.obj: cannot be read: Too many levels"):
        model.find("loop.obj")
    assert model.find("closed.obj") == model.folder / "b.obj"
    (model.folder / "out.obj").symlink_to(model.root.parent / "secret.obj")
    with pytest.raises(InvalidSource, match="is a symbolic link out of the model's folder"):
        model.read(model.folder / "out.obj")


@pytest.mark.parametrize("kind", ["FIFO", "folder", "device", "round link"])
def test_a_package_xml_that_is_no_file_is_none(model, kind):
    (model.root / "package.xml").unlink()
    unfit(model.root / "package.xml", kind, 0)
    with pytest.raises(InvalidSource, match=r"no folder above, up to .*, has a package"):
        model.find("package://arm/meshes/a.obj")
    assert model.find("package://pkg/meshes/a.obj") is not None


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.EIO, MachineFault),
        (errno.EMFILE, MachineFault),
        (errno.ENOMEM, MemoryError),
        (errno.EACCES, InvalidSource),
        (errno.ENOENT, InvalidSource),
    ],
)
def test_a_fault_of_the_machine_is_not_the_models(model, monkeypatch, number, kind):
    path = model.find("b.obj")

    def fails(*_args, **_kinds):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(model_files, "read_regular", fails)
    with pytest.raises(kind):
        model.read(path)


NAMED = '<mesh filename="package://arm/meshes/a.obj"/>'


@pytest.mark.parametrize(
    ("named", "name", "read"),
    [
        ("robots", "robots", True),
        ("robots/pkg", "robots/pkg", True),
        ("robots/pkg/robots", "robots/pkg", False),
        ("robots/pkg/robots/one", "robots/pkg", False),
        ("robots/pkg/robots/one/m.urdf", "robots/pkg", True),  # stands for its package
        ("robots/pkg/robots/one/m.urdf", "robots", False),  # which is the nearest one
        ("robots/pkg/urdf", "robots/pkg", False),
    ],
)
def test_no_package_above_the_folder_that_was_named_is_read(tmp_path, named, name, read):
    """A stranger's model in a folder of somebody's own package is not part of that."""
    package = tmp_path / name
    text = VISUAL.format(NAMED)
    for folder in (
        "robots/pkg/robots/one",
        "robots/pkg/urdf",
        "robots/pkg/meshes",
        f"{name}/meshes",
    ):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    write(tmp_path / "robots" / "pkg" / "package.xml", "<package><name>other</name></package>")
    write(package / "package.xml", "<package><name>arm</name></package>")
    write(package / "meshes" / "a.obj", SQUARE_OBJ + "f 1 2 3\n")
    folder = "urdf" if named.endswith("urdf") and "one" not in named else "robots/one"
    write(tmp_path / "robots" / "pkg" / folder / "m.urdf", text)
    for load in (load_path, lambda path: readers.load(*open_source(path).objects("x"))):
        if read:
            assert len(load(tmp_path / named).links[0].mesh.faces) == 1
        else:
            with pytest.raises(InvalidSource, match="is of a package that is not found: no folder"):
                load(tmp_path / named)


def test_the_meshes_beside_a_folder_called_urdf_are_not_read_where_that_was_named(tmp_path):
    for folder in ("urdf", "meshes"):
        (tmp_path / "pkg" / folder).mkdir(parents=True)
    write(tmp_path / "pkg" / "meshes" / "a.obj", SQUARE_OBJ + "f 1 2 3\n")
    text = VISUAL.format('<mesh filename="../meshes/a.obj"/>')
    path = write(tmp_path / "pkg" / "urdf" / "m.urdf", text)
    for named in (path, tmp_path):
        assert len(load_path(named).links[0].mesh.faces) == 1
    with pytest.raises(InvalidSource, match="leads out of"):
        load_path(tmp_path / "pkg" / "urdf")


VISUAL = """<robot name="r"><link name="a"><visual><geometry>{}</geometry></visual></link>
<link name="b"/>
<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>"""
