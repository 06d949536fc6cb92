"""Recordings in their published layouts: bundled laptops on a table, seen by our cameras."""

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from articugen.core.arrays import Floats, Ints
from articugen.core.errors import InvalidSource
from articugen.core.geometry import apply, invert_rigid, look_along, rotation_about, transform
from articugen.core.recipe import load_recipe
from articugen.core.records import JointKind, JointState, LabelledMesh, Views
from articugen.evaluation.reconstruction import PartJoints, labelled_points
from articugen.evaluation.recorded import read_recording
from articugen.evaluation.recorded.frames import (
    BACKGROUND,
    Posed,
    Recording,
    into_unit_frame,
    measured,
)
from articugen.instance.articulation import resolve
from articugen.instance.preparing import Prepared, prepare
from articugen.instance.sampling import as_kinect
from articugen.rendering.rasterizer import render
from tests.procedural_truth import object_id, written

METRES = 0.4  # of the unit frame's edge
FRAMES = 4
START = datetime(2016, 10, 28, 12, tzinfo=timezone.utc).timestamp()
CHAIN = ("map", "AsusXtionCameraFrame", "camera_link", "camera_rgb_frame")


@dataclass(frozen=True, eq=False)
class Scene:
    """What was recorded: one laptop in several states on a table, a camera that moves.

    Attributes:
        T_map_unit: from unit-frame points times METRES to the room.
        T_map_camera: (F, 4, 4).
        motion: (F, 2, 4, 4) of the parts, metres.
        depth, part: (F, H, W) metres, 0 for none; the part that is seen, BACKGROUND for the table.
    """

    prepared: Prepared
    intrinsics: tuple[float, float, float, float]
    T_map_unit: Floats
    T_map_camera: Floats
    states: Floats
    motion: Floats
    depth: Floats
    part: Ints

    def camera_from_parts(self, frame: int) -> Floats:
        """(2, 4, 4) from the frame in which the parts' meshes are."""
        return invert_rigid(self.T_map_camera[frame]) @ self.T_map_unit @ self.motion[frame]

    def vertices(self, part: int) -> tuple[Floats, Ints]:
        mesh = self.prepared.mesh
        faces = mesh.faces[mesh.part_of_face == part]
        used, faces = np.unique(faces, return_inverse=True)
        return mesh.vertices[used] * METRES, faces.reshape(-1, 3)


def scene(
    folder: Path, k: int, intrinsics: tuple[float, float, float, float], *, noisy: bool = False
) -> Scene:
    recipe = load_recipe(None, "laptop").with_options(states=60)
    name = object_id("laptop", k)
    raw, _ = written("laptop", name, folder / name)
    prepared = prepare(resolve(raw, recipe.articulation), recipe, seed=0)
    rng = np.random.default_rng(k)
    states = np.radians([20.0, 50.0, 80.0, 110.0])
    fx, fy, cx, cy = intrinsics
    T_map_unit = transform(rotation_about([2 / 7, -3 / 7, 6 / 7], 0.7), [0.5, 1.0, 0.2])
    cameras, motions, depths, parts = [], [], [], []
    for state in states:
        motion = prepared.material(JointState(np.array([state]))).part_motion
        mesh = prepared.mesh.moved(motion)
        floor = prepared.mesh.vertices[:, 2].min() - 1e-3
        table = np.array(
            [[-0.9, -0.9, floor], [0.9, -0.9, floor], [0.9, 0.9, floor], [-0.9, 0.9, floor]]
        )
        corners = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + len(mesh.vertices)
        scenery = LabelledMesh(
            np.concatenate([mesh.vertices, table]),
            np.concatenate([mesh.faces, corners]),
            np.append(mesh.part_of_face, np.array([2, 2], np.uint8)),
        )
        way = np.array([1.0, rng.uniform(-0.5, 0.5), -rng.uniform(0.6, 1.0)])
        way /= np.linalg.norm(way)
        T = look_along(way[None], -1.9 * way[None])
        views = Views(
            "pinhole", T, *(np.array([x]) for x in (fx, fy, cx + 0.5, cy + 0.5)), 640, 480
        )
        maps = render(scenery, views)
        depth, face = maps.depth[0].astype(np.float64), maps.face[0]
        if noisy:
            depth, face = as_kinect(depth, face, METRES, rng=rng)
        part = np.append(scenery.part_of_face, 3)[face].astype(int)
        depths.append(np.where(face >= 0, METRES * depth, 0.0))
        parts.append(np.where(part < 2, part, BACKGROUND))
        T_unit_camera = invert_rigid(T[0])
        T_unit_camera[:3, 3] *= METRES
        cameras.append(T_map_unit @ T_unit_camera)
        in_metres = motion.copy()
        in_metres[:, :3, 3] *= METRES
        motions.append(in_metres)
    return Scene(
        prepared, intrinsics, T_map_unit, np.array(cameras), states, np.array(motions),
        np.array(depths), np.array(parts),
    )  # fmt: skip


def quaternion(R: Floats) -> Floats:
    w, x, y, z = trimesh.transformations.quaternion_from_matrix(transform(R))
    return np.array([x, y, z, w])


def write_rbo(made: Scene, root: Path) -> Path:
    """Write a sequence and its model; parts' meshes and markers have frames of their own."""
    rng = np.random.default_rng(7)
    model, sequence = root / "objects" / "laptop", root / "interactions" / "laptop" / "laptop01_o"
    (sequence / "camera_depth_registered").mkdir(parents=True)
    (model / "meshes").mkdir(parents=True)
    lines, T_part_marker = [], []
    for part in range(2):
        to_mesh = transform(rotation_about([0, 0, 1], 0.3), [0.1, 0, 0])
        angles = rng.uniform(-1, 1, 3)
        xyz = rng.uniform(-0.1, 0.1, 3)
        turn = [rotation_about(np.eye(3)[k], angles[k]) for k in range(3)]
        to_marker = transform(turn[2] @ turn[1] @ turn[0], xyz)
        points, faces = made.vertices(part)
        mesh = trimesh.Trimesh(apply(to_mesh, points), faces, process=False)
        mesh.export(model / "meshes" / f"part{part}.stl")
        text = " ".join(f"{x:.12f}" for x in xyz)
        rpy = " ".join(f"{x:.12f}" for x in angles)
        lines.append(f"<origin xyz='{text}' rpy='{rpy}'/>")
        T_part_marker.append(invert_rigid(to_marker @ to_mesh))
    for day, ids in {"2016-10-01": (5, 3), "2016-10-20": (3, 5), "2016-11-02": (5, 3)}.items():
        folder = model / f"configuration_{day}"
        folder.mkdir()
        (folder / "laptop_in.yaml").write_text(
            f'link_ids: {{{ids[1]}: "1", {ids[0]}: "0"}}\nlink_name_prefix: rb\n'
            f'meshes: {{rb0: "laptop/meshes/part0.stl", rb1: "laptop/meshes/part1.stl"}}\n'
            f'mesh_poses: {{rb0: "{lines[0]}", rb1: "{lines[1]}"}}\n'
        )
    fx, fy, cx, cy = made.intrinsics
    K = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    (sequence / "camera_depth_registered_camera_info.csv").write_text(
        ",".join(["%time", *(f"field.K{i}" for i in range(9))]) + "\n" + ",".join(map(str, [0, *K]))
    )
    fixed = [
        transform(rotation_about([2 / 3, -1 / 3, 2 / 3], rng.uniform(0, 3)), rng.normal(size=3))
        for _ in range(3)
    ]
    bodies, tf = [], []
    for frame in range(FRAMES):
        seconds = START + frame
        name = f"{frame:05d}-{seconds:.6f}.txt"
        depth = np.where(made.depth[frame] > 0.0, made.depth[frame], np.nan)
        np.savetxt(sequence / "camera_depth_registered" / name, depth, fmt="%.6f")
        stamp = int(1e9 * (seconds + 0.01))
        poses = [
            made.T_map_unit @ made.motion[frame][part] @ T_part_marker[part] for part in range(2)
        ]
        rows = [[i, *T[:3, 3], *quaternion(T[:3, :3])] for i, T in zip((3, 5), poses, strict=True)]
        bodies.append([stamp, *rows[1], *rows[0]])
        first = made.T_map_camera[frame] @ invert_rigid(fixed[0] @ fixed[1] @ fixed[2])
        tf.append([CHAIN[0], "/" + CHAIN[1], stamp, *first[:3, 3], *quaternion(first[:3, :3])])
    ends = (*CHAIN[1:], "camera_rgb_optical_frame")
    for of, to, T in zip(ends[:-1], ends[1:], fixed, strict=True):  # seldom, and never moves
        tf.append([of, to, int(1e9 * (START - 9)), *T[:3, 3], *quaternion(T[:3, :3])])
    pose = [f"position.{k}" for k in "xyz"] + [f"orientation.{k}" for k in "xyzw"]
    header = ["%time"]
    for slot in range(2):
        header += [f"field.markers{slot}.id", *(f"field.markers{slot}.pose.{x}" for x in pose)]
    write_table(sequence / "rb_poses_array.csv", header, bodies)
    p = "field.transforms0."
    header = [f"{p}header.frame_id", f"{p}child_frame_id", f"{p}header.stamp"]
    header += [f"{p}transform.translation.{k}" for k in "xyz"]
    header += [f"{p}transform.rotation.{k}" for k in "xyzw"]
    write_table(sequence / "tf.csv", header, tf)
    return sequence


def write_table(path: Path, header: list[str], rows: list[list]) -> None:
    path.write_text("\n".join(",".join(map(str, row)) for row in [header, *rows]) + "\n")


def write_aod(made: Scene, root: Path) -> Path:
    sequence = root / "test" / "Laptop_Seq_1"
    for name in ("depth_filled", "mask", "info"):
        (sequence / name).mkdir(parents=True)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    for frame in range(FRAMES):
        number = f"{frame:05d}"
        depth = np.rint(1000.0 * made.depth[frame]).astype(np.uint16)
        Image.fromarray(depth).save(sequence / "depth_filled" / f"{number}.png")
        for part, T in enumerate(flip @ made.camera_from_parts(frame)):
            mask = (made.part[frame] == part).astype(np.uint8)
            Image.fromarray(mask).save(sequence / "mask" / f"{number}_{part:03d}.png")
            rows = "\n".join(" ".join(f"{x:.9f}" for x in row) for row in T[:3, :3])
            place = " ".join(f"{x:.9f}" for x in T[:3, 3])
            (sequence / "info" / f"info_{number}_{part:03d}.txt").write_text(
                f"image size\n640 480\nLaptop_Seq_1\nrotation:\n{rows}\ncenter:\n{place}\n"
                "extent:\n0.3 0.2 0.02\n"
            )
    return sequence


def write_opalign(made: Scene, root: Path) -> Path:
    """As the authors' files are: whole images, of which some was detected."""
    fx, fy, cx, cy = made.intrinsics
    for frame in range(FRAMES):
        z = made.depth[frame]
        v, u = np.mgrid[: z.shape[0], : z.shape[1]]
        T, seen = made.camera_from_parts(frame), made.part[frame].ravel() + 1
        joint = [*apply(T[0], np.zeros(3)), *T[0, :3, 1]]
        view = {
            "pc": np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1).reshape(-1, 3),
            "color": np.zeros((z.size, 3), np.uint8),
            "detection": (z > 0.0).ravel(),
            "segmentation": seen,
            "part": np.stack([[*pose[:3, :3].ravel(), *pose[:3, 3], 1, 1, 1] for pose in T]),
            "joint": np.array([joint]),
        }
        (root / "laptop" / f"{frame:04d}" / "input_2").mkdir(parents=True)
        np.savez(root / "laptop" / f"{frame:04d}" / "input_2" / "00.npz", view)
    return root / "laptop"


LAYOUTS = {
    "opalign": (write_opalign, (525.0, 525.0, 319.5, 239.5)),
    "rbo": (write_rbo, (525.0, 525.0, 319.5, 239.5)),
    "aod": (write_aod, (540.0, 540.0, 323.65, 479 - 240.81)),
}


@dataclass(frozen=True, eq=False)
class Recorded:
    scene: Scene
    folder: Path
    noisy: bool

    @cached_property
    def recording(self) -> Recording:
        return read_recording(self.folder, 10)


@pytest.fixture(scope="module", params=["rbo", "aod", "opalign", "noisy rbo", "noisy aod"])
def recorded(request, tmp_path_factory) -> Recorded:
    noisy, name = request.param.startswith("noisy"), request.param.removeprefix("noisy ")
    write, intrinsics = LAYOUTS[name]
    folder = tmp_path_factory.mktemp(name)
    made = scene(folder, 3, intrinsics, noisy=noisy)
    return Recorded(made, write(made, folder / "recorded"), noisy)


@pytest.fixture(scope="module")
def copied(tmp_path_factory) -> Callable[[str], Path]:
    """Makes a copy of a layout's recording, to do harm to: its sequence."""
    root = tmp_path_factory.mktemp("whole")
    made = scene(root, 3, LAYOUTS["aod"][1])
    paths = {n: write(made, root / n).relative_to(root / n) for n, (write, _) in LAYOUTS.items()}
    return lambda n: shutil.copytree(root / n, tmp_path_factory.mktemp(n) / n) / paths[n]


def test_a_recording_is_read_as_it_was_made(recorded):
    made = recorded.scene
    fx, fy, cx, cy = made.intrinsics
    assert len(recorded.recording.frames) == FRAMES
    for number, frame in enumerate(recorded.recording.frames):
        i, j = np.nonzero(made.depth[number])
        z, true = made.depth[number][i, j], made.part[number][i, j]
        points = np.stack([(j - cx) / fx * z, (i - cy) / fy * z, z], axis=1)
        np.testing.assert_allclose(frame.points, points, atol=6e-4)
        assert np.mean(frame.part == true) > (0.999 if recorded.noisy else 0.9999)
        for part in range(2):
            local = apply(invert_rigid(frame.T_camera_part[part]), points[true == part][::5])
            far = cKDTree(recorded.recording.surfaces[part]).query(local)[0]
            assert np.mean(far < 0.015) > 0.98


def test_points_come_into_the_data_sets_frame(recorded):
    """Its box is that of the states that were drawn, here it is that of 0 to 135 degrees."""
    made = recorded.scene
    for number, one in enumerate(into_unit_frame(recorded.recording)):
        assert np.degrees(abs(one.state - made.states[number])) < 0.5
        frame = recorded.recording.frames[number]
        T_unit_camera = invert_rigid(made.T_map_unit) @ made.T_map_camera[number]
        true = apply(T_unit_camera, frame.points[frame.part != BACKGROUND]) / METRES
        if recorded.noisy:  # a few points may have left the cube
            true = true[cKDTree(true).query(one.points)[1]]
        assert np.abs(one.points - true).max() < 0.03


def test_the_truth_scores_as_such(recorded):
    posed = into_unit_frame(recorded.recording)

    def predicted(one: Posed, *, state: float = 0.0, tilt: float = 0.0, shift: float = 0.0):
        y = np.array([np.sin(tilt), np.cos(tilt), 0.0])
        kinds = np.array([JointKind.FIXED, JointKind.FIXED, JointKind.REVOLUTE])
        joints = PartJoints(
            kinds, np.array([0.0, 0.0, 0.3 + one.state + state * one.state]),
            np.tile(one.pivot + np.array([shift, 7.0, 0.0]), (3, 1)), np.tile(y, (3, 1)),
        )  # fmt: skip
        return labelled_points(one.points, 2 * one.part, 3, joints=joints)

    labels, _, right = measured(posed, [predicted(one) for one in posed])
    assert labels.tolist() == [0, -1, 1]
    assert right == pytest.approx(
        {"label_iou": 1.0, "direction_degrees": 0.0, "pivot": 0.0, "state_degrees": 0.0}, abs=1e-9
    )
    some = [predicted(p, state=0.1, tilt=np.radians(3), shift=0.05) for p in posed]
    off = measured(posed, some)[2]
    turned = np.degrees([one.state for one in posed])
    assert off["direction_degrees"] == pytest.approx(3.0)
    assert off["state_degrees"] == pytest.approx(0.1 * np.mean(turned - turned.min()))
    still = measured(posed, [labelled_points(p.points, 0 * p.part, 3) for p in posed])[2]
    assert still["label_iou"] < 0.5
    assert np.isnan(still["state_degrees"])


RBO_MODEL = "../../../objects/laptop/*-10-20/*"
"""The file that describes the laptop, from the sequence's folder."""


def broken(folder: Path, name: str, old: str, new: str) -> None:
    path = next(folder.glob(name))
    path.write_text(re.sub(old, new, path.read_text()))


@pytest.mark.parametrize(
    ("layout", "name", "old", "new", "reason"),
    [
        ("rbo", "tf.csv", "/AsusXtionCameraFrame", "other", "no image has a pose of every part"),
        ("rbo", "tf.csv", "child_frame_id", "child", "has no column field.transforms0.child_frame"),
        ("rbo", "rb_poses_array.csv", "\n[^,]*,5,", "\n1,6,", "has no marker 5"),
        ("rbo", "rb_poses_array.csv", "\n[^,]*,5,", "\nx,5,", "holds what is no number"),
        ("rbo", "rb_poses_array.csv", "\n[^,]*,5,", "\n9,5,", "no image has a pose of every part"),
        ("rbo", "rb_poses_array.csv", "(?s)\n.*", "", "holds no row"),
        ("rbo", "camera_depth*/*.txt", "^[^ ]*", "deep", "no rows of metres"),
        ("rbo", RBO_MODEL, "rb0:", "rb7:", "not what describes a laptop"),
        ("rbo", RBO_MODEL, "laptop/meshes", "../..", "not what describes"),
        ("rbo", RBO_MODEL, "part0", "part7", "part7.stl"),
        ("rbo", RBO_MODEL, '"1"', ".inf", "not what describes"),
        ("rbo", RBO_MODEL, "xyz='[^ ]*", "xyz='1e300", "rb0 is far away"),
        ("rbo", "camera_depth*/*.txt", "(?s).+", "", "it is empty"),
        ("rbo", "*_info.csv", ",[1-9][^,]*,0", ",0,0", "no focal lengths and centre"),
        ("rbo", "rb_poses_array.csv", "\n", "\rx\n", "no table"),
        ("rbo", "rb_poses_array.csv", ",5,[^,]*", ",5,1e300", "no image has a pose of every part"),
        ("rbo", "rb_*.csv", r"(?<=\d),[^,\n]*\n", ",inf\n", "no image has a pose of every part"),
        ("aod", "info/*_000.txt", "center:\n[^ ]*", "center:\nnan", "no pose"),
        ("aod", "info/*_000.txt", "center:\n[^ ]*", "center:\n1e300", "no pose"),
        ("aod", "info/*_000.txt", "center:\n[^ ]*", "center:\nx", "no pose"),
        ("aod", "info/*_000.txt", "center:\n[^ ]* ", "center:\n", "no pose"),
        ("aod", "mask/*_001.png", "", "", "no picture of depths or parts"),
        ("opalign", "0001/*/*.npz", "", "", "00.npz: no view of a laptop"),
    ],
)
def test_what_is_broken_is_refused_in_a_sentence(layout, name, old, new, reason, copied):
    folder = copied(layout)
    if name.endswith((".png", ".npz")):
        next(folder.glob(name)).write_bytes(b"\x89PNG\r\n\x1a\n")
    else:
        broken(folder, name, old, new)
    with pytest.raises(InvalidSource, match=reason):
        read_recording(folder, 10)


@pytest.mark.parametrize("seconds", ["nan", "1e30", "soon"])
def test_a_name_that_is_no_time_is_refused(seconds, tmp_path):
    folder = tmp_path / "objects" / "laptop" / "laptop01_o"
    (folder / "camera_depth_registered").mkdir(parents=True)
    (folder / "camera_depth_registered" / f"0-{seconds}.txt").write_text("1")
    with pytest.raises(InvalidSource, match="its name is not <index>-<seconds>"):
        read_recording(folder, 10)


def test_an_image_of_nothing_near_has_no_points_of_parts(copied):
    folder = copied("rbo")
    path = min(folder.glob("camera_depth*/*.txt"))
    path.write_text("\n".join(["900 " * 640] * 480))
    assert set(read_recording(folder, 10).frames[0].part) == {BACKGROUND}


def test_images_without_a_part_are_left_out(copied):
    folder = copied("aod")
    (folder / "info" / "info_00001_001.txt").write_text("")
    recording = read_recording(folder, 10)
    assert len(recording.frames) == FRAMES - 1
    still = replace(recording, frames=recording.frames[:1] * 3)
    with pytest.raises(InvalidSource, match=r"turns by 0\.0 degrees"):
        into_unit_frame(still)
    with pytest.raises(InvalidSource, match="no sequence of RBO"):
        read_recording(folder / "info", 10)
