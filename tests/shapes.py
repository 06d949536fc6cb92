"""Small closed-form shapes for tests, and naive oracles over them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import trimesh
from numpy.typing import NDArray

from articugen.core.recipe import Fusion, ViewSettings
from articugen.core.records import DepthMaps, LabelledMesh, Views
from articugen.fusion.field import FusedField, fuse
from articugen.rendering.rasterizer import render
from articugen.rendering.views import fusion_views

Floats = NDArray[np.float64]


def labelled(*parts: trimesh.Trimesh) -> LabelledMesh:
    """One part for each mesh, in order."""
    pieces = [
        LabelledMesh(m.vertices, m.faces, np.full(len(m.faces), k, np.uint8))
        for k, m in enumerate(parts)
    ]
    return LabelledMesh.joined(pieces)


def box(size: Sequence[float], center: Sequence[float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(center)
    return mesh


def tube(a: Sequence[float], b: Sequence[float], radius: float) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius=radius, segment=(a, b), sections=12)


def spectacles() -> list[trimesh.Trimesh]:
    """Eyeglasses of tubes of radius 0.01."""
    t = np.linspace(0, 2 * np.pi, 21)
    rims = []
    for side in (-0.2, 0.2):
        ring = np.c_[side + 0.15 * np.cos(t), np.zeros_like(t), 0.12 * np.sin(t)]
        rims += [tube(a, b, 0.01) for a, b in pairwise(ring)]
    temples = [tube((x, 0, 0.05), (x, 0.8 / 2, 0.04), 0.01) for x in (-0.36, 0.36)]
    return [*rims, *temples, tube((-0.05, 0, 0), (0.05, 0, 0), 0.01)]


def sheet(size: float = 0.8) -> trimesh.Trimesh:
    """A square of no thickness in the plane z = 0."""
    h = size / 2
    corners = [(-h, -h, 0), (h, -h, 0), (h, h, 0), (-h, h, 0)]
    return trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)


def two_sided(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Every triangle twice, with opposite winding, as real models have them."""
    faces = np.concatenate([mesh.faces, mesh.faces[:, ::-1]])
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def rotated(mesh: trimesh.Trimesh, angle: float, axis: Sequence[float]) -> trimesh.Trimesh:
    turned = mesh.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(angle, axis))
    return turned


@dataclass(frozen=True)
class Convex:
    """Solids that are unions of convex meshes, known by their half-spaces."""

    planes: tuple[Floats, ...]

    @staticmethod
    def of(*meshes: trimesh.Trimesh) -> "Convex":
        planes = []
        for mesh in meshes:
            offsets = np.sum(mesh.triangles[:, 0] * mesh.face_normals, axis=1)
            rounded = np.round(np.c_[mesh.face_normals, offsets], 9)
            planes.append(np.unique(rounded, axis=0))
        return Convex(tuple(planes))

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        held = [np.all(points @ p[:, :3].T <= p[:, 3], axis=1) for p in self.planes]
        return np.any(held, axis=0)

    def seen_free(self, points: Floats, towards: Floats) -> NDArray[np.bool_]:
        """Whether some ray from each point, along one of `towards` (K, 3), meets no solid."""
        hidden = np.arange(len(points))
        for direction in towards:
            hidden = hidden[self._blocked(points[hidden], direction)]
        return ~np.isin(np.arange(len(points)), hidden)

    def _blocked(self, points: Floats, direction: Floats) -> NDArray[np.bool_]:
        blocked = np.zeros(len(points), np.bool_)
        for p in self.planes:
            rest = np.flatnonzero(~blocked)
            gap = p[:, 3] - points[rest] @ p[:, :3].T
            slope = p[:, :3] @ direction
            into, out = slope < 0, slope > 0
            enter = np.max(gap[:, into] / slope[into], axis=1, initial=0.0)
            leave = np.min(gap[:, out] / slope[out], axis=1, initial=np.inf)
            beside = np.any(gap[:, slope == 0] < 0, axis=1)
            blocked[rest] = ~beside & (enter <= leave)
        return blocked


def views_of(mesh: LabelledMesh, count: int = 100, resolution: int = 256, **options) -> Views:
    box = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
    return fusion_views(ViewSettings(count=count, resolution=resolution, **options), box)


def field_of(*parts: trimesh.Trimesh, settings: Fusion | None = None, **views) -> FusedField:
    """The field of some parts by views of them all, by default with the settings of `Fusion`."""
    mesh = labelled(*parts)
    return fuse(render(mesh, views_of(mesh, **views)), mesh, settings or Fusion())


def towards_cameras(views: Views) -> Floats:
    """(K, 3) for orthographic views."""
    return -views.T_camera_world[:, 2, :3]


def pixel_points(maps: DepthMaps, k: int) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
    """The points that view k sees, in the frame of the mesh, with their pixels (i, j)."""
    views = maps.views
    i, j = np.nonzero(np.isfinite(maps.depth[k]))
    z = maps.depth[k][i, j].astype(np.float64)
    w = z if views.projection == "pinhole" else np.ones_like(z)
    x = (j + 0.5 - views.cx[k]) / views.fx[k] * w
    y = (i + 0.5 - views.cy[k]) / views.fy[k] * w
    T = views.T_camera_world[k]
    return (np.stack([x, y, z], axis=1) - T[:3, 3]) @ T[:3, :3], i, j


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float(np.sum(a & b) / max(np.sum(a | b), 1))
