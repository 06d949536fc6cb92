"""GLB (glTF 2.0): parts on their joints, with an animation a joint.

A joint's node carries its part and all that hangs on it, so that turning the node turns them. glTF
is y up; one node above all turns it so.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats

_SECONDS = 2.0  # from one end of a joint's range to the other
_STEP = np.radians(15.0)
"""Between two keys of a rotation: shorter than half a turn, so that there is one way between."""

_MATERIAL = {"metallicFactor": 0.0, "roughnessFactor": 0.8}
_FLOAT, _UINT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_POINTS = 0


@dataclass(frozen=True, eq=False)
class Moving:
    """Motion of a part; its state is 0 where its geometry is given.

    Attributes:
        name: of the animation.
        kind: "revolute" or "prismatic".
        axis: (3,) unit direction.
        lower, upper: the ends of its animation, rad or metres.
    """

    name: str
    kind: str
    axis: Floats
    lower: float
    upper: float


class Drawn(NamedTuple):
    """Triangles `faces` (m, 3) of a part's vertices, or None for all of these as points, in one
    colour, `light` (3,) linear, 0 to 1; or in a `picture`, a PNG, at the places (m, 3, 2) of their
    corners, v up."""

    light: Floats
    faces: NDArray[np.integer] | None
    picture: bytes = b""
    places: Floats | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """A node of the scene.

    Attributes:
        name: of the node.
        parent: the number of the part that it hangs on; the first part hangs on none.
        origin: (3,) where its node stands: a point on its axis.
        vertices: (n, 3) metres, in the frame of the scene.
        drawn: of each colour or picture what has it.
        joint: None where it is fixed to its parent.
    """

    name: str
    parent: int
    origin: Floats
    vertices: Floats
    drawn: Sequence[Drawn]
    joint: Moving | None = None


class _Buffer:
    """The binary chunk, and what glTF says of the arrays in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []

    def add_material(self, drawn: Drawn) -> dict[str, Any]:
        """Return the material of what is drawn, whose picture is added."""
        if not drawn.picture:
            how = {"baseColorFactor": [*drawn.light.tolist(), 1.0]}
        else:
            how = {"baseColorTexture": {"index": len(self.images)}}
            self.images.append({"bufferView": len(self.views), "mimeType": "image/png"})
            place = {"byteOffset": len(self.data), "byteLength": len(drawn.picture)}
            self.views.append({"buffer": 0, **place})
            self.data += drawn.picture + bytes(-len(drawn.picture) % 4)
        return {"pbrMetallicRoughness": {**how, **_MATERIAL}}

    def add(self, array: NDArray[Any], *, used_as: int | None = None) -> int:
        """Return the number of a new accessor of `array`: (n,) or (n, k), float32 or uint32."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view if used_as is None else {**view, "target": used_as})
        flat = array.reshape(len(array), -1)
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[flat.shape[1]]
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


def glb_of(name: str, parts: Sequence[Part], extras: dict[str, Any] | None = None) -> bytes:
    """Return the file of a scene: its name, its parts, z up, and other facts about it.

    A part without any vertex is a node alone.
    """
    buffer, root = _Buffer(), {"name": name, "rotation": [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]}
    nodes: list[dict[str, Any]] = [
        {**root, "children": [1], **({"extras": extras} if extras else {})}
    ]
    first = np.cumsum([0, *(len(part.drawn) for part in parts)]).tolist()
    shown = [k for k, part in enumerate(parts) if len(part.vertices)]
    for k, part in enumerate(parts):
        above = parts[part.parent].origin if k else np.zeros(3)
        nodes.append({"name": part.name, "translation": (part.origin - above).tolist()})
        if k in shown:
            nodes[-1]["mesh"] = shown.index(k)
        if below := [j + 1 for j, other in enumerate(parts) if j and other.parent == k]:
            nodes[-1]["children"] = below
    scene = {
        "asset": {"version": "2.0", "generator": "articugen"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [_mesh(parts[k], k, first[k], buffer) for k in shown],
        "materials": [buffer.add_material(drawn) for part in parts for drawn in part.drawn],
        "animations": [
            _animation(part.joint, k, nodes[k + 1]["translation"], buffer)
            for k, part in enumerate(parts)
            if part.joint
        ],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    if buffer.images:
        scene["images"] = buffer.images
        scene["textures"] = [{"source": k} for k in range(len(buffer.images))]
    text = json.dumps(scene, separators=(",", ":")).encode()
    chunks = [_chunk(b"JSON", text, b" "), _chunk(b"BIN\0", bytes(buffer.data), b"\0")]
    header = struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, chunks)))
    return header + b"".join(chunks)


def _mesh(part: Part, number: int, material: int, buffer: _Buffer) -> dict[str, Any]:
    """Return the mesh of a part, all of whose colours share vertices; its materials are numbered
    from `material` on."""
    place = (part.vertices - part.origin).astype(np.float32)
    shared = {"POSITION": buffer.add(place, used_as=_VERTICES)}
    primitives: list[dict[str, Any]] = []
    for k, drawn in enumerate(part.drawn, material):
        how: dict[str, Any] = {"attributes": shared}
        if drawn.faces is None:
            how["mode"] = _POINTS
        elif drawn.places is not None:  # a corner has another place on each of its faces
            places = drawn.places.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]
            corners = place[drawn.faces.ravel()], places.astype(np.float32)
            both = (buffer.add(array, used_as=_VERTICES) for array in corners)
            how["attributes"] = dict(zip(("POSITION", "TEXCOORD_0"), both, strict=True))
        else:
            corners = drawn.faces.astype(np.uint32).ravel()
            how["indices"] = buffer.add(corners, used_as=_INDICES)
        primitives.append({**how, "material": k})
    return {"name": f"part_{number}", "primitives": primitives}


def _animation(
    joint: Moving, part: int, translation: list[float], buffer: _Buffer
) -> dict[str, Any]:
    """Return the joint from one end of its range to the other."""
    span = joint.upper - joint.lower
    turns = joint.kind == "revolute"
    state = np.linspace(joint.lower, joint.upper, 2 + int(span // _STEP) if turns else 2)
    if turns:
        half = state[:, None] / 2.0
        keys, path = np.concatenate([np.sin(half) * joint.axis, np.cos(half)], 1), "rotation"
    else:
        keys, path = np.array(translation) + state[:, None] * joint.axis, "translation"
    times = np.linspace(0.0, _SECONDS, len(state))
    sampler = {
        "input": buffer.add(times.astype(np.float32)),
        "output": buffer.add(keys.astype(np.float32)),
        "interpolation": "LINEAR",
    }
    return {
        "name": joint.name,
        "samplers": [sampler],
        "channels": [{"sampler": 0, "target": {"node": part + 1, "path": path}}],
        "extras": {"kind": joint.kind, "lower": joint.lower, "upper": joint.upper},
    }


def _chunk(kind: bytes, data: bytes, filler: bytes) -> bytes:
    data += filler * (-len(data) % 4)
    return struct.pack("<I4s", len(data), kind) + data
