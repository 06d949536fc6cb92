from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from articugen.core.geometry import apply, rotation_about, transform
from articugen.core.records import (
    ArticulatedObject,
    DepthMaps,
    Joint,
    JointKind,
    LabelledMesh,
    Link,
    Mesh,
    Normalization,
    Views,
    dequantize,
    quantize,
)
from articugen.core.schema import Instance

TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2]]))


def joint(name: str, kind: str, parent: str, child: str) -> Joint:
    return Joint(name, JointKind[kind.upper()], parent, child, np.eye(4), np.array([0.0, 0.0, 1.0]))


def cabinet() -> ArticulatedObject:
    """base - drawer (prismatic) - knob (fixed); base - door (revolute) - handle (continuous)."""
    names = ("base", "drawer", "knob", "door", "handle")
    joints = (
        joint("slide", "prismatic", "base", "drawer"),
        joint("glue", "fixed", "drawer", "knob"),
        joint("hinge", "revolute", "base", "door"),
        joint("turn", "continuous", "door", "handle"),
    )
    links = tuple(Link(name, TRIANGLE) for name in names)
    return ArticulatedObject("c1", "cabinet", links, joints, np.eye(4), "0" * 64)


def test_joint_kinds_have_the_words_of_urdf_and_the_numbers_of_shards() -> None:
    assert [f"{kind}" for kind in JointKind] == ["fixed", "revolute", "continuous", "prismatic"]
    assert all(JointKind[str(kind).upper()] is kind for kind in JointKind)
    stored = {str(kind): np.uint8(kind.stored) for kind in JointKind}
    assert stored == {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 2}


def test_parts_are_the_fixed_one_then_revolute_then_prismatic() -> None:
    obj = cabinet()
    assert [j.name for j in obj.moving_joints] == ["hinge", "turn", "slide"]
    assert obj.part_of_link.tolist() == [0, 3, 3, 1, 2]
    assert obj.part_count == 4


def test_arrays_are_copied_and_read_only() -> None:
    vertices = np.eye(3)
    mesh = Mesh(vertices, np.array([[0, 1, 2]]))
    vertices[0, 0] = 7.0
    assert mesh.vertices[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 2.0
    with pytest.raises(FrozenInstanceError):
        mesh.vertices = vertices  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Mesh(np.eye(4), np.zeros((1, 3))), r"Mesh.vertices: shape \(4, 4\)"),
        (lambda: Mesh(np.eye(3), np.zeros(3)), r"Mesh.faces: shape \(3,\)"),
        (
            lambda: LabelledMesh(np.eye(3), np.zeros((2, 3)), np.zeros(1)),
            r"LabelledMesh.part_of_face: shape \(1,\)",
        ),
        (
            lambda: Joint("j", JointKind.REVOLUTE, "a", "b", np.eye(4), np.array([0.0, 0.0, 2.0])),
            "joint j: axis .* is not of unit length",
        ),
        (
            lambda: Joint("j", "fixed", "a", "b", np.eye(4), np.eye(3)[0]),  # type: ignore[arg-type]
            "joint j: its kind is 'fixed', not a JointKind",
        ),
    ],
)
def test_a_record_of_the_wrong_shape_is_not_made(make, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make()


def test_a_fixed_joint_needs_no_axis() -> None:
    assert Joint("j", JointKind.FIXED, "a", "b", np.eye(4), np.zeros(3)).kind == JointKind.FIXED


points = arrays(np.float64, (4, 3), elements=st.floats(-3, 3))
centers = arrays(np.float64, (3,), elements=st.floats(-5, 5))


@given(centers, st.floats(0.01, 10), points)
def test_the_unit_frame_there_and_back(center, scale, x) -> None:
    unit = Normalization(center, scale)
    np.testing.assert_allclose(unit.to_world(unit.to_unit(x)), x, atol=1e-11)


@given(centers, st.floats(0.1, 10), st.floats(-4, 4), centers, points)
def test_a_motion_in_the_unit_frame_is_the_motion_in_the_world(center, scale, angle, t, x) -> None:
    unit = Normalization(center, scale)
    T = transform(rotation_about((0.6, 0.0, 0.8), angle), t)
    np.testing.assert_allclose(
        apply(unit.rigid_to_unit(T), unit.to_unit(x)), unit.to_unit(apply(T, x)), atol=1e-10
    )


def test_each_part_of_a_labelled_mesh_moves_by_itself() -> None:
    vertices = np.concatenate([np.eye(3), np.eye(3)])
    mesh = LabelledMesh(vertices, np.array([[0, 1, 2], [3, 4, 5]]), np.array([0, 1]))
    lift = transform(translation=(0.0, 0.0, 1.0))
    moved = mesh.moved(np.stack([np.eye(4), lift]))
    np.testing.assert_array_equal(moved.vertices[:3], np.eye(3))
    np.testing.assert_array_equal(moved.vertices[3:], np.eye(3) + np.array([0, 0, 1]))


@given(arrays(np.float64, (20, 3), elements=st.floats(-0.5, 0.5)))
def test_fixed_point_is_exact_to_half_a_step(x) -> None:
    assert np.abs(dequantize(quantize(x)) - x).max() <= 0.5 / 65535 + 1e-15


@given(arrays(np.uint16, (20, 3)))
def test_every_stored_value_survives_reading_and_writing(stored) -> None:
    np.testing.assert_array_equal(quantize(dequantize(stored)), stored)


def test_fixed_point_reaches_both_faces_of_the_cube() -> None:
    assert quantize(np.array([-0.5, 0.0, 0.5])).tolist() == [0, 32768, 65535]
    assert dequantize(np.array([0, 65535], np.uint16)).tolist() == [-0.5, 0.5]


def views(count: int, **changed) -> Views:
    each = np.ones(count)
    given = {"fx": each, "fy": each, "cx": each, "cy": each} | changed
    return Views("pinhole", np.tile(np.eye(4), (count, 1, 1)), width=4, height=3, **given)


def test_views_and_depth_maps_agree_in_number_and_size() -> None:
    assert len(views(2)) == 2
    assert DepthMaps(np.zeros((2, 3, 4), np.float32), None, views(2)).face is None
    with pytest.raises(ValueError, match=r"Views.fx: shape \(1,\)"):
        views(2, fx=np.ones(1))
    with pytest.raises(ValueError, match=r"DepthMaps.depth: shape \(2, 4, 3\)"):
        DepthMaps(np.zeros((2, 4, 3), np.float32), None, views(2))


def bare_instance(**changed) -> Instance:
    J = 1
    given = {
        "object_id": "x",
        "state_index": 0,
        "center": np.zeros(3),
        "scale": 1.0,
        "joint_kind": np.ones(J),
        "joint_parent": np.zeros(J),
        "joint_state": np.zeros(J),
        "joint_lower": np.zeros(J),
        "joint_upper": np.ones(J),
        "joint_axis": np.array([[0, 0, 1]]),
        "joint_pivot": np.zeros((J, 3)),
        "part_motion": np.tile(np.eye(4), (J + 1, 1, 1)),
    }
    return Instance(**(given | changed))


def test_an_instance_lists_every_field_once_with_one_entry_a_grid() -> None:
    grids = {32: np.zeros((32,) * 3, np.uint8), 16: np.zeros((16,) * 3, np.uint8)}
    may_lack = {f.name for f in fields(Instance) if f.default is None}
    own = {f.name for f in fields(Instance)} - {"occupancy", "coverage"}
    names = {"joint_name": ("a",), "part_name": ("b", "c"), "part_semantic": ("", "")}
    grid_names = {"occupancy_16", "occupancy_32", "coverage_32"}
    full = bare_instance(occupancy=grids, coverage={32: grids[32]}, **names)
    assert set(full.arrays()) == (own - may_lack) | set(names) | grid_names
    assert set(bare_instance().arrays()) == own - may_lack


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"part_motion": np.eye(4)[None]}, "Instance.part_motion"),
        ({"joint_axis": np.zeros((2, 3))}, "Instance.joint_axis"),
        ({"surface_points": np.zeros((5, 3))}, "Instance.surface_normals"),
        ({"occupancy": {16: np.zeros((16, 16, 15), np.uint8)}}, r"Instance.occupancy\[16\]"),
        ({"occupancy": {4: np.zeros((4, 4, 4), np.int64)}}, r"Instance.occupancy\[4\]"),
        ({"coverage": {4: np.zeros((4, 4, 5), np.uint8)}}, r"Instance.coverage\[4\]"),
        ({"part_semantic": ("lid",)}, r"Instance.part_semantic: shape \(1, 1\), not \(N, P\)"),
    ],
)
def test_an_instance_whose_fields_disagree_is_not_made(changed, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        bare_instance(**changed)
