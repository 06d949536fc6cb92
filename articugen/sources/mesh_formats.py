"""PLY, COLLADA and glTF through trimesh, which believes files that lie: headers are checked first.

Every reader gives `(vertices (V, 3), faces (F, 3))` with the transforms of a scene's nodes baked
in; materials and textures are not read. `meshes.checked` sees the result.
"""

import io
import json
import os
import re
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray

from articugen.errors import InvalidSource
from articugen.geometry import apply
from articugen.sources.model_files import ModelFiles
from articugen.sources.xml_strict import parse_xml

MAX_SCENE_VERTICES = 10_000_000
"""Most vertices of a scene, each node counted: one mesh may hang on many nodes."""

_Arrays = tuple[NDArray[np.float64], NDArray[np.int64]]


def read_ply(data: bytes, path: Path, _files: ModelFiles) -> _Arrays:
    """PLY, ASCII or binary. Each row takes at least one byte a property, so a header cannot claim
    more rows than the file has bytes."""
    header = data[: data.find(b"end_header") + 1].decode("ascii", "replace")
    if not header.startswith("ply"):
        raise _broken(path, "has no PLY header")
    claimed = {name: int(count) for name, count in re.findall(r"element (\w+) (\d+)", header)}
    if any(count > len(data) for count in claimed.values()):
        raise _broken(path, "its PLY header claims more than the file holds")
    vertices, faces = _through_trimesh(data, path)
    if len(vertices) < claimed.get("vertex", 0) or len(faces) < claimed.get("face", 0):
        raise _broken(path, "not every face of the PLY header can be read")
    return vertices, faces


def read_dae(data: bytes, path: Path, _files: ModelFiles) -> _Arrays:
    """COLLADA. As in ROS, the file's unit is applied and its up axis is not."""
    root = parse_xml(data, path)
    unit = root.find("{*}asset/{*}unit")
    try:
        meter = float(unit.get("meter", "1")) if unit is not None else 1.0
    except ValueError:
        raise _broken(path, "its <unit> is not a number") from None
    if root.find(".//{*}instance_controller") is not None:
        raise _broken(path, "has skinned meshes, which are not read")
    vertices, faces = _through_trimesh(data, path, ignore_broken=False)
    return vertices * meter, faces


def read_glb(data: bytes, path: Path, files: ModelFiles) -> _Arrays:
    """Binary glTF 2.0."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise _broken(path, "has no GLB header")
    version, length, json_length = struct.unpack_from("<III", data, 4)
    if version != 2 or length != len(data) or json_length > length - 20:
        raise _broken(path, f"its GLB header does not fit its {len(data)} bytes or is not glTF 2")
    resolver = _check_gltf(data[20 : 20 + json_length], path, files)
    return _through_trimesh(data, path, resolver=resolver, skip_materials=True)


def read_gltf(data: bytes, path: Path, files: ModelFiles) -> _Arrays:
    """glTF 2.0 as JSON; its buffers lie inside it or in files of the model."""
    resolver = _check_gltf(data, path, files)
    return _through_trimesh(data, path, resolver=resolver, skip_materials=True)


def _through_trimesh(data: bytes, path: Path, **options: Any) -> _Arrays:
    file_type = path.suffix.lower().lstrip(".")
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=file_type, process=False, **options)
        return _baked(scene, path)
    except InvalidSource:
        raise
    except Exception as error:  # whatever a foreign parser meets in a broken file
        raise _broken(path, f"{type(error).__name__}: {error}".rstrip(": ")) from None


def _baked(scene: trimesh.Scene, path: Path) -> _Arrays:
    """All triangles of a scene in its world frame; mirrored nodes keep their outside outside."""
    vertices: list[NDArray[np.float64]] = [np.zeros((0, 3))]
    faces: list[NDArray[np.int64]] = [np.zeros((0, 3), np.int64)]
    offset = 0
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        own = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
        if own.size and (own.min() < 0 or own.max() >= len(mesh.vertices)):
            raise _broken(path, f"a face of {name!r} names a vertex that is not there")
        faces.append((own[:, ::-1] if np.linalg.det(T[:3, :3]) < 0 else own) + offset)
        vertices.append(apply(T, mesh.vertices))
        offset += len(mesh.vertices)
        if offset > MAX_SCENE_VERTICES:
            raise _broken(path, f"has more than {MAX_SCENE_VERTICES:,} vertices")
    return np.concatenate(vertices), np.concatenate(faces)


class _Buffers(dict[str, bytes]):
    """The resolver trimesh asks for the external buffers of a glTF file; it has no other files."""

    def get(self, key: str, default: Any = None) -> Any:
        return self[key]


def _check_gltf(text: bytes, path: Path, files: ModelFiles) -> _Buffers:
    """Refuse a glTF document that trimesh would misread; give it the buffers it names."""
    try:
        document = json.loads(text)
        _check_triangles(document, path)
        _check_nodes(document.get("nodes", []), path)
        names = [b["uri"] for b in document.get("buffers", []) if "uri" in b]
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise _broken(path, f"not a glTF document ({type(error).__name__}: {error})") from None
    buffers = _Buffers()
    for name in names:
        if not name.startswith("data:"):
            found = files.find(os.path.relpath(path.resolve().parent / unquote(name), files.folder))
            if found is None:
                raise InvalidSource(f"{path}: its buffer {name!r} is missing; put it beside it")
            buffers[name] = files.read(found)
    return buffers


def _check_triangles(document: dict[str, Any], path: Path) -> None:
    """Positions are plain floats that lie in a buffer; compressed or sparse ones are refused."""
    for mesh in document.get("meshes", []):
        for primitive in mesh["primitives"]:
            if primitive.get("mode", 4) == 6:
                raise _broken(path, "has triangle fans, which are not read")
            used = [primitive["attributes"]["POSITION"]]
            used += [primitive["indices"]] if "indices" in primitive else []
            accessors = [document["accessors"][i] for i in used]
            if any("bufferView" not in a or "sparse" in a for a in accessors):
                raise _broken(path, "has compressed or sparse geometry, which is not read")
            if accessors[0]["componentType"] != 5126:
                raise _broken(path, "has quantised positions, which are not read")
            if any(not 0 < a["count"] <= MAX_SCENE_VERTICES for a in accessors):
                raise _broken(path, "an accessor has no or too many elements")
    for view in document.get("bufferViews", []):
        if view.get("byteOffset", 0) < 0 or view["byteLength"] < 0:
            raise _broken(path, "a buffer view has a negative size or offset")


def _check_nodes(nodes: list[dict[str, Any]], path: Path) -> None:
    """Nodes form trees, as the format demands: no node has two parents or is its own ancestor."""
    children = [child for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children) or not set(children) <= set(range(len(nodes))):
        raise _broken(path, "its nodes do not form a tree")
    reached = sorted(set(range(len(nodes))) - set(children))
    for i in reached:  # grows while it is walked; a loop is never reached from a root
        reached += nodes[i].get("children", [])
    if len(reached) < len(nodes):
        raise _broken(path, "its nodes form a loop")


def _broken(path: Path, problem: str) -> InvalidSource:
    return InvalidSource(f"{path}: {problem}; export it again")
