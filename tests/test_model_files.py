"""Names in a model's files lead to its own files alone; hash and limits of them."""

import os

import pytest
from test_meshes import SQUARE_OBJ, write

from articugen.errors import InvalidSource
from articugen.sources import meshes, model_files
from articugen.sources.meshes import read_mesh
from articugen.sources.model_files import ModelFiles


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


@pytest.mark.parametrize(
    "name",
    [
        "../../secret.obj",
        "package://arm/../secret.obj",
        "package://robots/secret.obj",
        "package://../secret.obj",
        "package:///secret.obj",
        "package://nowhere/a.obj",
        "http://example.org/a.obj",
        "link.obj",
        "package://arm/urdf/link.obj",
    ],
)
def test_names_that_lead_out_are_refused(model, name):
    (model.folder / "link.obj").symlink_to(model.root.parent / "secret.obj")
    with pytest.raises(InvalidSource):
        model.find(name)


def test_existing_file_outside_is_not_read_by_its_absolute_path(model):
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
    monkeypatch.setattr(meshes, "MAX_COUNT", 8)
    with pytest.raises(InvalidSource, match="more than 8 vertices or faces"):
        read_mesh(path)
    monkeypatch.setattr(model_files, "MAX_FILE_BYTES", 50)
    with pytest.raises(InvalidSource, match="larger than"):
        read_mesh(path)
