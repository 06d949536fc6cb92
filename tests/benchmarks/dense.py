"""The dense chain at Occupancy Networks' settings, written anew from its published description.

100 pinhole views of 640 x 640; depth brought forward by 1.5 voxels and grey-eroded 3 x 3; read at
the nearest pixel; the mean over the views of the distance truncated at 10 voxels, on a grid of
256^3; a voxel without a view is inside; marching cubes; containment in that mesh. Drawn with our
rasterizer and asked by Embree, which are faster than what that chain itself uses, and fused on all
cores; the views are placed evenly, where its own leave gaps.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import config, njit, prange

from articugen.core.geometry import bounds, fibonacci_sphere, look_along
from articugen.core.records import Floats, LabelledMesh, Views
from articugen.rendering import rasterizer
from tests.benchmarks.cases import Inside

# Always there; numba warns of the versions of the others.
config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Dense:
    """Lengths are in units of the cube that the mesh is fitted to; its padding is 0.1."""

    views: int = 100
    image: int = 640
    grid: int = 256
    distance: float = 1.0
    far: float = 1.75
    offset_voxels: float = 1.5
    truncation_voxels: float = 10.0

    def __str__(self) -> str:
        return f"{self.views} views of {self.image}, {self.grid}^3"

    def build(self, mesh: LabelledMesh) -> tuple[Inside, Views]:
        """The containment test of the fused mesh, and the views it was seen from."""
        from scipy.ndimage import grey_erosion  # noqa: PLC0415 - optional libraries
        from skimage.measure import marching_cubes  # noqa: PLC0415

        box = bounds(mesh.vertices[np.unique(mesh.faces)])
        center, side = box.mean(axis=0), float(np.max(box[1] - box[0])) / 0.9
        views = self._views(center, side)
        depth = rasterizer.render(mesh, views).depth
        depth[np.isinf(depth)] = self.far * side
        voxel = side / self.grid
        depth -= np.float32(self.offset_voxels * voxel)
        depth = np.stack([grey_erosion(image, size=(3, 3)) for image in depth])
        corner = center - side / 2.0
        field = _fuse(
            depth, views.T_camera_world[:, :3].astype(np.float32), np.float32(self.image),
            corner.astype(np.float32), np.float32(voxel), self.grid,
            np.float32(self.truncation_voxels * voxel),
        )  # fmt: skip
        padded = np.pad(field, 1, constant_values=float(field.max()))
        vertices, faces, _, _ = marching_cubes(padded, 0.0)
        return containment(corner + (vertices - 0.5) * voxel, faces), views

    def _views(self, center: Floats, side: float) -> Views:
        directions = fibonacci_sphere(self.views)
        T = [look_along(d, center - self.distance * side * d) for d in directions]
        focal = np.full(self.views, float(self.image))
        return Views(
            "pinhole", np.stack(T), focal, focal, focal / 2, focal / 2, self.image, self.image
        )


def containment(vertices: Floats, faces: np.ndarray) -> Inside:
    """Parity of the crossings along a ray, by Embree (open3d)."""
    import open3d  # noqa: PLC0415 - optional

    scene: Any = open3d.t.geometry.RaycastingScene()
    if len(faces):
        scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))

    def inside(points: Floats) -> np.ndarray:
        if not len(faces):
            return np.zeros(len(points), np.bool_)
        return scene.compute_occupancy(points.astype(np.float32)).numpy() > 0.5

    return inside


@njit(cache=True, parallel=True)
def _fuse(depth, cameras, focal, corner, voxel, grid, truncation):
    """(grid, grid, grid) float32: the mean truncated distance, positive where free."""
    size = depth.shape[1]
    middle, edge = np.float32(size / 2), np.float32(size)
    centers = (np.arange(grid) + 0.5).astype(np.float32) * voxel
    field = np.empty((grid, grid, grid), np.float32)
    for i in prange(grid):
        total = np.zeros((grid, grid), np.float32)
        count = np.zeros((grid, grid), np.float32)
        x = corner[0] + centers[i]
        for k in range(cameras.shape[0]):
            T, image = cameras[k], depth[k]
            for j in range(grid):
                y = corner[1] + centers[j]
                a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * corner[2] + T[0, 3]
                b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * corner[2] + T[1, 3]
                c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * corner[2] + T[2, 3]
                for m in range(grid):
                    z = c + T[2, 2] * centers[m]
                    scale = focal / z
                    u = (a + T[0, 2] * centers[m]) * scale + middle
                    v = (b + T[1, 2] * centers[m]) * scale + middle
                    if u >= 0.0 and v >= 0.0 and u < edge and v < edge:
                        free = image[np.int32(v), np.int32(u)] - z
                        if free >= -truncation:
                            total[j, m] += min(free, truncation)
                            count[j, m] += np.float32(1.0)
        for j in range(grid):
            for m in range(grid):
                field[i, j, m] = total[j, m] / count[j, m] if count[j, m] > 0.0 else -truncation
    return field
