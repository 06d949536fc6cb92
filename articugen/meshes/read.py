"""Mesh files and primitive shapes to `Mesh`: OBJ and STL read here, other formats by `scenes`.

OBJ has a reader of its own because a real model has up to 270 small OBJ files, and STL because
trimesh accepts headers that lie. Whatever reads a file, `checked` sees the result.
"""

import codecs
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from articugen.core.arrays import Floats, Ints
from articugen.core.errors import InvalidSource
from articugen.core.portable import cos, sin
from articugen.core.records import Mesh
from articugen.meshes import scenes
from articugen.meshes.looks import Painted, wanted_looks
from articugen.meshes.model_files import ModelFiles, quoted

MAX_LINE_BYTES = 2**20  # of an OBJ: a face with so many corners is none
MAX_COORDINATE = 1e9
"""Largest absolute coordinate; beyond it differences lose everything smaller than 0.1 um."""

_WANTED = ContextVar("_WANTED", default="meshes")

_NAME_OTHER_FILES = (".glb", ".gltf")
"""Formats whose files must be understood before one knows all bytes that count."""

STAND_IN = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32))


def wanted() -> str:
    """Return what is wanted of mesh files: their "meshes", their "hash" alone, or "nothing"."""
    return _WANTED.get()


@contextmanager
def wanting(what: str) -> Iterator[None]:
    """Meanwhile have `read_mesh` give a stand-in of one triangle for any file.

    Where the "hash" of a model is wanted it reads files all the same, so that their bytes count:
    that of a sound model is what it always is. Where "nothing" is but its joints, no file is opened
    and the hash is of no use.
    """
    token = _WANTED.set(what)
    try:
        yield
    finally:
        _WANTED.reset(token)


class NoMesh(InvalidSource):
    """A mesh file that is missing, or has no triangle."""


def read_mesh(path: Path, files: ModelFiles | None = None) -> Mesh:
    """Read the triangles of a mesh file of any of `_READERS`, in file units and frame.

    Polygons become fans; nodes of a scene are baked in; lines and points are ignored.
    Faces that name a vertex twice are dropped, nothing else: no merging, no reordering.

    Args:
        path: the file.
        files: reads it (and what a .gltf names), so that it counts in the model's hash; by default
            only files in the folder of `path` can be read.

    Raises:
        NoMesh: no triangle in it.
        InvalidSource: unreadable, of an unknown format, inconsistent, too large, or not finite.
    """
    files = files or ModelFiles(path.parent)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InvalidSource(
            f"{path}: {quoted(path.suffix)} is no known mesh format; convert it to one of "
            f"{', '.join(_READERS)}"
        )
    if wanted() == "nothing":
        return STAND_IN
    data = files.read(path)
    looks = wanted_looks()
    names_others = (*_NAME_OTHER_FILES, ".dae") if looks else _NAME_OTHER_FILES
    if wanted() == "hash" and path.suffix.lower() not in names_others:
        if looks and path.suffix.lower() == ".obj":
            looks.materials(_obj_lines(data), path, files)
        return STAND_IN
    vertices, faces, paint = read(data, path, files)
    painted = paint() if paint and wanted() == "meshes" else None
    return checked(vertices, faces, path, painted)


def checked(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    path: Path,
    painted: Painted | None = None,
) -> Mesh:
    """Make a `Mesh` of (V, 3) vertices and (F, 3) faces of a stranger; raises as `read_mesh`."""
    vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    scenes.check_size(path, faces=len(faces), vertices=len(vertices))
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InvalidSource(
            f"{path}: a face names a vertex that is not there ({len(vertices)} vertices); export it"
            " again"
        )
    if not (np.abs(vertices) <= MAX_COORDINATE).all():
        raise InvalidSource(
            f"{path}: a coordinate is not finite, or beyond {MAX_COORDINATE:g}; export it again"
        )
    a, b, c = faces.T
    sound = (a != b) & (b != c) & (c != a)
    faces = faces[sound]
    if len(faces) == 0:
        raise NoMesh(f"{path}: has no triangle; remove the <visual> that uses it or export again")
    colours, texture = painted.of(sound) if painted else (None, None)
    return Mesh(vertices, faces.astype(np.int32), colours, texture)


def box(size: ArrayLike) -> Mesh:
    """Return a closed box of edges `size` (3,), about the origin; ValueError if one is not > 0."""
    if not (np.asarray(size) > 0.0).all():
        raise ValueError(f"a box of the size {np.asarray(size)}; each length must be above 0")
    corners = np.array([[(i >> 2) & 1, (i >> 1) & 1, i & 1] for i in range(8)]) - 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(
        corners * np.asarray(size), fans(np.array(quads).ravel(), np.full(6, 4)).astype(np.int32)
    )


_SECTIONS = 64  # corners of a circle, meridians of a sphere; it has half as many parallels


def cylinder(radius: float, length: float) -> Mesh:
    """Return a closed cylinder about z, centred on the origin."""
    return _lathe(np.array([0.0, radius, radius, 0.0]), np.array([-0.5, -0.5, 0.5, 0.5]) * length)


def sphere(radius: float) -> Mesh:
    """Return a closed sphere about the origin."""
    polar = np.linspace(np.pi, 0.0, _SECTIONS // 2 + 1)
    around = sin(polar)
    around[[0, -1]] = 0.0
    return _lathe(radius * around, radius * cos(polar))


def capsule(radius: float, length: float) -> Mesh:
    """Return a closed cylinder about z of that length, centred on the origin, with a half sphere on
    each end."""
    polar = np.linspace(np.pi, 0.5 * np.pi, _SECTIONS // 4 + 1)
    around, along = sin(polar), cos(polar)
    around[0], along[-1] = 0.0, 0.0
    half = 0.5 * length
    return _lathe(
        radius * np.concatenate([around, around[::-1]]),
        np.concatenate([radius * along - half, half - radius * along[::-1]]),
    )


def cone(radius: float, height: float) -> Mesh:
    """Return a closed cone about z with its tip up, centred on the origin as its box is."""
    return _lathe(np.array([0.0, radius, 0.0]), np.array([-0.5, -0.5, 0.5]) * height)


PRIMITIVE_FACES = {"box": 12, "cylinder": 4 * 64, "sphere": 62 * 64, "capsule": 64 * 64}
"""Triangles of each, to be counted before any is made."""


def scaled(mesh: Mesh, scale: ArrayLike) -> Mesh:
    """`mesh` scaled along x, y, z; a mirrored one is turned outside out again."""
    mirrored = np.prod(np.sign(scale)) < 0
    if mirrored:
        texture = mesh.texture and mesh.texture.turned()
        mesh = replace(mesh, faces=mesh.faces[:, ::-1], texture=texture)
    return replace(mesh, vertices=mesh.vertices * np.asarray(scale))


def fans(corners: NDArray[np.integer], counts: NDArray[np.integer]) -> Ints:
    """Triangles (F, 3) of polygons, each a fan about its first corner.

    Args:
        corners: the vertex indices of all polygons, one after another.
        counts: (P,) corners of each polygon; a polygon of fewer than 3 gives nothing.
    """
    triangles = np.maximum(counts - 2, 0)
    start = np.repeat(np.cumsum(counts) - counts, triangles)
    nth = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    picked = np.stack([start, start + nth + 1, start + nth + 2], axis=1)
    return np.asarray(corners, np.int64)[picked]


def _lathe(radii: Floats, heights: Floats) -> Mesh:
    """Return the closed surface of a profile turned about z: radius 0 at both ends, heights
    ascending."""
    turn = 2.0 * np.pi * np.arange(_SECTIONS) / _SECTIONS
    ring = np.stack([cos(turn), sin(turn), np.zeros(_SECTIONS)], axis=1)
    rings = [ring * r + [0.0, 0.0, z] for r, z in zip(radii[1:-1], heights[1:-1], strict=True)]
    poles = [[0.0, 0.0, heights[0]], [0.0, 0.0, heights[-1]]]
    here = np.arange(_SECTIONS)
    there = (here + 1) % _SECTIONS
    bottom = len(rings) * _SECTIONS
    last = bottom - _SECTIONS
    faces = [np.stack([there, here, np.full(_SECTIONS, bottom)], axis=1)]
    for low in range(0, last, _SECTIONS):
        high = low + _SECTIONS
        faces.append(np.stack([low + here, low + there, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, high + here], axis=1))
    faces.append(np.stack([last + here, last + there, np.full(_SECTIONS, bottom + 1)], axis=1))
    return Mesh(np.concatenate([*rings, poles]), np.concatenate(faces).astype(np.int32))


_OBJ_VERTEX = re.compile(rb"\nv(?=\s)" + 3 * rb"[ \t\v\f]*(\S*)")
_OBJ_POLYGON = re.compile(rb"\nf(?=\s)([^\n#]*)")
_OBJ_BLANKS = bytes.maketrans(b"\r\t\v\f", b"\n   ")


def _obj_lines(data: bytes) -> bytes:
    """Return whole lines, each after a line feed."""
    data = data.removeprefix(codecs.BOM_UTF8)
    if b"\\" in data:
        data = re.sub(rb"\\\r?\n", b" ", data)
    return re.sub(rb"\n[ \t\v\f]+", b"\n", b"\n%b\n" % data.translate(_OBJ_BLANKS))


def _read_obj(data: bytes, path: Path, files: ModelFiles) -> scenes.Arrays:
    """Read `v` and `f` lines, also with texture and normal indices, polygons, negative (relative)
    indices, continued lines and comments; materials where they are wanted."""
    data = _obj_lines(data)
    if data.count(b"\nv") > scenes.MAX_VERTICES or data.count(b"\nf") > scenes.MAX_FACES:
        vertices, faces = (
            sum(data.count(b"\n%b%c" % (kind, blank)) for blank in _BLANKS) for kind in (b"v", b"f")
        )
        scenes.check_size(path, faces=faces, vertices=vertices)
    vertices, lines = _OBJ_VERTEX.findall(data), _OBJ_POLYGON.findall(data)
    text = b"\n" + b"\n".join(lines)
    counts = _words(text, path)
    words = text.split()
    if b"/" in text:
        words = [word.partition(b"/")[0] for word in words]
    try:
        coordinates = np.fromiter(map(float, chain.from_iterable(vertices)), np.float64)
        corners = np.fromiter(map(int, words), np.int64)
    except (ValueError, OverflowError):
        line = quoted(_odd_line(data)[:60].decode(errors="replace"))
        raise InvalidSource(f"{path}: the line {line} is not OBJ; export it again") from None
    known = np.zeros(len(counts), np.int64)
    if lines and (corners < 0).any():
        begins = ([m.start() for m in kind.finditer(data)] for kind in (_OBJ_VERTEX, _OBJ_POLYGON))
        known = np.searchsorted(np.array(next(begins)), np.array(next(begins)))
    corners = np.where(corners < 0, corners + np.repeat(known, counts), corners - 1)
    looks = wanted_looks()
    paint = partial(looks.of_obj, data, path, files) if looks else None
    return coordinates.reshape(-1, 3), fans(corners, counts), paint


_BLANKS = b" \t\v\f\n"
_IS_BLANK = np.isin(np.arange(256), list(_BLANKS))


def _words(text: bytes, path: Path) -> Ints:
    """Count the words of each line; polygons that are too large are refused before room is made."""
    letters = np.frombuffer(text, np.uint8)
    first = np.flatnonzero(letters == ord("\n"))
    longest = int(np.diff(first, append=len(letters)).max())
    if longest > MAX_LINE_BYTES:
        raise InvalidSource(f"{path}: a line has {longest:,} bytes; export it again")
    blank = _IS_BLANK[letters]
    begins = blank & ~np.append(blank[1:], True)
    counts = np.add.reduceat(begins, first, dtype=np.int64)
    scenes.check_size(path, faces=int(np.maximum(counts - 2, 0).sum()))
    return counts


def _odd_line(data: bytes) -> bytes:
    """Return the first line of a vertex or polygon that is none."""
    for line in re.findall(rb"\n([vf](?=\s)[^\n]*)", data):
        words = line.split()[1:4]
        if line.startswith(b"f"):
            words = [w.partition(b"/")[0] for w in line.partition(b"#")[0].split()[1:]]
        try:
            if line.startswith(b"f"):
                np.fromiter(map(int, words), np.int64)
            elif len([float(word) for word in words]) < 3:
                return line
        except (ValueError, OverflowError):
            return line
    return b""


_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)")


def _read_stl(data: bytes, path: Path, _files: ModelFiles) -> scenes.Arrays:
    """STL, binary where the size fits the count in the header, else ASCII."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * _STL_TRIANGLE.itemsize:
        scenes.check_size(path, faces=count)
        corners = np.frombuffer(data, _STL_TRIANGLE, offset=84)["corners"]
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data:
        data = data.lower()  # some write FACET NORMAL
        scenes.check_size(path, faces=data.count(b"endfacet"), vertices=data.count(b"vertex"))
        texts = _STL_VERTEX.findall(data)
        try:
            corners = np.array([[float(x) for x in vertex] for vertex in texts], np.float64)
        except ValueError:
            raise InvalidSource(f"{path}: a vertex is not three numbers; export it again") from None
        if len(corners) != 3 * len(re.findall(rb"\bendfacet\b", data)):
            raise InvalidSource(f"{path}: a facet has not three vertices; export it again")
    else:
        raise InvalidSource(
            f"{path}: {len(data)} bytes do not hold the {count:,} triangles that its STL"
            " header claims; export it again"
        )
    with np.errstate(invalid="ignore"):  # of what is no number `checked` tells
        vertices = corners.reshape(-1, 3).astype(np.float64)
    return vertices, np.arange(len(vertices)).reshape(-1, 3), None


def _read_msh(data: bytes, path: Path, _files: ModelFiles) -> scenes.Arrays:
    """MuJoCo's own format: numbers of vertices, normals, texture coordinates and faces, and each of
    these."""
    counts = np.frombuffer(data[:16].ljust(16, b"\0"), "<u4")
    vertices, normals, coordinates, faces = map(int, counts)
    skipped = 3 * normals + 2 * coordinates
    if len(data) != 16 + 4 * (3 * vertices + skipped + 3 * faces):
        raise InvalidSource(f"{path}: its size does not fit its header; export it again")
    scenes.check_size(path, faces=faces, vertices=vertices)
    with np.errstate(invalid="ignore"):  # of what is no number `checked` tells
        points = np.frombuffer(data, "<f4", 3 * vertices, 16).astype(np.float64)
    corners = np.frombuffer(data, "<i4", 3 * faces, 16 + 4 * (3 * vertices + skipped))
    return points.reshape(-1, 3), corners.reshape(-1, 3), None


_READERS: dict[str, Callable[[bytes, Path, ModelFiles], scenes.Arrays]] = {
    ".obj": _read_obj,
    ".stl": _read_stl,
    ".msh": _read_msh,
    ".ply": scenes.read_ply,
    ".dae": scenes.read_dae,
    ".glb": scenes.read_glb,
    ".gltf": scenes.read_gltf,
}

SUFFIXES = tuple(_READERS)
"""Of the files that can be read."""
