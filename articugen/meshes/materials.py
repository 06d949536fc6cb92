"""Materials of glTF and COLLADA, read beside the triangles, which never depend on them.

A glTF's is the baseColorFactor, which is linear light, times the baseColorTexture and the colours
of vertices, COLOR_0; COLLADA's the diffuse colour, taken as sRGB like the Kd of an OBJ, or the
diffuse texture. Any exception may come of what is amiss with them.
"""

import base64
import io
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from articugen.core.arrays import Floats, Ints
from articugen.core.colours import srgb
from articugen.core.portable import sin_cos, turned
from articugen.meshes.looks import GREY, Looks, Material, Painted, rgb_of
from articugen.meshes.model_files import ModelFiles

_MOST_MATERIALS = 10_000  # of a glTF
_MOST_IMAGES = 256  # inside it
_MADE = (0, 1, 4, 5)  # modes of its primitives that trimesh makes a geometry of
_KINDS = {5126: ("<f4", 1.0), 5121: ("u1", 255.0), 5123: ("<u2", 65535.0)}
"""By componentType, and the number that stands for 1."""

Shown = list[tuple[str, int, bool]]
"""Names of geometries of a scene of trimesh, in the order of faces: how many faces each has, and
whether it is mirrored, so that their corners come in the other order."""

ScenePaint = Callable[[Any, Shown], Painted | None]
"""Returns what the faces of such a scene show; None where it states no material."""

_WHITE = Material((1.0, 1.0, 1.0))


class _Coat(NamedTuple):
    """Material of a geometry, where the corners of its faces lie in the texture, v up, and sRGB
    from 0 to 1 that they have besides."""

    material: Material = GREY
    places: Floats = np.full((1, 3, 2), np.nan)  # or (F, 3, 2)
    corners: Floats = np.ones((1, 3, 3))  # or (F, 3, 3)


def _painted(looks: Looks, coats: list[_Coat], shown: Shown) -> Painted | None:
    def joined(arrays: list[Floats]) -> Floats:
        return np.concatenate([
            np.broadcast_to(array, (n, *array.shape[1:]))[:, :: -1 if mirrored else 1]
            for array, (_, n, mirrored) in zip(arrays, shown, strict=True)
        ])  # fmt: skip

    which = np.repeat(np.arange(len(coats)), [n for _, n, _ in shown])
    places, corners = joined([coat.places for coat in coats]), joined([c.corners for c in coats])
    return looks.painted([coat.material for coat in coats], which, places, corners)


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
        known: list[tuple[Material, str, Floats]] = []
        for stated in self._document.get("materials", [])[:_MOST_MATERIALS]:
            base = stated.get("pbrMetallicRoughness", {})
            light = rgb_of(base.get("baseColorFactor", (1.0,))[:3]) or (1.0, 1.0, 1.0)
            texture = base.get("baseColorTexture", {})
            picture = self._texture(texture, looks, path, files) if "index" in texture else None
            moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
            attribute = f"TEXCOORD_{(texture | moved).get('texCoord', 0)}"
            material = Material(tuple(srgb(light).tolist()), picture)
            known.append((material, attribute, _moving(**moved)))

        def coat(primitive: Any, mesh: Any) -> _Coat:
            attributes, coat = primitive["attributes"], _Coat()
            if "COLOR_0" in attributes:
                light = self._at_corners(attributes["COLOR_0"], mesh.faces, ("VEC3", "VEC4"))
                light = np.clip(np.nan_to_num(light[..., :3]), 0.0, 1.0)
                coat = _Coat(_WHITE, corners=srgb(light))
            if "material" not in primitive:
                return coat
            material, attribute, moving = known[primitive["material"]]
            if material.texture is not None and attribute in attributes:
                uv = self._at_corners(attributes[attribute], mesh.faces, ("VEC2",))
                with np.errstate(over="ignore", invalid="ignore"):  # of places that are no numbers
                    uv = turned(moving[:, :2], uv) + moving[:, 2]
                coat = coat._replace(places=np.stack([uv[..., 0], 1.0 - uv[..., 1]], axis=-1))
            return coat._replace(material=material)

        def scene_paint(scene: Any, shown: Shown) -> Painted | None:
            every = chain.from_iterable(m["primitives"] for m in self._document["meshes"])
            drawn = [primitive for primitive in every if primitive.get("mode", 4) in _MADE]
            of_name = dict(zip(scene.geometry, drawn, strict=True))
            names = [name for name, *_ in shown]
            coats = {name: coat(of_name[name], scene.geometry[name]) for name in {*names}}
            return _painted(looks, [coats[name] for name in names], shown)

        return scene_paint

    def _texture(self, texture: Any, looks: Looks, path: Path, files: ModelFiles) -> Path | None:
        """Read a texture, undecoded; None where it cannot be read."""
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

    def _at_corners(self, n: int, faces: Ints, types: tuple[str, ...]) -> Floats:
        """Return (F, 3, k) what an accessor of one of these types has of the vertices of faces."""
        accessor = self._document["accessors"][n]
        data, stride = self._view(accessor["bufferView"])
        kind, one = _KINDS[accessor["componentType"]]
        size, count, columns = np.dtype(kind).itemsize, accessor["count"], int(accessor["type"][-1])
        stride = columns * size if stride is None else stride
        if accessor["type"] not in types or "sparse" in accessor:
            raise ValueError(f"an accessor that is no {' or '.join(types)}, or sparse")
        if not 0 < stride < 256 or count > len(data):
            raise ValueError("an accessor beyond its view")
        first = accessor.get("byteOffset", 0)
        values = np.ndarray((count, columns), kind, data, first, (stride, size))
        return values[faces].astype(np.float64) / one


def _moving(
    offset: Any = (0, 0), rotation: Any = 0.0, scale: Any = (1, 1), **_others: Any
) -> Floats:
    """Return (2, 3) that takes places in a texture, v down, through a KHR_texture_transform.

    A positive rotation is counter-clockwise on the picture, as the extension's text, its example
    and viewers have it; its listing turns the other way (KhronosGroup/glTF, issue 1563).
    """
    (u, v), (width, height) = offset, scale
    if not np.isfinite(np.array([u, v, width, height], np.float64)).all():
        raise ValueError("a KHR_texture_transform of no numbers")
    sine, cosine = sin_cos(rotation)
    return np.array([[cosine * width, sine * height, u], [-sine * width, cosine * height, v]])


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
                for p in node.geometry.primitives
                for primitive in [p.triangleset() if hasattr(p, "triangleset") else p]
                if isinstance(primitive, triangleset.TriangleSet) and primitive.vertex is not None
            ]
        yield from nodes[node]

    known: dict[Any, Material] = {None: GREY}
    nodes: dict[Any, list[_Coat]] = {}
    document: Any = Collada(io.BytesIO(data), ignore=[DaeError])
    every = [coat for node in document.scene.nodes for coat in walk(node)]
    return lambda _scene, shown: _painted(looks, every, shown)


def _of_effect(diffuse: Any, looks: Looks, path: Path, files: ModelFiles) -> Material:
    """Return the material of COLLADA's diffuse colour or texture."""
    if hasattr(diffuse, "sampler"):
        name = unquote(diffuse.sampler.surface.image.path).removeprefix("file://")
        return _WHITE._replace(texture=looks.find(name, path, files))
    kd = rgb_of(() if diffuse is None else diffuse[:3])
    return Material(kd) if kd else GREY
