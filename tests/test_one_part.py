"""One part for everything: the floor of label IoU."""

import numpy as np
import pytest
import torch
from ppd_data import write_boxes

from articugen.core.records import dequantize
from articugen.evaluation.evaluate import evaluate
from articugen.evaluation.tally import Protocol
from articugen.learning import commands
from articugen.learning.method import find_method, load_recipe

CPU = torch.device("cpu")


def test_it_scores_one_over_the_square_of_the_number_of_parts(tmp_path):
    boxes = write_boxes(tmp_path / "boxes", train=2, test=1, states=1)
    commands.train(boxes, "one_part", runs=tmp_path)
    means = evaluate(boxes, reconstruct, Protocol(points=10)).means  # so many on each of three
    assert means["label_iou"] == pytest.approx(1 / 9)


def reconstruct(instance):
    learner = find_method("one_part").start(load_recipe("one_part"), seed=0, device=CPU)
    return learner.reconstruct(dequantize(instance.surface_points), resolution=32)


def test_its_shape_is_the_box_of_the_cloud():
    learner = find_method("one_part").start(load_recipe("one_part"), seed=0, device=CPU)
    cloud = np.array([[-0.5, -0.25, 0.0], [0.25, 0.25, 0.5], [0.0, 0.0, 0.1]])
    shape = learner.reconstruct(cloud, resolution=4)
    assert shape.triangles.min((0, 1)).tolist() == [-0.5, -0.25, 0.0]
    assert shape.triangles.max((0, 1)).tolist() == [0.25, 0.25, 0.5]
    assert shape.occupied.nonzero()[0].max() == 2
    assert shape.occupied.sum() == 3 * 2 * 2
