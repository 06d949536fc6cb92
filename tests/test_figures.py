"""Figures: what is drawn is what was given, in the colours of the true parts."""

import dataclasses

import numpy as np
import pytest
from instances import LOWER, UPPER, hinged_box
from ppd_data import write_boxes
from shapes import box

pytest.importorskip("matplotlib", reason="figures need matplotlib")

from PIL import Image

from articugen.core.colours import COLOURS, UNNAMED, part_colours
from articugen.core.geometry import apply
from articugen.core.records import Normalization, dequantize
from articugen.core.schema import Instance
from articugen.evaluation.evaluate import objects_of
from articugen.evaluation.figures import plots
from articugen.evaluation.figures.draw import (
    Drawable,
    Example,
    cutting_plane,
    draw_examples,
    draw_figures,
)
from articugen.evaluation.figures.shapes import Names, by_opening, reconstructions
from articugen.evaluation.reconstruction import Reconstruction, truth
from articugen.evaluation.results import (
    Evaluation,
    JointError,
    JointLine,
    JointState,
)
from articugen.pictures.layout import CAPTION, MARGIN, TILE, in_columns, sheet

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


def drawn(instances, reconstruct, names, **options):
    return sheet(reconstructions(instances, [("", reconstruct, names)], FROM_ABOVE, **options))


def pixels_of(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def test_the_truth_as_a_prediction_looks_like_the_truth():
    instances = by_opening(hinged_box())
    true, predicted = tiles(drawn(instances, solid_truth, NAMES, states=2))
    off = np.abs(true - predicted).max(-1)
    assert (off > 40).mean() < 0.02  # edges of points and of triangles
    assert np.median(off[true.min(-1) < 200]) < 12
    swapped = Names([0, 2, 1], [0, 2, 1])
    _, wrong = tiles(drawn(instances, solid_truth, swapped, states=2))
    assert (np.abs(true - wrong).max(-1) > 40).mean() > 0.04


def test_sheets_stand_in_rows_of_so_many():
    one, two, three = (
        Image.new("RGB", size, colour)
        for size, colour in (((8, 5), "red"), ((6, 9), "green"), ((8, 4), "blue"))
    )
    pixels = np.asarray(in_columns([one, two, three], 2))
    assert pixels.shape == (9 + 4, 2 * 8, 3)
    np.testing.assert_array_equal(pixels[:5, :8], np.asarray(one))
    np.testing.assert_array_equal(pixels[:9, 8:14], np.asarray(two))
    np.testing.assert_array_equal(pixels[9:, :8], np.asarray(three))
    assert (pixels[9:, 8:] == 255).all()


def test_a_test_object_of_each_run_stands_in_one_picture(tmp_path):
    """The first test object from its canonical pose to its widest, drawn as figures draw it."""
    data = write_boxes(tmp_path / "boxes", train=1, test=2, states=2)
    instances, _ = objects_of(data, "test", None)
    clouds = {dequantize(i.surface_points).tobytes(): i for i in instances}
    model = Drawable(lambda cloud: solid_truth(clouds[cloud.tobytes()]))
    result = Evaluation(
        means={}, votes=(), labels=(0, 1, 2), dominant=(0, 1, 2), objects=1, instances=1
    )
    draw_examples(tmp_path / "examples.png", [Example("boxes", "model", data, model, result)])
    with Image.open(tmp_path / "examples.png") as picture:
        true, predicted = tiles(picture.convert("RGB"))
    assert len(true) == 3
    assert (np.abs(true - predicted).max(-1) > 40).mean() < 0.02
    assert np.abs(true[0] - true[2]).max() > 100  # they move


def test_methods_stand_beside_each_other_in_rows_of_three(tmp_path):
    data = write_boxes(tmp_path / "boxes", train=1, test=1, states=2)
    (instances,) = objects_of(data, "test", None)
    clouds = {dequantize(i.surface_points).tobytes(): i for i in instances}
    model = Drawable(lambda cloud: solid_truth(clouds[cloud.tobytes()]))
    result = Evaluation(
        means={}, votes=(), labels=(0, 1, 2), dominant=(0, 1, 2), objects=1, instances=1
    )
    examples = [Example("boxes", name, data, model, result) for name in "abc"]
    draw_examples(tmp_path / "examples.png", examples)
    with Image.open(tmp_path / "examples.png") as picture:
        assert picture.width == 3 * (3 * TILE + 2 * MARGIN)  # the truth, a, b; below it c
        assert picture.height == 2 * (TILE + 2 * CAPTION + 2 * MARGIN)


def test_nothing_predicted_is_drawn_as_nothing():
    def nothing(instance):
        empty = np.zeros((0, 3, 3))
        return dataclasses.replace(
            truth(instance), triangles=empty, part=np.zeros(0, int), whole=empty
        )

    none = Names([-1, -1, -1], [-1, -1, -1])
    _, predicted = tiles(drawn(hinged_box(), nothing, none, states=1))
    assert predicted.min() == 255


def test_of_parts_with_one_label_the_one_that_is_there_tells_of_the_joint():
    """A door that is hinged left and one that is hinged right have a part each."""
    shape = dataclasses.replace(solid_truth(hinged_box()[0]), parts=4)
    moved = dataclasses.replace(shape, part=np.where(shape.part == 1, 3, shape.part))
    left_and_right = Names([0, 1, 2, 1], [0, 1, 2, -1])
    assert left_and_right.part_of(0, shape) == 1
    assert left_and_right.part_of(0, moved) == 3
    assert left_and_right.part_of(1, moved) == 2
    assert Names([0, -1, 2, -1], [0, -1, 2, -1]).part_of(0, shape) is None


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
    metrics = [
        {"iteration": i, "stage": int(i > 20), "terms": {"rec": 1.0 / i, "vol": 0.0}}
        for i in (10, 20, 30)
    ]
    metrics.append({"iteration": 30, "validation": {"rec": 0.5, "iou": 0.25}})
    panels, borders = plots.curve_panels(metrics)
    assert borders == [20]
    assert panels[0] == ("rec", [10, 20, 30], [0.1, 0.05, 1.0 / 30.0], True)
    assert panels[2:] == [
        ("held-out rec", [30], [0.5], False), ("held-out iou", [30], [0.25], False)
    ]  # fmt: skip
    for some in (metrics, []):
        plots.curves(some, tmp_path / "curves.png", {"rec": "$L_{rec}$"})
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


def test_a_method_that_only_segments_is_drawn_as_far_as_it_goes(tmp_path):
    """Without joints, fields or interpolations: its curves and shapes, without question marks."""
    data = write_boxes(tmp_path / "boxes", train=1, test=1, states=1)
    (objects,) = objects_of(data, "test", None)

    def segments(cloud):
        one = min(objects, key=lambda i: np.abs(dequantize(i.surface_points) - cloud).max())
        return dataclasses.replace(solid_truth(one), joints=None, T_part=None)

    result = Evaluation(
        means={}, votes=(), labels=(0, 1, 2), dominant=(0, 1, 2), objects=1, instances=1
    )
    drawn = [p.name for p in draw_figures(tmp_path, [], data, Drawable(segments), result)]
    assert drawn == ["curves.png", "reconstructions.png"]
    picture = pixels_of(tmp_path / "reconstructions.png")
    *_, last_caption = (row for row in np.array_split(picture[:-MARGIN], len(picture) // CAPTION))
    assert last_caption.min() > 200
