"""Figures: what is drawn is what was given, in the colours of the true parts."""

import dataclasses

import numpy as np
import pytest
from instances import LOWER, UPPER, hinged_box
from shapes import box

pytest.importorskip("torch", reason="PPD needs torch")
pytest.importorskip("matplotlib", reason="figures need matplotlib")

import torch
from PIL import Image

from articugen.geometry import apply
from articugen.inspection.layout import CAPTION, MARGIN, TILE
from articugen.inspection.portrait import COLOURS
from articugen.learning.evaluation.figures import plots
from articugen.learning.evaluation.figures.colours import UNNAMED, part_colours
from articugen.learning.evaluation.figures.draw import cutting_plane
from articugen.learning.evaluation.figures.shapes import Names, by_opening, reconstructions
from articugen.learning.evaluation.reconstruction import Reconstruction, truth
from articugen.learning.evaluation.results import (
    Evaluation,
    JointError,
    JointLine,
    JointState,
)
from articugen.learning.ppd import reconstruct
from articugen.learning.ppd.drawing import between
from articugen.learning.ppd.model import PPD
from articugen.learning.ppd.settings import ModelSettings
from articugen.learning.runs import RunFolder
from articugen.records import Instance, Normalization, dequantize

NAMES = Names([0, 1, 2], [0, 1, 2])
FROM_ABOVE = float(np.radians(35.0))


def solid_truth(instance: Instance) -> Reconstruction:
    """The true boxes as a prediction, as triangles and not as points."""
    unit = Normalization(instance.center, instance.scale)
    triangles, part = [], []
    for k, (low, high) in enumerate(zip(unit.to_unit(LOWER), unit.to_unit(UPPER), strict=True)):
        corners = box(high - low, (low + high) / 2).triangles
        triangles.append(apply(instance.part_motion[k], corners))
        part += [k] * len(corners)
    whole = np.concatenate(triangles)
    found = truth(instance)
    return dataclasses.replace(found, triangles=whole, part=np.array(part), whole=whole)


def tiles(picture):
    """(row, column, TILE, TILE, 3) of a sheet."""
    pixels = np.asarray(picture).astype(int)[MARGIN:-MARGIN, MARGIN:-MARGIN]
    height = TILE + 2 * CAPTION
    rows, columns = pixels.shape[0] // height, pixels.shape[1] // TILE
    grid = pixels.reshape(rows, height, columns, TILE, 3).swapaxes(1, 2)
    return grid[:, :, CAPTION : CAPTION + TILE]


def pixels_of(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def test_the_truth_as_a_prediction_looks_like_the_truth():
    instances = by_opening(hinged_box())
    true, predicted = tiles(reconstructions([instances], solid_truth, NAMES, FROM_ABOVE, states=2))
    off = np.abs(true - predicted).max(-1)
    assert (off > 40).mean() < 0.02  # edges of points and of triangles
    assert np.median(off[true.min(-1) < 200]) < 12
    swapped = Names([0, 2, 1], [0, 2, 1])
    _, wrong = tiles(reconstructions([instances], solid_truth, swapped, FROM_ABOVE, states=2))
    assert (np.abs(true - wrong).max(-1) > 40).mean() > 0.04


def test_nothing_predicted_is_drawn_as_nothing():
    def nothing(instance):
        empty = np.zeros((0, 3, 3))
        return dataclasses.replace(
            truth(instance), triangles=empty, part=np.zeros(0, int), whole=empty
        )

    none = Names([-1, -1, -1], [-1, -1, -1])
    _, predicted = tiles(reconstructions([hinged_box()], nothing, none, FROM_ABOVE, states=1))
    assert predicted.min() == 255


def test_parts_of_one_label_have_shades_of_its_colour():
    colours = part_colours([0, 1, -1, 1], [0, -1, -1, 1])
    assert colours[0] == COLOURS[0]
    assert colours[3] == COLOURS[1]
    assert colours[2] == UNNAMED
    assert len(set(colours)) == 4


def two_boxes(size=64):
    """Part 0 low and to the left, part 1 high and to the right, part 2 nowhere: (3, R, R)."""
    at = (np.arange(size) + 0.5) / size - 0.5
    u, v = np.meshgrid(at, at, indexing="ij")
    low, high = (abs(u + 0.2) < 0.15) & (abs(v + 0.3) < 0.1), (u > 0.1) & (v > 0.2)
    return np.stack([low, high, np.zeros_like(low)]).astype(float)


def test_a_slice_has_each_part_s_colour_where_it_is():
    fields = two_boxes()
    low, high = fields[:2] > 0.5
    union, first, second, third = (255 * plots.slice_pictures(fields, COLOURS[1:4])).round()
    blue, yellow = ([int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in COLOURS[1:3])
    for picture, where, colour in (
        (union, low, blue), (union, high, yellow), (first, low, blue), (second, high, yellow)
    ):  # fmt: skip
        assert (picture[where] == colour).all()
    assert (union[~low & ~high] == 255).all()
    assert (first[high] == 255).all()
    assert (third == 255).all()


def test_a_slice_is_drawn_upright(tmp_path):
    """The plane's first axis goes to the right and its second one up."""
    nothing = (np.zeros((0, 2)), np.zeros(0, int), COLOURS)
    titles = ["one", "two", "three"]
    plots.slices(
        two_boxes(), COLOURS[1:4], titles, nothing, ("x", "z"), tmp_path / "s.png"
    )  # fmt: skip
    pixels = pixels_of(tmp_path / "s.png")
    union = pixels[:, : pixels.shape[1] // 2]
    blue, yellow = (np.array([int(c[i : i + 2], 16) for i in (1, 3, 5)]) for c in COLOURS[1:3])
    (row_1, column_1), (row_2, column_2) = (
        np.argwhere(np.abs(union - colour).max(-1) < 8).mean(0) for colour in (blue, yellow)
    )
    assert row_2 < row_1
    assert column_1 < column_2


def test_the_cut_shows_how_the_first_joint_moves():
    normal, offset = cutting_plane(hinged_box()[2])
    assert normal == 1  # the hinge is along y
    assert abs(offset) < 0.2


def test_curves_are_those_of_the_metrics_file(tmp_path):
    run = RunFolder(tmp_path)
    for iteration in (10, 20, 30):
        terms = {"rec": 1.0 / iteration, "vol": 0.0}
        stage = int(iteration > 20)
        run.log({"iteration": iteration, "stage": stage, "terms": terms})
    run.log({"iteration": 30, "validation": {"rec": 0.5, "iou": 0.25}})
    panels, borders = plots.curve_panels(run.metrics())
    assert borders == [20]
    assert panels[0] == ("rec", [10, 20, 30], [0.1, 0.05, 1.0 / 30.0], True)
    assert panels[2:] == [
        ("held-out rec", [30], [0.5], False), ("held-out iou", [30], [0.25], False)
    ]  # fmt: skip
    for metrics in (run.metrics(), []):
        plots.curves(metrics, tmp_path / "curves.png")
        assert pixels_of(tmp_path / "curves.png").min() < 128


def test_a_running_mean_is_a_mean_of_what_is_around():
    values = np.random.default_rng(0).normal(size=20)
    smooth = plots.running_mean(values, 3)
    assert smooth[0] == pytest.approx(values[0])
    assert smooth[10] == pytest.approx(values[7:14].mean())
    assert smooth[18] == pytest.approx(values[17:20].mean())


def test_what_failed_is_never_right():
    errors = [0.5, None, 2.0, 10.0]
    np.testing.assert_allclose(plots.accuracy(errors, np.array([0.5, 1, 3, 99])), [0, 25, 50, 75])


def test_joints_are_drawn_even_if_all_failed(tmp_path):
    which = {"object": "a", "state_index": 1, "joint": 0, "kind": "revolute"}
    fit = {"slope": None, "offset": None, "residual": None}
    result = Evaluation(
        means={}, votes=(), labels=(0, -1), dominant=(0, -1), objects=1, instances=1,
        joint_states=(JointState(**which, true=0.3, predicted=None),),
        joint_lines=(JointLine(joint=0, kind="revolute", states=1, predicted=0, **fit),),
        joint_errors=(JointError(**which, state=None, direction=None, axis=None),),
    )  # fmt: skip
    plots.joints(result, COLOURS, tmp_path / "joints.png")
    assert pixels_of(tmp_path / "joints.png").min() < 128


def test_interpolation_holds_what_it_holds():
    torch.manual_seed(0)
    model = PPD(ModelSettings()).eval()
    clouds = [dequantize(i.surface_points) for i in hinged_box()]
    openings = [(clouds[1], clouds[0], clouds[3]), (clouds[0], clouds[2], clouds[2])]
    first, shapes, states = between(model, openings, 5, True)
    openings = openings if first == 0 else openings[::-1]
    one, other, low, high = (
        model(torch.as_tensor(cloud, dtype=torch.float32)[None])
        for cloud in (openings[0][1], openings[1][1], openings[0][0], openings[0][2])
    )
    assert len(shapes) == len(states) == 5
    torch.testing.assert_close(shapes[0].shape.detail, one.shape.detail)
    torch.testing.assert_close(shapes[-1].shape.detail, other.shape.detail)
    assert not torch.equal(shapes[2].shape.detail, one.shape.detail)
    for prediction in shapes:
        torch.testing.assert_close(prediction.pose.state, one.pose.state)
    torch.testing.assert_close(states[0].pose.state, low.pose.state)
    torch.testing.assert_close(states[-1].pose.state, high.pose.state)
    for prediction in states:
        torch.testing.assert_close(prediction.shape.detail, one.shape.detail)


def test_a_fine_grid_need_only_be_evaluated_near_surfaces(monkeypatch):
    asked = []

    def balls(_model, _predicted, points):
        asked.append(len(points))
        p = points.double().numpy()
        at = [[0.0, 0.1, 0.0], [0.2, -0.2, 0.1]]
        return np.stack([20.0 * (0.2 - np.linalg.norm(p - c, axis=1)) for c in at])

    monkeypatch.setattr(reconstruct, "logits_at", balls)
    monkeypatch.setattr(reconstruct, "_DENSE", 16)
    fine = reconstruct._meshes(reconstruct.part_logits(None, None, 32))
    assert sum(asked) < 0.5 * 32**3
    monkeypatch.setattr(reconstruct, "_DENSE", 17)
    dense = reconstruct._meshes(reconstruct.part_logits(None, None, 32))
    for a, b in zip([*fine[0], fine[1]], [*dense[0], dense[1]], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
