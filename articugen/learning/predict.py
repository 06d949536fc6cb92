"""A rigged model from one cloud: a mesh a part, and a URDF whose joints are the predicted ones."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from articugen.errors import ArticugenError
from articugen.inspection.portrait import colour_of
from articugen.learning.clouds import UNIT
from articugen.learning.evaluation.reconstruction import (
    FIXED,
    KIND_NAMES,
    REVOLUTE,
    PartJoints,
    Reconstruction,
)
from articugen.records import Floats, Normalization
from articugen.store.files import write_atomically


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
    robot = ET.Element("robot", name=name)
    for i in range(found.parts):
        triangles = frame.to_world(found.triangles[found.part == i])
        if i and not len(triangles):
            continue
        kind = found.joints.kind[i] if found.joints else FIXED
        origin = np.zeros(3)
        if found.joints and kind == REVOLUTE:
            origin = frame.to_world(found.joints.pivot[i])
        link = ET.SubElement(robot, "link", name=f"part_{i}")
        if len(triangles):
            file = f"part_{i}.obj"
            write_atomically(folder / file, _obj(triangles - origin))
            visual = ET.SubElement(link, "visual")
            ET.SubElement(ET.SubElement(visual, "geometry"), "mesh", filename=file)
            material = ET.SubElement(visual, "material", name=f"part_{i}")
            ET.SubElement(material, "color", rgba=_rgba(colour_of(i)))
        if i:
            joint = ET.SubElement(robot, "joint", name=f"joint_{i}", type=KIND_NAMES[kind])
            ET.SubElement(joint, "parent", link="part_0")
            ET.SubElement(joint, "child", link=f"part_{i}")
            ET.SubElement(joint, "origin", xyz=_text(origin), rpy="0 0 0")
            if found.joints and kind != FIXED:
                _axis_and_limit(joint, found.joints, i, frame.scale)
    path = folder / f"{name}.urdf"
    ET.indent(robot)
    write_atomically(path, ET.tostring(robot, encoding="utf-8", xml_declaration=True) + b"\n")
    return path


def _axis_and_limit(joint: ET.Element, joints: PartJoints, i: int, unit: float) -> None:
    revolute = joints.kind[i] == REVOLUTE
    state = float(joints.state[i]) * (1.0 if revolute else unit)
    most = math.pi if revolute else unit
    axis = joints.direction[i] / np.linalg.norm(joints.direction[i])
    ET.SubElement(joint, "axis", xyz=_text(axis))
    lower, upper = f"{-state:.9g}", f"{most - state:.9g}"
    ET.SubElement(joint, "limit", lower=lower, upper=upper, effort="1", velocity="1")


def _rgba(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return f"{red:.3g} {green:.3g} {blue:.3g} 1"


def _text(vector: Floats) -> str:
    return " ".join(f"{x:.9g}" for x in vector)


def _obj(triangles: Floats) -> bytes:
    vertices, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    lines = [f"v {_text(v)}" for v in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces.reshape(-1, 3) + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()
