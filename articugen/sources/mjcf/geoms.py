"""The meshes of an MJCF's geoms, and which of them are seen."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import InvalidSource
from articugen.core.portable import turned
from articugen.core.records import Mesh
from articugen.meshes import read
from articugen.meshes.model_files import quoted
from articugen.meshes.simpler import hull
from articugen.sources.mjcf.document import Document
from articugen.sources.mjcf.places import ends, place, quaternion
from articugen.sources.shapes import Shapes
from articugen.sources.xml_check import MIN_SIZE

NO_SURFACE = ("plane", "hfield", "sdf")
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
_HIDDEN = 3  # the first group of geoms that MuJoCo's viewer does not show


def seen(geoms: Sequence[Any], document: Document) -> list[Any]:
    """Return the geoms of a body that are seen: not wholly transparent; of groups 0 to 2, if any
    is; of these, where some that collide with nothing are in groups of their own, only these."""

    def number(geom: Any, name: str, default: str) -> float:
        return document.numbers(geom, name, (len(default.split()),), default)[-1]

    geoms = [geom for geom in geoms if geom.get("type") not in NO_SURFACE]
    groups = {geom: number(geom, "group", "0") for geom in geoms if number(geom, "rgba", "1 1 1 1")}
    shown = [geom for geom in groups if groups[geom] < _HIDDEN] or list(groups)
    collide = (g for g in shown if number(g, "contype", "1") or number(g, "conaffinity", "1"))
    touching = {groups[geom] for geom in collide}
    return [geom for geom in shown if groups[geom] not in touching] or shown


class Geoms:
    """Makes the meshes of geoms."""

    def __init__(self, document: Document, shapes: Shapes) -> None:
        """InvalidSource where two mesh assets share a name."""
        self._document, self._shapes = document, shapes
        self._assets: dict[str, Any] = document.named(document.root.iterfind("asset/mesh"))

    def mesh(self, geom: Any) -> tuple[Mesh, Any, Floats]:
        """Return the mesh of a geom, the geom, and `T_parent_geom`."""
        kind, document = geom.get("type", "sphere"), self._document
        if kind == "mesh":
            return self._asset(geom), geom, place(geom, document)
        if kind not in _SIZES or geom.get("mesh") is not None:
            what = f"a {quoted(kind)}{' fitted to a mesh' if kind in _SIZES else ''}"
            raise document.refuse(geom, f"is {what}; make it a mesh, {', '.join(_SIZES)}")
        count = _SIZES[kind]
        size = document.numbers(geom, "size", (1, 2, 3), "0")
        if geom.get("fromto") is None:
            T = place(geom, document)
        else:
            T, half = ends(geom, document)
            size = [*([size[0]] * (count - 1)), half] if count > 1 else size
        if len(size) < count or not min(size[:count]) >= MIN_SIZE:
            raise document.refuse(geom, f"a {kind} has {count} sizes above 0; correct its size")
        if kind == "box":
            mesh = read.box(2.0 * np.array(size))
        elif kind in ("sphere", "ellipsoid"):
            mesh = read.scaled(read.sphere(1.0), size if count == 3 else size[:1] * 3)
        else:
            mesh = (read.capsule if kind == "capsule" else read.cylinder)(size[0], 2.0 * size[1])
        return mesh, geom, T

    def _asset(self, geom: Any) -> Mesh:
        name, document = geom.get("mesh", ""), self._document
        asset = self._assets.get(name)
        if asset is None:
            raise document.refuse(geom, f"unknown mesh {quoted(name)}; add it or correct it")
        if not isinstance(asset, Mesh):
            by = f"{document.path}: mesh {quoted(name)}"
            file = asset.get("file")
            mesh = self._shapes.file(file, by) if file else _written_out(asset, by)
            scale = document.numbers(asset, "scale", (3,), "1 1 1")
            if min(map(abs, scale)) < MIN_SIZE:
                raise document.refuse(asset, "has a zero scale, or nearly; give it another")
            moved = mesh.vertices - document.numbers(asset, "refpos", (3,), "0 0 0")
            moved = turned(quaternion(asset, "refquat", document).T, moved)
            asset = self._assets[name] = read.scaled(replace(mesh, vertices=moved), scale)
        return asset


def _written_out(asset: Any, by: str) -> Mesh:
    """Return a mesh whose vertices are in the XML; without faces it is their convex hull."""
    try:
        vertices = np.array(asset.get("vertex", "").split(), np.float64).reshape(-1, 3)
        faces = np.array(asset.get("face", "").split(), np.int64).reshape(-1, 3)
    except (ValueError, OverflowError):
        raise InvalidSource(f"{by}: its vertex or face is not in threes; correct it") from None
    if not faces.size:
        whole = hull(vertices)
        vertices, faces = whole.vertices, whole.faces
    return read.checked(vertices, faces, Path(by))
