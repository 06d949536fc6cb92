"""Laptops: one hinge that opens, parts that never meet, and no two alike."""

from pathlib import Path

import numpy as np
import pytest

from articugen.geometry import apply
from articugen.seeding import generator
from articugen.sources.procedural import build_model, object_id
from articugen.sources.procedural.laptop_shape import KINDS, draw_shape
from tests.procedural_truth import assert_sound, crossings, link_frames, written

IDS = [object_id("laptop", k) for k in range(86)]

SHAPES = {name: draw_shape(generator(0, name, "procedural")) for name in IDS}
EACH_KIND_AND_HINGE = sorted({(s.kind, s.hinge): name for name, s in SHAPES.items()}.values())


@pytest.mark.parametrize("name", EACH_KIND_AND_HINGE)
def test_laptop_is_sound_and_its_parts_never_meet(name: str, tmp_path: Path) -> None:
    assert_sound(build_model("laptop", name))
    obj, truth = written("laptop", name, tmp_path / name)
    rng = generator(0, name)
    for degrees in (0.0, rng.uniform(0, 135), 135.0):
        assert crossings(obj, truth, np.radians([degrees]), rng) == set(), degrees


def test_the_lid_opens_about_y_from_closed_to_135_degrees(tmp_path: Path) -> None:
    obj, _ = written("laptop", IDS[0], tmp_path / IDS[0])
    (hinge,) = obj.moving_joints
    assert (hinge.kind, hinge.parent, hinge.child) == ("revolute", "body", "lid")
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
        model = build_model("laptop", name)
        triangles = sum(len(s.faces) for link in model.links for s in link.solids)
        depth, width, height = np.ptp(model.bounds, axis=0)
        assert 2_000 < triangles < 15_000
        assert 0.2 < width < 0.5
        assert depth < width
        assert height < 0.08


def test_laptops_differ() -> None:
    shapes = SHAPES.values()
    assert {shape.kind for shape in shapes} == set(KINDS)
    assert {shape.hinge for shape in shapes} == {"pair", "center", "full"}
    ratios = np.array([shape.width / shape.depth for shape in shapes])
    slimness = np.array([shape.lid / shape.width for shape in shapes])
    assert np.ptp(ratios) > 0.3
    assert slimness.max() > 3 * slimness.min()


def test_what_lies_on_a_laptop_is_drawn_where_it_is_seen(tmp_path: Path) -> None:
    """In messy models too: a screen's rectangle is its face, with free space in front of it."""
    faces = 0
    for name in IDS[:10]:
        obj, truth = written("laptop", name, tmp_path / name)
        frames = link_frames(obj, np.zeros(1))
        solids = [s for link in build_model("laptop", name).links for s in link.solids]
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
