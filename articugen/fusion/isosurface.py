"""A watertight mesh of a fused field, at any resolution."""

from collections.abc import Callable

import numpy as np

from articugen.core.arrays import Bools, Floats, Ints
from articugen.core.errors import RejectedInstance
from articugen.core.geometry import bounds
from articugen.core.records import Mesh
from articugen.fusion.field import FusedField, PosedSolids
from articugen.meshes.marching_cubes import zero_level

_AT_A_TIME = 1 << 20  # voxels whose sign is asked at a time


def extract_mesh(field: FusedField | PosedSolids, resolution: int) -> Mesh:
    """Return the zero level of `field` in the unit cube as a closed mesh, unit frame, faces
    outwards.

    Marching cubes on the voxel centres of a grid of `resolution`^3. Vertices lie where the field's
    values say, those of solids where it becomes free; of these only voxels around are examined.

    Raises:
        RejectedInstance: no voxel centre lies inside.
    """
    first, count = 0, resolution  # the lowest voxel, and how many along an edge
    if isinstance(field, PosedSolids):
        box = bounds(np.concatenate([field.box(part) for part in range(len(field.own))]))
        first, last = np.clip(np.floor((box + 0.5) * resolution), 0, resolution - 1).astype(int)
        count = int((last - first).max()) + 1
    inside = ~_free(field, resolution, first, count)
    if not inside.any():
        raise RejectedInstance(
            f"no voxel centre of a {resolution}^3 grid lies inside; ask for a finer one"
        )
    if isinstance(field, FusedField):
        beside = _beside_a_change(inside)
        points = (np.argwhere(beside) + 0.5) / resolution - 0.5
        size = np.ones(inside.shape)
        # the sign decides what is connected; a value of exactly zero would belong to neither side
        size[beside] = np.maximum(np.abs(field.value(points)) / field.settings.truncation, 1e-3)
        return zero_level(np.where(inside, size, -size))
    mesh = zero_level(np.where(inside, np.float32(1.0), np.float32(-1.0)))
    at = _bisected(
        (mesh.vertices + 0.5) * count - 0.5,
        lambda place: field.is_free((place + first + 0.5) / resolution - 0.5),
    )
    return Mesh((at + first + 0.5) / resolution - 0.5, mesh.faces)


def _bisected(vertices: Floats, is_free: Callable[[Floats], Bools], steps: int = 8) -> Floats:
    """Move vertices (n, 3), in voxels, along their edges to where it is free, to 2^-steps."""
    index, axis = np.arange(len(vertices)), np.abs(vertices - np.round(vertices)).argmax(1)
    inside = np.round(vertices)
    inside[index, axis] = np.floor(vertices[index, axis])
    outside = inside.copy()
    outside[index, axis] += 1.0
    wrong = is_free(inside)
    inside[wrong], outside[wrong] = outside[wrong], inside[wrong]
    for _ in range(steps):
        middle = 0.5 * (inside + outside)
        free = is_free(middle)
        outside[free], inside[~free] = middle[free], middle[~free]
    return 0.5 * (inside + outside)


def _free(field: FusedField | PosedSolids, resolution: int, first: Ints | int, count: int) -> Bools:
    """Return (n, n, n) of the centres of `count` = n voxels along each edge, from voxel `first`
    on."""
    free = []
    for start in range(0, count**3, _AT_A_TIME):
        which = np.arange(start, min(start + _AT_A_TIME, count**3))
        place = np.stack(np.unravel_index(which, (count,) * 3), axis=1) + first
        free.append(field.is_free((place + 0.5) / resolution - 0.5))
    return np.concatenate(free).reshape((count,) * 3)


def _beside_a_change(inside: Bools) -> Bools:
    """Voxels one of whose six neighbours is on the other side; beyond the grid is outside."""
    padded = np.pad(inside, 1)
    beside = np.zeros_like(padded)
    for axis in range(3):
        change = np.moveaxis(np.diff(padded, axis=axis), axis, 0)
        layers = np.moveaxis(beside, axis, 0)
        layers[:-1] |= change
        layers[1:] |= change
    return beside[1:-1, 1:-1, 1:-1]
