"""The evaluation: the truth scores full marks, and each fault costs what it should."""

import math
from dataclasses import replace
from functools import partial
from threading import Barrier
from time import sleep

import numpy as np
import pytest
from instances import SMALL, hinged_box, nothing
from ppd_data import write_boxes
from shapes import box

from articugen.core.errors import UnfitData
from articugen.core.geometry import transform
from articugen.evaluation import evaluate as evaluation_module
from articugen.evaluation.evaluate import evaluate, label_votes, objects_of
from articugen.evaluation.reconstruction import PartJoints, truth
from articugen.evaluation.report import _details
from articugen.evaluation.tally import Protocol

BOXES = {"train": 2, "test": 2, "states": 2}

FEW = Protocol(points=100, surface_samples=200)


def exactly(instance):
    return truth(instance, min(instance.occupancy))


def test_the_truth_scores_full_marks(boxes):
    seen = []
    result = evaluate(boxes, exactly, FEW, on_object=seen.append)
    means = result.means
    assert means["label_iou"] == 1.0
    assert means["epe_transform_all"] == pytest.approx(0.0, abs=1e-15)
    assert means["epe_transform_dominant"] == pytest.approx(0.0, abs=1e-15)
    assert means["epe_nothing_moves"] > 0.05
    assert means["chamfer_l1"] == pytest.approx(0.0, abs=1e-15)
    assert means["f_score"] == 100.0
    assert means["assigned_parts"] == 1.0
    assert means["type_accuracy"] == 100.0
    assert means["reconstruction_iou"] == 1.0
    matched = {name: value for name, value in means.items() if name.startswith("matched")}
    assert matched.pop("matched_part_iou") == 1.0
    assert len(matched) == 4 + 5
    assert max(matched.values()) == pytest.approx(0.0, abs=1e-6)
    joints = [(state.joint, state.kind) for state in result.joint_states]
    assert joints == 6 * [(0, "revolute"), (1, "prismatic")]
    assert all(state.predicted == state.true for state in result.joint_states)
    limits = {name: value for name, value in means.items() if "_below_" in name}
    assert len(limits) == 5 + 4 + 5 + 4 + 5
    assert set(limits.values()) == {100.0}
    assert result.labels == result.dominant == (0, 1, 2)
    assert (result.objects, result.instances) == (2, 6)
    assert seen == ["box-0", "box-1", "box-2", "box-3"]


def test_surfaces_that_no_view_sees_do_not_count(boxes):
    """As true points are on none: of a box in a box, but of one that is beside it."""

    def measured(*more):
        def made(instance):
            shapes = [box((0.6, 0.6, 0.6)), *more]
            whole = np.concatenate([np.asarray(shape.triangles) for shape in shapes])
            return replace(exactly(instance), whole=whole)

        return evaluate(boxes, made, FEW).means

    alone, hidden = measured(), measured(box((0.2, 0.2, 0.2)))
    beside = measured(box((0.2, 0.2, 0.2), (0.9, 0.0, 0.0)))
    assert hidden == alone
    for name in ("chamfer_l1", "f_score"):
        assert beside[name] != pytest.approx(alone[name], rel=1e-2)


def test_objects_at_a_time_change_nothing(boxes):
    both, names, rng = Barrier(2), [], np.random.default_rng(0)
    objects = [*objects_of(boxes, "train", 0), *objects_of(boxes, "test", None)]
    wrong = {(i.object_id, i.state_index): rng.normal(0.0, 0.05) for o in objects for i in o}

    def shifted(instance):
        found, by = exactly(instance), wrong[instance.object_id, instance.state_index]
        return replace(found, triangles=found.triangles + by, whole=found.whole + by)

    def beside_another(instance):
        both.wait(30)
        return shifted(instance)

    result = evaluate(boxes, beside_another, FEW, jobs=2, on_object=names.append)
    assert result == evaluate(boxes, shifted, FEW)
    assert names == ["box-0", "box-1", "box-2", "box-3"]


def test_after_an_error_no_other_object_goes_on(boxes):
    both, asked = Barrier(2), []

    def fails(instance):
        if instance.state_index == 0:
            both.wait(30)
        asked.append((instance.object_id, instance.state_index))
        if instance.object_id == "box-2":
            raise ZeroDivisionError
        sleep(0.5 * (instance.object_id == "box-3"))
        return exactly(instance)

    with pytest.raises(ZeroDivisionError):
        evaluate(boxes, fails, FEW, jobs=2)
    assert sorted(asked) == [(f"box-{k}", 0) for k in range(4)]


def test_labels_and_surfaces_are_measured_on_a_finer_grid_as_well(boxes):
    """The finer surfaces alone decide, and the votes of the others."""

    def confused(instance):
        found = exactly(instance)
        return replace(found, part=(found.part + 1) % found.parts)

    means = evaluate(boxes, exactly, FEW, finer=exactly).means
    assert means["label_iou"] == means["finer_label_iou"] == 1.0
    means = evaluate(boxes, exactly, FEW, finer=confused).means
    assert (means["label_iou"], means["finer_label_iou"]) == (1.0, 0.0)
    assert "finer_label_iou" not in evaluate(boxes, exactly, FEW).means

    def finer_than_asked(instance):
        exact = exactly(instance)
        return replace(exact, whole=np.zeros((0, 3, 3)), finer=exact.whole)

    means = evaluate(boxes, finer_than_asked, FEW, finer=confused).means
    assert means["label_iou"] == means["finer_label_iou"] == 1.0
    assert (means["f_score"], means["finer_f_score"]) == (0.0, 100.0)
    assert means["finer_chamfer_l1"] < 1e-9 < means["chamfer_l1"]


def test_parts_without_a_surface_move_as_predicted(boxes):
    def unseen(instance):
        exact = truth(instance)
        none = {"triangles": exact.triangles[:0], "part": exact.part[:0]}
        return replace(exact, **none) if instance.object_id in ("box-2", "box-3") else exact

    means = evaluate(boxes, unseen, FEW).means
    assert means["label_iou"] == 0.0
    assert means["epe_transform_all"] < 1e-9 < means["epe_nothing_moves"]


def test_nothing_predicted_counts_as_failed(boxes):
    result = evaluate(boxes, nothing, FEW)
    means = result.means
    assert means["reconstruction_iou"] == 0.0
    assert {state.predicted for state in result.joint_states} == {None}
    assert means["label_iou"] == means["f_score"] == means["type_accuracy"] == 0.0
    assert means["no_surface"] == 1.0
    assert means["epe_joint_all"] == means["epe_transform_all"] == means["epe_nothing_moves"]
    assert means["chamfer_l1"] == pytest.approx(math.sqrt(3))
    assert means["matched_part_iou"] == 0.0
    assert means["matched_direction_degrees"] == 90.0
    assert means["matched_pivot_distance"] == pytest.approx(math.sqrt(3))


def test_an_axis_that_points_the_other_way_is_as_good(boxes):
    def flipped(instance):
        found = truth(instance)
        flipped = replace(
            found.joints, state=-found.joints.state, direction=-found.joints.direction
        )
        return replace(found, joints=flipped)

    result = evaluate(boxes, flipped, FEW)
    means = result.means
    assert all(state.predicted == -state.true for state in result.joint_states)
    assert means["revolute_state_below_5"] == means["prismatic_state_below_0.025"] == 100.0
    assert means["revolute_direction_below_5"] == 100.0


def test_an_axis_beside_the_true_one_costs_its_distance(boxes):
    def beside(instance):
        found = truth(instance)
        across = np.cross(found.joints.direction, [0.0, 0.0, 1.0])
        beside = replace(found.joints, pivot=found.joints.pivot + 0.07 * across)
        return replace(found, joints=beside)

    means = evaluate(boxes, beside, FEW).means
    assert means["revolute_axis_below_0.05"] == 0.0
    assert means["revolute_axis_below_0.1"] == 100.0
    assert means["revolute_state_below_5"] == 100.0


def test_two_parts_for_one_label_are_not_one(boxes):
    """The lid in two halves: the segmentation is right, the joint is not counted right."""

    def halved(instance):
        found = truth(instance)
        second = (found.part == 1) & (np.arange(len(found.part)) % 3 == 0)

        def more(values):
            return np.concatenate([values, values[1:2]])

        return replace(
            found,
            part=np.where(second, 3, found.part),
            parts=4,
            T_part=more(found.T_part),
            joints=PartJoints(*(more(values) for values in vars(found.joints).values())),
        )

    result = evaluate(boxes, halved, FEW)
    assert result.labels == (0, 1, 2, 1)
    assert sorted(result.dominant) == [-1, 0, 1, 2]
    assert result.means["label_iou"] == 1.0
    assert result.means["assigned_parts"] == 1.5
    assert result.means["revolute_state_below_5"] == 0.0
    assert result.means["epe_transform_all"] == pytest.approx(0.0, abs=1e-15)


def test_what_is_thinner_than_a_voxel_is_missing_from_the_voxels(tmp_path):
    """Its points are given to whatever part lies nearest."""
    recipe = SMALL.model_copy(
        update={"sampling": SMALL.sampling.model_copy(update={"grids": (4, 8, 32)})}
    )
    data = write_boxes(tmp_path / "boxes", train=1, test=1, states=1, recipe=recipe)
    coarse, fair, fine = (
        evaluate(data, partial(truth, resolution=R), FEW).means["voxels_label_iou"]
        for R in (4, 8, 32)
    )
    assert coarse < fair < fine
    assert coarse < 0.7
    assert fine > 0.85


def test_a_method_without_joints_has_no_numbers_of_joints(boxes):
    """Labels and surfaces are measured as ever; the rest is not made up."""
    full = evaluate(boxes, exactly, FEW)
    segments = evaluate(boxes, lambda i: replace(exactly(i), joints=None, T_part=None), FEW)
    shape = {"label_iou", "reconstruction_iou", "voxels_label_iou"}
    shape |= {"chamfer_l1", "f_score", "no_surface"}
    assert set(segments.means) == shape | {"epe_nothing_moves", "matched_part_iou"}
    assert segments.means == {name: full.means[name] for name in segments.means}
    assert segments.joint_states == segments.joint_errors == ()
    assert (segments.labels, segments.votes) == (full.labels, full.votes)
    # states and directions follow from motions
    motions = evaluate(boxes, lambda i: replace(exactly(i), joints=None), FEW)
    assert motions.means["epe_transform_all"] == pytest.approx(0.0, abs=1e-15)
    assert motions.means["matched_rotation_degrees_all"] == pytest.approx(0.0, abs=1e-6)
    of_joints = ("epe_joint", "type", "matched_pivot", "revolute_axis")
    assert not any(name.startswith(of_joints) for name in motions.means)


def test_parts_may_have_other_numbers_in_every_instance(boxes):
    """Votes label by number; matching does not, so it alone is right here."""

    def renumbered(instance):
        found = truth(instance)
        return replace(found, part=(found.part + instance.state_index) % 3)

    means = evaluate(boxes, renumbered, FEW).means
    assert means["matched_part_iou"] == 1.0
    assert means["label_iou"] < 0.6


@pytest.mark.parametrize("whole", ["box-0", "box-1", "box-2", "box-3"])
def test_objects_may_have_other_numbers_of_parts(boxes, whole, monkeypatch):
    """One object alone has a knob; of all others it is a piece of the lid. A part that no training
    object has has no label: it counts as missed."""

    def without_knob(row):
        of_joints = ("kind", "parent", "state", "lower", "upper", "axis", "pivot")
        fewer = {f"joint_{name}": getattr(row, f"joint_{name}")[:1] for name in of_joints}
        return replace(
            row,
            surface_part=np.minimum(row.surface_part, 1),
            part_motion=row.part_motion[:2],
            occupancy={size: np.minimum(grid, 2) for size, grid in row.occupancy.items()},
            **fewer,
        )

    def mixed(*args):
        for rows in objects_of(*args):
            has = rows[0].object_id == whole
            yield rows if has else [without_knob(row) for row in rows]

    def predicted(row):
        return replace(exactly(row), parts=3, T_part=None, joints=None)

    monkeypatch.setattr(evaluation_module, "objects_of", mixed)
    means = evaluate(boxes, predicted, FEW).means
    known = 1.0 if whole in ("box-0", "box-1") else 0.5 * (1.0 + 2.0 / 3.0)
    assert means["label_iou"] == pytest.approx(known)
    assert means["matched_part_iou"] == 1.0


def test_all_poses_can_vote(boxes):
    canonical, none = label_votes(boxes, truth, FEW, 1, lambda _: None)
    assert none is None
    by_all = Protocol(points=100, label_poses="all")
    again, everything = label_votes(boxes, truth, by_all, 1, lambda _: None)
    np.testing.assert_allclose(canonical, 2 * np.eye(3))
    np.testing.assert_allclose(again, canonical)
    np.testing.assert_allclose(everything, 6 * np.eye(3))
    few = replace(by_all, states=1)
    np.testing.assert_allclose(label_votes(boxes, truth, few, 1, lambda _: None)[1], 4 * np.eye(3))


def test_what_moves_parts_among_labels_costs_those_of_canonical_poses(boxes):
    """Where predicted parts swap in all other poses, votes of all poses name them rightly there."""

    def swapping(instance):
        found = truth(instance)
        swap = np.array([0, 2, 1])[found.part] if instance.state_index else found.part
        return replace(found, part=swap, T_part=None, joints=None)

    canonical = evaluate(boxes, swapping, FEW).means
    both = evaluate(boxes, swapping, replace(FEW, label_poses="all")).means
    assert both["label_iou"] == canonical["label_iou"]
    assert "label_iou_all_poses" not in canonical
    posed = both["label_iou_all_poses"]
    count = FEW.states or 2
    assert canonical["label_iou"] == pytest.approx((1 + count / 3) / (1 + count))
    assert posed == pytest.approx((1 / 3 + count) / (1 + count))


def test_the_joint_aware_reading_turns_about_the_axis():
    first, _, turned, _ = hinged_box()
    motion = truth(first).joint_motion_to(truth(turned))
    np.testing.assert_allclose(motion[1], turned.part_motion[1], atol=1e-9)
    slide = transform(translation=turned.joint_state[1] * first.joint_axis[1])
    np.testing.assert_allclose(motion[2], slide, atol=1e-12)


def test_all_objects_of_another_data_set_are_tested(boxes, tmp_path):
    others = write_boxes(tmp_path / "others", train=2, test=1, states=1)
    seen = []
    result = evaluate(boxes, exactly, FEW, on=others, on_object=seen.append)
    assert (result.objects, result.instances) == (3, 6)
    assert sorted(seen[2:]) == ["box-0", "box-1", "box-2"]  # after two of `boxes`, which vote
    training = write_boxes(tmp_path / "training", train=1, test=0, states=1)
    assert evaluate(training, exactly, FEW, on=others).objects == 3
    lamps = write_boxes(tmp_path / "lamps", train=1, test=0, states=1, category="lamp")
    with pytest.raises(UnfitData, match="lamps: holds lamp, the model is of box"):
        evaluate(boxes, exactly, FEW, on=lamps, category="box")


def test_every_instance_has_its_measures_and_every_object_a_row(boxes):
    """They say which object is wrong; their means are those of the whole."""

    def wrong_once(instance):
        found = exactly(instance)
        wrong = instance.object_id == "box-2" and instance.state_index > 0
        return replace(found, part=np.zeros_like(found.part)) if wrong else found

    result = evaluate(boxes, wrong_once, FEW, finer=exactly)
    assert [(m.object, m.state_index) for m in result.measures] == [
        (f"box-{k}", state) for k in (2, 3) for state in range(3)
    ]
    for name in ("label_iou", "finer_label_iou", "f_score", "epe_joint_all"):
        values = [m.values[name] for m in result.measures if name in m.values]
        assert np.mean(values) == pytest.approx(result.means[name])
    assert "epe_joint_all" not in result.measures[0].values, "the canonical pose has not moved"
    wrong = [m.values["label_iou"] < 1.0 for m in result.measures]
    assert wrong == [False, True, True, False, False, False]
    rows = [line for line in _details(result) if line.startswith("| box-")]
    assert [row.split()[1:4:2] for row in rows] == [["box-2", "3"], ["box-3", "3"]]


def test_a_data_set_without_test_objects_is_refused(tmp_path):
    data = write_boxes(tmp_path / "boxes", train=1, test=0, states=1)
    with pytest.raises(UnfitData, match="has no object in split 'test'"):
        evaluate(data, truth, FEW)
