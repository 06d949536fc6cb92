"""Tables and pictures of shards, checked against spheres, boxes and counts made by hand."""

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import SMALL, changed, hinged_box
from numba import njit
from PIL import Image
from rich.console import Console
from test_html_report import cube as sampled_cube
from test_html_report import shard as write

from articugen.core.colours import COLOURS, colour_of
from articugen.core.errors import ArticugenError
from articugen.core.geometry import apply, fibonacci_sphere, invert_rigid, rotation_about, transform
from articugen.core.near import cells_of, near
from articugen.core.recipe import Recipe
from articugen.core.schema import Instance
from articugen.core.tables import duration, size
from articugen.inspection.summary import histogram, summary
from articugen.pictures.camera import framed
from articugen.pictures.contact_sheet import contact_sheet
from articugen.pictures.layout import CAPTION, MARGIN, TILE, Row, sheet
from articugen.pictures.light import SurfaceCloud, occlusion, occlusion_in_detail
from articugen.pictures.portrait import opened
from articugen.pictures.shading import PAPER
from articugen.pictures.splats import draw
from articugen.pictures.surfels import OrientedPoints, surfels


def one_part(points: np.ndarray, normals: np.ndarray) -> OrientedPoints:
    return OrientedPoints(points, normals, np.zeros(len(points), np.uint8))


def sphere(radius: float, count: int = 6000, seed: int = 0):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals, normals


def boxes(recipe: Recipe = SMALL) -> list[Instance]:
    """Three objects in four states each."""
    return [
        instance for k in range(3) for instance in hinged_box(object_id=f"box-{k}", recipe=recipe)
    ]


def cube(half: float, count: int = 6000, seed: int = 0):
    points = sampled_cube(half, count, seed)
    return points.points, points.normals


def shard(
    folder: Path, recipe: Recipe = SMALL, instances: Sequence[Instance] | None = None
) -> Path:
    return write(folder / "train-00000.h5", instances or boxes(recipe))


def printed(shards: list[Path]) -> str:
    console = Console(width=110, record=True, file=io.StringIO())
    console.print(summary(shards))
    return console.export_text()


def test_a_sphere_of_discs_is_seen_where_the_sphere_is() -> None:
    points, normals = sphere(0.4)
    camera = framed(points, 0.7, 0.4, 128, fill=0.8)
    discs = surfels([one_part(points, normals)])
    depth, seen_normals, values = draw(discs, 0.5 + discs.normals / 2, camera)
    rays = camera.rays
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
    discs = surfels([one_part(points, normals)])
    depth, _, _ = draw(discs, np.zeros((len(points), 1)), camera)
    assert camera.focal * discs.radius.mean() / 3.2 > 4.0
    rows, columns = np.nonzero(np.isfinite(depth))
    for seen in (rows, columns):
        assert abs(seen.min() - 0.1 * 128) <= 1.5
        assert abs(seen.max() + 1 - 0.9 * 128) <= 1.5
    assert np.isfinite(depth[14:114, 14:114]).all()


@pytest.mark.parametrize("reach", [3.0, 8.0, 300.0])
def test_the_camera_stands_back_from_what_reaches_far(reach: float) -> None:
    points = np.array([[0.0, 0.0, 0.0], [reach, 0.0, 0.1], [0.2, -reach, 0.0], [0.1, 0.0, reach]])
    for azimuth in np.linspace(0.0, 6.0, 7):
        camera = framed(points, azimuth, 0.4, 100, fill=0.9)
        assert apply(camera.T_camera_world, points)[:, 2].min() > 0.5


def test_a_part_opens_with_the_one_that_it_hangs_on_in_any_order() -> None:
    """A knob slides on a lid that turns; joints that turn come first, but a file may differ."""
    box, back = hinged_box()[1], [1, 0]
    names = ("kind", "state", "lower", "upper", "axis", "pivot")
    fields = {f"joint_{name}": getattr(box, f"joint_{name}")[back] for name in names}
    other = changed(box, joint_parent=np.array([2, 0], np.uint8), **fields)
    assert box.joint_parent.tolist() == [0, 1]
    for share in (0.0, 0.5, 1.0):
        np.testing.assert_allclose(opened(other, share)[[0, 2, 1]], opened(box, share))
    assert np.abs(opened(box, 1.0)[2] - opened(box, 0.0)[2]).max() > 0.3


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


def test_more_samples_make_smaller_discs_where_they_cover() -> None:
    """Six samples of a sphere, all of its upper half, one of its lower half too."""
    samples = []
    for seed in range(6):
        points, normals = sphere(0.4, 3000, seed)
        kept = (points[:, 2] > 0.0) | (seed == 0)
        samples.append(one_part(points[kept], normals[kept]))
    discs = surfels(samples)
    alone = np.sqrt(4 * np.pi * 0.4**2 / 3000)
    assert len(discs.points) == sum(len(sample.points) for sample in samples)
    assert np.median(discs.spacing[discs.points[:, 2] < -0.1]) == pytest.approx(alone, rel=0.06)
    upper = np.median(discs.spacing[discs.points[:, 2] > 0.1])
    assert upper == pytest.approx(alone / np.sqrt(6), rel=0.06)
    camera = framed(discs.points, 0.7, 0.0, 128, fill=0.8)
    depth, _, _ = draw(discs, np.zeros((len(discs.points), 0)), camera)
    from_middle = np.hypot(*(np.indices((128, 128)) + 0.5 - 64.0))
    assert np.isfinite(depth[from_middle < 50]).all()
    assert np.isinf(depth[from_middle > 53]).all()


def test_discs_move_with_their_parts() -> None:
    points, normals = cube(0.2)
    parts = np.repeat(np.arange(2, dtype=np.uint8), 3000)
    at_rest = OrientedPoints(
        points + 0.25 * parts[:, None] * np.array([1.0, 0.0, 0.0]), normals, parts
    )
    T_part = np.stack([np.eye(4), transform(rotation_about((0, 0, 1), 0.7), (0.1, 0.0, 0.2))])
    posed = at_rest.moved(T_part)
    back = posed.moved(invert_rigid(T_part))
    np.testing.assert_allclose(back.points, at_rest.points, atol=1e-12)
    camera = framed(posed.points, 0.5, 0.4, 96, fill=0.8)
    pictures = []
    for discs in (surfels([at_rest]).moved(T_part), surfels([posed])):
        pictures.append(draw(discs, discs.part[:, None].astype(float), camera))
    (depth, normal, part), (want, want_normal, want_part) = pictures
    both = np.isfinite(depth) & np.isfinite(want)
    assert both.sum() > 0.97 * (np.isfinite(depth) | np.isfinite(want)).sum()
    assert np.median(np.abs(depth[both] - want[both])) < 1e-6
    assert np.mean((normal * want_normal).sum(-1)[both] > 0.99) > 0.97
    assert np.mean(np.abs(part - want_part)[both] < 0.1) > 0.98


@settings(deadline=None)  # the first one compiles
@given(st.integers(1, 200), st.floats(0.01, 2.0), st.floats(0.01, 2.0), st.integers(0, 99))
def test_cells_find_what_is_near(count: int, side: float, reach: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, at = rng.normal(size=(count, 3)), 1.5 * rng.normal(size=3)
    found = np.empty(count, np.int64)
    have = found[: compiled_near(cells_of(points, side), points, at, reach, found)]
    want = np.flatnonzero(((points - at) ** 2).sum(axis=1) < reach * reach)
    assert sorted(have.tolist()) == want.tolist()


compiled_near = njit(near)


def cloud(points: np.ndarray, normals: np.ndarray, area: float) -> SurfaceCloud:
    return SurfaceCloud(points, normals, np.full(len(points), area / len(points)))


def test_a_sphere_hides_nothing_of_its_own_sky_and_its_share_of_others() -> None:
    points, normals = sphere(0.4)
    spacing = np.sqrt(4 * np.pi * 0.4**2 / len(points))
    assert one_part(points, normals).spacing() == pytest.approx(spacing, rel=0.08)
    ball = cloud(points, normals, 4 * np.pi * 0.4**2)
    assert occlusion(points, normals, ball).max() < 0.01
    # A sphere of radius r straight above at distance d hides (r / d)^2 of a cosine-weighted sky.
    below = np.array([[0.0, 0.0, -0.8], [0.0, 0.0, -1.6]])
    up = np.array([[0.0, 0.0, 1.0]] * 2)
    np.testing.assert_allclose(occlusion(below, up, ball), [0.25, 0.0625], rtol=0.05)


def test_even_directions_light_evenly() -> None:
    """The discs of a regular covering do not shade each other either."""
    normals = fibonacci_sphere(4000)
    ball = cloud(0.5 * normals, normals, np.pi)
    assert occlusion_in_detail(0.5 * normals, normals, ball, ball).max() < 0.01


def open_box(count: int, seed: int) -> SurfaceCloud:
    points, normals = cube(0.3, count, seed)
    kept = points[:, 2] < 0.3
    return cloud(points[kept], -normals[kept], 5 * 0.6**2)


def view_factor(a: float, b: float, c: float) -> float:
    """From a small square to a parallel a x b rectangle at distance c, one corner above the square.

    Howell, "A catalog of radiation heat transfer configuration factors", B-3.
    """
    A, B = a / c, b / c
    along = A / np.hypot(1, A) * np.arctan(B / np.hypot(1, A))
    across = B / np.hypot(1, B) * np.arctan(A / np.hypot(1, B))
    return (along + across) / (2 * np.pi)


@pytest.mark.parametrize(("from_wall", "tolerance"), [(0.3, 0.02), (0.1, 0.04), (0.03, 0.15)])
def test_over_the_floor_of_an_open_box_the_sky_is_its_mouth(from_wall, tolerance):
    coarse, fine = open_box(8000, 0), open_box(64000, 1)
    x = np.linspace(-0.2, 0.2, 100)
    at = np.stack([x, np.full(100, from_wall - 0.3), np.full(100, -0.3)], axis=1)
    mouth = [
        sum(
            view_factor(a, b, 0.6) for a in (0.3 + u, 0.3 - u) for b in (from_wall, 0.6 - from_wall)
        )
        for u in x
    ]
    up = np.tile((0.0, 0.0, 1.0), (100, 1))
    hidden = occlusion_in_detail(at, up, coarse, fine)
    assert np.mean(1.0 - hidden) == pytest.approx(np.mean(mouth), abs=tolerance)
    assert np.std(1.0 - hidden - mouth) < 0.08
    if from_wall > 0.2:
        np.testing.assert_allclose(hidden, occlusion(at, up, fine), atol=0.05)


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


def first_tile(folder: Path, instances: Sequence[Instance]) -> np.ndarray:
    contact_sheet([shard(folder, instances=instances)], folder / "s.png", objects=1, states=1)
    with Image.open(folder / "s.png") as sheet:
        return np.asarray(sheet.convert("RGB"), np.float64)


def test_every_instance_has_its_share_in_a_picture(tmp_path: Path) -> None:
    """The canonical pose is drawn alike from one and from four instances, as long as the motions
    of the others are right; where one is not, the lid is seen where it should not be."""
    box = hinged_box()
    alone, pooled = first_tile(tmp_path, box[:1]), first_tile(tmp_path, box)
    T_part = box[2].part_motion.copy()
    T_part[1, :3, 3] += (0.0, 0.0, 0.1)
    wrong = first_tile(tmp_path, [*box[:2], replace(box[2], part_motion=T_part), box[3]])
    far_off = [(np.abs(tile - pooled).max(axis=-1) > 60).sum() for tile in (alone, wrong)]
    assert 0 < far_off[0] < 1000
    assert far_off[1] > 4 * far_off[0]


def test_colours_are_distinct_to_sixteen_parts_and_never_part_0s() -> None:
    assert [colour_of(k) for k in range(17)] == list(COLOURS)
    assert colour_of(17) == colour_of(1)
    assert COLOURS[0] not in {colour_of(k) for k in range(1, 254)}
    lab = np.array([perceived(colour) for colour in COLOURS])
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=-1) + 1e3 * np.eye(len(lab))
    assert apart.min() > 24.0  # 2.3 is the least that can be seen at all


def perceived(colour: str) -> np.ndarray:
    """CIE L*a*b*, in which distances are as large as they look."""
    rgb = np.frombuffer(bytes.fromhex(colour[1:]), np.uint8) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    x, y, z = np.cbrt(np.array(to_xyz) @ linear / (0.9505, 1.0, 1.089))
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


def test_captions_of_many_joints_take_several_lines() -> None:
    tile = Image.new("RGB", (TILE, TILE), "#ffffff")
    captions = [[(f"{k + 100}°", colour_of(k + 1)) for k in range(count)] for count in (1, 12)]
    few, many = (
        np.asarray(sheet([Row("title", [tile], [caption])]).convert("L")) for caption in captions
    )
    assert (many.shape[0] - few.shape[0]) % CAPTION == 0
    assert many.shape[0] > few.shape[0] + CAPTION
    for picture in (few, many):  # nothing is written beside the tile
        assert (picture[:, :MARGIN] == 255).all()
        assert (picture[:, MARGIN + TILE :] == 255).all()


def test_discs_of_a_thin_plate_stay_within_it() -> None:
    """A plate 0.006 thick with a sparse face inside, which ends 0.01 before the plate's rim."""
    rng = np.random.default_rng(0)
    outer = rng.uniform(-0.3, 0.3, (4000, 3))
    outer[:, 0] = 0.0
    inner = rng.uniform(-0.29, 0.29, (300, 3))
    inner[:, 1], inner[:, 0] = -0.29, rng.uniform(-0.08, -0.006, 300)
    normals = np.concatenate([np.tile((1.0, 0.0, 0.0), (4000, 1)), np.tile((0, 1.0, 0), (300, 1))])
    part = np.repeat(np.array([0, 1], np.uint8), (4000, 300))
    discs = surfels([OrientedPoints(np.concatenate([outer, inner]), normals, part)])
    camera = framed(discs.points, np.pi / 5, 0.2, 192, fill=0.8)
    depth, _, values = draw(discs, discs.part[:, None].astype(float), camera)
    at = camera.eye + depth[..., None] * camera.rays
    shown = np.isfinite(depth) & (values[..., 0] > 0.5)
    assert shown.sum() == 0 or at[shown][:, 0].max() < 0.003


def test_tables_keep_their_numbers_on_one_line_on_a_narrow_terminal(tmp_path: Path) -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(summary([shard(tmp_path)]))
    text = console.export_text()
    assert " on disk " in text
    assert "…" not in text
    heads = next(line.split() for line in text.splitlines() if line.split()[:1] == ["part"])
    assert heads[1:5] == ["surface", "partial", "uniform", "near"]
    assert heads[5].removeprefix("occupancy_").isdigit()
    assert max(map(len, text.splitlines())) <= 80
    assert len(text.splitlines()) < 80


def test_a_sheet_needs_surface_points(tmp_path: Path) -> None:
    bare = SMALL.model_copy(
        update={
            "sampling": SMALL.sampling.model_copy(update={"surface_points": 0, "near_points": 0})
        }
    )
    with pytest.raises(ArticugenError, match="no surface points"):
        contact_sheet([shard(tmp_path, bare)], tmp_path / "sheet.png")


def test_a_sheet_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ArticugenError, match="not written: "):
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
    assert "0 to 0.3 " in joints[1]


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
