import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from articugen.core.geometry import look_along
from articugen.core.records import LabelledMesh, Views
from articugen.rendering import render
from articugen.rendering.rasterizer import Overlay
from articugen.rendering.rasterizer import render as rasterize
from tests.shapes import box, labelled, pixel_points, rotated, two_sided, views_of


def straight_view(resolution: int = 32, size: float = 1.0) -> Views:
    """One orthographic camera that looks down along -z on [-size/2, size/2]^2."""
    T = look_along((0, 0, -1), (0, 0, 1))
    f, c = resolution / size, resolution / 2
    return Views("orthographic", T[None], [f], [f], [c], [c], resolution, resolution)


@pytest.mark.parametrize("projection", ["orthographic", "pinhole"])
def test_pixels_see_points_of_the_face_they_name(projection):
    mesh = labelled(
        rotated(box((0.5, 0.4, 0.3)), 0.7, (1, 2, 3)), box((0.1, 0.1, 0.9), (0.3, 0, 0))
    )
    views = views_of(mesh, count=8, resolution=64, projection=projection)
    maps = rasterize(mesh, views)
    for k in range(len(views)):
        points, i, j = pixel_points(maps, k)
        assert len(points) > 300
        corners = mesh.vertices[mesh.faces[maps.face[k][i, j]]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        off_plane = np.einsum("ni,ni->n", points - corners[:, 0], normal)
        assert np.abs(off_plane).max() < 2e-6
        assert np.array_equal(maps.face[k] < 0, ~np.isfinite(maps.depth[k]))


def test_depth_of_a_sphere_is_its_closed_form():
    mesh = labelled(trimesh.creation.icosphere(subdivisions=5, radius=0.4))
    maps = rasterize(mesh, views_of(mesh, count=5, resolution=64))
    for k in range(5):
        points, _, _ = pixel_points(maps, k)
        radius = np.linalg.norm(points, axis=1)
        assert radius.max() <= 0.4 + 1e-6
        assert radius.min() >= 0.4 * np.cos(np.radians(1.6))  # an icosphere's chord


def test_nearest_face_wins_and_winding_does_not_matter():
    cube = box((0.5, 0.5, 0.5))
    view = straight_view()
    once, twice = (rasterize(labelled(m), view) for m in (cube, two_sided(cube)))
    assert np.array_equal(once.depth, twice.depth)
    inside = np.isfinite(once.depth[0])
    assert inside.sum() == 16 * 16
    assert np.allclose(once.depth[0][inside], 0.75)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_a_cut_square_is_covered_exactly_once(seed):
    """However a square is cut into triangles, each pixel centre belongs to exactly one."""
    rng = np.random.default_rng(seed)
    inner = rng.uniform(-0.45, 0.45, (12, 2))
    # corners on pixel centres, to exercise the fill rule's ties
    inner[:4] = (np.round(inner[:4] * 32 - 0.5) + 0.5) / 32
    ring = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    points = np.unique(np.concatenate([ring, inner]), axis=0)
    assert np.all(times_covered(points, 32) == 1)


@pytest.mark.parametrize("seed", range(3))
def test_triangles_smaller_than_a_pixel_cover_each_centre_once(seed):
    """Their corners lie on quarters of pixels, on many centres and on many lines through centres;
    some lie beside the image."""
    rng = np.random.default_rng(seed)
    ring = [(-20, -20), (20, -20), (20, 20), (-20, 20)]
    points = (
        np.unique(np.concatenate([ring, rng.integers(-20, 21, (500, 2))]), axis=0) / 32 - 1 / 16
    )
    assert np.all(times_covered(points, 8) == 1)


def times_covered(points, resolution):
    """(R, R) how many of the triangles that tile points (n, 2), each drawn alone, cover each
    pixel."""
    count = np.zeros((resolution, resolution), int)
    vertices = np.c_[points, np.zeros(len(points))]
    for face in Delaunay(points).simplices:
        mesh = LabelledMesh(vertices, face[None], np.zeros(1, np.uint8))
        count += np.isfinite(rasterize(mesh, straight_view(resolution)).depth[0])
    return count


@pytest.mark.parametrize("projection", ["orthographic", "pinhole"])
def test_drawing_over_fixed_faces_again_and_again_is_drawing_all_at_once(projection):
    mesh = labelled(box((0.6, 0.6, 0.1)), rotated(box((0.2, 0.2, 0.7)), 0.3, (1, 0, 0)))
    views = views_of(mesh, count=6, resolution=48, projection=projection)
    overlay = Overlay(rasterize(mesh.part(0), views))
    for angle in (0.0, 0.4, 1.5, 0.4):
        moving = labelled(rotated(box((0.2, 0.2, 0.7)), angle, (1, 0, 1)))
        over = overlay.draw(moving, closed=np.zeros(12, np.bool_), first_face=12)
        whole = rasterize(LabelledMesh.joined([mesh.part(0), moving]), views)
        assert np.array_equal(whole.face, over.face)
    nothing = overlay.draw(moving.part(1), closed=np.zeros(0, np.bool_), first_face=12)
    assert np.array_equal(nothing.face, rasterize(mesh.part(0), views).face)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_the_backs_of_closed_solids_are_never_missed(seed):
    rng = np.random.default_rng(seed)
    pieces = [
        rotated(box(rng.uniform(0.02, 0.4, 3), rng.uniform(-0.2, 0.2, 3)), t, (1, 2, 3))
        for t in rng.uniform(0.0, 3.0, 4)
    ]
    mesh = labelled(*pieces, trimesh.creation.icosphere(subdivisions=3, radius=0.15))
    for projection in ("orthographic", "pinhole"):
        views = views_of(mesh, count=4, resolution=64, projection=projection)
        all_faces = rasterize(mesh, views)
        fronts = rasterize(mesh, views, closed=np.ones(len(mesh.faces), np.bool_))
        assert np.array_equal(np.isfinite(all_faces.depth), np.isfinite(fronts.depth))
        seen = np.isfinite(fronts.depth)
        assert np.mean(all_faces.face[seen] == fronts.face[seen]) > 0.99  # silhouettes meet backs
        off = np.abs(all_faces.depth[seen] - fronts.depth[seen])
        assert np.mean(off > 1e-6) < 0.01


def test_what_lies_behind_a_pinhole_is_refused():
    view = straight_view()
    behind = Views("pinhole", view.T_camera_world, view.fx, view.fy, view.cx, view.cy, 32, 32)
    with pytest.raises(ValueError, match="behind a pinhole"):
        rasterize(labelled(box((0.1, 0.1, 4.0))), behind)


def test_far_outside_the_image_is_refused_and_beside_it_is_clipped():
    with pytest.raises(ValueError, match="outside the image"):
        rasterize(labelled(box((1e5, 1, 1))), straight_view())
    assert np.all(np.isfinite(rasterize(labelled(box((50, 50, 1))), straight_view()).depth))


def test_an_unknown_backend_is_named():
    with pytest.raises(ValueError, match=r"no backend 'embre'; did you mean 'embree'\?; there are"):
        render(labelled(box((1, 1, 1))), straight_view(), backend="embre")
