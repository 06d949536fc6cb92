"""Images of a posed mesh: depth, parts, normals and shaded colours, by the rasteriser."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes, Floats, Indices
from articugen.core.colours import PALETTE
from articugen.core.geometry import area_vectors, invert_rigid
from articugen.core.portable import dot, norm, power, turned
from articugen.core.records import LabelledMesh, Views
from articugen.rendering import rasterizer

_GAMMA = 2.2

_LAMP = np.array([-0.48, -0.64, -0.6])
"""Towards the lamp, over the viewer's left shoulder, in the camera's axes; of unit length."""

_LINEAR = power(np.arange(256) / 255.0, _GAMMA)

_SKY, _DIRECT = 0.4, 0.6  # how much of the light comes from all around, and from the lamp


def images(
    mesh: LabelledMesh,
    views: Views,
    wanted: tuple[str, ...],
    *,
    closed: Bools,
    colours: Callable[[Indices, Floats], Bytes] | None = None,
) -> dict[str, NDArray]:
    """Draw the `wanted` images of each of V cameras, by name.

    Args:
        mesh: posed, unit frame.
        views: pinhole cameras, outside of the mesh.
        closed: (F,) which faces bound closed solids: their backs cannot be seen.
        colours: gives (n, 3) sRGB of faces (n,) at points (n, 3) of them, posed as `mesh`; by
            default those of their parts.

    Returns:
        `depth` (V, H, W) float32, 0 where nothing is; `part` (V, H, W) uint8, k + 1 for part k;
        `normal` (V, H, W, 3) int8 in 1/127, towards the camera; `rgba` (V, H, W, 4) uint8.
    """
    maps = rasterizer.render(mesh, views, closed=closed)
    assert maps.depth is not None
    assert maps.face is not None
    hit = maps.face >= 0
    face = maps.face[hit].astype(np.intp)
    part = mesh.part_of_face[face]
    out: dict[str, NDArray] = {}
    if "depth" in wanted:
        out["depth"] = np.where(hit, maps.depth, np.float32(0.0))
    if "part" in wanted:
        out["part"] = _filled(hit, part + 1)
    if "normal" in wanted or "rgba" in wanted:
        view, row, column = np.nonzero(hit)
        corners = mesh.vertices[mesh.faces[face]]
        across = area_vectors(corners)
        T_world_camera = invert_rigid(views.T_camera_world)
        away = dot(across, T_world_camera[view, :3, 3] - corners[:, 0]) < 0.0
        normals = np.where(away[:, None], -across, across) / norm(across)[:, None]
        out["normal"] = _filled(hit, np.round(127.0 * normals).astype(np.int8))
        lamps = turned(T_world_camera[:, :3, :3], _LAMP)
        light = _SKY + _DIRECT * np.maximum(dot(normals, lamps[view]), 0.0)
        shown = PALETTE[part]
        if colours is not None:
            depth = maps.depth[hit].astype(np.float64)
            shown = colours(face, views.points(view, row, column, depth))
        linear = _LINEAR[shown] * light[:, None]
        rgba = np.full((len(face), 4), 255, np.uint8)
        rgba[:, :3] = np.round(255.0 * power(np.minimum(linear, 1.0), 1.0 / _GAMMA))
        out["rgba"] = _filled(hit, rgba)
    return {name: out[name] for name in wanted}


def _filled(hit: Bools, values: NDArray) -> NDArray:
    """Images of `values` where something is seen, in the order of the pixels, else 0."""
    image = np.zeros((*hit.shape, *values.shape[1:]), values.dtype)
    image[hit] = values
    return image
