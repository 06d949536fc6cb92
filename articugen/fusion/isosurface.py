"""A watertight mesh of a fused field, at any resolution."""

import numpy as np
from numpy.typing import NDArray

from articugen.errors import RejectedInstance
from articugen.fusion.field import FusedField, PosedSolids
from articugen.geometry import voxel_centres
from articugen.marching_cubes import zero_level
from articugen.records import Mesh

_AT_A_TIME = 1 << 20
"""Voxels whose sign is asked at a time."""


def extract_mesh(field: FusedField | PosedSolids, resolution: int) -> Mesh:
    """The zero level of `field` in the unit cube as a closed mesh, unit frame, faces outwards.

    Marching cubes on the voxel centres of a grid of `resolution`^3. Only voxels beside a
    change of sign are evaluated in full.

    Raises:
        RejectedInstance: no voxel centre lies inside.
    """
    inside = ~_free(field, resolution)
    if not inside.any():
        raise RejectedInstance(
            f"no voxel centre of a {resolution}^3 grid lies inside; ask for a finer one"
        )
    beside = _beside_a_change(inside)
    points = (np.argwhere(beside) + 0.5) / resolution - 0.5
    size = np.ones(inside.shape)
    # the sign decides what is connected; a value of exactly zero would belong to neither side
    size[beside] = np.maximum(np.abs(field.value(points)) / field.settings.truncation, 1e-3)
    return zero_level(np.where(inside, size, -size))


def _free(field: FusedField | PosedSolids, resolution: int) -> NDArray[np.bool_]:
    """(R, R, R) of the voxels' centres."""
    voxels = np.arange(resolution**3)
    free = [
        field.is_free(voxel_centres(resolution, voxels[first : first + _AT_A_TIME]))
        for first in range(0, len(voxels), _AT_A_TIME)
    ]
    return np.concatenate(free).reshape((resolution,) * 3)


def _beside_a_change(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Voxels one of whose six neighbours is on the other side; beyond the grid is outside."""
    padded = np.pad(inside, 1)
    beside = np.zeros_like(padded)
    for axis in range(3):
        change = np.diff(padded, axis=axis)
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        beside[tuple(low)] |= change
        beside[tuple(high)] |= change
    return beside[1:-1, 1:-1, 1:-1]
