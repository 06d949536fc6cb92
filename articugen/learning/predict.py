"""Predictions: clouds out of the shards of a data set, and the rigged models that are made of one:
what is reconstructed, and what was given, cut into the parts."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from articugen.core.colours import colour_of, linear, rgb
from articugen.core.errors import ArticugenError, InvalidSource, UnfitData
from articugen.core.files import make_folder, write_atomically
from articugen.core.records import Floats, JointKind, Normalization, dequantize
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.evaluation.figures import Names, solid_of
from articugen.evaluation.metrics import nearest_part_of
from articugen.evaluation.reconstruction import PartJoints, Reconstruction, labelled_points
from articugen.meshes.glb import Drawn, Moving, Part, glb_of
from articugen.meshes.model_text import Joint, Visual, obj_text, urdf_text
from articugen.meshes.points import UNIT, Cloud, checked
from articugen.pictures.layout import Row, save, sheet
from articugen.pictures.portrait import solid_portrait, tile_camera
from articugen.store.shards import open_shard

_CUTS, _SMALLEST = 6, 0.01
"""A triangle that parts share is quartered so often, unless its edges are shorter than that."""

_AT_ONCE = 1 << 18  # points, a second or two

_AZIMUTH = math.radians(35.0)

_SHARES = {"state 0": 0.0, "as given": None, "open": 1.0}
"""How pictures show joints, as `_at` takes it."""

_SHOWN = {JointKind.REVOLUTE: math.pi / 2.0, JointKind.PRISMATIC: 0.3}
"""Animations show joints from state 0 to where the cloud has them, or to here if it is farther."""


def cloud_of_shard(
    path: Path, row: int = 0, *, category: str | None = None, camera: int | None = None
) -> Cloud:
    """Return the surface points of a shard's instance.

    Args:
        category: what the shard must be of.
        camera: what this depth camera sees instead.

    Raises:
        CorruptShard: it cannot be read.
        InvalidSource: it is of another category, or has no such row or camera.
    """
    with open_shard(path) as shard:
        have = shard.attributes["category"]
        if category is not None and have != category:
            raise InvalidSource(f"{path}: holds {have}, the model is of {category}")
        if row >= len(shard):
            raise InvalidSource(f"{path}: has {len(shard)} instances, from 0; there is no {row}")
        cameras = shard.fields["partial_points"][1]
        if camera is not None and camera >= cameras:
            raise InvalidSource(f"{path}: has {cameras} cameras, from 0; there is no {camera}")
        name, at = ("surface_points", ...) if camera is None else ("partial_points", camera)
        return Cloud(checked(dequantize(shard.read(name, row)[at]), str(path)))


def seen_by_a_camera(instance: Instance) -> Floats:
    """Return (M, 3) what one of the instance's depth cameras sees, always the same one.

    Raises:
        UnfitData: it has none.
    """
    cameras = len(instance.partial_points)
    if not cameras:
        raise UnfitData(
            f"{instance.object_id}: has no partial clouds; set sampling.partial_views and make the "
            "data set again"
        )
    chosen = generator(0, "camera", instance.object_id, instance.state_index).integers(cameras)
    return dequantize(instance.partial_points[chosen])


def cut(
    cloud: Cloud, shape: Reconstruction, on_progress: Callable[[str], None] = lambda _: None
) -> Reconstruction:
    """Return the input instead of the reconstructed surfaces: labelled points, or the
    triangles of a mesh, each of the part whose surface is nearest. Triangles that parts share are
    cut small first. `on_progress` is called with how many points are done, of how many."""

    def part_of(points: Floats) -> NDArray[np.int64]:
        part = np.empty(len(points), np.int64)
        for at in range(0, len(points), _AT_ONCE):
            on_progress(f"cutting: {at:,} of {len(points):,} points")
            some = slice(at, at + _AT_ONCE)
            part[some] = nearest_part_of(shape, points[some])
        return part

    if cloud.triangles is None:
        known = {"T_part": shape.T_part, "joints": shape.joints}
        return labelled_points(cloud.points, part_of(cloud.points), shape.parts, **known)
    rest, pieces = cloud.triangles, list[Floats]()
    for _ in range(_CUTS):
        if not len(rest):
            break
        corners = part_of(rest.reshape(-1, 3)).reshape(-1, 3)
        edge = np.linalg.norm(rest - np.roll(rest, 1, axis=1), axis=2).max(1)
        is_shared = (corners != part_of(rest.mean(1))[:, None]).any(1) & (edge > _SMALLEST)
        pieces.append(rest[~is_shared])
        a, b, c = np.moveaxis(rest[is_shared], 1, 0)
        ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        rest = np.concatenate([np.stack(corners, 1) for corners in quarters])
    triangles = np.concatenate([*pieces, rest])
    return replace(shape, triangles=triangles, part=part_of(triangles.mean(1)), labelling=None)


def write_cut(pieces: Reconstruction, folder: Path, frame: Normalization = UNIT) -> list[Path]:
    """Write what `cut` returns: input.glb, in which each joint is an animation, and, of a mesh,
    input.urdf; `frame` as in `write_rig`."""
    is_mesh, joints, parts = pieces.whole is not None, pieces.joints, list[Part]()
    for i in range(pieces.parts):
        corners = frame.to_world(pieces.triangles[pieces.part == i])
        if i and not len(corners):
            continue
        kind = joints.kind[i] if joints else JointKind.FIXED
        origin, how = frame.center, None
        if joints and kind != JointKind.FIXED:
            origin = frame.to_world(joints.pivot[i])
            moving = _moving(joints, i, origin, frame.scale)
            unit = 1.0 if kind == JointKind.REVOLUTE else frame.scale
            most = max(moving.lower + _SHOWN[JointKind(kind)] * unit, 0.0)
            how = Moving(moving.name, moving.kind, np.asarray(moving.axis), moving.lower, most)
        vertices, faces = _welded(corners) if is_mesh else (corners[:, 0], None)
        drawn = [Drawn(linear(colour_of(i)), faces)]
        parts.append(Part(f"part_{i}", 0, origin, vertices, drawn, how))
    write_atomically(folder / "input.glb", glb_of("input", parts))
    if not is_mesh:
        return [folder / "input.glb"]
    return [folder / "input.glb", write_rig(pieces, folder, "input", frame, "input_")]


def draw_cut(pieces: Reconstruction, whole: Reconstruction, path: Path) -> Path:
    """Draw what is reconstructed, and below what was given, as `cut` returns it: with all joints at
    state 0, as they are, and open."""
    names = Names(range(whole.parts), range(whole.parts))
    shares = _SHARES if whole.joints else {"as given": None}
    posed = [[_at(shape, share) for share in shares.values()] for shape in (whole, pieces)]
    corners = np.concatenate([shape.triangles[:, 0] for row in posed for shape in row])
    camera, floor = tile_camera(corners, _AZIMUTH), float(pieces.triangles[..., 2].min())
    captions = [[(name, colour_of(0))] for name in shares]
    rows = [
        Row(title, [solid_portrait(solid_of(s, names), camera, floor) for s in shapes], captions)
        for title, shapes in zip(("reconstruction", "what was given"), posed, strict=True)
    ]
    save(sheet(rows), path)
    return path


def _at(shape: Reconstruction, share: float | None) -> Reconstruction:
    """Return the shape with its joints at this share of what animations show; None is as it is."""
    if share is None or shape.joints is None:
        return shape
    most = np.array([_SHOWN.get(JointKind(kind), 0.0) for kind in shape.joints.kind])
    open_ = np.maximum(most, shape.joints.state)
    motion = shape.joint_motion_to(
        replace(shape, joints=replace(shape.joints, state=share * open_))
    )
    assert motion is not None
    R, t = motion[shape.part, :3, :3], motion[shape.part, :3, 3]
    return replace(shape, triangles=np.einsum("fij,fkj->fki", R, shape.triangles) + t[:, None])


def _welded(triangles: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return vertices and faces of triangles (F, 3, 3)."""
    vertices, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, faces.reshape(-1, 3)


def write_rig(
    shape: Reconstruction, folder: Path, name: str = "predicted", frame: Normalization = UNIT,
    prefix: str = "",
) -> Path:  # fmt: skip
    """Write <prefix>part_<i>.obj and <name>.urdf; every joint is 0 where the cloud has it.

    The base link is part 0, or an empty one where that has no surface. A part's link sits at its
    pivot; limits reach from joint state 0 to pi (revolute) or to 1 unit (prismatic). Where a method
    knows no joints, all parts are fixed to the base.

    Args:
        frame: where the rig is to stand, and its scale; the unit frame if not given.

    Raises:
        ArticugenError: there is no surface at all, or (MachineFault) the folder cannot be written
            to.
    """
    if shape.whole is None:
        raise ArticugenError(
            f"{folder}: this model's method labels points and makes no surface, so there are no "
            "meshes; `articugen evaluate` measures it"
        )
    if not len(shape.triangles):
        raise ArticugenError(f"{folder}: the model sees no surface in this cloud; nothing to write")
    make_folder(folder)
    if not prefix and (folder / f"{name}.urdf").is_file():  # an earlier prediction's
        for old in ("part_[0-9]*.obj", "input_part_[0-9]*.obj", "input.urdf"):
            for path in folder.glob(old):
                path.unlink()
    links: dict[str, list[Visual]] = {}
    joints = []
    for i in range(shape.parts):
        link = f"part_{i}"
        triangles = frame.to_world(shape.triangles[shape.part == i])
        if i and not len(triangles):
            continue
        kind = shape.joints.kind[i] if shape.joints else JointKind.FIXED
        origin = np.zeros(3)
        if shape.joints and kind == JointKind.REVOLUTE:
            origin = frame.to_world(shape.joints.pivot[i])
        links[link] = []
        if len(triangles):
            file = f"{prefix}{link}.obj"
            write_atomically(folder / file, obj_text([_welded(triangles - origin)]).encode())
            red, green, blue = rgb(colour_of(i))
            links[link] = [Visual(file, rgba=(red / 255.0, green / 255.0, blue / 255.0, 1.0))]
        if shape.joints and kind != JointKind.FIXED:
            joints.append(_moving(shape.joints, i, origin, frame.scale))
        elif i:
            joints.append(Joint(f"joint_{i}", "fixed", "part_0", link, origin))
    path = folder / f"{name}.urdf"
    write_atomically(path, urdf_text(name, links, joints).encode())
    return path


def _moving(joints: PartJoints, i: int, origin: Floats, unit: float) -> Joint:
    revolute = joints.kind[i] == JointKind.REVOLUTE
    state = float(joints.state[i]) * (1.0 if revolute else unit)
    most = math.pi if revolute else unit
    return Joint(
        name=f"joint_{i}",
        kind=str(JointKind(joints.kind[i])),
        parent="part_0",
        child=f"part_{i}",
        origin=origin,
        axis=joints.direction[i] / np.linalg.norm(joints.direction[i]),
        lower=min(-state, 0.0),
        upper=max(most - state, 0.0),
    )
