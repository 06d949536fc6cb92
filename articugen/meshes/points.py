"""Files of points that others wrote, read distrustfully."""

import io
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import ArticugenError, InvalidSource
from articugen.core.files import read_or_refuse
from articugen.core.geometry import apply, invert_rigid, points_on_triangles
from articugen.core.records import Normalization
from articugen.core.seeding import generator
from articugen.meshes.model_files import claimed_rows
from articugen.meshes.opalign import view_of

FEWEST_POINTS = 64
LONGEST_EDGE = 0.9
"""Of an object over all its joint states in the unit frame, as data sets are made."""

MOST_BYTES = 1 << 28  # that a file of points may have, and what it unpacks to
UNIT = Normalization(np.zeros(3), 1.0)

_SMALLEST_EDGE, _FARTHEST_MIDDLE = 0.3, 0.25
_POINTS_ON_A_MESH = 8192


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a posed shape.

    Attributes:
        points: (n, 3) in the unit frame.
        frame: leads back to the file's own frame; the identity for a shard.
        hint: what looks wrong, in a sentence, or nothing.
        triangles: (F, 3, 3) of the mesh that the points were spread over, in the unit frame; None
            where points were given.
    """

    points: Floats
    frame: Normalization = UNIT
    hint: str = ""
    triangles: Floats | None = None


def cloud_of_file(path: Path, *, fit: bool = False) -> Cloud:
    """Return the points of a PLY, .npy, .npz or .xyz file, in an order that says nothing.

    Args:
        fit: the file is in a frame of its own; its bounding box is brought to where a data set's
            objects are. Theirs is the box over all joint states, which one cloud does not show, so
            this is an estimate. Axes stay: z must be up, and joints point as the category's do.

    Raises:
        InvalidSource: it cannot be read, or is no cloud to make sense of.
    """
    stored, triangles = shape_of_file(path)
    name = str(path)
    points = finite(stored, name)
    frame = UNIT
    if fit:
        low, high = points.min(0), points.max(0)
        edge = float((high - low).max())
        if edge == 0.0:
            raise InvalidSource(f"{name}: all its points are one")
        frame = Normalization((low + high) / 2.0, edge / LONGEST_EDGE)
    points = generator(0, "cloud").permutation(checked(frame.to_unit(points), name))
    low, high, hint = points.min(0), points.max(0), ""
    if (high - low).max() < _SMALLEST_EDGE or np.abs(low + high).max() / 2 > _FARTHEST_MIDDLE:
        hint = (
            f"{name}: reaches from {_text(low)} to {_text(high)}, which is small or off centre for "
            "the unit frame; --fit if its frame is another"
        )
    return Cloud(points, frame, hint, None if triangles is None else frame.to_unit(triangles))


def shape_of_file(path: Path) -> tuple[Floats, Floats | None]:
    """Return the array that a PLY, .npy, .npz or .xyz file holds, its frame, and the triangles (F,
    3, 3) of a mesh that these points were spread over, None for none; or InvalidSource."""
    read = _READERS.get(path.suffix.lower())
    if read is None:
        known = ", ".join(_READERS)
        raise InvalidSource(f"{path}: neither a shard (.h5) nor points ({known})")
    data = read_or_refuse(path, MOST_BYTES, InvalidSource, "correct it or name another file")
    try:
        with np.errstate(all="ignore"):  # of what is no number `checked` tells
            numbers, triangles = read(data)
            return np.asarray(numbers, np.float64), triangles
    except MemoryError:
        raise
    except Exception as error:  # whatever a parser meets in a broken file
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InvalidSource(f"{path}: broken ({reason})") from None


def checked(cloud: Floats, name: str) -> Floats:
    """Return the cloud (n, 3); InvalidSource if few, not finite or out of the cube."""
    finite(cloud, name)
    if np.abs(cloud).max() > 0.5:
        raise InvalidSource(
            f"{name}: reaches from {_text(cloud.min(0))} to {_text(cloud.max(0))}, beyond the "
            "unit frame [-0.5, 0.5]^3; --fit brings it there"
        )
    return cloud


def finite(cloud: Floats, name: str, error: type[ArticugenError] = InvalidSource) -> Floats:
    """Return the cloud (n, 3); an `error` if it is of another shape, few, or not finite."""
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise error(f"{name}: numbers of shape {cloud.shape}, not points (n, 3)")
    if len(cloud) < FEWEST_POINTS:
        few = f"{len(cloud)} points, too few to say anything"
        raise error(f"{name}: has {few}; give {FEWEST_POINTS} or more")
    if not np.isfinite(cloud).all():
        bad = int((~np.isfinite(cloud)).any(1).sum())
        raise error(f"{name}: {bad} points are not finite numbers; remove them")
    return cloud


def _text(vector: Floats) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in vector) + ")"


def _ply(data: bytes) -> Any:
    """Vertices; where there are faces, points spread over them, and these."""
    import trimesh  # noqa: PLC0415 - takes a second

    claimed = claimed_rows(data)
    cloud: Any = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    if len(getattr(cloud, "faces", ())):
        triangles = np.asarray(cloud.triangles, np.float64)
        rng = generator(0, "cloud of mesh")
        return points_on_triangles(triangles, _POINTS_ON_A_MESH, rng=rng)[0], triangles
    if len(cloud.vertices) < claimed.get("vertex", 1):
        raise ValueError("cut short")
    return cloud.vertices, None


def _npy(data: bytes) -> Any:
    """numpy makes room for what a header claims before it looks whether that is there."""
    file = io.BytesIO(data)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    shape, _, dtype = read[np.lib.format.read_magic(file)](file)
    if dtype.kind not in "biuf":
        raise ValueError("holds no numbers")
    if math.prod(shape) * dtype.itemsize != len(data) - file.tell():
        raise ValueError("its header does not fit its size")
    return np.load(io.BytesIO(data), allow_pickle=False)


def _npz(data: bytes) -> Any:
    """Return the array "points", or one without a name; or of a view as OP-Align has it what is
    detected, in the frame of its first part, which all views of an object share."""
    name, array = unpacked(data, "points", "arr_0")
    if name == "points" or b"'|O'" not in array[:128]:
        return _npy(array)
    view = view_of(array)
    return apply(invert_rigid(view.T_camera_part[0]), view.points)


def unpacked(data: bytes, *names: str) -> tuple[str, bytes]:
    """Return the first of these names that a zip archive of arrays has, and the array's .npy file;
    numpy would unpack whatever it claims to hold."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        there = [name.removesuffix(".npy") for name in archive.namelist()]
        name = next((name for name in names if name in there), None)
        if name is None:
            raise ValueError(f"no array named {names[0]}, only {', '.join(there[:5]) or 'none'}")
        array = archive.getinfo(f"{name}.npy")
        if array.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("packed in an unusual way")
        if array.file_size > MOST_BYTES:
            raise ValueError("unpacks to too much")
        return name, archive.read(array)


_READERS: dict[str, Callable[[bytes], Any]] = {
    ".ply": _ply,
    ".npy": lambda data: (_npy(data), None),
    ".npz": lambda data: (_npz(data), None),
    ".xyz": lambda data: (np.loadtxt(io.BytesIO(data), usecols=(0, 1, 2), ndmin=2), None),
}
