"""`articugen compare`: distances against every pair of points, sets of known likeness, messages."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run as invoke
from instances import LIMITS, hinged_box
from PIL import Image
from ppd_data import shard
from test_html_report import STATES

from articugen.core.records import dequantize, quantize
from articugen.core.schema import Instance
from articugen.inspection.likeness import POINTS, chamfer, likeness, rows


@pytest.fixture(scope="module")
def box() -> Instance:
    return hinged_box(STATES)[0]


def stretched(box: Instance, height: float, name: str) -> Instance:
    """The object, so many times as high, with points of its own."""
    points = dequantize(box.surface_points)
    middle = points.mean(axis=0)
    points = middle + (points - middle) * (1.0, 1.0, height)
    return replace(box, object_id=name, surface_points=quantize(points))


@pytest.fixture(scope="module")
def sets(box: Instance, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Three low boxes, and two of which one is as low and one twice as high."""
    folder = tmp_path_factory.mktemp("sets")
    low = [stretched(box, height, f"low {height}") for height in (0.9, 1.0, 1.1)]
    high = [stretched(box, height, f"high {height}") for height in (1.0, 2.0)]
    return shard(folder / "train-00000.h5", low), shard(folder / "train-00001.h5", high)


def test_distances_are_those_of_every_pair_of_points() -> None:
    rng = np.random.default_rng(0)
    cloud, others = rng.random((3, 40), np.float32), rng.random((5, 3, 40), np.float32)
    apart = np.linalg.norm(cloud[None, :, :, None] - others[:, :, None, :], axis=1)
    naive = (apart.min(axis=2).mean(axis=1) + apart.min(axis=1).mean(axis=1)) / 2
    np.testing.assert_allclose(chamfer(cloud, others), naive, rtol=1e-5)
    np.testing.assert_array_equal(chamfer(others[2], others)[2], 0.0)


def test_the_nearest_are_found_and_proportions_told(sets: tuple[Path, Path]) -> None:
    found = likeness(*sets)
    assert (len(found.first.chosen), len(found.second.chosen)) == (3, 2)
    ids = [c.object_id for c in found.first.chosen]
    nearest = {
        c.object_id: ids[k]
        for c, k in zip(found.second.chosen, found.between.argmin(axis=1), strict=True)
    }
    assert nearest == {"high 1.0": "low 1.0", "high 2.0": "low 1.1"}
    # Both sets show some of the same points: nearer than an object is by all others.
    assert 0.0 < found.between.min() < found.second.floor < 1.5 / np.sqrt(POINTS)
    assert found.second.pairs > 2 * found.first.pairs
    numbers = found.numbers
    heights = [numbers[f"{name}: height (z), quantile 0.5"] for name in ("first", "second")]
    assert 1.3 < heights[1] / heights[0] < 1.7  # the middle of 1 and 2
    assert numbers["first: moving parts, quantile 0.5"] == 2
    assert numbers["first: range, degrees, quantile 0.9"] == pytest.approx(np.degrees(LIMITS[0, 1]))
    assert numbers["second to nearest first"] == pytest.approx(found.reached, abs=1e-6)
    assert all(len(line) == 3 for line in rows(found))


def test_the_height_of_an_axis_does_not_depend_on_where_its_pivot_lies(box, tmp_path):
    axis = np.tile((0.0, 0.0, 1.0), (len(box.joint_kind), 1))
    heights = []
    for k, along in enumerate((0.0, 3.0)):
        moved = replace(box, joint_axis=axis, joint_pivot=box.joint_pivot + along * axis)
        some = [replace(moved, object_id=name) for name in "ab"]
        path = shard(tmp_path / f"train-{k:05d}.h5", some)
        heights.append(likeness(path, path).first.measures["height of a joint"])
    np.testing.assert_allclose(heights[0], heights[1], atol=1e-9)


def test_a_set_is_as_near_to_itself_as_can_be(sets: tuple[Path, Path]) -> None:
    found = likeness(sets[0], sets[0])
    assert found.reached == 0.0
    assert found.first.pairs == found.second.pairs


def test_the_command_prints_draws_and_refuses(sets, box, tmp_path):
    picture = tmp_path / "far.png"
    done = invoke("compare", *sets, "--image", picture)
    assert done.exit_code == 0
    assert "nearest in the first" in done.output
    with Image.open(picture) as drawn:
        assert drawn.width > 500
    numbers = json.loads(invoke("compare", *sets, "--json").stdout)
    assert numbers["second: objects"] == 2
    done = invoke("compare", *sets, "--image", tmp_path / "models.urdf")
    assert done.exit_code == 1
    assert "ending in .png" in done.output.replace("\n", "")
    html = tmp_path / "report.html"
    assert invoke("inspect", sets[0], "--html", html, "--beside", sets[1]).exit_code == 0
    page = html.read_text("utf-8")
    assert 'id="likeness"' in page
    assert f"{likeness(*sets).reached:.3f}" in page
    assert invoke("inspect", sets[0], "--beside", sets[1]).exit_code == 2
    alone = shard(tmp_path / "train-00000.h5", [box])
    assert "holds one object" in invoke("compare", alone, sets[0]).output
    assert "there is no such" in invoke("compare", sets[0], tmp_path / "nowhere").output
