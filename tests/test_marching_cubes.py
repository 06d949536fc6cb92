"""Surfaces of grids against spheres, and whether they are closed whatever the signs."""

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from articugen.core.records import Mesh
from articugen.meshes.marching_cubes import zero_level
from tests.procedural_truth import is_closed


def volume(mesh: Mesh) -> float:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume


def sphere(resolution, radius=0.3, centre=(0.0, 0.0, 0.0)):
    at = (np.arange(resolution) + 0.5) / resolution - 0.5
    grid = np.stack(np.meshgrid(at, at, at, indexing="ij"), -1) - centre
    return radius - np.linalg.norm(grid, axis=-1)


@pytest.mark.parametrize("resolution", [16, 32])
def test_a_sphere_is_where_it_is_not_a_voxel_beside(resolution):
    mesh = zero_level(sphere(resolution, centre=(0.05, -0.02, 0.01)))
    off = np.linalg.norm(mesh.vertices - [0.05, -0.02, 0.01], axis=1) - 0.3
    h = 1 / resolution  # linear between samples: h^2 / 8 times the greatest curvature there
    assert np.abs(off).max() < h**2 / 8 / (0.3 - h)
    np.testing.assert_allclose(mesh.vertices.mean(0), [0.05, -0.02, 0.01], atol=2e-3)
    exact = 4 / 3 * math.pi * 0.027
    assert volume(mesh) == pytest.approx(exact, rel=0.05 if resolution == 16 else 0.02)
    assert is_closed(mesh.faces)


def test_every_pattern_of_signs_has_its_surface():
    """A lone cell of each of the 256: closed, and as large as what it is closed around."""
    for case in range(1, 256):
        signs = (case >> np.arange(8) & 1).reshape(2, 2, 2)
        mesh = zero_level(np.where(signs, 1.0, -1.0))
        assert is_closed(mesh.faces), case
        assert volume(mesh) > 0.0, case  # faces outwards


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10**6), shift=st.floats(-1.0, 1.0), whole=st.booleans())
def test_surfaces_are_closed_and_turned_one_way(seed, shift, whole):
    """Noise, where faces of cells are ambiguous; with samples of exactly zero too."""
    field = np.random.default_rng(seed).normal(shift, size=(6, 6, 6))
    field = np.round(field) if whole else field
    mesh = zero_level(field)
    assert is_closed(mesh.faces)
    assert (len(mesh.faces) > 0) == (field > 0).any()
    assert np.abs(mesh.vertices).max(initial=0.0) <= 0.5


def test_vertices_lie_on_the_zero_level_between_two_samples():
    """Of a plane, which is linear, exactly."""
    at = (np.arange(8) + 0.5) / 8 - 0.5
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    mesh = zero_level(0.1 + x - 2.0 * y + 0.5 * z)
    within = (np.abs(mesh.vertices) < 0.43).all(1)  # not where it is closed at the border
    assert within.sum() > 50
    np.testing.assert_allclose(0.1 + mesh.vertices[within] @ [1.0, -2.0, 0.5], 0.0, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10**6), size=st.tuples(*[st.integers(1, 4)] * 3), data=st.data())
def test_a_surface_is_the_same_wherever_it_is(seed, size, data):
    """Grids are looked at near what is inside alone, in a corner or in the middle."""
    at = [data.draw(st.integers(0, 8 - side)) for side in size]
    meshes = []
    for R, start in ((8, at), (16, [i + 4 for i in at])):
        field = np.full((R, R, R), -2.0)
        place = tuple(slice(i, i + side) for i, side in zip(start, size, strict=True))
        field[place] = np.random.default_rng(seed).uniform(-2.0, 2.0, size)
        meshes.append(zero_level(field))
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    np.testing.assert_allclose(meshes[0].vertices, 2.0 * meshes[1].vertices, atol=1e-12)


def test_the_whole_cube_is_closed_at_its_border():
    mesh = zero_level(np.ones((4, 4, 4)))
    assert is_closed(mesh.faces)
    assert np.abs(mesh.vertices).max() == 0.5


def test_nothing_has_no_surface():
    assert zero_level(-np.ones((4, 4, 4))).faces.shape == (0, 3)
