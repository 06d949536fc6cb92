"""Tables and pictures of shards, checked against spheres, boxes and counts made by hand."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instances import SMALL, hinged_box
from PIL import Image
from rich.console import Console

from articugen.errors import ArticugenError, CorruptShard
from articugen.geometry import fibonacci_sphere
from articugen.inspection.contact_sheet import COLOURS, PAPER, contact_sheet
from articugen.inspection.summary import histogram, shards_of, summary
from articugen.inspection.surfels import draw, framed, occlusion_at, surfels
from articugen.inspection.tables import duration, size
from articugen.recipe import Recipe
from articugen.shards import write_shard

ONE_PART = np.zeros(6000, np.uint8)


def sphere(radius: float, count: int = 6000):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals, normals


def cube(half: float, count: int = 6000):
    rng = np.random.default_rng(0)
    points = rng.uniform(-half, half, (count, 3))
    axis, side = rng.integers(3, size=count), rng.choice((-1.0, 1.0), count)
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = side
    points[np.arange(count), axis] = half * side
    return points, normals


def shard(folder: Path, recipe: Recipe = SMALL, **changed: object) -> Path:
    instances = [
        instance for k in range(3) for instance in hinged_box(object_id=f"box-{k}", recipe=recipe)
    ]
    path = folder / "train-00000.h5"
    about = {
        "category": "box",
        "split": "train",
        "recipe": recipe.text(),
        "recipe_sha256": recipe.sha256(),
        "seed": 0,
        "articugen_version": "0",
    }
    write_shard(path, instances, about | changed)
    return path


def printed(shards: list[Path]) -> str:
    console = Console(width=110, record=True, file=io.StringIO())
    console.print(summary(shards))
    return console.export_text()


def test_a_sphere_of_discs_is_seen_where_the_sphere_is() -> None:
    points, normals = sphere(0.4)
    camera = framed(points, 0.7, 0.4, 128, fill=0.8)
    depth, seen_normals, values = draw(
        surfels(points, normals, ONE_PART), 0.5 + normals / 2, camera
    )
    rays = camera.rays()
    a, b = (rays**2).sum(-1), rays @ camera.eye
    c = camera.eye @ camera.eye - 0.4**2
    root = b * b - a * c
    inside = root > 0.02 * a.mean()
    t = (-b - np.sqrt(np.where(inside, root, 0.0))) / a
    assert np.abs(depth - t)[inside].max() < 0.01
    assert np.isinf(depth[root < -0.02]).all()
    hit = (camera.eye + t[..., None] * rays) / 0.4
    assert (seen_normals * hit).sum(-1)[inside].min() > 0.97
    assert np.abs(values - (0.5 + hit / 2))[inside].max() < 0.12


def test_discs_end_at_the_edges_of_a_cube() -> None:
    """The silhouette is the cube's, to a pixel or so, though the discs are five pixels wide."""
    points, normals = cube(0.3)
    camera = framed(points, 0.0, 0.0, 128, fill=0.8)
    discs = surfels(points, normals, ONE_PART)
    depth, _, _ = draw(discs, np.zeros((len(points), 1)), camera)
    assert camera.focal * discs.radius.mean() / 3.2 > 4.0
    rows, columns = np.nonzero(np.isfinite(depth))
    for seen in (rows, columns):
        assert abs(seen.min() - 0.1 * 128) <= 1.5
        assert abs(seen.max() + 1 - 0.9 * 128) <= 1.5
    assert np.isfinite(depth[14:114, 14:114]).all()


@given(st.floats(-3.0, 3.0), st.floats(-1.2, 1.2), st.floats(0.3, 1.0))
def test_what_is_framed_fits_the_image(azimuth: float, elevation: float, fill: float) -> None:
    points = np.array([[-0.4, 0.1, 0.0], [0.3, -0.2, 0.45], [0.0, 0.4, -0.3], [0.1, 0.0, 0.2]])
    camera = framed(points, azimuth, elevation, 100, fill=fill)
    seen = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    u = camera.focal * seen[:, :2] / seen[:, 2:] + (camera.cx, camera.cy)
    extent = u.max(axis=0) - u.min(axis=0)
    assert seen[:, 2].min() > 0.0
    assert extent.max() == pytest.approx(100 * fill)
    np.testing.assert_allclose(u.max(axis=0) + u.min(axis=0), 100.0)


def test_a_sphere_hides_nothing_of_its_own_sky_and_its_share_of_others() -> None:
    points, normals = sphere(0.4)
    discs = surfels(points, normals, ONE_PART)
    assert discs.spacing == pytest.approx(np.sqrt(4 * np.pi * 0.4**2 / len(points)), rel=0.05)
    assert discs.light.min() > 0.99
    # A sphere of radius r straight above at distance d hides (r / d)^2 of a cosine-weighted sky.
    below = np.array([[0.0, 0.0, -0.8], [0.0, 0.0, -1.6]])
    up = np.array([[0.0, 0.0, 1.0]] * 2)
    np.testing.assert_allclose(occlusion_at(below, up, discs), [0.25, 0.0625], rtol=0.05)


def test_the_bottom_of_a_box_is_darker_than_its_rim() -> None:
    points, normals = cube(0.3)
    top = points[:, 2] == 0.3
    discs = surfels(points[~top], -normals[~top], ONE_PART[: (~top).sum()])
    floor = points[~top, 2] == -0.3
    rim = ~floor & (points[~top, 2] > 0.25)
    assert discs.light[floor].mean() < 0.35
    assert discs.light[rim].mean() > discs.light[floor].mean() + 0.2


def test_a_sheet_has_a_picture_for_each_state_and_each_parts_colour(tmp_path: Path) -> None:
    image = tmp_path / "sheet.png"
    contact_sheet([shard(tmp_path)], image, objects=1, states=2)
    with Image.open(image) as sheet:
        one = np.asarray(sheet.convert("RGB"), np.float64)
    contact_sheet([shard(tmp_path)], image, objects=2, states=3)
    with Image.open(image) as sheet:
        assert sheet.size[0] - one.shape[1] == pytest.approx(one.shape[1] / 2, abs=20)
        assert sheet.size[1] > 1.8 * one.shape[0]
    assert (one[-3:, :3] == 255).all()
    paper = np.frombuffer(bytes.fromhex(PAPER[1:]), np.uint8)
    drawn = one[np.abs(one - paper).max(axis=-1) > 60]
    hue = drawn / drawn.sum(axis=-1, keepdims=True)
    for colour in COLOURS[1:3]:  # the lid's and the knob's
        want = np.frombuffer(bytes.fromhex(colour[1:]), np.uint8).astype(float)
        assert (np.abs(hue - want / want.sum()).max(axis=-1) < 0.06).sum() > 50


def test_a_sheet_needs_surface_points(tmp_path: Path) -> None:
    bare = SMALL.model_copy(
        update={
            "sampling": SMALL.sampling.model_copy(update={"surface_points": 0, "near_points": 0})
        }
    )
    with pytest.raises(ArticugenError, match="no surface points"):
        contact_sheet([shard(tmp_path, bare)], tmp_path / "sheet.png")


def test_a_sheet_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ArticugenError, match="cannot be written"):
        contact_sheet([shard(tmp_path)], tmp_path / "no" / "sheet.png", objects=1, states=1)


def test_the_summary_tells_what_the_shards_hold(tmp_path: Path) -> None:
    path = shard(tmp_path)
    text = printed([path])
    assert "3 objects (3 train), 12 instances" in text
    for name in ("surface_points", "part_motion", "occupancy_32"):
        assert name in text
    joints = [line for line in text.splitlines() if "revolute" in line or "prismatic" in line]
    assert [line.split()[:3] for line in joints] == [
        ["0", "revolute", "12"],
        ["1", "prismatic", "12"],
    ]
    assert "0.0 to 100.0°" in joints[0]
    assert "0.0 to 30.0 cm" in joints[1]


def test_the_summary_adds_up(tmp_path: Path) -> None:
    path = shard(tmp_path)
    rows = [line.split() for line in printed([path]).splitlines()]
    parts = [row for row in rows if row and row[-1].endswith("%")]
    surface = [float(row[1].rstrip("%")) for row in parts]
    assert len(parts) == 4
    assert surface[-1] == 100.0
    assert sum(surface[:-1]) == pytest.approx(100.0, abs=0.02)
    total = next(row for row in rows if row[:1] == ["all"] and "B" in row[-1])
    assert " ".join(total[1:3]) == size(path.stat().st_size)


def test_a_folder_stands_for_its_shards(tmp_path: Path) -> None:
    path = shard(tmp_path)
    assert shards_of(tmp_path) == [path] == shards_of(path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(CorruptShard, match="holds no shard"):
        shards_of(tmp_path / "empty")
    with pytest.raises(CorruptShard, match="no such shard or folder"):
        shards_of(tmp_path / "lost.h5")


def test_the_histogram_is_as_high_as_its_fullest_bin() -> None:
    assert histogram(np.array([0.0, 0.0, 1.0]), 0.0, 1.0) == "█" + " " * 22 + "▄"
    assert histogram(np.array([0.0]), 0.0, 0.0) == ""


def test_sizes_and_times_are_written_for_people() -> None:
    sizes = {0: "0 B", 999: "999 B", 1000: "1.0 kB", 250_000: "250 kB", 1.94e9: "1.9 GB"}
    assert {n: size(n) for n in sizes} == sizes
    times = {
        0.25: "0.2 s",
        59.94: "59.9 s",
        60: "1 min 0 s",
        1420: "23 min 40 s",
        7260: "2 h 1 min",
    }
    assert {t: duration(t) for t in times} == times


def test_even_directions_light_evenly() -> None:
    """The discs of a regular covering do not shade each other either."""
    normals = fibonacci_sphere(4000)
    assert surfels(0.5 * normals, normals, ONE_PART[:4000]).light.min() > 0.99
