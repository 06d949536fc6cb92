"""PLY, COLLADA and glTF through trimesh, which believes files that lie: headers are checked first.

Every reader gives `(vertices (V, 3), faces (F, 3))` with the transforms of a scene's nodes baked
in, and what paints the faces where colours are wanted. trimesh sees neither materials nor textures,
so that triangles are the same either way. `meshes.checked` sees the result.
"""

import io
import json
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np

from articugen.core.arrays import Floats, Ints
from articugen.core.errors import InvalidSource, machine_fault
from articugen.core.geometry import apply
from articugen.meshes import materials
from articugen.meshes.looks import Looks, Painted, wanted_looks
from articugen.meshes.model_files import ModelFiles, claimed_rows, quoted
from articugen.meshes.xml_strict import parse_xml, tostring

MAX_FACES = 1_000_000
MAX_VERTICES = 3 * MAX_FACES
"""Of one mesh file, and of an object. Each node of a scene counts: a mesh may hang on many."""

_MAX_NODES = 10_000  # of a scene
_MAX_DEPTH = 100  # of nodes that instance others

Paint = Callable[[], Painted | None] | None
"""Returns what a mesh's faces show; None where it states no colours, or none are wanted."""

Arrays = tuple[Floats, Ints, Paint]
_T = TypeVar("_T")


def read_ply(data: bytes, path: Path, _files: ModelFiles) -> Arrays:
    """PLY, ASCII or binary."""
    try:
        claimed = claimed_rows(data)
    except ValueError as error:
        raise _broken(path, str(error)) from None
    check_size(path, faces=claimed.get("face", 0), vertices=claimed.get("vertex", 0))
    vertices, faces, _ = _through_trimesh(data, path, skip_materials=True)
    if len(vertices) < claimed.get("vertex", 0) or len(faces) < claimed.get("face", 0):
        raise _broken(path, "not every face of the PLY header can be read")
    return vertices, faces, None


def read_dae(data: bytes, path: Path, files: ModelFiles) -> Arrays:
    """COLLADA. As in ROS, the file's unit is applied and its up axis is not."""
    root = parse_xml(data, path)
    unit = root.find("{*}asset/{*}unit")
    try:
        meter = float(unit.get("meter", "1")) if unit is not None else 1.0
    except ValueError:
        raise _broken(path, "its <unit> is not a number") from None
    if not 1e-9 <= meter <= 1e6:
        raise _broken(path, f"its <unit> of {meter:g} m is none")
    for tag, what in (
        ("instance_controller", "skinned meshes"),
        ("ph", "polygons with holes"),
        ("node[{*}lookat]//{*}instance_geometry", "shapes placed by <lookat>"),
        ("node[{*}skew]//{*}instance_geometry", "shapes placed by <skew>"),
    ):
        if root.find(f".//{{*}}{tag}") is not None:
            raise _broken(path, f"has {what}, which are not read")
    _check_dae_size(root, path)
    _remove(root, _UNUSED)
    scene_paint = _spared(path, lambda looks: materials.of_dae(tostring(root), looks, path, files))
    _remove(root, _LOOKS)
    baked = _through_trimesh(tostring(root), path, scene_paint, ignore_broken=False)
    return baked[0] * meter, *baked[1:]


def _remove(root: Any, names: tuple[str, ...]) -> None:
    for element in list(root.iter(*(f"{{*}}{name}" for name in names))):
        element.getparent().remove(element)


_LOOKS = ("library_images", "library_effects", "library_materials", "bind_material")
_UNUSED = (
    *("library_cameras", "library_lights", "instance_camera", "instance_light"),
    *("library_animations", "extra"),
)
"""Other elements of COLLADA that say nothing of triangles."""


def _check_dae_size(root: Any, path: Path) -> None:
    """Refuse scenes of too many triangles, each instance counted, since nodes that instance nodes
    can double at each step; and nodes that pycollada would take for ever to put together."""
    faces = {g.get("id"): _dae_faces(g, path) for g in root.iterfind(".//{*}geometry")}
    nodes = {n.get("id"): n for n in root.iterfind(".//{*}node") if n.get("id")}
    known: dict[str, tuple[int, int]] = {}

    def size(element: Any, above: tuple[str, ...]) -> tuple[int, int]:
        """Return (triangles, nodes) of what hangs on an element."""
        total = (0, 1)
        for child in element:
            name = child.tag.rpartition("}")[2]
            target = child.get("url", "").removeprefix("#")
            more = (0, 0)
            if name == "node":
                more = size(child, above)
            elif name == "instance_geometry":
                more = (faces.get(target, 0), 1)
            elif name == "instance_node" and target in nodes:
                if target in above:
                    raise _broken(path, f"its node {quoted(target)} holds itself")
                if len(above) > _MAX_DEPTH:
                    raise _broken(path, f"its nodes are nested more than {_MAX_DEPTH} deep")
                if target not in known:
                    known[target] = size(nodes[target], (*above, target))
                more = known[target]
            total = (total[0] + more[0], total[1] + more[1])
        return total

    every = list(root.iterfind(".//{*}node"))
    if len(every) > _MAX_NODES:
        raise _broken(path, f"it has more than {_MAX_NODES:,} nodes")
    for element in (*every, *root.iterfind(".//{*}visual_scene")):
        triangles, count = size(element, ())
        check_size(path, faces=triangles)
        if count > _MAX_NODES:
            raise _broken(path, f"its scene has more than {_MAX_NODES:,} nodes")


_FACES = ("triangles", "polylist", "polygons", "tristrips", "trifans")


def _dae_faces(geometry: Any, path: Path) -> int:
    """Return how many triangles a geometry says that it has, or has numbers for."""
    faces = 0
    try:
        for element in (e for tag in _FACES for e in geometry.iterfind(f".//{{*}}{tag}")):
            offsets = [int(i.get("offset", "0")) for i in element.iterfind("{*}input")]
            texts = [p.text or "" for p in element.iterfind("{*}p")]
            numbers = sum(text.count(" ") + text.count("\n") for text in texts)
            corners = numbers // (1 + max(offsets, default=0))
            faces += max(int(element.get("count") or 0), corners // 3)
            # pycollada makes room for as many corners as polygons are said to have
            counts = [int(n) for v in element.iterfind("{*}vcount") for n in (v.text or "").split()]
            check_size(path, vertices=sum(map(abs, counts)))
    except (ValueError, ZeroDivisionError):
        raise _broken(path, "a count or offset of its faces is not a number") from None
    return faces


def read_glb(data: bytes, path: Path, files: ModelFiles) -> Arrays:
    """Binary glTF 2.0."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise _broken(path, "has no GLB header")
    version, length, json_length = struct.unpack_from("<III", data, 4)
    if version != 2 or length != len(data) or json_length > length - 20:
        raise _broken(path, f"its GLB header does not fit its {len(data)} bytes or is not glTF 2")
    return read_gltf(data, path, files, data[20 : 20 + json_length])


def read_gltf(data: bytes, path: Path, files: ModelFiles, text: bytes | None = None) -> Arrays:
    """glTF 2.0 as JSON; its buffers lie inside it or in files of the model. Of a GLB that is its
    `text`."""
    text = data if text is None else text
    document, buffers = _check_gltf(text, path, files)

    def read(looks: Looks) -> materials.ScenePaint:
        chunk = data[len(text) + 28 :]  # of a GLB
        return materials.Gltf(document, chunk, buffers).scene_paint(looks, path, files)

    scene_paint = _spared(path, read)
    return _through_trimesh(data, path, scene_paint, resolver=buffers, skip_materials=True)


def _spared(path: Path, read: Callable[[Looks], _T]) -> _T | None:
    """Return what is read of materials where they are wanted; a note where they are amiss."""
    if looks := wanted_looks():
        try:
            with _parsing(path):
                return read(looks)
        except InvalidSource:
            looks.miss(path.name)
    return None


def _through_trimesh(
    data: bytes, path: Path, scene_paint: materials.ScenePaint | None = None, **options: Any
) -> Arrays:
    import trimesh  # noqa: PLC0415 - takes a second, and many commands read no mesh

    file_type = path.suffix.lower().lstrip(".")
    with _parsing(path):
        scene = trimesh.load_scene(io.BytesIO(data), file_type=file_type, process=False, **options)
        vertices, faces, shown = _baked(scene, path, trimesh.Trimesh)
    if scene_paint is None:
        return vertices, faces, None
    return vertices, faces, lambda: _spared(path, lambda _: scene_paint(scene, shown))


@contextmanager
def _parsing(path: Path) -> Iterator[None]:
    """Make a refusal of whatever a foreign parser meets in a broken file."""
    try:
        yield
    except (InvalidSource, MemoryError):
        raise
    except Exception as error:
        fault = machine_fault(error)
        if fault is not None:
            raise fault from error
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200].rstrip(": ")
        raise _broken(path, f"cannot be read as {path.suffix[1:].upper()} ({reason})") from None


def _baked(scene: Any, path: Path, kind: type) -> tuple[Floats, Ints, materials.Shown]:
    """Return all triangles of a scene, world frame; mirrored nodes keep their outside outside."""
    shown: materials.Shown = []
    vertices: list[Floats] = [np.zeros((0, 3))]
    faces: list[Ints] = [np.zeros((0, 3), np.int64)]
    offset = total = 0
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        # single precision, as these formats': trimesh's last bits depend on the processor
        T = T.astype(np.float32).astype(np.float64)
        mesh = scene.geometry[name]
        if not isinstance(mesh, kind):
            continue
        indices = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
        if indices.size and (indices.min() < 0 or indices.max() >= len(mesh.vertices)):
            raise _broken(path, f"a face of {name!r} names a vertex that is not there")
        mirrored = bool(np.linalg.det(T[:3, :3]) < 0)
        faces.append((indices[:, ::-1] if mirrored else indices) + offset)
        vertices.append(apply(T, mesh.vertices))
        shown.append((name, len(indices), mirrored))
        offset += len(mesh.vertices)
        total += len(indices)
        check_size(path, faces=total, vertices=offset)
    return np.concatenate(vertices), np.concatenate(faces), shown


def _check_gltf(text: bytes, path: Path, files: ModelFiles) -> tuple[Any, dict[str, bytes]]:
    """Refuse a glTF document that trimesh would misread; return it, and the buffers it names."""
    try:
        document = json.loads(text)
        faces = _check_triangles(document, path)
        _check_nodes(document.get("nodes", []), faces, path)
        if document.get("nodes") and not document.get("scenes"):
            raise _broken(path, "has no scene, which would say what is shown")
        names = [b["uri"] for b in document.get("buffers", []) if "uri" in b]
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"[:200]
        raise _broken(path, f"not a glTF document ({reason})") from None
    buffers: dict[str, bytes] = {}
    for name in names:
        if not isinstance(name, str):
            raise _broken(path, f"the uri of a buffer is {name!r}, not a text"[:200])
        if not name.startswith("data:"):
            inside = unquote(name)
            if "\0" not in inside:
                inside = os.path.relpath(path.resolve().parent / inside, files.folder)
            file = files.find(inside, f"{path}: buffer {quoted(name)}")
            if file is None:
                raise InvalidSource(
                    f"{path}: its buffer {quoted(name)} is missing; put it beside it"
                )
            buffers[name] = files.read(file)
    return document, buffers


def _check_triangles(document: dict[str, Any], path: Path) -> list[int]:
    """Return the triangles of each mesh; positions must be plain floats in a buffer, and nothing
    else may move them than the nodes."""
    faces = []
    for moved in (*document.get("nodes", []), *document.get("meshes", [])):
        instanced = "EXT_mesh_gpu_instancing" in moved.get("extensions", ())
        if instanced or "skin" in moved or any(moved.get("weights", ())):
            raise _broken(path, "has instanced, skinned or morphed meshes, which are not read")
    for mesh in document.get("meshes", []):
        faces.append(0)
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
            if any(not 0 < a["count"] <= MAX_VERTICES for a in accessors):
                raise _broken(path, "an accessor has no or too many elements")
            faces[-1] += accessors[-1]["count"] // 3
    for view in document.get("bufferViews", []):
        if view.get("byteOffset", 0) < 0 or view["byteLength"] < 0:
            raise _broken(path, "a buffer view has a negative size or offset")
    return faces


def _check_nodes(nodes: list[dict[str, Any]], faces: list[int], path: Path) -> None:
    """Nodes form trees, as the format demands: no node has two parents or is its own ancestor; and
    the meshes on them (with this number of `faces`) are not too much together."""
    children = [child for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children) or not set(children) <= set(range(len(nodes))):
        raise _broken(path, "its nodes do not form a tree")
    reached = sorted(set(range(len(nodes))) - set(children))
    for i in reached:  # grows while it is walked; a loop is never reached from a root
        reached += nodes[i].get("children", [])
    if len(reached) < len(nodes):
        raise _broken(path, "its nodes form a loop")
    if len(nodes) > _MAX_NODES:
        raise _broken(path, f"its scene has more than {_MAX_NODES:,} nodes")
    check_size(path, faces=sum(faces[node["mesh"]] for node in nodes if "mesh" in node))


def check_size(path: Path, *, faces: float = 0, vertices: float = 0) -> None:
    """Raise InvalidSource for too many triangles or vertices, best before any is made."""
    if faces > MAX_FACES or vertices > MAX_VERTICES:
        raise InvalidSource(
            f"{path}: more than {MAX_FACES:,} triangles or {MAX_VERTICES:,} vertices; simplify it"
        )


def _broken(path: Path, problem: str) -> InvalidSource:
    return InvalidSource(f"{path}: {problem}; export it again")
