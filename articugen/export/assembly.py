"""An object as simulators want it: a body a part, in the frame of its joint, in metres.

All frames are turned as the model's own; a part's stands at its joint's pivot, canonical pose.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.records import Mesh
from articugen.export.items import Item, LeftOut, canonical
from articugen.export.parts import metric_joints, part_names, part_solids, picture_of
from articugen.export.target import Files
from articugen.meshes.convex import agreement, apart, convex_pieces
from articugen.meshes.model_text import obj_text
from articugen.meshes.painting import Look, looks
from articugen.store.rows import RowJoint

DENSITY = 500.0
"""kg/m^3, of wood. Models do not state theirs; mass and inertia follow from it and the volume."""

SLOWING = 0.1
"""Seconds in which a joint that nothing drives loses two thirds of its speed. A lid that is let go
sinks on its stop instead of hitting it."""

# Drawers: ball bearings have .02, wood on wood .25 to .5 (Engineering ToolBox). Hinges: a cabinet's
# door of 2 kg gets 1 N m, where furniture_sim's (Franka Kitchen's) has 2; a room's of 15 kg wants
# 18 N at its handle, where the ADA allows 22 (404.2.9). It holds glasses whose hinges lean by ten
# degrees, and a lid that is let go sinks all the same.
JOINT_FRICTION = {"revolute": 0.2, "prismatic": 0.1}
"""By kind of joint: what holds what it moves at rest, as a share of the weight of that; about a
hinge it acts at the radius of gyration."""

SURFACE_FRICTION = 0.5
"""Of what touches a part: wood on wood, and what PhysX takes where nothing is stated."""

_GRAVITY = 9.81  # m/s^2
_SPECK = 1e-12  # m^2, of faces that nobody sees; MuJoCo refuses meshes of 1e-14


@dataclass(frozen=True, eq=False)
class Body:
    """A part.

    Attributes:
        name: none is there twice.
        place: (3,) where its frame stands in the model's own, canonical pose, metres.
        unit_mesh, mesh: watertight, in the unit frame, and in its own.
        hulls: convex meshes that together fill about the same space; () unless asked for.
        filled: the mesh with DENSITY in it: `mass` kg; `center_mass` (3,) metres, in its frame;
            `moment_inertia` (3, 3) about that, kg m^2.
        joint: what it moves by, as `metric_joints` has it; None of part 0.
    """

    name: str
    place: Floats
    unit_mesh: Mesh
    mesh: Mesh
    hulls: tuple[Mesh, ...]
    filled: trimesh.Trimesh
    joint: RowJoint | None


def bodies(item: Item, target: Files) -> tuple[Body, ...]:
    """Return the parts of the object whose instances `item` holds, part 0 first."""
    row = canonical(item.rows)
    joints, names = metric_joints(row), part_names(row)
    at = [np.zeros(3), *(joint.pivot for joint in joints)]
    built, fits = [], []
    for part, solid in enumerate(part_solids(item.rows, target.options, colours=True)):
        if not len(solid.mesh.faces):
            raise LeftOut(f"{row.object_id}: part {names[part]!r} has no shape, and so no mass")
        mesh, *closed = (
            replace(one, vertices=row.to_metres(one.vertices) - at[part])
            for one in (solid.mesh, *solid.closed)
        )
        hulls = ()
        if target.options.collision:
            solids = apart(mesh, closed)
            hulls = convex_pieces(*solids)
            iou, cavities = agreement(hulls, *solids)
            volumes = [float(f"{volume:.4g}") for volume in cavities]
            fit = {"part": names[part], "pieces": len(hulls), "iou": round(iou, 4)}
            fits.append({**fit, "cavities": volumes})
        joint = joints[part - 1] if part else None
        filled = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        filled.density = DENSITY
        built.append(Body(names[part], at[part], solid.mesh, mesh, hulls, filled, joint))
    if target.options.collision:
        target.write(f"{item.key}/collision.json", json.dumps(fits, indent=1).encode())
    return tuple(built)


def resistance(parts: Sequence[Body], part: int) -> tuple[float, float]:
    """Compute what slows the joint that moves `part`: its damping, N m s/rad or N s/m, which is
    inertia over SLOWING; and its friction, N m or N, by JOINT_FRICTION.

    The inertia is that of all that moves with it, canonical pose, about a hinge's axis, or its mass
    on a slide.
    """
    joint = parts[part].joint
    assert joint is not None
    mass = turned = 0.0
    for body in (parts[k] for k in from_the_root(parts, part)):
        solid = body.filled
        arm = np.cross(joint.axis, body.place + solid.center_mass - joint.pivot)
        turned += float(joint.axis @ solid.moment_inertia @ joint.axis + solid.mass * arm @ arm)
        mass += float(solid.mass)
    weight = JOINT_FRICTION[joint.kind] * _GRAVITY * mass
    if joint.kind == "prismatic":
        return mass / SLOWING, weight
    return turned / SLOWING, weight * float(np.sqrt(turned / mass))


def from_the_root(parts: Sequence[Body], root: int = 0) -> list[int]:
    """Return the numbers of `root` and of all parts on it, each after the part that it hangs on."""
    order = [root]
    for above in order:
        order += [k for k, body in enumerate(parts) if body.joint and body.joint.parent == above]
    return order


def write_meshes(
    item: Item, target: Files, part: int, body: Body, *, apart: bool = False
) -> tuple[dict[str, Look | None], list[str]]:
    """Write a part's meshes as OBJ files in the folder `meshes`; `apart` is a file a colour or
    picture, which is called as it is. They are else materials in a file beside it.

    Return their names, without the ending: what is seen, with the one look that it has, if any
    that is not in its file; and the convex ones.
    """
    mesh, name = body.mesh, f"part_{part}"
    some = [] if mesh.colours is None else looks(mesh)
    visuals, files = (_a_file_each if apart else _in_one_file)(name, mesh, some)
    collisions = [f"{name}_convex_{k}" for k in range(len(body.hulls))]
    for file, hull in zip(collisions, body.hulls, strict=True):
        files[f"{file}.obj"] = obj_text([(hull.vertices, hull.faces)]).encode()
    for file, content in files.items():
        target.write(f"{item.key}/meshes/{file}", content)
    return visuals, collisions


_Seen = tuple[dict[str, Look | None], dict[str, bytes]]


def _a_file_each(name: str, mesh: Mesh, some: Sequence[Look]) -> _Seen:
    """Return what is seen of a mesh, a name a look, and the files of it."""
    if not some:
        return {name: None}, {f"{name}.obj": _obj(mesh.vertices, {"": (mesh.faces, None)})}
    shown = [look for look in some if look.area > _SPECK] or some[:1]
    names = [f"{name}_colour_{k}" for k in range(len(shown))] if len(some) > 1 else [name]
    files: dict[str, bytes] = {}
    for file, look in zip(names, shown, strict=True):
        used, corners = np.unique(mesh.faces[look.faces], return_inverse=True)
        used = np.append(used, used[-1:]) if len(used) < 4 else used  # MuJoCo's fewest
        alone = corners.reshape(-1, 3), look.places
        files[f"{file}.obj"] = _obj(mesh.vertices[used], {"": alone})
        if picture := picture_of(look):
            files[f"{file}.png"] = picture
    return dict(zip(names, shown, strict=True)), files


def _in_one_file(name: str, mesh: Mesh, some: Sequence[Look]) -> _Seen:
    """Return the one name of what is seen of a mesh, and its files."""
    pictures = {look.colour[1:]: picture_of(look) for look in some}
    if len(some) < 2 and not any(pictures.values()):
        plain = {f"{name}.obj": _obj(mesh.vertices, {"": (mesh.faces, None)})}
        return {name: some[0] if some else None}, plain
    faces = {look.colour[1:]: (mesh.faces[look.faces], look.places) for look in some}
    kinds, files = [], {f"{name}.obj": f"mtllib {name}.mtl\n".encode() + _obj(mesh.vertices, faces)}
    for look, (kind, picture) in zip(some, pictures.items(), strict=True):
        file = f"{name}_{kind}.png"
        how = f"Kd 1 1 1\nmap_Kd {file}\n" if picture else f"Kd {numbers(look.rgba[:3])}\n"
        kinds.append(f"newmtl {kind}\n{how}")
        files |= {file: picture} if picture else {}
    return {name: None}, {**files, f"{name}.mtl": "".join(kinds).encode()}


def _obj(vertices: Floats, runs: Mapping[str, tuple[NDArray[np.integer], Floats | None]]) -> bytes:
    """Return an OBJ file of triangles (m, 3) by their material, "" for none, with the places (m, 3,
    2) of their corners in its picture if it has one."""
    texts, first = [obj_text([(vertices, np.zeros((0, 3), np.intp))])], 1
    for material, (faces, places) in runs.items():
        texts += [f"usemtl {material}\n"] if material else []
        if places is None:
            texts.append(obj_text([(vertices[:0], faces)]))
            continue
        known, which = np.unique(places.reshape(-1, 2).round(6), axis=0, return_inverse=True)
        texts += [f"vt {u:.6f} {v:.6f}\n" for u, v in known.tolist()]
        corners = np.stack([faces.ravel() + 1, which.ravel() + first], axis=1).reshape(-1, 6)
        texts += ["f {}/{} {}/{} {}/{}\n".format(*corner) for corner in corners.tolist()]
        first += len(known)
    return "".join(texts).encode()


def numbers(values: Sequence[float] | Floats) -> str:
    """Numbers for XML, in metres to a nanometre and in radians as finely."""
    return " ".join(f"{round(float(value), 12) + 0.0:.12g}" for value in values)
