"""Every depth backend against closed forms, a naive ray caster, and the others."""

import errno
import sys
from functools import cache

import numpy as np
import pytest
import trimesh
from real_models import REAL_MODELS, needs_real_models

from articugen.core.backends import BACKENDS
from articugen.core.errors import MachineFault, MissingDriver, MissingExtra
from articugen.core.geometry import (
    apply,
    fibonacci_sphere,
    invert_rigid,
    look_along,
    rotation_from_rpy,
)
from articugen.core.records import LabelledMesh, Views
from articugen.rendering import render
from articugen.rendering.foreign import import_library, missing_driver

TOLERANCE = {"rasterizer": 5e-7, "embree": 2e-6, "opengl": 1e-5, "sapien": 1e-5}
"""Of depth in the unit frame: the last three compute in float32."""

BOX_HALF = np.array([0.25, 0.3, 0.35])
BOX_ROTATION, BOX_CENTER = rotation_from_rpy((0.3, 0.5, 0.7)), np.array([0.05, -0.03, 0.02])


def labelled(vertices, faces) -> LabelledMesh:
    return LabelledMesh(vertices, faces, np.zeros(len(faces), np.uint8))


def box() -> LabelledMesh:
    mesh = trimesh.creation.box(2 * BOX_HALF)
    return labelled(mesh.vertices @ BOX_ROTATION.T + BOX_CENTER, mesh.faces)


def cameras(projection: str, distance: float | None = None, count: int = 3) -> Views:
    """Views from all around, each with its own intrinsics, none centred; width and height differ.

    Orthographic cameras stand in the middle of the object, so that some depths are negative.
    """
    pinhole = projection == "pinhole"
    back = distance if distance is not None else 1.5 if pinhole else 0.0
    T = np.array([look_along(d, -back * d) for d in fibonacci_sphere(count)])
    k = np.arange(count)
    focal = (100.0 if pinhole else 66.0) + k
    return Views(projection, T, focal, focal + 7.0, 50.0 - 4.1 * k, 38.0 + 2.3 * k, 96, 80)


def rays(views: Views, k: int, shift: tuple[float, float] = (0.0, 0.0)):
    """Origins and directions (H, W, 3), in the world, of the rays through the pixels' centres.

    Depth is the length along them in directions. `shift` in pixels.
    """
    u = np.arange(views.width) + 0.5 + shift[0]
    v = np.arange(views.height) + 0.5 + shift[1]
    x, y = np.meshgrid((u - views.cx[k]) / views.fx[k], (v - views.cy[k]) / views.fy[k])
    zero, one = np.zeros_like(x), np.ones_like(x)
    origin, direction = [x, y, zero], [zero, zero, one]
    if views.projection == "pinhole":
        origin, direction = [zero, zero, zero], [x, y, one]
    T = invert_rigid(views.T_camera_world[k])
    return apply(T, np.stack(origin, -1)), np.stack(direction, -1) @ T[:3, :3].T


def box_depth(origin, direction):
    """Where rays enter the box (slab method; inf where they miss) and on which of its 3 axes."""
    o, d = (origin - BOX_CENTER) @ BOX_ROTATION, direction @ BOX_ROTATION
    low, high = np.sort(np.stack([(-BOX_HALF - o) / d, (BOX_HALF - o) / d]), axis=0)
    enter = low.max(axis=-1)
    return np.where(enter < high.min(axis=-1), enter, np.inf), low.argmax(axis=-1)


def sphere_depth(origin, direction, radius: float):
    """Where rays enter the sphere about the origin; inf where they miss."""
    a, b = (direction**2).sum(-1), (origin * direction).sum(-1)
    root = b * b - a * ((origin**2).sum(-1) - radius**2)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)


def soup_depth(mesh: LabelledMesh, origin, direction):
    """The nearest triangle along each ray, one triangle at a time (Moeller and Trumbore 1997)."""
    depth = np.full(origin.shape[:-1], np.inf)
    for a, b, c in mesh.vertices[mesh.faces]:
        p = np.cross(direction, c - a)
        det = p @ (b - a)
        q = np.cross(origin - a, b - a)
        s = ((origin - a) * p).sum(-1) / det
        t = (direction * q).sum(-1) / det
        hit = (s >= 0) & (t >= 0) & (s + t <= 1)
        depth = np.where(hit, np.minimum(depth, (q @ (c - a)) / det), depth)
    return depth


def eroded(seen):
    """Pixels whose whole neighbourhood is as they are, seen or not: no silhouette passes."""
    padded = np.pad(seen, 1, mode="edge")
    shifted = [
        padded[i : i + seen.shape[0], j : j + seen.shape[1]] for i in range(3) for j in range(3)
    ]
    return np.all(shifted, axis=0) | ~np.any(shifted, axis=0)


@cache
def why_not(backend: str) -> str | None:
    try:
        render(box(), cameras("orthographic", count=1), backend=backend)
    except (MissingExtra, MissingDriver) as missing:
        return str(missing)
    return None


@pytest.fixture(params=BACKENDS)
def backend(request) -> str:
    if reason := why_not(request.param):
        pytest.skip(reason)
    return request.param


both_projections = pytest.mark.parametrize("projection", ["orthographic", "pinhole"])


@both_projections
def test_depth_of_a_turned_box_is_that_of_its_planes(backend, projection):
    views = cameras(projection)
    maps = render(box(), views, backend=backend)
    assert maps.depth.dtype == np.float32
    errors = []
    for k, depth in enumerate(maps.depth):
        exact, _ = box_depth(*rays(views, k))
        clear = eroded(np.isfinite(exact))
        np.testing.assert_array_equal(np.isfinite(depth)[clear], np.isfinite(exact)[clear])
        inside = clear & np.isfinite(exact)
        assert inside.sum() > 800
        errors.append(np.abs(depth[inside] - exact[inside]))
    assert np.percentile(np.concatenate(errors), 99) < TOLERANCE[backend]
    assert (maps.depth < 0).any() == (projection == "orthographic")


@both_projections
def test_the_face_seen_lies_on_the_side_that_the_ray_enters(backend, projection):
    mesh, views = box(), cameras(projection)
    maps = render(mesh, views, backend=backend)
    if not BACKENDS[backend].tells_faces:
        assert maps.face is None
        return
    assert maps.face.dtype == np.int32
    np.testing.assert_array_equal(maps.face == -1, np.isinf(maps.depth))
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    axis_of_face = np.abs(np.cross(b - a, c - a) @ BOX_ROTATION).argmax(axis=1)
    for k, face in enumerate(maps.face):
        exact, axis = box_depth(*rays(views, k))
        both = (face >= 0) & np.isfinite(exact)
        assert (axis_of_face[face[both]] == axis[both]).mean() > 0.995  # the rest: on an edge


@both_projections
def test_the_part_that_each_pixel_shows_is_known_of_every_backend(backend, projection):
    """Of two boxes, one in front of the other from some sides: the nearest by the naive caster."""
    pieces = [box(), labelled(box().vertices * 0.5 + (0.3, 0.2, -0.1), box().faces)]
    mesh = LabelledMesh(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([pieces[0].faces, pieces[1].faces + 8]),
        np.repeat([0, 3], 12).astype(np.uint8),
    )
    views = cameras(projection)
    maps = BACKENDS[backend].render_parts(mesh, views)
    whole = render(mesh, views, backend=backend)
    np.testing.assert_array_equal(maps.face >= 0, np.isfinite(maps.depth))
    seen = np.isfinite(whole.depth)
    np.testing.assert_array_equal(np.isfinite(maps.depth), seen)
    assert np.percentile(np.abs(maps.depth[seen] - whole.depth[seen]), 99) < TOLERANCE[backend]
    for k in range(len(views)):
        alone = [soup_depth(piece, *rays(views, k)) for piece in pieces]
        nearest = np.where(alone[1] < alone[0], 3, 0)
        at = (maps.face[k] >= 0) & np.isfinite(np.minimum(*alone))
        assert {0, 3} == set(nearest[at])
        assert (mesh.part_of_face[maps.face[k][at]] == nearest[at]).mean() > 0.995


@both_projections
def test_depth_of_a_sphere_lies_between_its_in_and_circumscribed_ones(backend, projection):
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    inner = np.einsum("ij,ij->i", sphere.triangles_center, sphere.face_normals).min()
    views = cameras(projection)
    maps = render(labelled(sphere.vertices, sphere.faces), views, backend=backend)
    for k, depth in enumerate(maps.depth):
        nearest = sphere_depth(*rays(views, k), 0.4)
        farthest = sphere_depth(*rays(views, k), inner)
        surely = np.isfinite(farthest) & eroded(np.isfinite(farthest))
        slack = TOLERANCE[backend]
        assert surely.sum() > 1500
        assert np.all(depth[surely] > nearest[surely] - slack)
        assert np.all(depth[surely] < farthest[surely] + slack)
        assert np.all(np.isinf(depth[np.isinf(nearest) & eroded(np.isfinite(nearest))]))


@both_projections
@pytest.mark.parametrize("seed", [0, 1])
def test_a_soup_of_random_triangles_agrees_with_a_naive_ray_caster(backend, projection, seed):
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-0.4, 0.4, (24, 1, 3))
    vertices = (centers + rng.normal(scale=0.15, size=(24, 3, 3))).reshape(-1, 3)
    mesh = labelled(vertices, np.arange(72).reshape(24, 3))
    views = cameras(projection, distance=2.0)
    maps = render(mesh, views, backend=backend)
    for k, depth in enumerate(maps.depth):
        exact = soup_depth(mesh, *rays(views, k))
        near_by = [
            soup_depth(mesh, *rays(views, k, s)) for s in ((0.05, 0.0), (-0.05, 0.03), (0.0, -0.05))
        ]
        # leave out the pixels where an edge passes: a twentieth of a pixel away depth jumps
        clear = np.all([np.isfinite(d) == np.isfinite(exact) for d in near_by], axis=0)
        assert clear.mean() > 0.9
        np.testing.assert_array_equal(np.isfinite(depth)[clear], np.isfinite(exact)[clear])
        inside = clear & np.isfinite(exact)
        slope = np.max([np.abs(d[inside] - exact[inside]) for d in near_by], axis=0)
        error = np.abs(depth[inside] - exact[inside])
        smooth = slope < 0.01
        assert inside.sum() > 500
        assert smooth.mean() > 0.9
        assert np.all(error[smooth] < TOLERANCE[backend] + 1e-3 * slope[smooth])


@both_projections
def test_a_triangle_is_seen_from_both_sides(backend, projection):
    a, b, c = corners = np.array([[-0.3, -0.3, 0.1], [0.4, -0.2, 0.1], [0.0, 0.4, 0.1]])
    T = np.array([look_along((0, 0, z), (0, 0, -1.5 * z)) for z in (1.0, -1.0)])
    focal = np.full(2, 100.0)
    views = Views(projection, T, focal, focal, np.full(2, 47.3), np.full(2, 40.6), 96, 80)
    below, above = render(labelled(corners, [[0, 1, 2]]), views, backend=backend).depth
    for depth, z in ((below, 1.6), (above, 1.4)):
        seen = np.isfinite(depth)
        pixels = np.linalg.norm(np.cross(b - a, c - a)) / 2 * 100.0**2
        pixels /= z**2 if projection == "pinhole" else 1.0
        assert seen.sum() == pytest.approx(pixels, rel=0.03)
        np.testing.assert_allclose(depth[seen], z, atol=TOLERANCE[backend])


def test_winding_changes_nothing(backend):
    mesh, views = box(), cameras("orthographic")
    turned = mesh.faces[:, ::-1]
    once = render(mesh, views, backend=backend).depth
    for faces in (turned, np.concatenate([mesh.faces, turned])):
        again = render(labelled(mesh.vertices, faces), views, backend=backend).depth
        np.testing.assert_array_equal(np.isfinite(again), np.isfinite(once))
        seen = np.isfinite(once)
        assert np.percentile(np.abs(again[seen] - once[seen]), 99) < TOLERANCE[backend]


@both_projections
def test_nothing_is_seen_of_no_faces_or_of_a_mesh_beside_the_image(backend, projection):
    views = cameras(projection, distance=3.0, count=1)
    to_the_right = invert_rigid(views.T_camera_world[0])[:3, 0]
    for mesh in (
        labelled(np.zeros((0, 3)), np.zeros((0, 3))),
        labelled(box().vertices + 4.0 * to_the_right, box().faces),
    ):
        maps = render(mesh, views, backend=backend)
        assert maps.depth.shape == (1, 80, 96)
        assert np.all(np.isposinf(maps.depth))
        assert maps.face is None or np.all(maps.face == -1)


def test_a_mesh_that_reaches_behind_a_pinhole_camera_is_refused(backend):
    with pytest.raises(ValueError, match="pinhole camera"):
        render(box(), cameras("pinhole", distance=0.1), backend=backend)


def test_the_same_call_gives_the_same_bytes(backend):
    mesh, views = box(), cameras("pinhole")
    first, second = (render(mesh, views, backend=backend).depth for _ in range(2))
    assert first.tobytes() == second.tobytes()


@cache
def real_laptop() -> LabelledMesh:
    """All the meshes of a real laptop as they lie in its folder, fitted into the unit frame."""
    folder = REAL_MODELS / "partnet_mobility/laptop/10040/textured_objs"
    meshes = [trimesh.load(path, force="mesh") for path in sorted(folder.glob("*.obj"))]
    soup = trimesh.util.concatenate(meshes)
    low, high = soup.bounds
    return labelled((soup.vertices - (low + high) / 2) / (high - low).max(), soup.faces)


@needs_real_models
@both_projections
def test_all_agree_on_a_real_model(backend, projection):
    views = cameras(projection, count=4)
    ours = render(real_laptop(), views).depth
    theirs = render(real_laptop(), views, backend=backend).depth
    with np.errstate(invalid="ignore"):
        differ = ~((np.abs(ours - theirs) <= 1e-4) | (np.isinf(ours) & np.isinf(theirs)))
    worst = differ.mean(axis=(1, 2)).argmax()
    assert differ.mean() < 0.002, f"{backend} differs most in view {worst}"


@pytest.mark.parametrize(
    ("backend", "library", "extra"),
    [
        ("embree", "open3d", "open3d"),
        ("opengl", "pyrender", "opengl"),
        ("sapien", "sapien", "sapien"),
    ],
)
def test_an_absent_library_is_one_sentence_with_its_cure(monkeypatch, backend, library, extra):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingExtra, match=rf"{library} .*pip install 'articugen\[{extra}\]'"):
        render(box(), cameras("pinhole"), backend=backend)


def test_a_library_that_cannot_be_loaded_names_the_system_packages(monkeypatch, tmp_path):
    tmp_path.joinpath("unloadable.py").write_text("raise ImportError('libfoo.so.1: not found')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDriver, match=r"libfoo\.so\.1.*apt-get install libfoo1"):
        import_library("unloadable", "none", "libfoo1")


def test_a_fault_of_the_machine_is_no_missing_package():
    fault = missing_driver("open3d", "libgl1", OSError(errno.EMFILE, "Too many open files"))
    assert isinstance(fault, MachineFault)
    absent = missing_driver("open3d", "libgl1", OSError("libGL.so.1: cannot open"))
    assert "open3d cannot run on this machine (libGL.so.1: cannot open)" in str(absent)
