"""A watertight mesh of a fused field, at any resolution."""

import importlib

import numpy as np
from numpy.typing import NDArray

from articugen.errors import MissingExtra, RejectedInstance
from articugen.fusion.field import FusedField, PosedSolids
from articugen.geometry import voxel_centres
from articugen.records import Mesh

_AT_A_TIME = 1 << 20
"""Voxels whose sign is asked at a time."""


def extract_mesh(field: FusedField | PosedSolids, resolution: int) -> Mesh:
    """The zero level of `field` in the unit cube as a closed mesh, unit frame, faces outwards.

    Marching cubes (Lorensen and Cline 1987; scikit-image's, after Lewiner et al. 2003) on the voxel
    centres of a grid of `resolution`^3. Only voxels beside a change of sign are evaluated in full.

    Raises:
        MissingExtra: scikit-image is not installed.
        RejectedInstance: no voxel centre lies inside.
    """
    try:
        measure = importlib.import_module("skimage.measure")
    except ImportError:
        raise MissingExtra("scikit-image", "mesh") from None
    inside = np.pad(~_free(field, resolution), 1)  # free all around, so that the mesh is closed
    if not inside.any():
        raise RejectedInstance(
            f"no voxel centre of a {resolution}^3 grid lies inside; ask for a finer one"
        )
    truncation = field.settings.truncation
    values = np.where(inside, -truncation, truncation)
    index = np.argwhere(_beside_a_change(inside))
    in_cube = np.all((index >= 1) & (index <= resolution), axis=1)
    index = index[in_cube]
    points = (index - 0.5) / resolution - 0.5
    # the sign decides what is connected; a value of exactly zero would belong to neither side
    size = np.maximum(np.abs(field.value(points)), 1e-3 * truncation)
    at = tuple(index.T)
    values[at] = np.where(inside[at], -size, size)
    vertices, faces, _, _ = measure.marching_cubes(values, 0.0, gradient_direction="descent")
    return Mesh((vertices - 0.5) / resolution - 0.5, faces)


def _free(field: FusedField | PosedSolids, resolution: int) -> NDArray[np.bool_]:
    """(R, R, R) of the voxels' centres."""
    voxels = np.arange(resolution**3)
    free = [
        field.is_free(voxel_centres(resolution, voxels[first : first + _AT_A_TIME]))
        for first in range(0, len(voxels), _AT_A_TIME)
    ]
    return np.concatenate(free).reshape((resolution,) * 3)


def _beside_a_change(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Voxels one of whose six neighbours is on the other side."""
    beside = np.zeros_like(inside)
    for axis in range(3):
        change = np.diff(inside, axis=axis)
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        beside[tuple(low)] |= change
        beside[tuple(high)] |= change
    return beside
