import numpy as np
import pytest
import trimesh

from articugen.core.errors import RejectedInstance
from articugen.fusion.isosurface import extract_mesh
from tests.shapes import box, field_of, rotated


@pytest.mark.parametrize("resolution", [32, 96])
def test_the_mesh_of_a_sphere_is_closed_and_where_the_sphere_is(resolution):
    field = field_of(trimesh.creation.icosphere(subdivisions=5, radius=0.4))
    mesh = extract_mesh(field, resolution)
    closed = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert closed.is_watertight
    assert closed.is_winding_consistent
    assert closed.volume == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=1.5 / resolution)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - 0.4).max() < 0.6 / resolution
    assert np.abs(np.mean(mesh.vertices, axis=0)).max() < 0.1 / resolution  # no half-voxel shift


def test_the_mesh_of_a_turned_box_touches_its_faces():
    solid = rotated(box((0.6, 0.5, 0.3)), 0.5, (1, 2, 3))
    mesh = extract_mesh(field_of(solid), 96)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight
    distance = np.abs(trimesh.proximity.signed_distance(solid, mesh.vertices))
    assert np.mean(distance) < 0.1 / 96
    assert np.quantile(distance, 0.99) < 0.6 / 96


def test_a_shape_that_touches_the_cube_is_closed_too():
    mesh = extract_mesh(field_of(box((1.0, 1.0, 1.0))), 24)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight


def test_nothing_inside_is_said():
    with pytest.raises(RejectedInstance, match="finer"):
        extract_mesh(field_of(box((0.9, 0.9, 0.01), (0, 0, 0.1))), 4)
