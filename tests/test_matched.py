"""Parts matched in every instance: closed forms, and what each fault costs."""

from dataclasses import replace

import numpy as np
import pytest
from instances import changed, hinged_box

from articugen.core.geometry import apply, rotation_about, transform
from articugen.core.records import dequantize
from articugen.evaluation import metrics
from articugen.evaluation.matched import joint_errors, matching, pose_errors
from articugen.evaluation.metrics import NO_LABEL
from articugen.evaluation.reconstruction import truth
from articugen.evaluation.tally import Protocol, Tally

EACH = np.arange(3)
"""Every true part with its own number."""


@pytest.fixture(scope="module")
def boxes():
    first, _, posed, _ = hinged_box()
    return first, posed


def poses(boxes, found, matched=EACH):
    return dict(pose_errors(boxes, (truth(boxes[0]), found), matched))


def joints(boxes, found, matched=EACH):
    return dict(joint_errors(boxes, (truth(boxes[0]), found), matched))


def with_points(instance, *counts):
    """The instance with so many points of each part."""
    part = np.repeat(np.arange(len(counts), dtype=np.uint8), counts)
    points, normals = instance.surface_points[: len(part)], instance.surface_normals[: len(part)]
    return changed(instance, surface_part=part, surface_points=points, surface_normals=normals)


def moved_joints(instance, **fields):
    found = truth(instance)
    return replace(found, joints=replace(found.joints, **fields))


def test_the_truth_is_matched_with_itself_whatever_its_numbers(boxes):
    _, posed = boxes
    true = posed.surface_part.astype(np.int64)
    for order in ([0, 1, 2], [4, 0, 2]):
        predicted, iou = matching(np.array(order)[true], true, posed, 5)
        assert predicted.tolist() == order
        assert iou.tolist() == [1.0, 1.0, 1.0]
    for errors in (poses(boxes, truth(posed)), joints(boxes, truth(posed))):
        assert max(errors.values()) == pytest.approx(0.0, abs=1e-6)


def test_points_count_by_area_however_many_of_each_part_are_looked_at(boxes):
    """Three parts of 600, 300 and 100 stored points, of which 10 each are looked at. Prediction 0
    has all of part 0 and half of part 1, prediction 1 the other half, nobody part 2."""
    instance = with_points(boxes[0], 600, 300, 100)
    true = np.repeat([0, 1, 2], 10)
    nearest = np.array([0] * 15 + [1] * 5 + [NO_LABEL] * 10)
    predicted, iou = matching(nearest, true, instance, 4)
    assert predicted.tolist() == [0, 1, NO_LABEL]
    np.testing.assert_allclose(iou, [600 / 750, 150 / 300, 0.0])


def test_a_part_that_no_point_shows_is_not_counted(boxes):
    instance = with_points(boxes[0], 500, 500, 0)
    predicted, iou = matching(np.repeat([0, 1], 9), np.repeat([0, 1], 9), instance, 3)
    assert predicted.tolist() == [0, 1, NO_LABEL]
    np.testing.assert_array_equal(iou, [1.0, 1.0, np.nan])
    hidden = boxes[0], with_points(boxes[1], 500, 500, 0)
    assert "matched_state_length" not in joints(hidden, truth(hidden[1]))
    tally = Tally(Protocol(), np.eye(3))
    tally.at(hidden[1])
    tally.measure(hidden[1], truth(hidden[1]), (boxes[0], truth(boxes[0])))
    assert {state.joint for state in tally.joint_states + tally.joint_errors} == {0}


def test_a_part_turned_in_its_place_is_off_by_the_angle(boxes):
    first, posed = boxes
    lid = dequantize(first.surface_points)[first.surface_part == 1]
    centre = 0.5 * (lid.min(0) + lid.max(0))
    R = rotation_about((0.6, 0.0, 0.8), np.radians(10.0))
    found = truth(posed)
    T_part = found.T_part.copy()
    T_part[1] = T_part[1] @ transform(R, centre - R @ centre)
    errors = poses(boxes, replace(found, T_part=T_part))
    assert errors["matched_rotation_degrees_all"] == pytest.approx(10.0 / 3)
    assert errors["matched_rotation_degrees_moving"] == pytest.approx(5.0)
    assert errors["matched_translation_moving"] == pytest.approx(0.0, abs=1e-9)
    T_part[1] = transform(translation=(0.0, 0.3, 0.4)) @ found.T_part[1]
    errors = poses(boxes, replace(found, T_part=T_part))
    assert errors["matched_rotation_degrees_all"] == pytest.approx(0.0, abs=1e-6)
    assert errors["matched_translation_all"] == pytest.approx(0.5 / 3)
    assert errors["matched_translation_moving"] == pytest.approx(0.25)


def test_poses_are_read_from_joints_where_there_are_no_transforms(boxes):
    """The knob rides on the lid, which its own joint does not know."""
    first, posed = (replace(truth(i), T_part=None) for i in boxes)
    lid_alone = np.array([0, 1, NO_LABEL])
    errors = dict(pose_errors(boxes, (first, posed), lid_alone))
    turned = np.degrees(boxes[1].joint_state[0])
    assert errors["matched_rotation_degrees_all"] == pytest.approx(turned / 3, abs=1e-3)


def test_pivots_count_across_the_true_axis_and_directions_whatever_their_sign(boxes):
    _, posed = boxes
    there = truth(posed).joints
    along, across = there.direction, np.cross(there.direction, [0.0, 0.0, 1.0])
    errors = joints(boxes, moved_joints(posed, pivot=there.pivot + 0.3 * along + 0.07 * across))
    assert errors["matched_pivot_distance"] == pytest.approx(0.07)
    assert errors["matched_direction_degrees"] == pytest.approx(0.0, abs=1e-6)
    tilted = apply(transform(rotation_about(across[1], np.radians(12.0))), along)
    errors = list(
        joint_errors(boxes, (truth(boxes[0]), moved_joints(posed, direction=tilted)), EACH)
    )
    assert errors[0] == ("matched_direction_degrees", pytest.approx(12.0))
    flipped = moved_joints(posed, direction=-there.direction, state=-there.state)
    assert max(joints(boxes, flipped).values()) == pytest.approx(0.0, abs=1e-6)


def test_states_are_off_by_what_they_are(boxes):
    _, posed = boxes
    state = truth(posed).joints.state + np.array([0.0, np.radians(3.0), 0.02])
    errors = joints(boxes, moved_joints(posed, state=state))
    assert errors["matched_state_degrees"] == pytest.approx(3.0)
    assert errors["matched_state_length"] == pytest.approx(0.02)


def test_what_is_missing_or_of_another_kind_fails_and_does_not_move(boxes):
    first, posed = boxes
    nobody = np.full(3, NO_LABEL)
    lost = joints(boxes, truth(posed), nobody)
    swapped = joints(boxes, truth(posed), np.array([0, 2, 1]))
    for errors in (lost, swapped):
        assert errors["matched_direction_degrees"] == 90.0
        assert errors["matched_pivot_distance"] == pytest.approx(np.sqrt(3))
        turned = np.degrees(posed.joint_state[0] - first.joint_state[0])
        assert errors["matched_state_degrees"] == pytest.approx(turned)
        assert errors["matched_state_length"] == pytest.approx(posed.joint_state[1])
    still = poses(boxes, replace(truth(posed), T_part=truth(first).T_part))
    assert poses(boxes, truth(posed), nobody) == pytest.approx(still)
    turned = [metrics.angle_between_rotations(np.eye(3), T[:3, :3]) for T in posed.part_motion[1:]]
    assert still["matched_rotation_degrees_moving"] == pytest.approx(np.degrees(np.mean(turned)))


def test_a_method_without_joints_or_motions_has_no_such_numbers(boxes):
    first, posed = (replace(truth(i), joints=None, T_part=None) for i in boxes)
    assert not list(pose_errors(boxes, (first, posed), EACH))
    assert not list(joint_errors(boxes, (first, posed), EACH))
