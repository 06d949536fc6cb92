"""A rigged model from one cloud: a mesh a part, and a URDF whose joints are the predicted ones."""

import math
from pathlib import Path

import numpy as np

from articugen.core.colours import colour_of
from articugen.core.errors import ArticugenError
from articugen.core.files import write_atomically
from articugen.core.records import Floats, JointKind, Normalization
from articugen.learning.evaluation.reconstruction import PartJoints, Reconstruction
from articugen.meshes.model_text import Joint, Visual, obj_text, urdf_text
from articugen.meshes.points import UNIT


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
            write_atomically(folder / f"{link}.obj", _obj(triangles - origin).encode())
            links[link] = [Visual(f"{link}.obj", rgba=_rgba(colour_of(i)))]
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


def _rgba(colour: str) -> tuple[float, float, float, float]:
    red, green, blue = (int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return red, green, blue, 1.0


def _obj(triangles: Floats) -> str:
    vertices, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return obj_text([(vertices, faces.reshape(-1, 3))])
