"""Laptops: one hinge that opens, and no two alike; as thin as real ones."""

from pathlib import Path

import numpy as np
import pytest

from articugen.core.geometry import apply
from articugen.core.seeding import generator
from articugen.procedural.laptop.shape import KINDS, draw_shape
from tests.procedural_truth import link_frames, model_of, object_id, truth_of, written

IDS = [object_id("laptop", k) for k in range(86)]

SHAPES = {name: draw_shape(generator(0, name, "procedural")) for name in IDS}
EACH_KIND_OF_HINGE = sorted({(s.drops, s.hinge): name for name, s in SHAPES.items()}.values())
OF_ALL_KINDS = sorted({*{s.kind: n for n, s in SHAPES.items()}.values(), *EACH_KIND_OF_HINGE})


def test_the_lid_opens_about_y_from_closed_to_135_degrees(tmp_path: Path) -> None:
    obj, _ = written("laptop", IDS[0], tmp_path / IDS[0])
    (hinge,) = obj.moving_joints
    assert (str(hinge.kind), hinge.parent, hinge.child) == ("revolute", "body", "lid")
    np.testing.assert_array_equal(hinge.axis, (0, 1, 0))
    assert np.degrees((hinge.lower, hinge.upper)) == pytest.approx((0, 135))
    base, lid = (obj.links[obj.link_index[k]].mesh.vertices for k in ("body", "lid"))
    heights = []
    for degrees in (0, 90, 135):
        T = link_frames(obj, np.radians([degrees]))
        posed = apply(T["lid"], lid)
        heights.append(np.ptp(posed[:, 2]))
        assert base[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        assert posed[:, 2].min() > 0.0
        if degrees == 0:
            assert np.median(posed[:, 2]) > np.percentile(base[:, 2], 95)
        else:
            assert np.median(posed[:, 0]) > np.median(base[:, 0])
    assert heights[0] < 0.15 * heights[1]
    assert heights[2] == pytest.approx(heights[1] * np.sin(np.pi / 4), rel=0.2)


def test_laptops_are_of_a_sensible_size() -> None:
    for name in IDS[:3]:
        model = model_of("laptop", name)
        triangles = sum(len(s.faces) for link in model.links for s in link.solids)
        depth, width, height = np.ptp(model.bounds, axis=0)
        assert 2_000 < triangles < 15_000
        assert 0.2 < width < 0.5
        assert depth < width
        assert height < 0.08


def test_laptops_differ() -> None:
    shapes = SHAPES.values()
    assert {shape.kind for shape in shapes} == set(KINDS)
    hinges = {(shape.hinge, shape.drops) for shape in shapes}
    assert hinges == {(h, d) for h in ("pair", "center", "full") for d in (False, True)}
    ratios = np.array([shape.width / shape.depth for shape in shapes])
    slimness = np.array([shape.lid / shape.width for shape in shapes])
    assert np.ptp(ratios) > 0.3
    assert slimness.max() > 2 * slimness.min()


def test_laptops_are_as_thin_as_real_ones() -> None:
    """Of eight real ones the part that does not move is 0.034 to 0.081 of its width high, half of
    them less than 0.047."""
    sizes = np.array([_base_size(name) for name in IDS[::2]])
    thin = sizes[:, 2] / sizes[:, 1]
    assert 0.043 < np.median(thin) < 0.051
    assert thin.min() > 0.034
    assert thin.max() < 0.081
    assert np.ptp(np.quantile(thin, (0.1, 0.9))) > 0.02, "not all alike"


def _base_size(name: str) -> np.ndarray:
    base = model_of("laptop", name).links[0]
    return np.ptp(np.concatenate([s.vertices for s in base.solids]), axis=0)


@pytest.mark.parametrize("name", EACH_KIND_OF_HINGE)
def test_nothing_of_a_closed_laptops_hinge_stands_behind_it(name: str) -> None:
    """Behind the axis a barrel has its body beside it, or the lid above it."""
    shape, model = SHAPES[name], model_of("laptop", name)
    axis = np.asarray(model.joints[0].origin)[0]
    base, lid = (
        np.concatenate([s.vertices for s in link.solids]) - (axis, 0, 0) for link in model.links
    )
    if shape.drops:
        assert lid[:, 0].max() >= 0.5 * shape.barrel
        assert lid[:, 0].max() <= shape.barrel + 1e-9
    else:
        at_the_sides = np.abs(base[:, 1]) > 0.45 * shape.width
        assert base[at_the_sides, 0].max() >= shape.barrel - 1e-9


def test_what_lies_on_a_laptop_is_drawn_where_it_is_seen() -> None:
    """In messy models too: a screen's rectangle is its face, with free space in front of it."""
    faces = 0
    for name in IDS[:10]:
        solids = [s for link in model_of("laptop", name).links for s in link.solids]
        truth = truth_of(*solids)
        frames = dict.fromkeys(truth.links, np.eye(4))
        for sheet in (s.sheet for s in solids if s.sheet is not None):
            a, b, c = np.moveaxis(sheet.drawn, 1, 0)
            out = sheet.seen * np.cross(b - a, c - a)
            out /= np.linalg.norm(out, axis=1, keepdims=True)
            middle = (a + b + c) / 3
            assert truth.inside(middle - 1e-6 * out, frames).all(), name
            covered = truth.inside(middle + 1e-6 * out, frames) > 0  # a camera's tab may
            assert covered.mean() < 0.5, name
            faces += 1
    assert faces > 15
