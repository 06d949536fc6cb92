"""Solids, outlines and truth of the procedural source, against closed forms, naive oracles."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from articugen.core.geometry import apply, fibonacci_sphere, rotation_about, transform
from articugen.core.records import Floats
from articugen.core.seeding import generator
from articugen.procedural.kit import outlines
from articugen.procedural.kit.solids import (
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
from tests.procedural_truth import L_SHAPE, is_closed, mesh_volume, truth_of

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
    "block": (block((0, 0, 0), (2, 2, 1), bevel=(0.0, 0.5)), 4 * 0.5 + frustum(4.0, 1.0, 0.5)),
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
    blocked = np.stack([truth.enclosed(points, way[None], T) for way in directions], axis=1)
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
    assert truth_of(*walls[:5]).enclosed(points[:1], up, T).all()


@given(st.lists(st.floats(0.3, 1.0), min_size=3, max_size=14), st.floats(0.0, 1.0))
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
