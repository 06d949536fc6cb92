"""The fused field against exact solids, a plain reading of its definition, and open3d."""

import numpy as np
import pytest
import trimesh

from articugen.core.geometry import rotation_about, transform, voxel_centres
from articugen.core.recipe import Fusion
from articugen.core.records import DepthMaps, Views
from articugen.fusion.field import fuse
from articugen.rendering.rasterizer import render
from tests.shapes import (
    Convex,
    box,
    field_of,
    iou,
    labelled,
    rotated,
    spectacles,
    towards_cameras,
    two_sided,
    views_of,
)

SEEN, MEAN = Fusion(), Fusion(rule="mean")


def uniform_and_near(meshes: list[trimesh.Trimesh], count: int = 8_000) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    per_area = trimesh.util.concatenate(meshes)
    surface = trimesh.sample.sample_surface(per_area, count, seed=1)[0]
    return [rng.uniform(-0.5, 0.5, (count, 3)), surface + 0.01 * rng.normal(size=(count, 3))]


def thin_laptop() -> list[trimesh.Trimesh]:
    lid = box((0.5, 0.8, 0.02))
    lid.apply_transform(transform(rotation_about((0, 1, 0), 1.9), (0.32, 0, 0.24)))
    keys = [box((0.03, 0.04, 0.006), (x, y, 0.03)) for x in (-0.1, -0.05, 0, 0.05)
            for y in np.linspace(-0.3, 0.3, 12)]  # fmt: skip
    return [box((0.5, 0.8, 0.04), (0, 0, 0.005)), lid, *keys]


def half_open_cupboard() -> list[trimesh.Trimesh]:
    """Panels around a cavity, and a slab that leaves a slit of 0.05."""
    walls = [box((0.6, 0.02, 0.6), (0, y, 0)) for y in (-0.3, 0.3)]
    walls += [box((0.6, 0.6, 0.02), (0, 0, z)) for z in (-0.3, 0.3)]
    return [*walls, box((0.02, 0.6, 0.6), (-0.3, 0, 0)), box((0.02, 0.6, 0.55), (0.31, 0, -0.03))]


@pytest.mark.parametrize("make", [thin_laptop, spectacles, half_open_cupboard])
@pytest.mark.parametrize("twice", [False, True])
def test_outside_is_what_exact_rays_from_the_same_views_leave_free(make, twice):
    meshes = make()
    field = field_of(*(two_sided(m) if twice else m for m in meshes))
    truth = Convex.of(*meshes)
    towards = towards_cameras(field.maps.views)
    for points, goal in zip(uniform_and_near(meshes), (0.999, 0.998), strict=True):
        exact = truth.inside(points)
        exact[~exact] = ~truth.seen_free(points[~exact], towards)
        assert iou(~field.is_free(points), exact) >= goal


def test_unseen_space_is_inside():
    shell = [box((0.8, 0.8, 0.02), (0, 0, z)) for z in (-0.4, 0.4)]
    shell += [box((0.8, 0.02, 0.8), (0, y, 0)) for y in (-0.4, 0.4)]
    shell += [box((0.02, 0.8, 0.8), (x, 0, 0)) for x in (-0.4, 0.4)]
    points = np.random.default_rng(0).uniform(-0.38, 0.38, (1000, 3))
    for settings in (SEEN, MEAN):
        assert not field_of(*shell, settings=settings, resolution=64).is_free(points).any()


@pytest.mark.parametrize("settings", [SEEN, MEAN])
def test_the_sign_of_the_value_is_the_occupancy(settings):
    field = field_of(*thin_laptop(), settings=settings, resolution=128)
    for points in uniform_and_near(thin_laptop(), 3000):
        value = field.value(points)
        assert np.array_equal(value > 0, field.is_free(points))
        assert np.abs(value).max() <= settings.truncation + 1e-12


@pytest.mark.parametrize("settings", [SEEN, MEAN])
def test_the_value_near_a_plane_is_the_mean_over_the_views_before_it(settings):
    """Before a wide plane at height d every view on that side says d / cos, cut at truncation."""
    field = field_of(box((0.9, 0.9, 0.3)), settings=settings)
    cosines = field.maps.views.T_camera_world[:, 2, 2]
    before = -cosines[cosines < 0]
    for d in (0.002, -0.002):
        said = np.minimum(np.abs(d) / before, settings.truncation)
        if d < 0:  # further behind than the truncation is not counted
            said = said[np.abs(d) / before <= settings.truncation]
        value = field.value(np.array([[0.01, 0.02, 0.15 + d]]))[0]
        assert value == pytest.approx(np.sign(d) * said.mean(), rel=2e-3)


def test_the_field_is_the_same_on_a_dense_grid():
    """Asked at scattered points or on a whole grid, in any order: the same field."""
    field = field_of(*thin_laptop(), resolution=96)
    grid = voxel_centres(24)
    dense = field.value(grid)
    some = np.random.default_rng(0).permutation(len(grid))[:777]
    assert np.array_equal(field.value(grid[some]), dense[some])
    assert np.array_equal(field.is_free(grid[some]), field.is_free(grid)[some])


@pytest.mark.parametrize("projection", ["orthographic", "pinhole"])
def test_a_naive_reading_of_one_view_agrees(projection):
    """One view: free is what no face hides, by intersecting every face with every ray."""
    mesh = labelled(rotated(box((0.6, 0.5, 0.2)), 0.5, (1, 1, 0)), box((0.1, 0.1, 0.8)))
    views = views_of(mesh, count=6, resolution=128, projection=projection)
    maps = render(mesh, views)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (1500, 3))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    for k in range(6):
        T = views.T_camera_world[k]
        if projection == "pinhole":
            towards = -T[:3, :3].T @ T[:3, 3] - points
        else:
            towards = np.repeat(-T[2:3, :3], len(points), axis=0)
        one = Views(projection, T[None], views.fx[k : k + 1], views.fy[k : k + 1],
                    views.cx[k : k + 1], views.cy[k : k + 1], 128, 128)  # fmt: skip
        field = fuse(DepthMaps(maps.depth[k : k + 1], maps.face[k : k + 1], one), mesh, SEEN)
        triangle, ray, _ = trimesh.ray.ray_triangle.ray_triangle_id(
            solid.triangles, points, towards, multiple_hits=False
        )
        hidden = np.zeros(len(points), bool)
        hidden[ray] = triangle >= 0
        assert np.mean(field.is_free(points) == ~hidden) > 0.998


def test_depth_alone_will_do_for_smooth_shapes():
    """Backends that name no faces: interpolated depth, silhouettes left out."""
    mesh = labelled(trimesh.creation.icosphere(subdivisions=4, radius=0.4))
    maps = render(mesh, views_of(mesh))
    field = fuse(DepthMaps(maps.depth, None, maps.views), mesh, SEEN)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3))
    assert iou(~field.is_free(points), np.linalg.norm(points, axis=1) < 0.4) > 0.99


def test_solids_neither_grow_nor_shrink():
    """The mean distance between the zero level and a box's faces is below 0.25 voxel of 1/256."""
    meshes = [rotated(box((0.5, 0.4, 0.3)), 0.6, (1, 2, 3))]
    field = field_of(*meshes)
    surface, face = trimesh.sample.sample_surface(meshes[0], 4000, seed=2)
    normals = meshes[0].face_normals[face]
    offsets = np.linspace(-1, 1, 41) / 256
    free = np.stack([field.is_free(surface + d * normals) for d in offsets])
    shift = np.where(free.any(axis=0), offsets[np.argmax(free, axis=0)], offsets[-1])
    assert abs(shift.mean()) < 0.25 / 256


def test_agrees_with_open3d_on_a_thick_shape():
    """open3d's VoxelBlockGrid fuses pinhole depth at voxel centres; a thick shape suits it."""
    o3d = pytest.importorskip("open3d", reason="it cannot be loaded here", exc_type=ImportError)
    mesh = labelled(trimesh.creation.icosphere(subdivisions=5, radius=0.4))
    views = views_of(mesh, count=40, resolution=256, projection="pinhole")
    maps = render(mesh, views)
    core, voxel = o3d.core, 1 / 128
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), voxel, 8, 9000
    )
    for k in range(len(views)):
        image = np.where(np.isfinite(maps.depth[k]), maps.depth[k], 0).astype(np.float32)
        depth = o3d.t.geometry.Image(core.Tensor(image))
        lens = np.array([[views.fx[k], 0, views.cx[k]], [0, views.fy[k], views.cy[k]], [0, 0, 1]])
        intrinsic, extrinsic = core.Tensor(lens), core.Tensor(views.T_camera_world[k])
        blocks = grid.compute_unique_block_coordinates(depth, intrinsic, extrinsic, 1.0, 4.0)
        grid.integrate(blocks, depth, intrinsic, extrinsic, 1.0, 4.0)
    vertices = grid.extract_triangle_mesh().to_legacy().vertices
    theirs = np.asarray(vertices)
    assert len(theirs) > 1000
    field = fuse(maps, mesh, SEEN)
    outwards = theirs / np.linalg.norm(theirs, axis=1, keepdims=True)
    assert np.mean(field.is_free(theirs + 0.75 * voxel * outwards)) > 0.99
    assert np.mean(field.is_free(theirs - 0.75 * voxel * outwards)) < 0.01
