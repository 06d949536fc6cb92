"""The surfaces that a stage shows, as triangles in stage coordinates."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.errors import InvalidSource
from articugen.core.geometry import apply, cross
from articugen.core.portable import dot
from articugen.core.records import Mesh
from articugen.meshes import openusd as pxr
from articugen.meshes import read
from articugen.meshes.scenes import check_size
from articugen.sources.usd.transforms import Places, numbers, value_of

MAX_SHAPES = 5_000
_MIN_SIZE = 1e-9

_REFUSED = {"PointInstancer": "instances by points", "SkelRoot": "skinned meshes"}
_NOT_READ = ("BasisCurves", "NurbsCurves", "HermiteCurves", "NurbsPatch", "Points", "TetMesh",
             "Plane", "Volume", "Capsule_1", "Cylinder_1")  # fmt: skip


class Shapes:
    """Makes the meshes of the prims of one stage, and counts them; `left_out` are types of prims
    that show something and are not read."""

    def __init__(self, path: Path, places: Places) -> None:
        self._path, self._places = path, places
        self._faces = self._vertices = self._count = 0
        self.left_out: set[str] = set()

    def shown(self, prim: Any) -> bool:
        """Return whether a prim is a surface that is seen: not a guide or proxy, not hidden;
        InvalidSource for a kind without which the model would not be itself."""
        kind = str(prim.GetTypeName())
        if kind not in (*_REFUSED, *_NOT_READ, *_MAKERS):
            return False
        imageable = pxr.UsdGeom.Imageable(prim)
        hidden = imageable.ComputeVisibility() == pxr.UsdGeom.Tokens.invisible
        if hidden or imageable.ComputePurpose() not in ("default", "render"):
            return False
        if kind in _REFUSED:
            raise InvalidSource(
                f"{self._path}: {prim.GetPath()}: has {_REFUSED[kind]}, which are not read; flatten"
                " the model"
            )
        if kind in _NOT_READ:
            self.left_out.add(kind)
            return False
        return True

    def triangles(self, prim: Any) -> Mesh:
        """Return (V, 3) in stage coordinates and (F, 3) of a prim that is `shown`; InvalidSource if
        anything is amiss with it, or all together are too many."""
        by = f"{self._path}: {prim.GetPath()}"
        self._count += 1
        if self._count > MAX_SHAPES:
            raise InvalidSource(f"{self._path}: shows more than {MAX_SHAPES:,} shapes; merge some")
        shape = _MAKERS[str(prim.GetTypeName())](prim, by)
        try:
            mesh = read.checked(shape.vertices, shape.faces, Path(by))
        except read.NoMesh:
            raise InvalidSource(f"{by}: has no triangle; remove it, or export it again") from None
        self._faces += len(mesh.faces)
        self._vertices += len(mesh.vertices)
        check_size(self._path, faces=self._faces, vertices=self._vertices)
        T = self._places.of(prim)
        x, y, z = T[:3, 0], T[:3, 1], T[:3, 2]
        volume = dot(x, cross(y, z))
        if volume == 0.0:
            raise InvalidSource(f"{by}: is scaled to nothing; correct its scale")
        return Mesh(apply(T, mesh.vertices), mesh.faces[:, ::-1] if volume < 0.0 else mesh.faces)


def _mesh(prim: Any, by: str) -> Mesh:
    mesh = pxr.UsdGeom.Mesh(prim)
    points = _array(mesh.GetPointsAttr(), np.float64, by).reshape(-1, 3)
    counts = _array(mesh.GetFaceVertexCountsAttr(), np.int64, by)
    corners = _array(mesh.GetFaceVertexIndicesAttr(), np.int64, by)
    if (counts.size and counts.min() < 0) or counts.sum() != len(corners):
        raise InvalidSource(
            f"{by}: its faces have {counts.sum():,} corners and its indices are {len(corners):,}; "
            "export it again"
        )
    check_size(Path(by), faces=float(np.maximum(counts - 2, 0).sum()), vertices=len(points))
    kept = ~np.isin(np.arange(len(counts)), _array(mesh.GetHoleIndicesAttr(), np.int64, by))
    faces = read.fans(corners[np.repeat(kept, counts)], counts[kept])
    if faces.size and not 0 <= faces.min() <= faces.max() < len(points):
        raise InvalidSource(f"{by}: a face names a point that is not there; export it again")
    if value_of(mesh.GetOrientationAttr(), by) == pxr.UsdGeom.Tokens.leftHanded:
        faces = faces[:, ::-1]
    return Mesh(points, faces.astype(np.int32))


def _array(attribute: Any, kind: type, by: str) -> Any:
    """Return an array attribute; of one without a value an empty one."""
    value = value_of(attribute, by)
    return np.zeros(0, kind) if value is None else np.array(value).astype(kind)


def _size(prim: Any, name: str, by: str) -> float:
    size = float(numbers(value_of(prim.GetAttribute(name), by), (), by, f"its {name}"))
    if size < _MIN_SIZE:
        raise InvalidSource(f"{by}: its {name} is {size:g}; make it more than 0")
    return size


def _lathed(make: Callable[[float, float], Mesh]) -> Callable[[Any, str], Mesh]:
    """Return what makes a shape about the axis that its prim has, of one about z."""

    def made(prim: Any, by: str) -> Mesh:
        mesh = make(_size(prim, "radius", by), _size(prim, "height", by))
        shift = {"X": 1, "Y": 2}.get(str(value_of(prim.GetAttribute("axis"), by)), 0)
        return Mesh(np.roll(mesh.vertices, shift, axis=1), mesh.faces)

    return made


_MAKERS: Mapping[str, Callable[[Any, str], Mesh]] = {
    "Mesh": _mesh,
    "Cube": lambda prim, by: read.box([_size(prim, "size", by)] * 3),
    "Sphere": lambda prim, by: read.sphere(_size(prim, "radius", by)),
    "Cylinder": _lathed(read.cylinder),
    "Capsule": _lathed(read.capsule),
    "Cone": _lathed(read.cone),
}
