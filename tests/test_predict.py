"""Rigged predictions: what is written is read back by yourdfpy and moves as predicted."""

import dataclasses
import json

import numpy as np
import pytest
from instances import hinged_box
from PIL import Image
from yourdfpy import URDF

from articugen.core.errors import ArticugenError
from articugen.core.geometry import apply
from articugen.core.records import Normalization
from articugen.evaluation.reconstruction import Reconstruction, truth
from articugen.learning import predict
from articugen.learning.predict import cut, draw_cut, write_cut, write_rig
from articugen.meshes.distances import distance
from articugen.meshes.marching_cubes import zero_level
from articugen.meshes.points import Cloud


def three_balls() -> Reconstruction:
    """The hinged box's joints with a ball for each part: base, lid, knob (all on part 0)."""
    (instance,) = hinged_box([(0.4, 0.1)])
    found = truth(instance)
    at = (np.arange(16) + 0.5) / 16 - 0.5
    grid = np.stack(np.meshgrid(at, at, at, indexing="ij"), -1)
    balls = [
        zero_level(0.1 - np.linalg.norm(grid - centre, axis=-1)).triangles
        for centre in ([0, 0, -0.3], [0.1, 0, 0.1], [-0.2, 0.2, 0.2])
    ]
    return dataclasses.replace(
        found, triangles=np.concatenate(balls), part=np.repeat([0, 1, 2], [len(b) for b in balls])
    )


def test_a_rig_moves_as_predicted(tmp_path):
    found = three_balls()
    robot = URDF.load(str(write_rig(found, tmp_path)))
    assert robot.actuated_joint_names == ["joint_1", "joint_2"]
    blue = robot.link_map["part_1"].visuals[0].material.color.rgba
    np.testing.assert_allclose(blue, [0x44 / 255, 0x77 / 255, 0xAA / 255, 1.0], atol=1e-3)
    more = np.array([0.0, 0.5, -0.05])
    moved = dataclasses.replace(
        found, joints=dataclasses.replace(found.joints, state=found.joints.state + more)
    )
    motion = found.joint_motion_to(moved)
    for value, T in ((0 * more, np.tile(np.eye(4), (3, 1, 1))), (more, motion)):
        robot.update_cfg({f"joint_{i}": value[i] for i in (1, 2)})
        for i in range(3):
            T_world = robot.get_transform(f"part_{i}", "part_0")
            (mesh,) = [
                robot.scene.geometry[name] for name in robot.scene.geometry if f"part_{i}" in name
            ]
            posed = apply(T_world, mesh.vertices)
            wanted = apply(T[i], found.triangles[found.part == i].reshape(-1, 3)).reshape(-1, 3, 3)
            assert distance(posed, wanted).max() < 1e-6
    limit = robot.joint_map["joint_1"].limit
    assert limit.lower == pytest.approx(-0.4)
    assert limit.upper == pytest.approx(np.pi - 0.4)
    beyond = dataclasses.replace(found.joints, state=np.array([0.0, -0.1, 1.1]))
    robot = URDF.load(str(write_rig(dataclasses.replace(found, joints=beyond), tmp_path)))
    limits = [robot.joint_map[f"joint_{i}"].limit for i in (1, 2)]
    assert (limits[0].lower, limits[1].upper) == (0.0, 0.0)  # as given is always within


def test_parts_without_joints_are_fixed(tmp_path):
    found = dataclasses.replace(three_balls(), joints=None, T_part=None)
    robot = URDF.load(str(write_rig(found, tmp_path)))
    assert robot.actuated_joint_names == []
    assert set(robot.link_map) == {"part_0", "part_1", "part_2"}


def test_nothing_of_an_earlier_prediction_stays_and_all_else_does(tmp_path):
    found = three_balls()
    write_rig(found, tmp_path)
    write_cut(cut(Cloud(found.triangles.mean(1), triangles=found.triangles), found), tmp_path)
    (tmp_path / "part_notes.obj").write_text("mine")
    two = found.part < 2
    write_rig(
        dataclasses.replace(found, triangles=found.triangles[two], part=found.part[two]), tmp_path
    )
    there = {path.name for path in tmp_path.iterdir()}
    kept = {"input.glb", "part_notes.obj"}
    assert there == {"predicted.urdf", "part_0.obj", "part_1.obj", *kept}


def test_no_surface_is_said(tmp_path):
    found = three_balls()
    empty = dataclasses.replace(found, triangles=np.zeros((0, 3, 3)), part=np.zeros(0, int))
    with pytest.raises(ArticugenError, match="sees no surface"):
        write_rig(empty, tmp_path)


def test_a_rig_stands_where_its_cloud_stood(tmp_path):
    """In a frame twice as large: lengths double, angles stay."""
    found = three_balls()
    frame = Normalization(np.array([1.0, 2.0, 3.0]), 2.0)
    small = URDF.load(str(write_rig(found, tmp_path / "small")))
    large = URDF.load(str(write_rig(found, tmp_path / "large", frame=frame)))
    for robot in (small, large):
        robot.update_cfg({"joint_1": 0.3, "joint_2": 0.05 if robot is small else 0.1})
    for i in range(3):
        one, two = (
            apply(robot.get_transform(name, "part_0"), robot.scene.geometry[name].vertices)
            for robot in (small, large)
            for name in [next(n for n in robot.scene.geometry if f"part_{i}" in n)]
        )
        where = np.lexsort(np.round(one.T, 6))
        order = np.lexsort(np.round(frame.to_unit(two).T, 6))
        np.testing.assert_allclose(frame.to_unit(two)[order], one[where], atol=1e-5)
    assert large.joint_map["joint_2"].limit.upper == pytest.approx(
        2.0 * (1.0 - found.joints.state[2])
    )


def area(triangles: np.ndarray) -> float:
    a, b, c = np.moveaxis(triangles, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


def test_a_mesh_is_cut_where_another_part_is_nearer():
    """Base and lid are balls about (0, 0, -0.3) and (0.1, 0, 0.1): the border is the plane between.

    A sheet reaches through both; nothing of it is lost."""
    found, corners = three_balls(), np.array([[0.0, 0, -0.4], [0.2, 0, 0.2], [-0.1, 0, 0.2]])
    cloud = Cloud(np.zeros((64, 3)), triangles=corners[None])
    pieces = cut(cloud, found)
    assert area(pieces.triangles) == pytest.approx(area(corners[None]))
    assert set(pieces.part) == {0, 1}
    along = pieces.triangles.mean(1) @ [0.1, 0.0, 0.4] - np.dot([0.05, 0, -0.1], [0.1, 0.0, 0.4])
    sure = np.abs(along) / np.linalg.norm([0.1, 0.4]) > 0.02  # balls of 16^3 are not quite round
    assert sure.mean() > 0.2
    np.testing.assert_array_equal(pieces.part[sure], (along[sure] > 0).astype(int))


def test_a_cut_says_how_many_points_are_done_and_is_the_same_in_blocks(monkeypatch):
    found, lines = three_balls(), []
    cloud = Cloud(np.zeros((64, 3)), triangles=found.triangles + np.array([0.05, 0.0, 0.0]))
    whole = cut(cloud, found)
    monkeypatch.setattr(predict, "_AT_ONCE", 100)
    blocks = cut(cloud, found, lines.append)
    np.testing.assert_array_equal(blocks.triangles, whole.triangles)
    np.testing.assert_array_equal(blocks.part, whole.part)
    total = f"{3 * len(cloud.triangles):,} points"
    assert lines[:2] == [f"cutting: {done} of {total}" for done in (0, 100)]


def test_what_is_far_smaller_than_its_reconstruction_is_drawn(tmp_path):
    found = dataclasses.replace(three_balls(), joints=None, T_part=None)
    small = cut(Cloud(1e-4 * found.triangles.mean(1)), found)
    assert draw_cut(small, found, tmp_path / "input.png").is_file()


@pytest.mark.parametrize("is_mesh", [False, True])
def test_what_was_given_moves_as_predicted(tmp_path, is_mesh):
    found = three_balls()
    frame = Normalization(np.array([1.0, 2.0, 3.0]), 2.0)
    cloud = Cloud(found.triangles.mean(1), frame, triangles=found.triangles if is_mesh else None)
    pieces = cut(cloud, found)
    written = write_cut(pieces, tmp_path, frame)
    data = (tmp_path / "input.glb").read_bytes()
    scene = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    primitives = [mesh["primitives"][0] for mesh in scene["meshes"]]
    assert [primitive.get("mode", 4) for primitive in primitives] == [4 if is_mesh else 0] * 3
    turning, sliding = (animation["extras"] for animation in scene["animations"])
    assert (turning["kind"], sliding["kind"]) == ("revolute", "prismatic")
    assert (turning["lower"], turning["upper"]) == pytest.approx((-0.4, np.pi / 2 - 0.4))
    slid = 2.0 * found.joints.state[2]
    assert (sliding["lower"], sliding["upper"]) == pytest.approx((-slid, 0.6 - slid))
    base = np.array(scene["accessors"][primitives[0]["attributes"]["POSITION"]]["max"])
    assert np.abs(base).max() < 1.0  # far from 0 single precision would blur them
    base += scene["nodes"][1]["translation"]
    np.testing.assert_allclose(base, frame.to_world(np.array([0.1, 0.1, -0.2])), atol=0.05)
    with Image.open(draw_cut(pieces, found, tmp_path / "input.png")) as picture:
        tiles = np.asarray(picture.convert("RGB"), int)
    third = tiles.shape[1] // 3
    closed, ajar = tiles[:, :third], tiles[:, third : 2 * third]
    assert np.abs(closed - ajar).max() > 100  # the lid and the knob have moved
    assert [path.name for path in written] == ["input.glb", "input.urdf"][: 1 + is_mesh]
    if is_mesh:
        robot = URDF.load(str(written[1]))
        assert robot.joint_map["joint_1"].limit.lower == pytest.approx(-0.4)
        assert len(robot.scene.geometry) == 3
