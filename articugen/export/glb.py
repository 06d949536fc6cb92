"""GLB (glTF 2.0): each object as watertight parts on its joints, with an animation a joint.

A joint's node carries its part and all that hangs on it, so that turning the node turns them. glTF
is y up; one node above all turns it so. Lengths are metres in the model's own frame.
"""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.colours import colour_of
from articugen.core.records import Mesh
from articugen.export.formats import Format
from articugen.export.items import Item, canonical, of_objects
from articugen.export.parts import MetricJoint, in_metres, metric_joints
from articugen.export.target import Target
from articugen.pictures.shading import linear

_SECONDS = 2.0  # from one end of a joint's range to the other
_STEP = np.radians(15.0)
"""Between two keys of a rotation: shorter than half a turn, so that there is one way between."""

_MATERIAL = {"metallicFactor": 0.0, "roughnessFactor": 0.8}
_FLOAT, _UINT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963


class _Buffer:
    """The binary chunk, and what glTF says of the arrays in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, used_as: int | None = None) -> int:
        """Return the number of a new accessor of `array`: (n,) or (n, k), float32 or uint32."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view if used_as is None else {**view, "target": used_as})
        flat = array.reshape(len(array), -1)
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[flat.shape[1]]
        self.accessors.append({
            "bufferView": len(self.views) - 1,
            "componentType": _FLOAT if array.dtype == np.float32 else _UINT,
            "count": len(array),
            "type": kind,
            "min": flat.min(axis=0).tolist(),
            "max": flat.max(axis=0).tolist(),
        })  # fmt: skip
        self.data += np.ascontiguousarray(array).tobytes()
        return len(self.accessors) - 1


def _write(item: Item, target: Target) -> None:
    row = canonical(item.rows)
    meshes = [in_metres(mesh, row) for mesh in target.meshes.of(item.rows)]
    joints = metric_joints(row)
    buffer = _Buffer()
    at = [np.zeros(3), *(joint.pivot for joint in joints)]  # where each part's node stands
    nodes: list[dict[str, Any]] = [{
        "name": item.key.rpartition("/")[2],
        "rotation": [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)],
        "children": [1],
        "extras": {"category": row.category, "object_id": row.object_id},
    }]  # fmt: skip
    for part, name in enumerate([row.parts[0].name or "part_0", *(j.name for j in joints)]):
        parent = joints[part - 1].parent if part else 0
        below = [j.part + 1 for j in joints if j.parent == part]
        nodes.append({"name": name, "translation": (at[part] - at[parent]).tolist(), "mesh": part})
        if below:
            nodes[-1]["children"] = below
    scene = {
        "asset": {"version": "2.0", "generator": "articugen"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [_mesh(m, at[k], k, buffer) for k, m in enumerate(meshes)],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": colour, **_MATERIAL}}
            for colour in ([*linear(colour_of(k)).tolist(), 1.0] for k in range(len(meshes)))
        ],
        "animations": [_animation(j, nodes[j.part + 1], buffer) for j in joints],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(scene, separators=(",", ":")).encode()
    chunks = [_chunk(b"JSON", text, b" "), _chunk(b"BIN\0", bytes(buffer.data), b"\0")]
    header = struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, chunks)))
    target.write(f"{item.key}.glb", header + b"".join(chunks))


def _mesh(mesh: Mesh, origin: Floats, part: int, buffer: _Buffer) -> dict[str, Any]:
    place = buffer.add((mesh.vertices - origin).astype(np.float32), used_as=_VERTICES)
    faces = buffer.add(mesh.faces.astype(np.uint32).ravel(), used_as=_INDICES)
    return {
        "name": f"part_{part}",
        "primitives": [{"attributes": {"POSITION": place}, "indices": faces, "material": part}],
    }


def _animation(joint: MetricJoint, node: dict[str, Any], buffer: _Buffer) -> dict[str, Any]:
    """Return the joint from one end of its range to the other."""
    span = joint.upper - joint.lower
    turns = joint.kind == "revolute"
    state = np.linspace(joint.lower, joint.upper, 2 + int(span // _STEP) if turns else 2)
    if turns:
        half = state[:, None] / 2.0
        keys, path = np.concatenate([np.sin(half) * joint.axis, np.cos(half)], 1), "rotation"
    else:
        keys, path = np.array(node["translation"]) + state[:, None] * joint.axis, "translation"
    times = np.linspace(0.0, _SECONDS, len(state))
    sampler = {
        "input": buffer.add(times.astype(np.float32)),
        "output": buffer.add(keys.astype(np.float32)),
        "interpolation": "LINEAR",
    }
    target = {"node": joint.part + 1, "path": path}
    return {
        "name": joint.name,
        "samplers": [sampler],
        "channels": [{"sampler": 0, "target": target}],
        "extras": {"kind": joint.kind, "lower": joint.lower, "upper": joint.upper},
    }


def _chunk(kind: bytes, data: bytes, filler: bytes) -> bytes:
    data += filler * (-len(data) % 4)
    return struct.pack("<I4s", len(data), kind) + data


FORMAT = Format(
    "each object's parts as watertight meshes, each joint an animation",
    of_objects,
    _write,
    takes=("resolution", "from_grids"),
)
