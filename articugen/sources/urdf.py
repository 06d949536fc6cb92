"""Any URDF to an `ArticulatedObject`. The only user of yourdfpy.

yourdfpy parses the tree that `urdf_check` found sound; meshes, paths, topological order, limits and
unit axes are ours, because there it is wrong or silent.
"""

import heapq
import io
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import yourdfpy
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from articugen.errors import InvalidSource
from articugen.geometry import apply
from articugen.records import ArticulatedObject, Floats, Joint, JointKind, Link, Mesh, Mimic
from articugen.sources import meshes
from articugen.sources.model_files import ModelFiles
from articugen.sources.urdf_check import checked_robot

MAX_OBJECT_FACES = 20_000_000
"""Most triangles of one object: a small URDF can name one large mesh many times."""


def load_urdf(
    path: Path,
    *,
    object_id: str,
    category: str,
    source: str = "",
    root: Path | None = None,
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
            the one above where that is called urdf, as in ROS packages.
        missing_ok: pattern with * and ? of mesh file names that are left out, with a note, where
            they are missing or hold no triangle.
        semantics: what each link is, by link name.
        T_world_root: (4, 4), default identity.

    Raises:
        InvalidSource: anything amiss with the file, its tree or a mesh; see `urdf_check`.
    """
    path = Path(path)
    above = path.parent.parent if path.parent.name == "urdf" else path.parent
    files = ModelFiles(path.parent, root or above)
    checked, unseen = checked_robot(files.read(path), path)
    robot = _parse(checked)
    visuals = _Visuals(path, files, missing_ok)
    joints = _topological(robot.joints)
    children = {joint.child for joint in joints}
    links = sorted(robot.links, key=lambda link: link.name in children)
    semantics = semantics or {}
    obj = ArticulatedObject(
        object_id=object_id,
        category=category,
        links=tuple(Link(k.name, visuals.mesh(k), semantics.get(k.name, "")) for k in links),
        joints=tuple(_joint(joint) for joint in joints),
        T_world_root=np.eye(4) if T_world_root is None else T_world_root,
        sha256=files.sha256(),
        source=source,
        notes=(*visuals.notes(), *_unseen_note(unseen)),
    )
    if not any(len(link.mesh.faces) for link in obj.links):
        raise InvalidSource(f"{path}: no link has a <visual> with a shape; add one")
    return obj


def _parse(checked: Any) -> Any:
    """yourdfpy's records of a tree that has passed every check."""
    clean = io.BytesIO(etree.tostring(checked))
    return yourdfpy.URDF.load(clean, build_scene_graph=False, load_meshes=False).robot


def _unseen_note(links: list[str]) -> tuple[str, ...]:
    if not links:
        return ()
    return (f"links with collision shapes but no visual, not seen: {', '.join(links)}",)


def _topological(joints: list[Any]) -> list[Any]:
    """Each joint after the joint its parent hangs on, else in the order of the file."""
    children = {joint.child for joint in joints}
    hanging: dict[str, list[int]] = {}
    for i, joint in enumerate(joints):
        hanging.setdefault(joint.parent, []).append(i)
    ready = [i for i, joint in enumerate(joints) if joint.parent not in children]
    ordered: list[Any] = []
    while ready:
        joint = joints[heapq.heappop(ready)]
        ordered.append(joint)
        for i in hanging.get(joint.child, []):
            heapq.heappush(ready, i)
    return ordered


def _joint(joint: Any) -> Joint:
    kind: JointKind = joint.type
    lower, upper = _limits(joint)
    mimic = joint.mimic if kind != "fixed" else None
    return Joint(
        name=joint.name,
        kind=kind,
        parent=joint.parent,
        child=joint.child,
        T_parent_joint=_matrix(joint.origin),
        axis=np.array([1.0, 0.0, 0.0]) if kind == "fixed" else _unit(joint.axis),
        lower=lower,
        upper=upper,
        mimic=mimic and Mimic(mimic.joint, mimic.multiplier, mimic.offset),
    )


def _limits(joint: Any) -> tuple[float, float]:
    if joint.type == "fixed":
        return 0.0, 0.0
    limit = joint.limit
    if joint.type == "continuous" or limit is None or (limit.lower, limit.upper) == (None, None):
        return -np.inf, np.inf
    return limit.lower or 0.0, limit.upper or 0.0


def _unit(axis: Floats) -> Floats:
    axis = axis / np.abs(axis).max()
    return axis / np.linalg.norm(axis)


def _matrix(origin: Floats | None) -> Floats:
    return np.eye(4) if origin is None else origin


class _Visuals:
    """Builds the links' meshes; each mesh file is read once."""

    def __init__(self, path: Path, files: ModelFiles, missing_ok: str) -> None:
        self.path = path
        self.files = files
        self.missing_ok = missing_ok
        self.faces = 0
        self.left_out: list[str] = []
        self._cache: dict[Path, Mesh] = {}

    def mesh(self, link: Any) -> Mesh:
        """All visuals of a link as one mesh in the link's frame, in the order of the file."""
        vertices: list[Any] = [np.zeros((0, 3))]
        faces: list[Any] = [np.zeros((0, 3), np.int32)]
        offset = 0
        for visual in link.visuals:
            shape = self._shape(visual.geometry, link.name)
            if shape is None:
                continue
            vertices.append(apply(_matrix(visual.origin), shape.vertices))
            faces.append(shape.faces + offset)
            offset += len(shape.vertices)
            self.faces += len(shape.faces)
            if self.faces > MAX_OBJECT_FACES:
                raise InvalidSource(
                    f"{self.path}: more than {MAX_OBJECT_FACES:,} triangles; simplify its meshes"
                )
        return Mesh(np.concatenate(vertices), np.concatenate(faces))

    def notes(self) -> tuple[str, ...]:
        if not self.left_out:
            return ()
        return (f"meshes missing or empty, left out: {', '.join(self.left_out)}",)

    def _shape(self, geometry: Any, link: str) -> Mesh | None:
        if geometry.box is not None:
            return meshes.box(geometry.box.size)
        if geometry.cylinder is not None:
            return meshes.cylinder(geometry.cylinder.radius, geometry.cylinder.length)
        if geometry.sphere is not None:
            return meshes.sphere(geometry.sphere.radius)
        mesh = self._file(geometry.mesh.filename, link)
        scale = geometry.mesh.scale
        if mesh is None or scale is None:
            return mesh
        return meshes.scaled(mesh, np.broadcast_to(scale, 3))

    def _file(self, name: str, link: str) -> Mesh | None:
        try:
            found = self.files.find(name)
            if found is not None:
                if found not in self._cache:
                    self._cache[found] = meshes.read_mesh(found, self.files)
                return self._cache[found]
            problem = InvalidSource(
                f"{self.path}: link {link!r}: mesh {name!r} does not exist; put the file there or "
                "remove the <visual>"
            )
        except meshes.EmptyMesh as empty:
            problem = empty
        if not fnmatchcase(PurePosixPath(name).name, self.missing_ok):
            raise problem
        self.left_out.append(name)
        return None
