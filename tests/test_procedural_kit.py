"""Solids, writer and truth of the procedural source, against closed forms and naive oracles."""

import json
import math
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from articugen.errors import InvalidSource
from articugen.geometry import apply, fibonacci_sphere, rotation_about, transform
from articugen.records import Floats
from articugen.seeding import generator
from articugen.sources.procedural import build_model, object_id, outlines, write_object, writer
from articugen.sources.procedural.model import Model, ModelJoint, ModelLink
from articugen.sources.procedural.solids import (
    Solid,
    along_x,
    along_y,
    block,
    box,
    cylinder,
    loft,
    prism,
    ring,
    stack,
    sweep,
)
from articugen.sources.procedural.truth import Truth, load_truth
from tests.procedural_truth import (
    assert_sound,
    is_closed,
    link_frames,
    mesh_volume,
    random_state,
    written,
)

L_SHAPE = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], dtype=float)
OCTAGON = outlines.circle(0.2, 8)
OCTAGON_AREA = 4 * 0.2**2 * math.sin(math.pi / 4)


def polygon_area(outline: Floats) -> float:
    x, y = outline.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def n_gon_area(radius: float, n: int) -> float:
    return n / 2 * radius**2 * math.sin(2 * math.pi / n)


def frustum(a: float, b: float, height: float) -> float:
    return height / 3 * (a + b + math.sqrt(a * b))


def torus_path(n: int) -> Floats:
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


SOLIDS = {
    "box": (box((0, 1, 2), (1, 3, 2.5)), 1.0),
    "thin box": (box((0, 0, 0), (0.01, 2, 3), panel=True), 0.06),
    "L prism": (prism(L_SHAPE, -1, 1), 10.0),
    "cylinder": (cylinder(0.5, 0, 2, sides=12), 2 * n_gon_area(0.5, 12)),
    "bevelled cylinder": (
        cylinder(0.5, 0, 2, sides=12, bevel=0.1),
        1.8 * n_gon_area(0.5, 12) + 2 * frustum(n_gon_area(0.4, 12), n_gon_area(0.5, 12), 0.1),
    ),
    "block": (
        block((0, 0, 0), (2, 2, 1), bevel=(0.0, 0.5)),
        4 * 0.5 + frustum(4.0, 1.0, 0.5),
    ),
    "ring": (
        ring(outlines.circle(2, 24), outlines.circle(1, 24), 0, 3),
        3 * (n_gon_area(2, 24) - n_gon_area(1, 24)),
    ),
    "plate with a hole": (
        ring(*outlines.matched(outlines.rectangle(4, 6), outlines.circle(1.5, 20)), 0, 0.5),
        0.5 * (24 - n_gon_area(1.5, 20)),
    ),
    # A mitred tube is as long as its path: what a bend adds outside it takes inside.
    "torus": (
        sweep(torus_path(40), OCTAGON, closed=True),
        OCTAGON_AREA * 40 * 2 * math.sin(math.pi / 40),
    ),
    "bent tube": (
        sweep([(0, 0, 0), (1, 0, 0), (2, 1, 0), (2, 2, 1)], OCTAGON),
        OCTAGON_AREA * (1 + 2 * math.sqrt(2)),
    ),
    "mirrored": (prism(L_SHAPE, 0, 1).mirrored(0), 5.0),
    "turned": (along_x(along_y(prism(L_SHAPE, 0, 1))), 5.0),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_builders_make_closed_solids_of_the_right_volume(name: str) -> None:
    solid, volume = SOLIDS[name]
    assert is_closed(solid.faces)
    assert solid.volume == pytest.approx(volume, rel=1e-12)
    assert mesh_volume(solid) == pytest.approx(volume, rel=1e-12)
    corners = solid.vertices[solid.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(doubled, axis=1).min() > 1e-9, "a flat triangle"
    assert len(solid.half_spaces) == len(solid.cells)


def winding(points: Floats, solid: Solid) -> NDArray[np.bool_]:
    """Inside by the winding number (van Oosterom and Strackee 1983), a naive oracle."""
    total = np.zeros(len(points))
    for face in solid.faces:
        a, b, c = (solid.vertices[v] - points for v in face)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        top = np.sum(a * np.cross(b, c), axis=1)
        dots = np.sum(a * b, 1) * lc + np.sum(b * c, 1) * la + np.sum(c * a, 1) * lb
        total += 2.0 * np.arctan2(top, la * lb * lc + dots)
    return total > 2.0 * np.pi


def truth_of(*solids: Solid) -> Truth:
    """A truth whose link k is solid k."""
    planes = [p for s in solids for p in s.half_spaces]
    return Truth(
        links=tuple(f"link{k}" for k in range(len(solids))),
        link_of_cell=np.repeat(np.arange(len(solids)), [len(s.cells) for s in solids]),
        first_plane=np.cumsum([0, *map(len, planes)]),
        planes=np.concatenate(planes),
        boxes=np.concatenate([s.cell_bounds for s in solids]),
    )


@pytest.mark.parametrize("name", SOLIDS)
def test_cells_hold_what_the_mesh_encloses(name: str) -> None:
    solid, _ = SOLIDS[name]
    rng = generator(0, name)
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    points = rng.uniform(low - 0.1, high + 0.1, (3000, 3))
    T = transform(rotation_about((0.6, 0.0, 0.8), 1.0), (3.0, 2.0, 1.0))
    found = truth_of(solid).inside(apply(T, points), {"link0": T})
    expected = winding(points, solid)
    assert expected.any()
    assert not expected.all()
    np.testing.assert_array_equal(found == 1, expected)


def test_inside_agrees_with_closed_forms() -> None:
    rng = generator(0, "closed forms")
    points = rng.uniform(-1, 1, (20_000, 3))
    cube = box((-0.5, -0.2, -0.9), (0.1, 0.7, 0.3))
    tube = ring(outlines.circle(0.9, 64), outlines.circle(0.8, 64), 0.4, 0.8)
    label = truth_of(cube, tube).inside(points, {"link0": np.eye(4), "link1": np.eye(4)})
    in_cube = np.all((points > (-0.5, -0.2, -0.9)) & (points < (0.1, 0.7, 0.3)), axis=1)
    # A regular n-gon: the distance to the nearest side, measured in its sector.
    angle = np.arctan2(points[:, 1], points[:, 0])
    # `circle` puts its first vertex half a step from +x, so the sides' middles lie at whole steps.
    sector = (angle + np.pi / 64) % (2 * np.pi / 64) - np.pi / 64
    across = np.hypot(points[:, 0], points[:, 1]) * np.cos(sector) / np.cos(np.pi / 64)
    in_tube = (across < 0.9) & (across > 0.8) & (points[:, 2] > 0.4) & (points[:, 2] < 0.8)
    np.testing.assert_array_equal(label, np.where(in_cube, 1, np.where(in_tube, 2, 0)))


def test_rays_agree_with_small_steps_along_them() -> None:
    solids = [SOLIDS[name][0] for name in ("ring", "bent tube", "box")]
    truth = truth_of(*solids)
    T = {f"link{k}": transform(rotation_about((0, 0, 1), k), (k, 0, 0)) for k in range(3)}
    rng = generator(0, "rays")
    points, directions = rng.uniform(-3, 4, (20, 3)), fibonacci_sphere(12)
    steps = np.linspace(0.0, 12.0, 3000)[:, None, None, None] * directions
    walked = truth.inside((points[:, None] + steps).reshape(-1, 3), T).reshape(3000, 20, 12)
    blocked = truth.blocked(points, directions, T)
    # A step of 4 mm may jump over a corner, never meet anything that is not there.
    met = (walked > 0).any(axis=0)
    assert not np.any(met & ~blocked)
    assert np.mean(met == blocked) > 0.99
    np.testing.assert_array_equal(truth.enclosed(points, directions, T), blocked.all(axis=1))


def test_a_point_in_a_closed_box_is_enclosed_until_a_wall_is_missing() -> None:
    t = 0.1
    walls = [
        box((-1, -1, -1), (1, 1, -1 + t)),
        box((-1, -1, 1 - t), (1, 1, 1)),
        box((-1, -1, -1 + t), (-1 + t, 1, 1 - t)),
        box((1 - t, -1, -1 + t), (1, 1, 1 - t)),
        box((-1 + t, -1, -1 + t), (1 - t, -1 + t, 1 - t)),
        box((-1 + t, 1 - t, -1 + t), (1 - t, 1, 1 - t)),
    ]
    points = np.array([(0.0, 0.0, 0.0), (0.7, -0.5, 0.2), (1.5, 0.0, 0.0)])
    directions = np.concatenate([fibonacci_sphere(100), np.eye(3), -np.eye(3)])
    T = {f"link{k}": np.eye(4) for k in range(6)}
    np.testing.assert_array_equal(
        truth_of(*walls).enclosed(points, directions, T), [True, True, False]
    )
    assert not truth_of(*walls[:5]).enclosed(points, directions, T).any()
    up = np.array([[0.0, 0.0, 1.0]])
    assert truth_of(*walls[:5]).blocked(points[:1], up, T).all()


@given(
    st.lists(st.floats(0.3, 1.0), min_size=3, max_size=14),
    st.floats(0.0, 1.0),
)
@settings(max_examples=40, deadline=None)
def test_convex_pieces_tile_any_star_polygon(radii: list[float], turn: float) -> None:
    angles = turn + np.arange(len(radii)) * 2 * np.pi / len(radii)
    outline = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pieces = outlines.convex_pieces(outline)
    areas = [polygon_area(outline[piece]) for piece in pieces]
    assert min(areas) > 0.0
    assert sum(areas) == pytest.approx(polygon_area(outline), rel=1e-9)
    solid = prism(outline, 0.0, 1.0)
    assert len(solid.half_spaces) == len(pieces)
    assert is_closed(solid.faces)


@given(st.floats(0.001, 0.2), st.integers(3, 24))
def test_offset_moves_every_edge_of_a_regular_polygon(distance: float, n: int) -> None:
    moved = outlines.offset(outlines.circle(1.0, n), distance)
    apothem = math.cos(math.pi / n)
    expected = n_gon_area((apothem + distance) / apothem, n)
    assert polygon_area(moved) == pytest.approx(expected, rel=1e-9)
    with pytest.raises(ValueError, match="vanish"):
        outlines.offset(outlines.circle(1.0, n), -apothem - distance)


def test_outlines_that_make_no_solid_are_refused() -> None:
    with pytest.raises(ValueError, match="crosses itself or runs clockwise"):
        prism(L_SHAPE[::-1], 0, 1)
    with pytest.raises(ValueError, match="not convex"):
        _ = stack([L_SHAPE, L_SHAPE], (0, 1)).half_spaces
    with pytest.raises(ValueError, match="empty"):
        box((0, 0, 0), (1, 0, 1))
    with pytest.raises(ValueError, match="plane across"):
        sweep([(0, 0, 0), (1, 0, 0), (1, 1, 1)], OCTAGON, closed=True)
    with pytest.raises(ValueError, match="star-shaped"):
        outlines.matched(outlines.rectangle(4, 4), outlines.circle(1), (5.0, 5.0))


def test_loft_between_twisted_rings_is_convex_and_closed() -> None:
    lower = np.c_[outlines.rectangle(2, 2), np.zeros(4)]
    upper = np.c_[outlines.rectangle(2, 2) @ rotation_about((0, 0, 1), 0.4)[:2, :2], np.ones(4)]
    solid = loft([lower, upper])
    assert len(solid.faces) == 12
    assert is_closed(solid.faces)
    assert len(solid.half_spaces[0]) == 10


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


def test_a_model_is_a_tree() -> None:
    model = small_model()
    with pytest.raises(ValueError, match="parent must come first"):
        Model(model.links, model.joints[::-1])
    with pytest.raises(ValueError, match="each link but the first"):
        Model(model.links, model.joints[:1])
    with pytest.raises(ValueError, match="may not be called base"):
        Model((ModelLink("base", "", model.links[0].solids),), ())


@pytest.mark.parametrize("messy", [False, True])
def test_files_stand_where_the_model_was_drawn(tmp_path: Path, *, messy: bool) -> None:
    path = writer.write_model(
        small_model(), tmp_path / "m", object_id="m", category="none", messy=messy
    )
    robot = yourdfpy.URDF.load(str(path))
    robot.update_cfg(np.zeros(2))
    drawn = np.concatenate([s.vertices for k in small_model().links for s in k.solids])
    box_drawn = np.stack([drawn.min(axis=0), drawn.max(axis=0)])
    if messy:  # The tray's and the body's outlines remain, whatever became a sheet.
        np.testing.assert_allclose(robot.scene.bounds, box_drawn, atol=2e-3)
        np.testing.assert_allclose(robot.scene.bounds[0], box_drawn[0], atol=1e-8)
    else:
        np.testing.assert_allclose(robot.scene.bounds, box_drawn, atol=1e-8)


@pytest.mark.parametrize("messy", [False, True])
@pytest.mark.parametrize("category", ["laptop", "eyeglasses"])
def test_meshes_lie_on_the_truth(tmp_path: Path, category: str, *, messy: bool) -> None:
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


def first_with_thin_lenses() -> str:
    names = (object_id("eyeglasses", k) for k in range(42))
    lenses = ((name, build_model("eyeglasses", name).links[0].solids[0].sheet) for name in names)
    return next(name for name, lens in lenses if lens is not None and lens.thickness < 0.9e-3)


@pytest.mark.parametrize("category", ["laptop", "eyeglasses"])
def test_messy_and_clean_are_the_same_object(tmp_path: Path, category: str) -> None:
    sheets = 0
    for name in ("laptop_0000",) if category == "laptop" else (first_with_thin_lenses(),):
        clean, truth = written(category, name, tmp_path / name)
        messy, messy_truth = written(category, name, tmp_path / f"{name}m", messy=True)
        content = json.loads((tmp_path / f"{name}m" / "solids.json").read_text())
        sheets += sum(len(link["sheets"]) for link in content["links"].values())
        assert truth.links == messy_truth.links
        rng = generator(0, name, "states")
        for _ in range(3):
            q = random_state(clean, rng)
            T, T_messy = link_frames(clean, q), link_frames(messy, q)
            points = rng.uniform(*_bounds(clean, T), (10_000, 3))
            label = truth.inside(points, T)
            assert (label > 0).mean() > 0.003
            np.testing.assert_array_equal(label, messy_truth.inside(points, T_messy))
    assert sheets > 0


def _bounds(obj, T: dict[str, Floats]) -> tuple[Floats, Floats]:
    points = np.concatenate([apply(T[k.name], k.mesh.vertices) for k in obj.links])
    return points.min(axis=0), points.max(axis=0)


def test_messy_models_are_messy(tmp_path: Path) -> None:
    path = writer.write_model(small_model(), tmp_path / "m", object_id="m", category="", messy=True)
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
    path = writer.write_model(model, tmp_path / "m", object_id="m", category="", messy=True)
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


@pytest.mark.parametrize("messy", [False, True])
def test_same_id_same_bytes_other_id_other_bytes(tmp_path: Path, *, messy: bool) -> None:
    for folder, name in (("a", "laptop_0003"), ("b", "laptop_0003"), ("c", "laptop_0004")):
        write_object("laptop", name, tmp_path / folder / name, messy=messy)
    first = _bytes(tmp_path / "a" / "laptop_0003")
    assert first == _bytes(tmp_path / "b" / "laptop_0003")
    other = _bytes(tmp_path / "c" / "laptop_0004")
    assert first["solids.json"] != other["solids.json"]
    assert first["model.urdf"] != other["model.urdf"]


def test_a_whole_folder_is_left_alone_and_another_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "eyeglasses_0000"
    path = write_object("eyeglasses", folder.name, folder)
    before, stamp = _bytes(folder), os.stat(path).st_mtime_ns
    assert write_object("eyeglasses", folder.name, folder) == path
    assert os.stat(path).st_mtime_ns == stamp
    (folder / "solids.json").write_text('{"version": 0, "messy": false}')
    (folder / "left over.txt").write_text("of another version")
    write_object("eyeglasses", folder.name, folder)
    assert _bytes(folder) == before
    write_object("eyeglasses", folder.name, folder, messy=True)
    assert writer.is_complete(folder, messy=True)
    assert [p.name for p in tmp_path.iterdir()] == [folder.name]


def test_many_writers_of_one_object_leave_one_whole_object(tmp_path: Path) -> None:
    folder = tmp_path / "m"
    folder.mkdir()
    (folder / "solids.json").write_text("half a fi")

    def write(_: int) -> Path:
        return writer.write_model(small_model(), folder, object_id="m", category="none")

    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(write, range(24)))
    assert set(paths) == {folder / "model.urdf"}
    assert load_truth(folder).links == ("body", "lid", "tray")
    assert [p.name for p in tmp_path.iterdir()] == ["m"]


def test_unknown_category_is_refused() -> None:
    with pytest.raises(InvalidSource, match="no category 'chair'; it has drawer, eyeglasses"):
        build_model("chair", "chair_0000")


def test_small_model_is_sound() -> None:
    assert_sound(small_model())
