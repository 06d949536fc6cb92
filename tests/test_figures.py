"""Figures: what is drawn is what was given, in the colours of the true parts."""

import dataclasses

import numpy as np
from instances import LOWER, UPPER, hinged_box, nothing
from PIL import Image
from ppd_data import write_boxes
from shapes import box

from articugen.core.colours import COLOURS, UNNAMED, part_colours
from articugen.core.geometry import apply
from articugen.core.records import Normalization
from articugen.core.schema import Instance
from articugen.evaluation.figures import (
    Example,
    Names,
    by_opening,
    draw_examples,
    draw_interpolations,
    draw_reconstructions,
    reconstructions,
)
from articugen.evaluation.reconstruction import Reconstruction, truth
from articugen.evaluation.results import Evaluation
from articugen.pictures.layout import CAPTION, MARGIN, TILE, in_columns, sheet

NAMES = Names([0, 1, 2], [0, 1, 2])
RESULT = Evaluation(
    means={}, votes=(), labels=(0, 1, 2), dominant=(0, 1, 2), objects=1, instances=1
)
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
    """Row by row; `reconstruct` is given instances."""
    model = ("", reconstruct, names)
    return sheet(reconstructions(instances, [model], FROM_ABOVE, **options))


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
    plain = lambda i: dataclasses.replace(solid_truth(i), joints=None)  # noqa: E731
    axes = np.abs(predicted - tiles(drawn(instances, plain, NAMES, states=2))[1]).max(-1) > 40
    assert axes.mean() > 0.002
    assert (off[axes] > 40).mean() < 0.1  # the true ones are there as well


def test_a_predicted_axis_far_outside_is_not_drawn():
    instances = by_opening(hinged_box())

    def far(instance, away=6.0):
        found = solid_truth(instance)
        joints = dataclasses.replace(found.joints, pivot=found.joints.pivot + away)
        return dataclasses.replace(found, joints=joints)

    _, there = tiles(drawn(instances, far, NAMES, states=2))
    _, none = tiles(drawn(instances, lambda i: far(i, 5000.0), NAMES, states=2))
    np.testing.assert_array_equal(there, none)


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
    one = Example("boxes", "model", data, solid_truth, RESULT)
    draw_examples(tmp_path / "examples.png", [one])
    with Image.open(tmp_path / "examples.png") as picture:
        true, predicted = tiles(picture.convert("RGB"))
    assert len(true) == 3
    assert (np.abs(true - predicted).max(-1) > 40).mean() < 0.02
    assert np.abs(true[0] - true[2]).max() > 100  # they move


def test_methods_stand_beside_each_other_in_rows_of_three(tmp_path):
    data = write_boxes(tmp_path / "boxes", train=1, test=1, states=2)
    examples = [Example("boxes", name, data, solid_truth, RESULT) for name in "abc"]
    draw_examples(tmp_path / "examples.png", examples)
    with Image.open(tmp_path / "examples.png") as picture:
        assert picture.width == 3 * (3 * TILE + 2 * MARGIN)  # the truth, a, b; below it c
        assert picture.height == 2 * (TILE + 2 * CAPTION + 2 * MARGIN)


def test_nothing_predicted_is_drawn_as_nothing():
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


def test_a_method_that_only_segments_is_drawn_as_far_as_it_goes(tmp_path):
    """Without joints: its shapes, without question marks."""
    data = write_boxes(tmp_path / "boxes", train=1, test=1, states=1)

    def segments(instance):
        return dataclasses.replace(solid_truth(instance), joints=None, T_part=None)

    path = tmp_path / "reconstructions.png"
    draw_reconstructions(path, data, segments, RESULT)
    picture = pixels_of(path)
    *_, last_caption = (row for row in np.array_split(picture[:-MARGIN], len(picture) // CAPTION))
    assert last_caption.min() > 200


def test_between_objects_of_one_pose_is_drawn_too(tmp_path):
    data, given = write_boxes(tmp_path / "boxes", train=1, test=2, states=0), []

    def between(one, other, steps):
        given.append((one.object_id, other.object_id, steps))
        return [[solid_truth(one)] * steps] * 2

    draw_interpolations(tmp_path / "between.png", data, between, RESULT)
    assert given == [("box-1", "box-2", 6)]
    assert pixels_of(tmp_path / "between.png").std() > 1.0
