"""The rule `reachable` on boxes with openings of known width, and on open appliances."""

import numpy as np
import pytest

from articugen.fusion import fuse
from articugen.geometry import rotation_about, transform
from articugen.reachable import walls
from articugen.recipe import Fusion
from articugen.rendering.rasterizer import render
from tests.shapes import Convex, box, iou, labelled, rotated, views_of

OPENING = 1 / 48
RULE = Fusion(rule="reachable", opening=OPENING)


def cupboard(slit: float, turn: float = 0.0):
    """A deep box, its front shut by a slab that leaves a slit of the given width at the top."""
    panels = [box((0.7, 0.02, 0.4), (0, y, 0)) for y in (-0.2, 0.2)]
    panels += [box((0.7, 0.42, 0.02), (0, 0, z)) for z in (-0.2, 0.2)]
    panels += [box((0.02, 0.42, 0.42), (-0.35, 0, 0))]
    height = 0.42 - slit
    panels += [box((0.02, 0.42, height), (0.36, 0, -0.21 + height / 2))]
    T = transform(rotation_about((0, 0.6, 0.8), turn))
    for panel in panels:
        panel.apply_transform(T)
    return panels, lambda points: points @ T[:3, :3].T


def field_of(panels, settings=RULE):
    mesh = labelled(*panels)
    return fuse(render(mesh, views_of(mesh)), mesh, settings)


@pytest.mark.parametrize("turn", [0.0, 0.5])
@pytest.mark.parametrize(("slit", "opens"), [(2.2 * OPENING, True), (0.45 * OPENING, False)])
def test_a_cavity_is_outside_where_its_opening_is_wide_enough(slit, opens, turn):
    panels, turned = cupboard(slit + 0.01, turn)  # the top panel takes 0.01 of the slit
    inside = turned(np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * (0.33, 0.18, 0.18))
    field = field_of(panels)
    seen = field.is_seen_free(inside)
    assert np.mean(seen) < 0.6  # most of it is dark
    assert np.mean(field.is_free(inside)) == pytest.approx(
        1.0 if opens else np.mean(seen), abs=0.01
    )


def test_an_open_cupboard_is_its_panels():
    panels, _ = cupboard(0.2)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40_000, 3))
    truth = Convex.of(*panels).inside(points)
    assert iou(~field_of(panels).is_free(points), truth) > 0.985
    assert iou(~field_of(panels, Fusion()).is_free(points), truth) < 0.96


def test_what_is_seen_stays_outside_and_solids_stay_inside():
    solid = rotated(box((0.6, 0.4, 0.3)), 0.4, (1, 2, 3))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3))
    assert np.array_equal(
        field_of([solid]).is_free(points), field_of([solid], Fusion()).is_free(points)
    )


def test_value_and_occupancy_agree():
    panels, _ = cupboard(0.2)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 3))
    field = field_of(panels)
    assert np.array_equal(field.value(points) > 0, field.is_free(points))


def test_walls_are_the_voxels_that_faces_touch():
    """Against points sprinkled over the faces, and against the exact overlap of a big triangle."""
    solid = rotated(box((0.6, 0.4, 0.3)), 0.4, (1, 2, 3))
    state = walls(labelled(solid), 2 / 32)
    assert state.shape == (32, 32, 32)
    sprinkled = np.asarray(solid.sample(200_000))
    touched = np.zeros_like(state)
    touched[tuple(((sprinkled + 0.5) * 32).astype(int).T)] = 1
    assert np.all(state[touched == 1] == 1)
    assert np.mean(touched[state == 1]) > 0.9  # the rest is grazed at corners
