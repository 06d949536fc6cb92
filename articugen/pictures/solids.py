"""Pictures of triangle meshes: depth, smooth normals and the colour of what each pixel sees."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from articugen.core.arrays import Bools, Floats, Ints
from articugen.core.geometry import (
    area_vectors,
    bounds,
    look_along,
    nearest_weights,
    pick_by_weight,
    points_in_triangles,
    spread_evenly,
)
from articugen.core.recipe import ViewSettings
from articugen.core.records import LabelledMesh, Views
from articugen.pictures.camera import Camera
from articugen.pictures.light import SurfaceCloud
from articugen.rendering.rasterizer import render
from articugen.rendering.views import fusion_views

CREASE = np.cos(np.radians(35.0))
"""Where a face is turned further than this from the mean around a corner, the corner is sharp."""

_PLACES = 1 << 18
"""Corners that agree along each axis in this many places of the box are the same one."""


@dataclass(frozen=True, eq=False)
class ColouredMesh:
    """Coloured triangles.

    Attributes:
        triangles: (F, 3, 3), corners counter-clockwise as seen from outside.
        group: (F,) what each belongs to; shading is smooth within a group.
        colours: #rrggbb of each group.
    """

    triangles: Floats
    group: Ints
    colours: Sequence[str]

    @staticmethod
    def joined(solids: Sequence["ColouredMesh"]) -> "ColouredMesh":
        """Join solids into one mesh."""
        first = np.cumsum([0] + [len(solid.colours) for solid in solids])
        return ColouredMesh(
            np.concatenate([np.zeros((0, 3, 3)), *(solid.triangles for solid in solids)]),
            np.concatenate([
                np.zeros(0, np.int64), *(s.group + n for s, n in zip(solids, first, strict=False))
            ]),
            [colour for solid in solids for colour in solid.colours],
        )  # fmt: skip


def arrow(tail: Floats, tip: Floats, radius: float, colour: str) -> ColouredMesh:
    """Return a shaft with a cone at its `tip`, of 24 sides."""
    along = _unit(tip - tail)
    side = look_along(along)[0, :3]
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(along, side)
    neck = tip - 6.0 * radius * along
    profile = [(tail, 0.0), (tail, radius), (neck, radius), (neck, 2.5 * radius), (tip, 0.0)]
    rings = [at + r * ring for at, r in profile]
    triangles = []
    for low, high in pairwise(rings):
        a, b, c, d = low, np.roll(low, -1, 0), np.roll(high, -1, 0), high
        triangles += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    group = np.repeat(np.arange(4), 2 * 24)
    return ColouredMesh(np.concatenate(triangles), group, [colour] * 4)


def draw_solid(
    solid: ColouredMesh, values: Floats, camera: Camera
) -> tuple[Floats, Floats, Floats]:
    """Return a solid, all of it in front of the camera, as that sees it.

    Args:
        values: (G, C) of each group, for instance colours.

    Returns:
        Depth (H, W), inf where nothing is; unit normals (H, W, 3) towards the camera;
        values (H, W, C).
    """
    size = (camera.size, camera.size)
    triangles, group = solid.triangles, solid.group
    focal, cx, cy = (np.array([number]) for number in (camera.focal, camera.cx, camera.cy))
    views = Views("pinhole", camera.T_camera_world[None], focal, focal, cx, cy, *size)
    maps = render(soup(triangles), views)
    assert maps.depth is not None
    assert maps.face is not None
    depth, face = maps.depth[0].astype(np.float64), maps.face[0]
    hit = face >= 0
    normals, drawn = np.zeros((*size, 3)), np.zeros((*size, values.shape[1]))
    if hit.any():
        which, rays = face[hit], camera.rays[hit]
        at = camera.eye + depth[hit][:, None] * rays
        corner = _corner_normals(triangles, group)[which]
        smooth = np.einsum("nc,nci->ni", nearest_weights(triangles[which], at), corner)
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
        away = (smooth * rays).sum(1, keepdims=True) > 0.0
        normals[hit] = np.where(away, -smooth, smooth)
        drawn[hit] = values[group[which]]
    return depth, normals, drawn


def shown(triangles: Floats) -> Bools:
    """Return (F,) which of triangles (F, 3, 3), unit frame, are seen in views from all around, half
    as fine as those of a data set; those without area, which stand for points, count as seen."""
    mesh = soup(triangles)
    are_seen: Bools = np.all(area_vectors(triangles) == 0.0, axis=1)
    if not are_seen.all():
        views = fusion_views(ViewSettings(resolution=128), bounds(mesh.vertices))
        face = render(mesh, views, keep_depth=False).face
        assert face is not None
        are_seen |= np.isin(np.arange(len(triangles)), face)
    return are_seen


def soup(triangles: Floats) -> LabelledMesh:
    """Return triangles (F, 3, 3) as a mesh of one part, of which no two share a corner."""
    faces = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
    return LabelledMesh(triangles.reshape(-1, 3), faces, np.zeros(len(faces), np.uint8))


def spread(triangles: Floats, count: int) -> SurfaceCloud:
    """About `count` points over triangles (F, 3, 3), evenly by area."""
    normal = area_vectors(triangles)
    twice = np.linalg.norm(normal, axis=1)
    if not twice.any():
        return SurfaceCloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    rank = np.arange(count)
    face = pick_by_weight(twice, (rank + 0.5) / count)
    a, b = spread_evenly(rank)
    points = points_in_triangles(triangles[face], a[:, None], b[:, None])
    area = np.full(count, 0.5 * twice.sum() / count)
    return SurfaceCloud(points, normal[face] / twice[face, None], area)


def _corner_normals(triangles: Floats, group: Ints) -> Floats:
    """Return (F, 3, 3) unit normals at the corners: the mean by area of the faces of a group that
    meet there, or the face's own where it is turned far away from that."""
    normal = area_vectors(triangles)
    low, size = triangles.min((0, 1)), max(float(np.ptp(triangles, axis=(0, 1)).max()), 1e-9)
    x, y, z = ((triangles.reshape(-1, 3) - low) / size * (_PLACES - 1)).round().astype(np.int64).T
    place = ((np.repeat(group, 3) * _PLACES + x) * _PLACES + y) * _PLACES + z
    _, vertex = np.unique(place, return_inverse=True)
    total = np.zeros((vertex.max() + 1, 3))
    np.add.at(total, vertex, np.repeat(normal, 3, axis=0))
    mean = _unit(total)[vertex].reshape(-1, 3, 3)
    facing = _unit(normal)[:, None]
    sharp = (mean * facing).sum(2, keepdims=True) < CREASE
    return np.where(sharp, facing, mean)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
