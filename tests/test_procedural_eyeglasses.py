"""Eyeglasses: two temples that fold inwards, one above the other."""

from pathlib import Path

import numpy as np
import pytest

from articugen.core.geometry import apply
from tests.procedural_truth import link_frames, model_of, object_id, written

IDS = [object_id("eyeglasses", k) for k in range(42)]


@pytest.mark.parametrize("varied", [False, True])
def test_the_left_temple_turns_in_a_plane_above_the_right_ones(*, varied: bool) -> None:
    """No state has to be tried: along the common normal the two never share a height."""
    leans = []
    for name in IDS[::2]:
        model = model_of("eyeglasses", name, varied=varied)
        left, right = model.joints
        normal = np.asarray(left.axis)
        np.testing.assert_allclose(normal, -np.asarray(right.axis), atol=1e-15)
        above, below = (
            np.concatenate([s.vertices for s in link.solids]) @ normal for link in model.links[1:]
        )
        assert above.min() > below.max() + 0.0005, name
        leans.append(np.degrees(np.arccos(min(normal[2], 1.0))))
    assert max(leans) <= 13.0, "hinges lean a little, no more"
    assert (min(leans) == 0.0) == varied, "some varied ones stand upright"


def test_the_temples_fold_inwards_about_z(tmp_path: Path) -> None:
    obj, _ = written("eyeglasses", IDS[1], tmp_path / IDS[1])
    left, right = obj.moving_joints
    np.testing.assert_allclose([left.axis, right.axis], [(0, 0, 1), (0, 0, -1)], atol=0.22)
    assert np.degrees([left.lower, left.upper, right.lower, right.upper]) == pytest.approx(
        [0, 90, 0, 90]
    )
    for joint, side in ((left, -1.0), (right, 1.0)):
        points = obj.links[obj.link_index[joint.child]].mesh.vertices
        opened = apply(link_frames(obj, np.zeros(2))[joint.child], points)
        folded = apply(link_frames(obj, np.radians([90.0, 90.0]))[joint.child], points)
        assert np.ptp(opened[:, 0]) > 0.09
        assert np.ptp(folded[:, 1]) == pytest.approx(np.ptp(opened[:, 0]), rel=0.06)
        assert (side * opened[:, 1]).min() > 0.04
        # The tip has come across the middle of the face.
        assert (side * folded[:, 1]).min() < 0.0


def test_eyeglasses_are_symmetric_when_open() -> None:
    model = model_of("eyeglasses", IDS[3])
    left, right = (  # The hinge's knuckles come last; they lean.
        np.concatenate([s.vertices for s in model.links[k].solids[:-2]]) * (1, sign, 1)
        for k, sign in ((1, -1), (2, 1))
    )
    np.testing.assert_allclose(left, right, atol=1e-12)


def test_eyeglasses_are_thick_enough_and_small_enough() -> None:
    """No solid is thinner than 0.002 of the unit frame, in which the object is 0.9 long."""
    for name in IDS[:6]:
        model = model_of("eyeglasses", name)
        unit = 0.9 / np.ptp(model.bounds, axis=0).max()
        solids = [s for link in model.links for s in link.solids]
        assert 1_000 < sum(len(s.faces) for s in solids) < 6_000
        for solid in solids:
            middle = solid.vertices - solid.vertices.mean(axis=0)
            normals = np.concatenate([planes[:, :3] for planes in solid.half_spaces])
            assert np.ptp(middle @ normals.T, axis=0).min() * unit > 0.002


def test_eyeglasses_differ() -> None:
    models = [model_of("eyeglasses", name) for name in IDS]
    sizes = np.array([np.ptp(model.bounds, axis=0) for model in models])
    assert len(np.unique(sizes.round(6), axis=0)) == len(IDS)
    height = sizes[:, 2] / sizes[:, 1]
    assert height.max() > 1.4 * height.min()
    assert len({len(model.links[0].solids) for model in models}) > 5
