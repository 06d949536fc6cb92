"""URDF: each object with watertight part meshes on its joints, for simulators and for us."""

from xml.etree import ElementTree as ET

import numpy as np

from articugen.export.assembly import Body, bodies, numbers, resistance, write_meshes
from articugen.export.formats import Format
from articugen.export.items import Item, of_objects
from articugen.export.target import Files

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def _write(item: Item, target: Files) -> None:
    parts = bodies(item, target)
    robot = ET.Element("robot", name=item.key.rpartition("/")[2])
    for part, body in enumerate(parts):
        link = ET.SubElement(robot, "link", name=body.name)
        solid = body.filled
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=numbers(solid.center_mass), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=numbers([solid.mass]))
        upper = zip(_MOMENTS, solid.moment_inertia[np.triu_indices(3)], strict=True)
        ET.SubElement(inertial, "inertia", {name: f"{moment:.12g}" for name, moment in upper})
        visuals, collisions = write_meshes(item, target, part, body)
        for mesh in (*visuals, *collisions):
            shape = ET.SubElement(link, "visual" if mesh in visuals else "collision")
            geometry = ET.SubElement(shape, "geometry")
            ET.SubElement(geometry, "mesh", filename=f"meshes/{mesh}.obj")
            if look := visuals.get(mesh):
                material = ET.SubElement(shape, "material", name=look.colour[1:])
                ET.SubElement(material, "color", rgba=numbers(look.rgba))
    for part in range(1, len(parts)):
        _add_joint(robot, part, parts)
    ET.indent(robot)
    text = ET.tostring(robot, encoding="utf-8", xml_declaration=True)
    target.write(f"{item.key}/{item.key.rpartition('/')[2]}.urdf", text + b"\n")


def _add_joint(robot: ET.Element, part: int, parts: tuple[Body, ...]) -> None:
    body, joint = parts[part], parts[part].joint
    assert joint is not None
    element = ET.SubElement(robot, "joint", name=joint.name, type=joint.kind)
    ET.SubElement(element, "parent", link=parts[joint.parent].name)
    ET.SubElement(element, "child", link=body.name)
    origin = numbers(body.place - parts[joint.parent].place)
    ET.SubElement(element, "origin", xyz=origin, rpy="0 0 0")
    ET.SubElement(element, "axis", xyz=numbers(joint.axis))
    limits = {"lower": numbers([joint.lower]), "upper": numbers([joint.upper])}
    ET.SubElement(element, "limit", {**limits, "effort": "10", "velocity": "10"})
    damping, friction = (f"{number:.6g}" for number in resistance(parts, part))
    ET.SubElement(element, "dynamics", damping=damping, friction=friction)


FORMAT = Format(
    "each object as a URDF with watertight part meshes, and convex ones with --collision",
    of_objects,
    _write,
    takes=("resolution", "from_grids", "collision"),
)
