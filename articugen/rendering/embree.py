"""Depth by ray casting: Embree, by way of open3d's RaycastingScene. It gives the faces too.

Embree computes in float32. Orthographic rays start close to the mesh, so that 99 % of depths are
good to 5e-7 in the unit frame; on surfaces seen at a grazing angle they can be 1e-5 off.
"""

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import apply, invert_rigid
from articugen.core.records import DepthMaps, LabelledMesh, Views
from articugen.rendering.foreign import depth_ranges, import_library, unseen


def render(mesh: LabelledMesh, views: Views) -> DepthMaps:
    """Render `mesh` in each of `views`: depth and faces.

    Where two faces coincide, either may be named.

    Raises:
        MissingExtra, MissingDriver: open3d cannot be used.
        ValueError: a part of the mesh does not lie in front of a pinhole camera.
    """
    open3d = import_library("open3d", "open3d", "libgl1 libegl1 libgomp1 libusb-1.0-0")
    depth = unseen(views)
    face = np.full(depth.shape, -1, np.int32)
    if len(mesh.faces) == 0:
        return DepthMaps(depth, face, views)

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    for k, (nearest, _) in enumerate(depth_ranges(mesh, views)):
        start = 0.0 if views.projection == "pinhole" else nearest
        hits = scene.cast_rays(open3d.core.Tensor(_rays(views, k, start)))
        depth[k] = start + hits["t_hit"].numpy().astype(np.float64)
        face[k] = hits["primitive_ids"].numpy().view(np.int32)  # a miss is 2^32 - 1, thus -1
    return DepthMaps(depth, face, views)


def _rays(views: Views, k: int, start: float) -> NDArray[np.float32]:
    """Return (H, W, 6) origins and directions, in the world, of the rays through view k's pixel
    centres.

    A direction's z in the camera is 1, so that the length of a ray, in directions, is depth less
    the origin's. Pinhole rays leave the eye (`start` is 0), orthographic ones the plane z = start.
    """
    x = (np.arange(views.width) + 0.5 - views.cx[k]) / views.fx[k]
    y = (np.arange(views.height) + 0.5 - views.cy[k]) / views.fy[k]
    on_plane: Floats = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1)
    T_world_camera = invert_rigid(views.T_camera_world[k])
    rotation, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
    if views.projection == "pinhole":
        origins, directions = np.broadcast_to(eye, on_plane.shape), on_plane @ rotation.T
    else:
        origins = apply(T_world_camera, on_plane + np.array([0.0, 0.0, start - 1.0]))
        directions = np.broadcast_to(rotation[:, 2], on_plane.shape)
    return np.concatenate([origins, directions], axis=-1).astype(np.float32)
