"""Predictions: clouds out of the shards of a data set, and the rigged model that is made of one, a
mesh a part and a URDF whose joints are the predicted ones."""

import math
from pathlib import Path

import numpy as np

from articugen.core.colours import colour_of
from articugen.core.errors import ArticugenError, InvalidSource, UnfitData
from articugen.core.files import write_atomically
from articugen.core.records import Floats, JointKind, Normalization, dequantize
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.evaluation.reconstruction import PartJoints, Reconstruction
from articugen.meshes.model_text import Joint, Visual, obj_text, urdf_text
from articugen.meshes.points import UNIT, Cloud, checked
from articugen.store.shards import open_shard


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


def write_rig(
    found: Reconstruction, folder: Path, name: str = "predicted", frame: Normalization = UNIT
) -> Path:
    """Write part_<i>.obj and <name>.urdf; every joint is 0 where the cloud has it.

    The base link is part 0, or an empty one where that has no surface. A part's link sits at its
    pivot; limits reach from joint state 0 to pi (revolute) or to 1 unit (prismatic). Where a method
    knows no joints, all parts are fixed to the base.

    Args:
        frame: where the rig is to stand, and its scale; the unit frame if not given.

    Raises:
        ArticugenError: there is no surface at all, or the folder cannot be written to.
    """
    if found.whole is None:
        raise ArticugenError(
            f"{folder}: this model's method labels points and makes no surface, so there are no "
            "meshes; `articugen evaluate` measures it"
        )
    if not len(found.triangles):
        raise ArticugenError(f"{folder}: the model sees no surface in this cloud; nothing to write")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArticugenError(f"{folder}: cannot be made ({error.strerror})") from None
    links: dict[str, list[Visual]] = {}
    joints = []
    for i in range(found.parts):
        link = f"part_{i}"
        triangles = frame.to_world(found.triangles[found.part == i])
        if i and not len(triangles):
            continue
        kind = found.joints.kind[i] if found.joints else JointKind.FIXED
        origin = np.zeros(3)
        if found.joints and kind == JointKind.REVOLUTE:
            origin = frame.to_world(found.joints.pivot[i])
        links[link] = []
        if len(triangles):
            corners = (triangles - origin).reshape(-1, 3)
            vertices, faces = np.unique(corners, axis=0, return_inverse=True)
            text = obj_text([(vertices, faces.reshape(-1, 3))])
            write_atomically(folder / f"{link}.obj", text.encode())
            red, green, blue = (int(colour_of(i)[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
            links[link] = [Visual(f"{link}.obj", rgba=(red, green, blue, 1.0))]
        if found.joints and kind != JointKind.FIXED:
            joints.append(_moving(found.joints, i, origin, frame.scale))
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
        lower=-state,
        upper=most - state,
    )
