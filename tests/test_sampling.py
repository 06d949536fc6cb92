import numpy as np
import pytest
import trimesh

from articugen.core.errors import RejectedInstance
from articugen.core.geometry import voxel_centres
from articugen.core.recipe import Fusion, Sampling
from articugen.fusion.field import fuse
from articugen.fusion.reachable import touched
from articugen.instance import sampling
from articugen.rendering.rasterizer import render
from articugen.rendering.views import random_pinhole_views
from tests.shapes import box, labelled, views_of


def seen_surface(mesh, count, seed=0):
    field = fuse(render(mesh, views_of(mesh)), mesh, Fusion())
    every = np.ones(len(mesh.faces), bool)
    rng = np.random.default_rng(seed)
    return sampling.surface_points(mesh, every, lambda p, _: field.is_free(p), count, rng=rng)


def chi_square(counts, expected):
    """The statistic over its degrees of freedom: about 1 for draws from `expected`."""
    expected = expected / expected.sum() * counts.sum()
    return np.sum((counts - expected) ** 2 / expected) / (len(counts) - 1)


def test_surface_points_of_a_box_are_uniform_by_area():
    solid = box((0.8, 0.5, 0.3))
    drawn = seen_surface(labelled(solid), 20_000)
    counts = np.bincount(drawn.face, minlength=12)
    assert chi_square(counts, solid.area_faces) < 2.2  # 11 degrees of freedom: p < 0.01
    assert np.allclose(drawn.normals, solid.face_normals[drawn.face])
    offset = np.sum((drawn.points - solid.triangles[drawn.face, 0]) * drawn.normals, axis=1)
    assert np.abs(offset).max() < 1e-12


def test_surface_points_of_a_sphere_are_uniform_by_area():
    drawn = seen_surface(labelled(trimesh.creation.icosphere(subdivisions=4, radius=0.4)), 20_000)
    z = drawn.points[:, 2] / np.linalg.norm(drawn.points, axis=1)
    counts = np.histogram(z, bins=20, range=(-1, 1))[0]  # slices of equal area (Archimedes)
    assert chi_square(counts, np.ones(20)) < 1.9  # 19 degrees of freedom: p < 0.01


def test_only_what_is_seen_is_sampled():
    """Two boxes that touch: no point where they touch, the rest uniform by area."""
    left, right = box((0.4, 0.4, 0.4), (-0.2, 0, 0)), box((0.4, 0.4, 0.4), (0.2, 0, 0))
    drawn = seen_surface(labelled(left, right), 8000)
    assert np.all(np.abs(drawn.points[:, 0]) > 0.0)
    assert not np.any((np.abs(drawn.points[:, 0]) < 1e-9) & (np.abs(drawn.normals[:, 0]) > 0.5))
    assert np.array_equal(drawn.part, (drawn.points[:, 0] > 0).astype(np.uint8))
    assert np.mean(drawn.part) == pytest.approx(0.5, abs=0.02)


def test_nothing_to_see_is_a_rejection():
    def far_away(points, face):
        return points[:, 0] > 9

    mesh = labelled(box((0.5, 0.5, 0.5)))
    rng = np.random.default_rng(0)
    with pytest.raises(RejectedInstance, match="can be seen"):
        sampling.surface_points(mesh, np.zeros(12, bool), far_away, 10, rng=rng)
    with pytest.raises(RejectedInstance, match="can be seen"):
        sampling.surface_points(mesh, np.ones(12, bool), far_away, 10, rng=rng)


def covered_share(low, high, resolution, seed=0):
    """The share of each cell that a box holds: by sub-samples, and exactly (closed form)."""
    low, high = np.array(low, float), np.array(high, float)

    def is_inside(points):
        return ((points > low) & (points < high)).all(axis=1)

    centres = voxel_centres(resolution)
    inside = is_inside(centres).reshape((resolution,) * 3)
    mesh = labelled(box(high - low, (low + high) / 2))
    counts, most = sampling.solid_counts(
        inside, touched(mesh, resolution) > 0, is_inside, rng=np.random.default_rng(seed)
    )
    edges = np.arange(resolution + 1) / resolution - 0.5
    along = [
        np.clip(np.minimum(edges[1:], b) - np.maximum(edges[:-1], a), 0, None) * resolution
        for a, b in zip(low, high, strict=True)
    ]
    exact = along[0][:, None, None] * along[1][:, None] * along[2]
    return counts / most, exact


def test_cells_that_a_face_halves_are_half_covered():
    cells = 1 / 16
    share, exact = covered_share((-0.25, -0.25, -0.25), (0.25, 0.25, 0.25 - cells / 2), 16)
    top = exact == 0.5
    assert top.sum() == 64
    assert (share[top] == 0.5).all()  # the face lies between sub-cells
    assert ((share == 1.0) == (exact == 1.0)).all()
    assert ((share == 0.0) == (exact == 0.0)).all()


@pytest.mark.parametrize("resolution", [8, 16, 64])
def test_coverage_is_the_share_of_the_cell_without_bias(resolution):
    """A plate thinner than a voxel that no voxel's centre lies in, along the axes."""
    h = 1 / resolution
    low, high = (-0.31, -0.3, 0.15 * h), (0.29, 0.33, 0.45 * h)
    share, exact = covered_share(low, high, resolution)
    assert abs(share.mean() / exact.mean() - 1.0) < 0.02
    full = exact == exact.max()
    assert exact.max() == pytest.approx(0.3)
    assert abs(share[full].mean() - 0.3) < 0.01
    assert np.abs(share - exact).max() <= (0.5 if resolution == 64 else 0.2)  # 2^3 samples, or more


def test_near_points_are_a_gaussian_around_the_surface():
    surface = np.random.default_rng(0).uniform(-0.3, 0.3, (500, 3))
    near = sampling.near_points(surface, 5000, 0.01, rng=np.random.default_rng(1))
    moved = near - surface[np.arange(5000) % 500]
    assert moved.std() == pytest.approx(0.01, rel=0.05)
    assert np.abs(moved.mean(axis=0)).max() < 1e-3


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_partial_clouds_lie_on_what_their_camera_sees(noise):
    mesh = labelled(box((0.6, 0.6, 0.1)), box((0.1, 0.1, 0.5), (0, 0, 0.2)))
    rng = np.random.default_rng(0)
    views = random_pinhole_views(3, 96, np.array([[-0.3, -0.3, -0.05], [0.3, 0.3, 0.45]]), rng=rng)
    maps = render(mesh, views)
    wanted = Sampling(partial_points=500, depth_noise=noise)
    points, part = sampling.partial_clouds(maps, mesh.part_of_face, wanted, rng=rng)
    for k in range(3):
        assert len(np.unique(points[k], axis=0)) == 500
        T = views.T_camera_world[k]
        seen = points[k] @ T[:3, :3].T + T[:3, 3]
        j = views.fx[k] * seen[:, 0] / seen[:, 2] + views.cx[k] - 0.5
        i = views.fy[k] * seen[:, 1] / seen[:, 2] + views.cy[k] - 0.5
        assert np.allclose(j, np.round(j), atol=1e-3)
        rows, columns = np.round(i).astype(int), np.round(j).astype(int)
        error = seen[:, 2] - maps.depth[k][rows, columns]
        assert error.std() == pytest.approx(noise, rel=0.15, abs=1e-6)
        parts = mesh.part_of_face[maps.face[k][rows, columns]]
        assert np.array_equal(part[k], parts)


@pytest.mark.parametrize("metres", [0.3, 1.0])
def test_a_kinect_reads_one_of_its_disparities_half_a_pixel_off(metres):
    """Two plates that face the camera, 1.5 and 1.7 away; the far one is seen beside the near."""
    depth, face = np.zeros((120, 160)), np.full((120, 160), -1)
    depth[20:100, 20:140], face[20:100, 20:140] = 1.7, 1
    depth[40:80, 40:120], face[40:80, 40:120] = 1.5, 0
    measured, shows = sampling.as_kinect(depth, face, metres, rng=np.random.default_rng(3))
    for number, z in enumerate((1.5, 1.7)):
        steps = 35130 / (100 * metres * measured[shows == number])
        assert np.allclose(steps, np.rint(steps), atol=1e-9)
        exact = 35130 / (100 * metres * z)
        choices = np.floor(exact + np.random.default_rng(4).normal(0, 1 / 6, 10**6) + 0.5)
        assert steps.mean() == pytest.approx(choices.mean(), abs=0.03)
        assert steps.std() == pytest.approx(choices.std(), abs=0.03)
    changed = np.argwhere(shows != face)
    borders = np.argwhere((face[1:, 1:] != face[:-1, 1:]) | (face[1:, 1:] != face[1:, :-1]))
    gaps = np.abs(changed[:, None] - borders[None]).max(2).min(1)
    assert len(changed) > 100
    assert gaps.max() <= 3
    assert np.mean(gaps <= 1) > 0.95  # beyond, three standard deviations
    lost = (face >= 0) & (shows < 0)
    assert 0.1 < lost[20, 20:140].mean() < 0.3  # a pixel reads the row above with 16 % each


@pytest.mark.parametrize("metres", [1.0, 1.5])
@pytest.mark.parametrize("degrees", [60, 70, 75, 80])
def test_a_kinect_s_error_grows_with_the_angle_to_the_surface_as_was_measured(metres, degrees):
    """Of a plane in the middle of a Kinect's image, beside Nguyen, Izadi and Lovell (2012)."""
    x, angle = (np.arange(320) - 159.5) / 585.0, np.radians(degrees)
    depth = np.tile(metres / (1.0 + x * np.tan(angle)), (240, 1))
    measured, _ = sampling.as_kinect(
        depth, np.zeros(depth.shape, int), 1.0, rng=np.random.default_rng(0)
    )
    axial = 0.0012 + 0.0019 * (metres - 0.4) ** 2
    axial += 0.0001 / np.sqrt(metres) * angle**2 / (np.pi / 2.0 - angle) ** 2
    assert (measured - depth)[:, 140:180].std() == pytest.approx(axial, rel=0.3)


def test_left_of_what_is_nearer_nothing_is_lit():
    """A post 1.5 away before a wall at 2: its shadow is as wide as their disparities differ."""
    depth, face = np.full((4, 200), 2.0), np.zeros((4, 200), int)
    depth[1:3, 90:110], face[1:3, 90:110] = 1.5, 1
    face[:, 150:] = -1
    shown = sampling.lit(depth, face, 75.0)  # 75 / 1.5 - 75 / 2 = 12.5 pixels
    dark = np.zeros(shown.shape, bool)
    dark[1:3, 78:90] = True
    np.testing.assert_array_equal(shown, (face >= 0) & ~dark)


@pytest.mark.parametrize(("slope", "seen"), [(0.006, True), (-0.02, True), (0.007, False)])
def test_a_plane_is_lit_where_the_projector_is_before_it(slope, seen):
    """1 / depth of a plane is linear in the column, so its place in the other image is, too."""
    depth = 1.0 / (1.0 + slope * np.arange(40))
    shown = sampling.lit(depth[None], np.zeros((1, 40), int), 150.0)
    assert shown[0, :-1].all() == shown[0, :-1].any() == seen
