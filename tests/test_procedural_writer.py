"""Models as files: where the truth is, the same for the same id, messy where asked."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yourdfpy
from numpy.typing import NDArray

from articugen.core.errors import InvalidSource, MachineFault
from articugen.core.geometry import apply
from articugen.core.records import Floats
from articugen.core.seeding import generator
from articugen.meshes.model_text import Visual, urdf_text
from articugen.procedural import CATEGORIES, build_model, write_object
from articugen.procedural.kit import writer
from articugen.procedural.kit.model import Model, ModelJoint, ModelLink
from articugen.procedural.kit.solids import box, prism
from articugen.sources import readers
from articugen.sources.source import open_source, write_bundled
from tests.procedural_truth import (
    L_SHAPE,
    assert_sound,
    is_closed,
    link_frames,
    object_id,
    random_state,
    truth_of,
    written,
)


def small_model() -> Model:
    """A body with a knob that stands on it, a lid with a thin pane, and a drawer."""
    body = (
        box((0, 0, 0), (0.4, 0.3, 0.1)),
        box((0.1, 0.1, 0.1), (0.12, 0.12, 0.13)),
        box((0.0, 0.1, 0.1), (0.05, 0.2, 0.11)),
    )
    lid = (
        box((0, 0, 0.15), (0.4, 0.3, 0.16)),
        box((0.1, 0.1, 0.165), (0.3, 0.2, 0.166), panel=True),
    )
    tray = (prism(L_SHAPE * 0.05 + (0.5, 0.0), 0.0, 0.05),)
    joints = (
        ModelJoint("hinge", "revolute", "body", "lid", (0.4, 0, 0.14), (0, 1, 0), 0.0, 2.0),
        ModelJoint("slide", "prismatic", "lid", "tray", (0.5, 0, 0), (1, 0, 0), 0.0, 0.2),
    )
    links = (
        ModelLink("body", "body", body),
        ModelLink("lid", "lid", lid),
        ModelLink("tray", "tray", tray),
    )
    return Model(links, joints)


def files_of(model: Model, folder: Path, *, messy: int) -> Path:
    """The URDF of a model that was written into a new folder."""
    folder.mkdir()
    writer.write_model(model, folder, object_id="m", category="none", messy=messy)
    return folder / writer.URDF_NAME


def test_a_model_is_a_tree() -> None:
    model = small_model()
    with pytest.raises(ValueError, match="parent must come first"):
        Model(model.links, model.joints[::-1])
    with pytest.raises(ValueError, match="each link but the first"):
        Model(model.links, model.joints[:1])
    with pytest.raises(ValueError, match="may not be called base"):
        Model((ModelLink("base", "", model.links[0].solids),), ())


@pytest.mark.parametrize("messy", [0, 1, 2])
def test_files_stand_where_the_model_was_drawn(tmp_path: Path, messy: int) -> None:
    path = files_of(small_model(), tmp_path / "m", messy=messy)
    robot = yourdfpy.URDF.load(str(path))
    robot.update_cfg(np.zeros(2))
    drawn = np.concatenate([s.vertices for k in small_model().links for s in k.solids])
    box_drawn = np.stack([drawn.min(axis=0), drawn.max(axis=0)])
    if messy:  # The tray's and the body's outlines remain, whatever became a sheet.
        np.testing.assert_allclose(robot.scene.bounds, box_drawn, atol=2e-3)
        decal = 2e-4 if messy == 2 else 1e-8
        np.testing.assert_allclose(robot.scene.bounds[0], box_drawn[0], atol=decal)
    else:
        np.testing.assert_allclose(robot.scene.bounds, box_drawn, atol=1e-8)


@pytest.mark.parametrize("messy", [0, 1, 2])
@pytest.mark.parametrize("category", ["laptop", "eyeglasses"])
def test_meshes_lie_on_the_truth(tmp_path: Path, category: str, messy: int) -> None:
    """Just inside each triangle there is its link: with yourdfpy's kinematics, at random states."""
    name = object_id(category, 2)
    obj, truth = written(category, name, tmp_path / name, messy=messy)
    robot = yourdfpy.URDF.load(str(tmp_path / name / "model.urdf"))
    rng = generator(0, name, "states")
    q = random_state(obj, rng)
    robot.update_cfg(dict(zip([j.name for j in obj.moving_joints], q, strict=True)))
    T = {link.name: robot.get_transform(link.name) for link in obj.links}
    for link in obj.links:
        if len(link.mesh.faces) == 0:
            continue
        a, b, c = np.moveaxis(link.mesh.vertices[link.mesh.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        middle = (a + b + c) / 3
        k = truth.links.index(link.name)
        behind, before = (
            truth.holds(apply(T[link.name], middle + s * normal * 1e-6), T)[:, k] for s in (-1, 1)
        )
        assert (behind | before).all() if messy else behind.all()


WITH_PANELS = ("laptop_0000", "eyeglasses_0015")
"""The second has lenses so thin that messy copies have them as sheets."""


@pytest.mark.parametrize("name", WITH_PANELS)
def test_messy_and_clean_are_the_same_object(tmp_path: Path, name: str) -> None:
    category = name.partition("_")[0]
    clean, truth = written(category, name, tmp_path / name)
    messy, messy_truth = written(category, name, tmp_path / f"{name}m", messy=1)
    content = json.loads((tmp_path / f"{name}m" / "solids.json").read_text())
    assert any(link["sheets"] for link in content["links"].values())
    assert truth.links == messy_truth.links
    rng = generator(0, name, "states")
    for _ in range(3):
        q = random_state(clean, rng)
        T, T_messy = link_frames(clean, q), link_frames(messy, q)
        points = rng.uniform(*_bounds(clean, T), (10_000, 3))
        label = truth.inside(points, T)
        assert (label > 0).mean() > 0.003
        np.testing.assert_array_equal(label, messy_truth.inside(points, T_messy))


def _bounds(obj, T: dict[str, Floats]) -> tuple[Floats, Floats]:
    points = np.concatenate([apply(T[k.name], k.mesh.vertices) for k in obj.links])
    return points.min(axis=0), points.max(axis=0)


def test_messy_models_are_messy(tmp_path: Path) -> None:
    path = files_of(small_model(), tmp_path / "m", messy=1)
    robot = yourdfpy.URDF.load(str(path), load_meshes=False)
    assert [link.name for link in robot.robot.links] == ["base", "lid", "tray", "body"]
    assert [len(link.visuals) for link in robot.robot.links] == [0, 2, 1, 3]
    visual, hinge = robot.robot.links[1].visuals[0], robot.robot.joints[1]
    assert visual.origin is not None
    assert hinge.origin is not None
    np.testing.assert_allclose(visual.origin[:3, 3], -hinge.origin[:3, 3])
    assert [_closed_twice(tmp_path / "m" / f"body-{k}.obj") for k in range(3)] == [
        True,  # the body
        False,  # the knob, open where it stands on the body
        True,  # every second solid keeps all its faces
    ]
    sheet = _obj(tmp_path / "m" / "lid-1.obj")
    assert len(sheet[1]) == 4
    assert np.ptp(sheet[0], axis=0).min() == 0.0


@pytest.mark.parametrize("category", ["drawer", "oven"])
def test_rough_models_are_rough_and_keep_their_solids(tmp_path: Path, category: str) -> None:
    name = object_id(category, 1)
    clean, truth = written(category, name, tmp_path / "clean", varied=True)
    rough, rough_truth = written(category, name, tmp_path / "rough", messy=2, varied=True)
    pieces = [_obj(path) for path in sorted((tmp_path / "rough").glob("*.obj"))]
    closed = np.mean([_is_closed_by_place(vertices, faces[::2]) for vertices, faces in pieces])
    assert len(pieces) > 40
    assert 0.05 < closed < 0.95
    counts = [sum(len(link.mesh.faces) for link in obj.links) for obj in (clean, rough)]
    assert 4 < counts[1] / counts[0] < 40, "both windings of three to ten times as many"
    content = json.loads((tmp_path / "rough" / "solids.json").read_text())
    size = np.ptp(_bounds(clean, link_frames(clean, np.zeros(len(clean.moving_joints)))), axis=0)
    decals = [s for k in content["links"].values() for s in k["sheets"] if s["backed"]]
    assert decals
    assert all(sheet["thickness"] <= 2.1e-4 * size.max() for sheet in decals)
    q = random_state(clean, generator(0, name, "states"))
    T, T_rough = link_frames(clean, q), link_frames(rough, q)
    points = np.random.default_rng(0).uniform(*_bounds(clean, T), (20_000, 3))
    inside, again = truth.inside(points, T), rough_truth.inside(points, T_rough)
    assert (inside > 0).mean() > 0.03
    assert (inside != again).sum() <= 2, "a decal holds a point or none"


def _is_closed_by_place(vertices: Floats, faces: NDArray[np.int32]) -> bool:
    """Whether no edge has one triangle alone, however often its ends are listed."""
    _, index = np.unique(vertices.round(9), axis=0, return_inverse=True)
    corners = np.unique(np.sort(index.reshape(-1)[faces], axis=1), axis=0)
    edges = np.concatenate([corners[:, pair] for pair in ([0, 1], [1, 2], [0, 2])])
    return bool(np.unique(edges, axis=0, return_counts=True)[1].min() > 1)


def _obj(path: Path) -> tuple[Floats, NDArray[np.int32]]:
    rows = [line.split() for line in path.read_text().splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], float)
    return vertices, np.array([row[1:] for row in rows if row[0] == "f"], np.int32) - 1


def _closed_twice(path: Path) -> bool:
    """Every triangle is there with both windings; whether those of one winding are closed."""
    faces = _obj(path)[1]
    np.testing.assert_array_equal(faces[::2], faces[1::2, ::-1])
    return is_closed(faces[::2])


def test_only_faces_that_nothing_can_see_are_dropped(tmp_path: Path) -> None:
    """What a messy link leaves out lies within its other solids."""
    model = build_model("laptop", "laptop_0001")
    path = files_of(model, tmp_path / "m", messy=1)
    dropped = 0
    for link in model.links:
        names = [f"link{k}" for k in range(len(link.solids))]
        truth, T = truth_of(*link.solids), dict.fromkeys(names, np.eye(4))
        for k, solid in enumerate(link.solids):
            kept = len(_obj(path.parent / f"{link.name}-{k}.obj")[1]) // 2
            if solid.sheet is not None or kept == len(solid.faces):
                continue
            corners = solid.vertices[solid.faces]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            holds = truth.holds(corners.mean(axis=1) + 1e-6 * normal, T)
            assert np.sum(holds[:, np.arange(len(names)) != k].any(axis=1)) >= (
                len(solid.faces) - kept
            )
            dropped += len(solid.faces) - kept
    assert dropped > 50


def _bytes(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


@pytest.mark.parametrize(
    ("category", "messy"), [*((c, 0) for c in CATEGORIES), ("laptop", 1), ("laptop", 2)]
)
def test_same_id_same_bytes_other_id_other_bytes(tmp_path: Path, category: str, messy: int) -> None:
    for folder, k in (("a", 3), ("b", 3), ("c", 4)):
        write_object(category, object_id(category, k), tmp_path / folder, messy=messy)
    first, again, other = (_bytes(tmp_path / folder) for folder in "abc")
    assert first == again
    assert first["solids.json"] != other["solids.json"]
    assert first["model.urdf"] != other["model.urdf"]


def test_an_object_in_memory_is_the_one_that_is_written(tmp_path: Path) -> None:
    name = object_id("box", 2)
    (ref,) = open_source("procedural_messy").objects("box", ids=[name])
    for category, number in write_bundled(tmp_path, categories=("box",)):
        assert category.parent.parent == tmp_path
        assert number == len(list(category.iterdir())) == 37
    folder = tmp_path / "procedural_messy" / "box" / name
    (again,) = open_source(folder).objects("box")
    one, other = readers.load(ref), readers.load(again)
    assert one.sha256 == other.sha256
    for a, b in zip(one.links, other.links, strict=True):
        assert a.mesh.vertices.tobytes() == b.mesh.vertices.tobytes()
    contents = writer.model_files(build_model("box", name), object_id=name, messy=1)
    assert {path.name for path in folder.iterdir()} == {*contents, "solids.json"}


def test_a_model_is_written_nowhere_else(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "front.obj").symlink_to(tmp_path / "other")
    with pytest.raises(MachineFault, match="symbolic link"):
        write_object("eyeglasses", "eyeglasses_0000", tmp_path / "out")
    assert not (tmp_path / "other").exists()


def test_unknown_category_is_refused() -> None:
    with pytest.raises(InvalidSource, match="no category 'chair'; it has box, drawer, eyeglasses"):
        build_model("chair", "chair_0000")


@pytest.mark.parametrize("name", ["laptop_1/../../x", "oven_0001", "laptop_0001\n", "laptop_"])
def test_ids_that_are_not_the_categorys_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidSource, match="its ids are like laptop_0003"):
        write_object("laptop", name, tmp_path / "x")
    assert not list(tmp_path.iterdir())


def test_small_model_is_sound() -> None:
    assert_sound(small_model())


def test_a_models_name_may_hold_what_xml_reserves() -> None:
    text = urdf_text('a "<&> b', {"one": [Visual("m.obj", (0, 0, 1), (1.0, 0.5, 0.0, 1.0))]}, [])
    robot = ElementTree.fromstring(text)
    assert robot.get("name") == 'a "<&> b'
    (link,) = robot
    assert [e.tag for e in link.iter()] == [
        "link", "visual", "origin", "geometry", "mesh", "material", "color"
    ]  # fmt: skip
