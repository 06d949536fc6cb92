"""One object as viewer.js turns it: the surface of each part, and the joints that move them.

All of it is of the canonical pose; a state of the joints moves each part as a whole. Meshes are
packed as differences of whole numbers, byte by byte, which gzip makes a fifth of.
"""

import base64
import gzip
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.colours import colour_of
from articugen.core.errors import printable
from articugen.core.geometry import invert_rigid
from articugen.core.records import JointKind, Mesh, dequantize
from articugen.core.schema import Instance
from articugen.inspection.report.facts import JointStates, ObjectFacts, range_text
from articugen.inspection.report.skin import skin
from articugen.pictures.contact_sheet import evenly
from articugen.pictures.portrait import AJAR, best_azimuth, oriented_points, swept
from articugen.pictures.surfels import OrientedPoints
from articugen.store.shards import open_shard

VOXEL = 1 / 112  # of the unit frame: what is finer is not drawn; coarser where points are sparse
POOLED = 20  # instances whose points make the surface, or all that there are
SPARSE = 1.3  # a voxel is no smaller than this many spacings of the points
FEWEST = 50  # points that a part needs to be drawn


def turnable(objects: Sequence[ObjectFacts]) -> dict[str, Any] | None:
    """Return the first object of those with the most joints as viewer.js reads it, ready for JSON;
    None where no surface is stored."""
    shown = [one for one in objects if one.points >= FEWEST]
    if not shown:
        return None
    chosen = max(shown, key=lambda one: len(one.joints))
    with open_shard(chosen.shard) as shard:
        instances = [shard.instance(row) for row in evenly(chosen.rows, POOLED)]
    first = instances[0]
    clouds = [oriented_points(i).moved(invert_rigid(i.part_motion)) for i in instances]
    parts = [_skin_of(clouds, part) for part in range(len(first.part_motion))]
    posed = np.concatenate([*(dequantize(i.surface_points) for i in instances), swept(first)])
    low, high = posed.min(axis=0), posed.max(axis=0)
    middle = (low + high) / 2.0
    far = np.array([max(joint.lower, joint.upper, key=abs) for joint in chosen.joints])
    states = np.array([[one.states[n] for one in chosen.joints] for n in range(len(chosen.rows))])
    nearest = int(np.abs(states / np.where(far, far, 1.0) - AJAR).sum(axis=1).argmin())
    return {
        "name": printable(chosen.object_id),
        "split": printable(chosen.split),
        "middle": middle.tolist(),
        "radius": float(np.linalg.norm(posed - middle, axis=1).max()),
        "floor": float(low[2]),
        "azimuth": best_azimuth([max(instances, key=_moved)]),
        "parts": [
            {
                "name": printable(about.semantic or about.name),
                "colour": colour_of(k),
                "vertices": len(p.vertices),
                "faces": len(p.faces),
            }
            for k, (p, about) in enumerate(zip(parts, chosen.parts, strict=True))
        ],
        "states": [list(map(_short, state)) for state in states],
        "joints": [
            {
                **_slider(joint, j, nearest),
                "revolute": joint.kind == JointKind.REVOLUTE,
                "parent": int(first.joint_parent[j]),
                "axis": first.joint_axis[j].tolist(),
                "pivot": first.joint_pivot[j].tolist(),
                "unit": np.degrees(1.0) if joint.kind == JointKind.REVOLUTE else chosen.scale,
            }
            for j, joint in enumerate(chosen.joints)
        ],
        "meshes": packed(parts),
    }


def _slider(joint: JointStates, j: int, start: int) -> dict[str, Any]:
    """Return a slider from the canonical pose, or the least state, to the greatest; in the stored
    state `start` at first."""
    low, high = min(joint.lower, 0.0), max(joint.upper, 0.0)
    text = f"{joint.kind}, {range_text(joint.lower, joint.upper, joint.unit)}"
    return {"name": printable(joint.name) or f"joint {j}", "text": text, "low": _short(low),
            "high": _short(high), "start": _short(joint.states[start])}  # fmt: skip


def _short(number: float) -> float:
    return float(f"{number:.6g}")


def _moved(instance: Instance) -> float:
    """Return how far its joints are from the canonical pose, each by its range."""
    span = instance.joint_upper - instance.joint_lower
    return float(np.sum(np.abs(instance.joint_state) / np.where(span > 0.0, span, 1.0)))


def _skin_of(clouds: Sequence[OrientedPoints], part: int) -> Mesh:
    points, normals = (
        np.concatenate([getattr(cloud, name)[cloud.part == part] for cloud in clouds])
        for name in ("points", "normals")
    )
    if len(points) < FEWEST:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    one = OrientedPoints(points, normals, np.full(len(points), part, np.uint8))
    spacing = one.spacing()
    return skin(one, max(VOXEL, SPARSE * spacing), spacing)


def packed(parts: Sequence[Mesh]) -> str:
    """Return the meshes in base64: of each the coordinates x, y, z of its vertices as 16-bit fixed
    point over [-1, 1], then the numbers of its faces' corners in 32 bits."""
    pieces: list[bytes] = []
    for part in parts:
        fixed = np.round((np.clip(part.vertices, -1.0, 1.0) + 1.0) * 32767.5).astype(np.uint16)
        pieces += [_differences(column) for column in fixed.T]
        pieces.append(_differences(part.faces.ravel().astype(np.uint32)))
    return base64.b64encode(gzip.compress(b"".join(pieces), 9, mtime=0)).decode()


def _differences(numbers: NDArray[Any]) -> bytes:
    """Return each number less the one before it, all lowest bytes first, then all next ones."""
    steps = np.diff(numbers, prepend=numbers.dtype.type(0))
    little = steps.astype(numbers.dtype.newbyteorder("<"))
    return little.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes()
