"""Joints found from poses of boxes whose motion is known."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from ppd_data import write_boxes
from rich.console import Console

import articugen as ag
from articugen.cli.discover import _summary, _table
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import (
    apply,
    joint_motion,
    points_on_triangles,
    rotation_about,
)
from articugen.core.records import Floats, JointKind, dequantize
from articugen.discovery import KINDS, Discovery, FoundJoint, discover
from articugen.discovery.clouds import Surface
from articugen.discovery.frames import frame_of_faces
from articugen.discovery.objects import Judged, ObjectJoints, _judged, axes_apart, discover_all
from articugen.store.rows import Row
from tests.shapes import box

Motion = Callable[[float], Floats]


def turn(axis: Sequence[float], pivot: Sequence[float]) -> Motion:
    """The motion (4, 4) of a state about an axis through `pivot`."""
    way = np.array(axis) / np.linalg.norm(axis)
    return lambda angle: joint_motion(True, way, angle, pivot)


def slide(axis: Sequence[float]) -> Motion:
    return lambda length: joint_motion(False, axis, length)


def sampled(
    size: Sequence[float], centre: Sequence[float], rng: np.random.Generator, count: int
) -> Floats:
    """(count, 3) uniform on the surface of a box."""
    mesh = box(size, centre)
    return points_on_triangles(mesh.vertices[mesh.faces], count, rng=rng)[0]


BODY = ((0.4, 0.5, 0.5), (-0.2, 0.0, 0.0))


def posed(
    parts: Sequence[tuple[tuple[Sequence[float], Sequence[float]], Motion]], states: Floats
) -> list[Floats]:
    """Clouds of a body and parts, each drawn anew in each pose."""
    rng = np.random.default_rng(5)
    clouds = []
    for row in states:
        pieces = [sampled(*BODY, rng, 2000)]
        for (shape, motion), state in zip(parts, row, strict=True):
            pieces.append(apply(motion(state), sampled(*shape, rng, 600)))
        clouds.append(np.concatenate(pieces))
    return clouds


def line_distance(found: Discovery, j: int, axis: Sequence[float], pivot: Sequence[float]) -> float:
    """How far a true pivot is from the axis that was found."""
    off = np.array(pivot) - found.joints[j].pivot
    return float(np.linalg.norm(off - (off @ found.joints[j].axis) * found.joints[j].axis))


def degrees_between(a: Floats, b: Sequence[float]) -> float:
    way = np.array(b) / np.linalg.norm(b)
    return float(np.degrees(np.arccos(np.clip(a @ way, -1.0, 1.0))))


LID = ((0.03, 0.44, 0.44), (0.05, 0.0, 0.0))


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (0.0, 0.12, 1.0)])
def test_a_door_is_found_with_its_axis_its_pivot_and_its_angles(axis: Sequence[float]) -> None:
    pivot = (0.05, 0.0, -0.22) if axis[1] == 1.0 else (0.05, -0.22, 0.0)
    states = np.array([0.0, 0.5, 1.3, 0.9, 1.7])[:, None]
    found = discover(posed([(LID, turn(axis, pivot))], states))
    (joint,) = found.joints
    assert joint.kind is JointKind.REVOLUTE
    assert degrees_between(joint.axis, axis) < 1.0
    assert line_distance(found, 0, axis, pivot) < 0.01
    assert np.abs(joint.states - states[:, 0]).max() < 0.02
    assert joint.score > 0.6
    truth = np.repeat([0, 1], [2000, 600])
    assert (found.part == truth).mean() > 0.97
    moved = apply(found.motion(4)[1], found.points[truth == 1])
    wanted = apply(turn(axis, pivot)(1.7), found.points[truth == 1])
    assert np.abs(moved - wanted).max() < 0.02


def test_two_hinges_are_two_joints() -> None:
    sides = (-0.24, 0.24)
    arms = [
        (((0.45, 0.03, 0.06), (0.225, y, 0.0)), turn((0, 0, 1.0), (0.0, y, 0.0))) for y in sides
    ]
    rng = np.random.default_rng(1)
    states = np.concatenate([np.zeros((1, 2)), rng.uniform(0.1, 1.4, (5, 2)) * [1.0, -1.0]])
    found = discover(posed(arms, states))
    assert [joint.kind for joint in found.joints] == [JointKind.REVOLUTE] * 2
    for joint in found.joints:
        side = int(joint.pivot[1] > 0)
        sign = (1.0, -1.0)[side]
        assert degrees_between(joint.axis, (0, 0, sign)) < 1.0
        assert abs(joint.pivot[1] - sides[side]) < 0.01
        assert np.abs(joint.states - sign * states[:, side]).max() < 0.02


def test_three_drawers_are_three_slides() -> None:
    heights = (-0.16, 0.0, 0.16)
    fronts = [(((0.06, 0.46, 0.14), (0.04, 0.0, z)), slide((1.0, 0, 0))) for z in heights]
    rng = np.random.default_rng(2)
    states = np.concatenate([np.zeros((1, 3)), rng.uniform(0.02, 0.4, (8, 3))])
    found = discover(posed(fronts, states))
    assert [joint.kind for joint in found.joints] == [JointKind.PRISMATIC] * 3
    for joint in found.joints:
        which = int(np.abs(np.array(heights) - joint.pivot[2]).argmin())
        assert degrees_between(joint.axis, (1, 0, 0)) < 2.0
        assert np.abs(joint.states - states[:, which]).max() < 0.01


@pytest.mark.parametrize("kind", [JointKind.REVOLUTE, JointKind.PRISMATIC])
def test_only_kinds_that_are_asked_for_are_found(kind: JointKind) -> None:
    front = ((0.06, 0.46, 0.14), (0.04, 0.0, 0.16))
    leaf = ((0.03, 0.44, 0.3), (0.05, 0.0, -0.08))
    both = [(front, slide((1.0, 0, 0))), (leaf, turn((0, 0, 1), (0.05, -0.22, 0)))]
    states = np.array([[0.0, 0.0], [0.3, 0.6], [0.1, 1.2], [0.2, 0.3], [0.4, 0.9]])
    clouds = posed(both, states)
    assert {joint.kind for joint in discover(clouds).joints} == {*KINDS}
    found = discover(clouds, kinds=[kind])
    assert {joint.kind for joint in found.joints} == {kind}
    right = found.joints[int(np.argmax([joint.score for joint in found.joints]))]
    wanted = states[:, int(kind is JointKind.REVOLUTE)]
    assert np.abs(right.states - wanted).max() < 0.02


def test_two_poses_are_enough_and_any_frame_will_do() -> None:
    motion = turn((0, 1, 0), (0.05, 0, -0.22))
    clouds = posed([(LID, motion)], np.array([[0.0], [1.2]]))
    (joint,) = discover([7.0 * cloud + [3.0, 0.0, -2.0] for cloud in clouds]).joints
    assert joint.kind is JointKind.REVOLUTE
    assert degrees_between(joint.axis, (0, 1, 0)) < 3.0
    assert np.linalg.norm((joint.pivot - [3.35, 0, -3.54])[[0, 2]]) < 0.2
    assert abs(joint.states[1] - 1.2) < 0.05


@pytest.mark.parametrize("angle", [1.0, 1.6])
def test_what_a_lid_uncovers_is_not_where_it_went(angle: float) -> None:
    """The front of the body is under the lid, and out of sight, until that is open."""
    lid, motion = ((0.03, 0.48, 0.48), (0.03, 0.0, 0.0)), turn((0, 1, 0), (0.03, 0.0, -0.24))
    closed, opened = posed([(lid, motion)], np.array([[0.0], [angle]]))
    under = (np.abs(closed[:, 0]) < 0.02) & (np.abs(closed[:, 1:]).max(1) < 0.239)
    found = discover([closed[~under], opened])
    (joint,) = found.joints
    assert joint.kind is JointKind.REVOLUTE
    assert line_distance(found, 0, (0, 1, 0), (0.03, 0, -0.24)) < 0.05
    assert abs(joint.states[1] - angle) < 0.1


def faces(states: Floats) -> tuple[list[Floats], list[Floats]]:
    """Clouds and normals: a body, the outer face of a back wall and that of a front that slides."""
    rng, out = np.random.default_rng(3), np.array([1.0, 0.0, 0.0])
    clouds, normals = [], []
    for state in states:
        body = sampled((0.5, 0.5, 0.1), (0.0, 0.0, -0.2), rng, 2000)
        plates = 0.4 * rng.random((2, 600, 3)) - [[0.2, 0.2, 0.1]]
        plates[0, :, 0], plates[1, :, 0] = -0.2, 0.1 + state
        clouds.append(np.concatenate([body, *plates]))
        normals.append(np.repeat([0.0 * out, -out, out], [2000, 600, 600], axis=0))
    return clouds, normals


def test_with_normals_a_front_is_not_taken_for_the_back_wall() -> None:
    states = np.array([0.0, 0.11, 0.25, 0.05, 0.32, 0.19, 0.14])
    clouds, normals = faces(states)
    (joint,) = discover(clouds, normals=normals).joints
    assert joint.kind is JointKind.PRISMATIC
    assert degrees_between(joint.axis, (1, 0, 0)) < 2.0
    assert np.abs(joint.states - states).max() < 0.01
    turned = [cloud_normals * [-1.0, 1.0, 1.0] for cloud_normals in normals]
    inside_out = discover(clouds, normals=[normals[0], *turned[1:]]).joints
    for each in inside_out:
        assert np.abs(each.states[1:] - states[1:]).min() > 0.02
    assert ag.discover(clouds, normals=normals).joints[0].states.tolist() == joint.states.tolist()
    with pytest.raises(InvalidArgument, match="not one for each point"):
        discover(clouds, normals=normals[:3])


def board(size: Sequence[float], centre: Sequence[float]) -> tuple[Floats, Floats]:
    """Points of a box, and their normals."""
    points = sampled(size, centre, np.random.default_rng(6), 900)
    side = (points - centre) / np.array(size)
    return points, np.where(np.abs(side) > 0.499, np.sign(side), 0.0)


def test_a_door_is_not_turned_into_the_side_of_the_cabinet() -> None:
    """Turned inwards by 90 degrees its faces lie on those of a side as thick and as deep; of where
    it is, a part is out of sight in some poses."""
    walls = [board((0.4, 0.03, 0.5), (-0.2, y, 0.0)) for y in (-0.235, 0.235)]
    walls += [board((0.4, 0.44, 0.03), (-0.2, 0.0, z)) for z in (-0.235, 0.235)]
    leaf, turned = board((0.03, 0.4, 0.5), (0.015, -0.02, 0.0)), turn((0, 0, -1), (0.03, -0.22, 0))
    states = np.array([0.0, 0.9, 0.4, 1.4, 0.2, 1.1])
    shown = [leaf[0][:, 2] > (-0.1 if q > 1.0 else -1.0) for q in states]
    moved = [
        (apply(turned(q), leaf[0][seen]), leaf[1][seen] @ turned(q)[:3, :3].T)
        for q, seen in zip(states, shown, strict=True)
    ]
    clouds, normals = (
        [np.concatenate([*(wall[k] for wall in walls), one[k]]) for one in moved] for k in (0, 1)
    )
    (joint,) = discover(clouds, normals=normals).joints
    assert joint.kind is JointKind.REVOLUTE
    assert np.abs(joint.states - states).max() < 0.02


@pytest.mark.parametrize("angle", [0.6, 1.8])
@pytest.mark.parametrize("thick", [0.02, 0.04, 0.1])
def test_a_lid_does_not_sink_onto_what_it_hid(thick: float, angle: float) -> None:
    """Two poses: most of a flat lid comes to lie on the body's top if it slides down by its own
    thickness, but the top had been there before."""
    body, lid = board((0.6, 0.8, 0.05), (0, 0, -0.025)), board((0.6, 0.8, thick), (0, 0, thick / 2))
    outside = body[1][:, 2] < 0.5, lid[1][:, 2] > -0.5
    T = turn((0, 1, 0), (0.3, 0, 0))(angle)
    opened = apply(T, lid[0]), lid[1] @ T[:3, :3].T
    clouds, normals = (
        [
            np.concatenate([body[k][outside[0]], lid[k][outside[1]]]),
            np.concatenate([body[k], opened[k]]),
        ]
        for k in (0, 1)
    )
    orders = [slice(None), slice(None, None, -1)]  # closed first, and last: then the top vanishes
    for order in orders if angle < 1.0 else orders[:1]:
        (joint,) = discover(clouds[order], normals=normals[order]).joints
        assert joint.kind is JointKind.REVOLUTE
        assert abs(joint.states[1] - angle) < 0.02


def test_a_tray_that_slides_is_not_turned_around() -> None:
    """Two poses: turned by half a circle a tray with two equal ends is where it slid to, and what
    its sides left lies on something new; slid it lies on what had been the sides' middle."""
    case = [board((0.4, 0.02, 0.16), (-0.2, y, 0.0)) for y in (-0.2, 0.2)]
    case += [board((0.4, 0.38, 0.02), (-0.2, 0.0, z)) for z in (-0.07, 0.07)]
    tray = [board((0.38, 0.02, 0.08), (-0.19, y, 0.0)) for y in (-0.17, 0.17)]
    tray += [board((0.38, 0.32, 0.02), (-0.19, 0.0, -0.03))]
    ends = [board((0.02, 0.32, 0.08), (x, 0.0, 0.0)) for x in (-0.01, -0.37)]
    tray += [(points[:150], normals[:150]) for points, normals in ends]
    clouds = [
        np.concatenate(
            [*(wall for wall, _ in case), *(side + np.array([out, 0, 0]) for side, _ in tray)]
        )
        for out in (0.0, 0.1)
    ]
    normals = np.concatenate([out for _, out in case + tray])
    (joint,) = discover(clouds, normals=[normals, normals]).joints
    assert joint.kind is JointKind.PRISMATIC
    assert joint.states[1] == pytest.approx(0.1, abs=0.005)


def bundled(name: str, poses: int, R: Floats | None = None) -> Discovery:
    """Joints of a bundled model by its first poses, with normals, all turned by R (3, 3)."""
    few = {"grids": [], "uniform_points": 16, "near_points": 16, "partial_views": 0}
    keys = {"extends": "category", "sampling": few}
    made = ag.Maker(ag.load("procedural", name), keys)[:poses]
    R = np.eye(3) if R is None else R
    clouds = [dequantize(one.instance.surface_points) @ R.T for one in made]
    return ag.discover(clouds, normals=[one.instance.surface_normals / 127 @ R.T for one in made])


@pytest.mark.parametrize("name", ["drawer_0018", "drawer_0125"])
def test_what_a_drawer_hides_does_not_move(name: str) -> None:
    """The board below a drawer is seen through the gap until the drawer's floor lies over it."""
    found = bundled(name, 9)
    assert [joint.kind for joint in found.joints] == [JointKind.PRISMATIC] * 3
    for joint in found.joints:
        assert degrees_between(np.abs(joint.axis), (1, 0, 0)) < 2.0


def test_an_object_may_be_turned_any_way() -> None:
    R = rotation_about(np.array([0.6, 0.0, 0.8]), 1.0)
    upright, turned = bundled("drawer_0010", 9), bundled("drawer_0010", 9, R)
    assert len(upright.joints) == len(turned.joints) == 3
    assert (turned.points == upright.points @ R.T).all()
    for one, other in zip(upright.joints, turned.joints, strict=True):
        assert degrees_between(other.axis, (R @ one.axis).tolist()) < 1.0
        assert np.abs(other.states - one.states).max() < 0.005
        assert np.abs(other.pivot - R @ one.pivot).max() < 0.01


@pytest.mark.parametrize("normals", [True, False])
def test_faces_lay_an_object_along_the_axes(normals: bool) -> None:
    R = rotation_about(np.array([0.0, 0.6, 0.8]), 0.7)
    rng = np.random.default_rng(3)
    mesh = box((0.5, 0.4, 0.3))
    cloud, face = points_on_triangles(mesh.vertices[mesh.faces], 4000, rng=rng)
    outward = mesh.face_normals[face]

    def frame(points: Floats, faces: Floats) -> Floats:
        return frame_of_faces([Surface.bare(points, faces if normals else None)])

    axes = frame(cloud @ R.T, outward @ R.T)
    assert np.abs(axes @ R).max(1).min() > np.cos(np.radians(1.0))
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) > 0.0
    sphere = rng.normal(size=(4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    assert (frame(cloud, outward) == np.eye(3)).all()
    assert (frame(sphere, sphere) == np.eye(3)).all()


def test_two_poses_show_the_plainest_joint_that_explains_them() -> None:
    """Part of the door would come to lie on something new by another motion as well."""
    (joint,) = bundled("washing_machine_0013", 2).joints
    assert joint.kind is JointKind.REVOLUTE
    assert joint.states[1] == pytest.approx(1.42, abs=0.01)


def test_where_joints_point_may_be_known() -> None:
    leaf = ((0.03, 0.44, 0.3), (0.05, 0.0, -0.08))
    states = np.array([0.0, 0.6, 1.2, 0.3, 0.9])[:, None]
    clouds = posed([(leaf, turn((0, 0, 1), (0.05, -0.22, 0)))], states)
    upright = {JointKind.REVOLUTE: np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])}
    (joint,) = discover(clouds, directions=upright).joints
    assert degrees_between(joint.axis, (0, 0, 1)) < 2.0
    across = {JointKind.REVOLUTE: np.array([[0.0, 1.0, 0.0]])}
    for joint in discover(clouds, kinds=[JointKind.REVOLUTE], directions=across).joints:
        assert abs(joint.axis[1]) > np.cos(np.radians(35.0))


def filled(clear: Callable[[Floats], Floats], resolution: int = 48) -> np.ndarray:
    """The grid of a body and of a lid whose points `clear` brings back to where it is closed."""
    at = (np.indices((resolution,) * 3).reshape(3, -1).T + 0.5) / resolution - 0.5

    def inside(points: Floats, size: Sequence[float], centre: Sequence[float]) -> np.ndarray:
        return np.all(np.abs(points - centre) <= np.array(size) / 2, axis=1)

    return (inside(at, *BODY) | inside(clear(at), *LID)).reshape((resolution,) * 3)


def test_grids_are_as_good_as_clouds(tmp_path: Path) -> None:
    motion = turn((0, 1, 0), (0.05, 0.0, -0.22))
    angles = (0.0, 0.6, 1.1, 0.3)
    grids = [filled(lambda at, q=q: apply(motion(-q), at)) for q in angles]
    files = [tmp_path / f"{k}.npy" for k in range(len(grids))]
    for file, grid in zip(files, grids, strict=True):
        np.save(file, grid)
    done = run("discover", *files, "--json", tmp_path / "j")
    assert done.exit_code == 0, done.output
    (joint,) = json.loads((tmp_path / "j").read_text())["joints"]
    assert joint["kind"] == "revolute"
    assert "revolute" in done.output
    assert abs(joint["axis"][1]) > 0.999
    assert np.abs(np.array(joint["states"]) - angles).max() < 0.05
    (again,) = ag.discover(grids).joints
    assert again.states.tolist() == joint["states"]
    slides = ag.discover(grids, joints="prismatic").joints
    assert JointKind.REVOLUTE not in {joint.kind for joint in slides}


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        (["a.npy"], "one pose shows no motion"),
        (["a.npy", "a.npy"], "nothing moves"),
        (["a.npy", "b.npy"], "pose 1 has next to nothing where pose 0 has matter"),
        (["a.npy", "."], "give one data set or shard, or two or more clouds"),
        (["a.npy", "c.obj"], "neither a shard"),
        (["a.npy", "empty.npy"], "no voxel of the grid is occupied"),
        (["a.npy", "b.npy", "--joints", "screw"], "'screw': revolute, prismatic"),
        (["a.npy", "b.npy", "--poses", "2"], "--poses: give one data set's folder or shard"),
    ],
)
def test_the_command_says_what_is_wrong(files, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cloud = sampled(*BODY, np.random.default_rng(0), 500)
    np.save("a.npy", cloud)
    np.save("b.npy", cloud + 3.0)
    np.save("empty.npy", np.zeros((8, 8, 8), bool))
    done = run("discover", *files)
    assert done.exit_code == 1
    assert sentence in " ".join(done.output.split())


def test_a_data_set_is_judged_by_its_truth(tmp_path: Path) -> None:
    """Its lid carries a knob, which is a chain: two joints are there, the lid's is found."""
    data = write_boxes(tmp_path / "boxes", train=1, test=0, states=5)
    (one,) = discover_all(data)
    assert one.found is not None
    assert one.judged.turned is not None
    truth = ag.open(data)[0].joints[0]
    lid = max(one.found.joints, key=lambda joint: abs(joint.axis @ truth.axis))
    assert degrees_between(lid.axis * np.sign(lid.axis @ truth.axis), truth.axis) < 5.0
    assert axes_apart(lid, truth.axis, truth.pivot) < 0.05
    still = _judged(None, list(ag.open(data))).apart
    assert one.judged.apart is not None
    assert one.judged.apart < 0.5 * still  # the knob's is missing


def test_states_that_are_off_are_not_right() -> None:
    right = Judged(True, True, True, True, True, np.radians(1.0), None)
    off = replace(right, states=False, turned=np.radians(55.0))
    objects = [ObjectJoints(str(k), None, "", judged, 0.0) for k, judged in enumerate((right, off))]
    text = _summary(objects)
    assert text.startswith("2 objects, right in all joints: number 100%")
    assert "states within these 50%; states off by 28.00 degrees on average" in text
    assert _summary(objects[:1]).startswith("1 object, ")


def test_the_table_fits_a_narrow_terminal() -> None:
    axis, pivot = -np.ones(3) / np.sqrt(3), np.full(3, -0.45)
    joint = FoundJoint(JointKind.PRISMATIC, axis, pivot, np.array([-0.5, 0.5]), 0.5)
    turns = replace(joint, kind=JointKind.REVOLUTE, states=np.radians([-100.0, 100.0]))
    found = Discovery((joint, turns), np.zeros((9, 3)), np.ones(9, np.int64))
    console = Console(width=80)
    with console.capture() as shown:
        console.print(_table(found.joints))
    assert len(shown.get().strip().splitlines()) == 4


def test_the_same_poses_give_the_same_joints() -> None:
    clouds = posed([(LID, turn((0, 1, 0), (0.05, 0, -0.22)))], np.array([[0.0], [1.2]]))
    one, again = discover(clouds), discover(clouds)
    assert np.array_equal(one.part, again.part)
    for a, b in zip(one.joints, again.joints, strict=True):
        assert np.array_equal(a.states, b.states)
        assert np.array_equal(a.axis, b.axis)


def test_what_cannot_be_searched_is_said() -> None:
    clouds = posed([(LID, slide((1.0, 0, 0)))], np.array([[0.0], [0.3]]))
    with pytest.raises(InvalidArgument, match="1 pose of the object, which shows no motion"):
        discover(clouds[:1])
    with pytest.raises(InvalidArgument, match=r"nothing moves: .* is, to 0\.\d+, .* finer grids"):
        discover([clouds[0], clouds[0]])
    row = Row(lambda _: [], [])
    with pytest.raises(InvalidArgument, match=r"a Row is no pose; .* \[row.surface.points for row"):
        ag.discover([row, row])  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidArgument, match="pose 1 has next to nothing where pose 0"):
        discover([clouds[0], clouds[1] + 5.0])
    with pytest.raises(InvalidArgument, match="pose 1: numbers of shape"):
        discover([clouds[0], clouds[1][:, :2]])
    with pytest.raises(InvalidArgument, match="pose 0: has 10 points, too few"):
        discover([clouds[0][:10], clouds[1]])
    out = [cloud / np.linalg.norm(cloud, axis=1, keepdims=True) for cloud in clouds[:2]]
    out[1][3] = np.nan
    with pytest.raises(InvalidArgument, match=r"normals of pose 1: 1 points are not finite"):
        discover(clouds[:2], normals=out)
    with pytest.raises(InvalidArgument, match=r"pose 1: .* points are not finite"):
        discover([clouds[0], np.where(clouds[1] > 0.2, np.nan, clouds[1])])
