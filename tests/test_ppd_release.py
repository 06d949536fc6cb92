"""The release's protocol: what the truth scores there, its shift and stairs, what is left out."""

import dataclasses

import numpy as np
import pytest
from instances import nothing

from articugen.core.errors import UnfitData
from articugen.evaluation.reconstruction import Reconstruction, truth
from articugen.evaluation.results import LeftOut
from articugen.evaluation.tally import Protocol
from articugen.learning.ppd.release import as_points, evaluate, release_meshes

BOXES = {"train": 2, "test": 2, "states": 2}

SOME = Protocol(points=300)


def ball_logits(R: int, centre: float = 0.0, steep: float = 10.0) -> np.ndarray:
    at = (np.arange(R) + 0.5) / R - 0.5
    grid = np.stack(np.meshgrid(at, at, at, indexing="ij"), -1)
    return steep * (0.25 - np.linalg.norm(grid - centre, axis=-1))


@pytest.mark.parametrize("R", [32, 64])
def test_meshes_are_one_voxel_too_low(R):
    (part,), whole = release_meshes(ball_logits(R)[None])
    np.testing.assert_allclose(whole.reshape(-1, 3).mean(0), -1.0 / R, atol=1e-3)
    np.testing.assert_array_equal(part, whole)


def test_borders_between_parts_are_stairs():
    """Left and right half of a ball: the border lies at samples, none between them."""
    R, ball = 16, ball_logits(16)
    left = np.arange(R)[:, None, None] < R // 2
    logits = np.stack([np.where(left, ball, ball - 1.0), np.where(left, ball - 1.0, ball)])
    (first, second), _ = release_meshes(logits)
    at = (np.arange(R) + 0.5) / R - 0.5 - 1.0 / R
    assert first[..., 0].max() == pytest.approx(at[R // 2 - 1], abs=1e-6)
    assert second[..., 0].min() == pytest.approx(at[R // 2], abs=1e-6)


def test_samples_on_the_true_surface_cost_the_truth_some_iou_and_no_epe(boxes):
    """As measured of the release itself: 0.90 to 0.96, and exactly 0."""
    result = evaluate(boxes, truth, SOME, category="box")
    means = result.means
    assert set(means) == {"label_iou", "epe_joint_all", "epe_transform_all"}
    assert 0.8 < means["label_iou"] < 0.999
    assert means["epe_transform_all"] == pytest.approx(0.0, abs=1e-15)
    assert result.labels == (0, 1, 2)
    assert (result.objects, result.instances) == (2, 6)
    assert result.left_out == LeftOut()


def test_what_has_no_surface_is_left_out_and_counted(boxes):
    def one_pose_fails(instance):
        return nothing(instance) if instance.state_index == 1 else truth(instance)

    some = evaluate(boxes, one_pose_fails, SOME)
    assert some.left_out == LeftOut(instances_label_iou=2, instances_epe=2)
    assert some.means["label_iou"] > 0.8
    assert some.instances == 4
    none = evaluate(boxes, nothing, SOME)
    assert none.means == {}
    assert none.left_out == LeftOut(instances_label_iou=6, instances_epe=4, parts_epe=12)


def test_a_true_part_that_no_part_is_labelled_as_is_left_out_of_epe(boxes):
    """The lid told as the base's: EPE counts base and knob alone, which are right."""

    def no_lid(instance):
        found = truth(instance)
        return dataclasses.replace(found, part=np.where(found.part == 1, 0, found.part))

    result = evaluate(boxes, no_lid, SOME)
    assert result.labels[1] == -1
    assert result.means["epe_transform_all"] == pytest.approx(0.0, abs=1e-15)
    assert result.left_out.parts_epe == 4


def test_every_part_gets_as_many_points_whatever_its_size(boxes):
    parts, whole = release_meshes(np.stack([ball_logits(24), ball_logits(24, 0.2, 20.0) - 2.0]))
    part = np.repeat([0, 1], [len(p) for p in parts])
    found = Reconstruction(np.concatenate(parts), part, whole, np.zeros((0, 0, 0), bool), 2)
    points = as_points(found, 50, np.random.default_rng(0))
    assert np.bincount(points.part).tolist() == [50, 50]


def test_another_category_is_refused_before_anything_is_computed(boxes):
    def never(_):
        raise AssertionError

    with pytest.raises(UnfitData, match="holds box, the model is of oven"):
        evaluate(boxes, never, category="oven")
