"""Any URDF to an `ArticulatedObject`. The only user of yourdfpy.

yourdfpy parses the tree that `urdf_check` found sound; shapes, paths, topological order, limits and
unit axes are ours, because there it is wrong or silent.
"""

import heapq
import io
import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from articugen.core.arrays import grouped
from articugen.core.errors import InvalidSource
from articugen.core.geometry import rotation_from_rpy, transform
from articugen.core.portable import norm
from articugen.core.records import ArticulatedObject, Floats, Joint, JointKind, Link, Mesh, Mimic
from articugen.meshes import read
from articugen.meshes.model_files import MAX_TEXT_BYTES, ModelFiles, quoted
from articugen.meshes.xml_strict import OLD_VERSION, tostring
from articugen.sources.folders import ending_in
from articugen.sources.refs import CategorySettings, ObjectRef
from articugen.sources.shapes import Shapes
from articugen.sources.urdf_check import checked_robot

_Shown = dict[str, list[tuple[Any, Floats]]]
"""By the name of each link its shapes (lxml) and where they stand in it, (4, 4)."""


def load_urdf(
    path: Path,
    *,
    object_id: str,
    category: str,
    source: str = "",
    root: Path | None = None,
    top: Path | None = None,
    files: ModelFiles | None = None,
    missing_ok: str = "",
    semantics: Mapping[str, str] | None = None,
    T_world_root: Floats | None = None,
) -> ArticulatedObject:
    """Read a URDF and all its meshes.

    Axes are made unit vectors, of prismatic joints too: q is in metres along the axis, whatever the
    axis's length in the file (SAPIEN does so; yourdfpy would move by q times that length). A
    revolute or prismatic joint without `<limit>`, or with neither end of it, and every continuous
    joint has the limits -inf and inf; one missing end is 0, as the format says. Mimic elements of
    fixed joints mean nothing.

    Args:
        path: the URDF.
        object_id, category, source: kept in the object.
        root: the folder that meshes may not leave (see `ModelFiles`); by default the URDF's own, or
            the one above where that is called urdf, as in ROS packages, unless it is above `top`.
        top: the highest folder that may be the package of a `package://`; by default `root`.
        files: reads all files; by default those in `root`.
        missing_ok: pattern with * and ? of mesh file names that are left out, with a note, where
            they are missing or hold no triangle.
        semantics: what each link is, by link name.
        T_world_root: (4, 4), default identity.

    Raises:
        InvalidSource: anything amiss with the file, its tree or a mesh; see `urdf_check`.
    """
    import yourdfpy  # noqa: PLC0415 - takes a second, and many commands read no model

    path = Path(path)
    above = path.parent.parent if path.parent.name == "urdf" else path.parent
    if top and not above.resolve().is_relative_to(top.resolve()):
        above = path.parent
    files = files or ModelFiles(path.parent, root or above, top)
    text = files.read(path, MAX_TEXT_BYTES)
    checked, unseen = checked_robot(text, path)
    odd = ("its XML version 0.0 is read as 1.0",) if OLD_VERSION.match(text) else ()
    visuals = _Visuals(path, files, missing_ok, _take_visuals(checked))
    origins = {j.get("name"): _take_origin(j) for j in checked.findall("joint")}
    clean = io.BytesIO(tostring(checked))
    robot = yourdfpy.URDF.load(clean, build_scene_graph=False, load_meshes=False).robot
    joints = _topological(robot.joints)
    children = {joint.child for joint in joints}
    links = sorted(robot.links, key=lambda link: link.name in children)
    semantics = semantics or {}
    obj = ArticulatedObject(
        object_id=object_id,
        category=category,
        links=tuple(Link(k.name, visuals.mesh(k), semantics.get(k.name, "")) for k in links),
        joints=tuple(_joint(joint, origins[joint.name]) for joint in joints),
        T_world_root=np.eye(4) if T_world_root is None else T_world_root,
        sha256=files.sha256(),
        source=source,
        notes=(*odd, *visuals.notes(unseen)),
    )
    if not any(len(link.mesh.faces) for link in obj.links):
        raise InvalidSource(f"{path}: no link has a <visual> with a shape; add one")
    return obj


def load_object(
    ref: ObjectRef, settings: CategorySettings, path: Path, **options: Any
) -> ArticulatedObject:
    """Read the URDF at `path` as what a source lists; `options` are those of `load_urdf`."""
    return load_urdf(
        path, object_id=ref.object_id, category=ref.category, source=ref.source,
        T_world_root=settings.turn, **options,
    )  # fmt: skip


def load_shortest(
    ref: ObjectRef, settings: CategorySettings, folder: Path, missing: str
) -> ArticulatedObject:
    """Read the URDF in a folder, of several the one with the shortest name, which its notes say;
    InvalidSource says what is `missing` where there is none."""
    urdfs = ending_in(folder, ".urdf")
    if not urdfs:
        raise InvalidSource(f"{folder}: {missing}")
    obj = load_object(ref, settings, urdfs[0], root=folder)
    aside = f"read from {urdfs[0].name}; left aside: {', '.join(p.name for p in urdfs[1:])}"
    return replace(obj, notes=(*obj.notes, aside)) if urdfs[1:] else obj


def _take_visuals(checked: Any) -> _Shown:
    """Take out each link's visuals: shape (lxml) and T_link_visual. yourdfpy, which knows no
    capsules and builds no mesh here, gets a sphere instead."""
    taken: _Shown = {}
    for link in checked.findall("link"):
        shapes = taken[link.get("name")] = []
        for visual in link.findall("visual"):
            geometry = visual.find("geometry")
            shapes.append((geometry[0], _take_origin(visual)))
            geometry.remove(geometry[0])
            etree.SubElement(geometry, "sphere", radius="1")
    return taken


def _take_origin(element: Any) -> Floats:
    """Take out (4, 4) where a joint or visual stands, by our arithmetic: yourdfpy's last bits
    depend on the processor."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    element.remove(origin)
    xyz = [float(word) for word in origin.get("xyz", "0 0 0").split()]
    return transform(_rotation(origin.get("rpy", "0 0 0")), xyz)


@lru_cache(1024)
def _rotation(rpy: str) -> Floats:
    """Return (3, 3) of three angles; a model says the same ones, mostly zeros, at each of its
    visuals."""
    rotation = rotation_from_rpy([float(word) for word in rpy.split()])
    rotation.flags.writeable = False
    return rotation


def _topological(joints: list[Any]) -> list[Any]:
    """Return each joint after the joint its parent hangs on, else in the order of the file."""
    children = {joint.child for joint in joints}
    hanging = grouped((joint.parent, i) for i, joint in enumerate(joints))
    ready = [i for i, joint in enumerate(joints) if joint.parent not in children]
    ordered: list[Any] = []
    while ready:
        joint = joints[heapq.heappop(ready)]
        ordered.append(joint)
        for i in hanging.get(joint.child, []):
            heapq.heappush(ready, i)
    return ordered


def _joint(joint: Any, origin: Floats) -> Joint:
    kind = JointKind[joint.type.upper()]
    lower, upper = _limits(joint)
    axis, length = np.array([1.0, 0.0, 0.0]), 1.0
    if kind != JointKind.FIXED:
        length = min(math.hypot(*joint.axis), sys.float_info.max)
        axis = joint.axis / np.abs(joint.axis).max()
        axis = axis / norm(axis)
    mimic = joint.mimic if kind != JointKind.FIXED else None
    return Joint(
        name=joint.name, kind=kind, parent=joint.parent, child=joint.child, T_parent_joint=origin,
        axis=axis, lower=lower, upper=upper, axis_length=length,
        mimic=mimic and Mimic(mimic.joint, mimic.multiplier, mimic.offset),
    )  # fmt: skip


def _limits(joint: Any) -> tuple[float, float]:
    if joint.type == "fixed":
        return 0.0, 0.0
    limit = joint.limit
    if joint.type == "continuous" or limit is None or (limit.lower, limit.upper) == (None, None):
        return -np.inf, np.inf
    return limit.lower or 0.0, limit.upper or 0.0


class _Visuals:
    """Builds the links' meshes of their shapes."""

    def __init__(self, path: Path, files: ModelFiles, missing_ok: str, shapes: _Shown) -> None:
        self.path, self.missing_ok, self.shapes = path, missing_ok, shapes
        self.left_out: list[str] = []
        self._builder = Shapes(
            path, files, [shape.tag for of_link in shapes.values() for shape, _ in of_link]
        )

    def mesh(self, link: Any) -> Mesh:
        """Return all visuals of a link as one mesh in the link's frame, in the order of the
        file."""
        by = f"{self.path}: link {quoted(link.name)}"
        pieces = ((self._shape(element, by), element, T) for element, T in self.shapes[link.name])
        return self._builder.link(by, ((mesh, shape, T) for mesh, shape, T in pieces if mesh))

    def notes(self, unseen: list[str]) -> tuple[str, ...]:
        """Return a note for each kind of thing that is not in the meshes."""
        notes = {
            "meshes missing or empty, left out": self.left_out,
            "links with collision shapes but no visual, not seen": unseen,
        }
        return tuple(f"{note}: {', '.join(names)}" for note, names in notes.items() if names)

    def _shape(self, element: Any, by: str) -> Mesh | None:
        """Return the mesh of one shape, in the frame of its visual; None where it may be
        missing."""

        def numbers(attribute: str) -> list[float]:
            return [float(word) for word in element.get(attribute).split()]

        if element.tag == "box":
            return read.box(numbers("size"))
        if element.tag == "sphere":
            return read.sphere(numbers("radius")[0])
        if element.tag in ("cylinder", "capsule"):
            make = read.cylinder if element.tag == "cylinder" else read.capsule
            return make(numbers("radius")[0], numbers("length")[0])
        name = element.get("filename")
        try:
            mesh = self._builder.file(name, by)
        except read.NoMesh:
            if not fnmatchcase(PurePosixPath(name).name, self.missing_ok):
                raise
            self.left_out.append(name)
            return None
        if element.get("scale") is None:
            return mesh
        return read.scaled(mesh, np.broadcast_to(numbers("scale"), 3))
