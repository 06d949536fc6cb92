"""Materials of glTF and COLLADA, read beside the triangles, which never depend on them.

A glTF's is the baseColorFactor, which is linear light, times the baseColorTexture; COLLADA's the
diffuse colour, taken as sRGB like the Kd of an OBJ, or the diffuse texture. Any
exception may come of what is amiss with them.
"""

import base64
import io
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from articugen.core.arrays import Bytes, Floats, Ints
from articugen.core.colours import srgb
from articugen.meshes.looks import GREY, Looks, Material, rgb_of
from articugen.meshes.model_files import ModelFiles

_MOST_MATERIALS = 10_000  # of a glTF
_MOST_IMAGES = 256  # inside it
_MADE = (0, 1, 4, 5)  # modes of its primitives that trimesh makes a geometry of
_UV = {5126: ("<f4", 1.0), 5121: ("u1", 255.0), 5123: ("<u2", 65535.0)}
"""By componentType, and the number of the texture's edge."""

Shown = list[tuple[str, int]]
"""Names of geometries of a scene of trimesh, and how many faces each has, in the order of faces."""

ScenePaint = Callable[[Any, Shown], Bytes | None]
"""Returns (F, 3) sRGB of the faces of such a scene; None where it states no material."""


class _Coat(NamedTuple):
    """Material of a geometry, and where the corners of its faces lie in the texture, v up."""

    material: Material = GREY
    places: Floats = np.full((1, 3, 2), np.nan)  # or (F, 3, 2)


def _painted(looks: Looks, coats: list[_Coat], shown: Shown) -> Bytes | None:
    counts = [n for _, n in shown]
    places = [
        np.broadcast_to(coat.places, (n, 3, 2)) for coat, n in zip(coats, counts, strict=True)
    ]
    which = np.repeat(np.arange(len(coats)), counts)
    return looks.painted([coat.material for coat in coats], which, np.concatenate(places))


class Gltf:
    """A document, the buffer of its GLB, and its `outside` buffers, by their names."""

    def __init__(self, document: Any, chunk: bytes, outside: Mapping[str, bytes]) -> None:
        uris = [buffer.get("uri") for buffer in document.get("buffers", [])]
        self._buffers = [
            chunk if uri is None else outside[uri] if uri in outside else _inline(uri)
            for uri in uris
        ]
        self._document = document

    def scene_paint(self, looks: Looks, path: Path, files: ModelFiles) -> ScenePaint:
        """Read the materials, and the files of their textures."""
        known: list[tuple[Material, str]] = []
        for stated in self._document.get("materials", [])[:_MOST_MATERIALS]:
            base = stated.get("pbrMetallicRoughness", {})
            light = rgb_of(base.get("baseColorFactor", (1.0,))[:3]) or (1.0, 1.0, 1.0)
            texture = base.get("baseColorTexture", {})
            picture = self._texture(texture, looks, path, files) if "index" in texture else None
            attribute = f"TEXCOORD_{texture.get('texCoord', 0)}"
            known.append((Material(tuple(srgb(light).tolist()), picture), attribute))

        def coat(primitive: Any, mesh: Any) -> _Coat:
            if "material" not in primitive:
                return _Coat()
            material, attribute = known[primitive["material"]]
            place = primitive["attributes"].get(attribute)
            if material.texture is None or place is None:
                return _Coat(material)
            return _Coat(material, self._places(place, mesh.faces))

        def scene_paint(scene: Any, shown: Shown) -> Bytes | None:
            every = chain.from_iterable(m["primitives"] for m in self._document["meshes"])
            drawn = [primitive for primitive in every if primitive.get("mode", 4) in _MADE]
            of_name = dict(zip(scene.geometry, drawn, strict=True))
            coats = {name: coat(of_name[name], scene.geometry[name]) for name in dict(shown)}
            return _painted(looks, [coats[name] for name, _ in shown], shown)

        return scene_paint

    def _texture(self, texture: Any, looks: Looks, path: Path, files: ModelFiles) -> Path | None:
        """Read a texture, undecoded; None where it cannot be read."""
        if "KHR_texture_transform" in texture.get("extensions", {}):
            return looks.miss("KHR_texture_transform")
        source = self._document["textures"][texture["index"]]
        n = {**source.get("extensions", {}).get("EXT_texture_webp", {}), **source}["source"]
        image = self._document["images"][n]
        uri = image.get("uri", "data:")
        if not uri.startswith("data:"):
            return looks.find(unquote(uri), path, files)
        if not 0 <= n < _MOST_IMAGES:
            return looks.miss(f"image {n}")
        data = self._view(image["bufferView"])[0] if "bufferView" in image else _inline(uri)
        return looks.inside(path / f"image {n}", data)

    def _view(self, n: int) -> tuple[memoryview, int | None]:
        """Return the bytes of a buffer view, and its stride."""
        view = self._document["bufferViews"][n]
        first = view.get("byteOffset", 0)
        data = memoryview(self._buffers[view["buffer"]])[first : first + view["byteLength"]]
        return data, view.get("byteStride")

    def _places(self, n: int, faces: Ints) -> Floats:
        """Return (F, 3, 2) of faces of vertices whose places in a texture an accessor has."""
        accessor = self._document["accessors"][n]
        data, stride = self._view(accessor["bufferView"])
        kind, edge = _UV[accessor["componentType"]]
        size, count = np.dtype(kind).itemsize, accessor["count"]
        stride = 2 * size if stride is None else stride
        if accessor["type"] != "VEC2" or not 0 < stride < 256 or count > len(data):
            raise ValueError("places in a texture that are none")
        first = accessor.get("byteOffset", 0)
        uv = np.ndarray((count, 2), kind, data, first, (stride, size))[faces].astype(np.float64)
        return np.stack([uv[..., 0] / edge, 1.0 - uv[..., 1] / edge], axis=-1)


def _inline(uri: str) -> bytes:
    return base64.b64decode(uri.partition("base64,")[2])


def of_dae(data: bytes, looks: Looks, path: Path, files: ModelFiles) -> ScenePaint:
    """Read the materials of a COLLADA document whose size is checked, and the files of their
    textures. All of it is read, as the triangles are once more without what it states of looks."""
    from collada import Collada, DaeError, scene, triangleset  # noqa: PLC0415 - slow to import

    def coat(primitive: Any, material: Any) -> _Coat:
        if material not in known:
            known[material] = _of_effect(material.effect.diffuse, looks, path, files)
        places = np.full((len(primitive.vertex_index), 3, 2), np.nan)
        if primitive.texcoordset:
            places = primitive.texcoordset[0][primitive.texcoord_indexset[0]].astype(np.float64)
        return _Coat(known[material], places)

    def walk(node: Any) -> Iterator[_Coat]:
        """Yield the coats of geometries in the order in which trimesh makes these."""
        if not isinstance(node, scene.GeometryNode):
            for child in getattr(node, "children", None) or ():
                yield from walk(child)
            return
        if node not in nodes:
            bound = {material.symbol: material.target for material in node.materials}
            nodes[node] = [
                coat(primitive, bound.get(primitive.material))
                for primitive in map(_as_triangles, node.geometry.primitives)
                if isinstance(primitive, triangleset.TriangleSet) and primitive.vertex is not None
            ]
        yield from nodes[node]

    known: dict[Any, Material] = {None: GREY}
    nodes: dict[Any, list[_Coat]] = {}
    document: Any = Collada(io.BytesIO(data), ignore=[DaeError])
    every = [coat for node in document.scene.nodes for coat in walk(node)]
    return lambda _scene, shown: _painted(looks, every, shown)


def _as_triangles(primitive: Any) -> Any:
    return primitive.triangleset() if hasattr(primitive, "triangleset") else primitive


def _of_effect(diffuse: Any, looks: Looks, path: Path, files: ModelFiles) -> Material:
    """Return the material of COLLADA's diffuse colour or texture."""
    if hasattr(diffuse, "sampler"):
        name = unquote(diffuse.sampler.surface.image.path).removeprefix("file://")
        return Material((1.0, 1.0, 1.0), looks.find(name, path, files))
    kd = rgb_of(() if diffuse is None else diffuse[:3])
    return Material(kd) if kd else GREY
