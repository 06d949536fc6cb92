"""MJCF: each object for MuJoCo, with watertight part meshes on its joints.

Parts do not collide, unless convex ones are asked for: MuJoCo collides a mesh as its convex hull,
and a drawer would stick in the hull of its cabinet. Parts that share a joint never collide.
"""

from xml.etree import ElementTree as ET

import numpy as np

from articugen.export.assembly import (
    DENSITY,
    SURFACE_FRICTION,
    bodies,
    from_the_root,
    numbers,
    resistance,
    write_meshes,
)
from articugen.export.formats import Format
from articugen.export.items import Item, of_objects
from articugen.export.parts import unique
from articugen.export.target import Files

_WORLD = "world"  # MuJoCo's own body, whose name many URDFs give to their first link
_STOP = "0.01 1"
"""A stop gives way for half as long as MuJoCo's own, and so half as far, and does not bounce."""

_STUCK = "0.9999 0.9999 0.001"
"""Friction holds as hard as MuJoCo can: by its own .9 what leans creeps at a degree a second."""

_SEEN = {
    "type": "mesh", "contype": "0", "conaffinity": "0", "group": "2", "density": f"{DENSITY:g}",
}  # fmt: skip
_FELT = {
    "type": "mesh", "group": "3", "density": "0", "friction": f"{SURFACE_FRICTION:g} 0.005 0.0001",
}  # fmt: skip


def _write(item: Item, target: Files) -> None:
    parts = bodies(item, target)
    names = unique((_WORLD, *(body.name for body in parts)))[1:]
    name = item.key.rpartition("/")[2]
    root = ET.Element("mujoco", model=name)
    ET.SubElement(root, "compiler", angle="radian", meshdir="meshes", autolimits="true")
    assets = ET.SubElement(root, "asset")
    world = ET.SubElement(root, "worldbody")
    placed: dict[int, ET.Element] = {}
    for part in from_the_root(parts):
        body = parts[part]
        above, origin, joint = world, body.place, body.joint
        if joint is not None:
            above, origin = placed[joint.parent], origin - parts[joint.parent].place
        placed[part] = ET.SubElement(above, "body", name=names[part], pos=numbers(origin))
        if joint is not None:
            kind = "hinge" if joint.kind == "revolute" else "slide"
            damping, friction = (f"{number:.6g}" for number in resistance(parts, part))
            about = {"name": joint.name, "type": kind, "axis": numbers(joint.axis)}
            about |= {"range": numbers([joint.lower, joint.upper]), "solreflimit": _STOP}
            about |= {"damping": damping, "frictionloss": friction, "solimpfriction": _STUCK}
            ET.SubElement(placed[part], "joint", about)
        visuals, collisions = write_meshes(item, target, part, body, apart=True)
        whole = f"part_{part}" in visuals
        if not whole:  # its pieces enclose nothing
            tensor = body.filled.moment_inertia
            moments = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]
            stated = {"pos": numbers(body.filled.center_mass)}
            stated |= {"mass": numbers([body.filled.mass])}
            stated |= {"fullinertia": " ".join(f"{moment:.12g}" for moment in moments)}
            ET.SubElement(placed[part], "inertial", stated)
        for mesh, look in visuals.items():
            how = {"inertia": "exact" if whole else "shell"}
            ET.SubElement(assets, "mesh", {"name": mesh, "file": f"{mesh}.obj", **how})
            if look and look.picture is not None:
                file = f"meshes/{mesh}.png"
                ET.SubElement(assets, "texture", name=mesh, type="2d", file=file)
                ET.SubElement(assets, "material", name=mesh, texture=mesh)
                shown = {"material": mesh}
            else:
                shown = {"rgba": numbers(look.rgba)} if look else {}
            ET.SubElement(placed[part], "geom", {**_SEEN, "mesh": mesh, **shown})
        for mesh in collisions:
            ET.SubElement(assets, "mesh", {"name": mesh, "file": f"{mesh}.obj"})
            ET.SubElement(placed[part], "geom", {**_FELT, "mesh": mesh})
    contact = ET.SubElement(root, "contact")
    for part, body in enumerate(parts):
        if body.joint is not None:
            above = names[body.joint.parent]
            ET.SubElement(contact, "exclude", body1=above, body2=names[part])
    ET.indent(root)
    target.write(f"{item.key}/{name}.xml", ET.tostring(root, encoding="utf-8") + b"\n")


FORMAT = Format(
    "each object for MuJoCo, which collides with --collision",
    of_objects,
    _write,
    takes=("resolution", "from_grids", "collision"),
)
