"""Depth by the renderer of SAPIEN, the home of PartNet-Mobility; it runs on Vulkan.

Its "Position" picture holds each pixel's point in camera coordinates as float32, and the depth
buffer beside it. Without a graphics card, Mesa's lavapipe of version 24.3 or newer will do.
"""

import warnings
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from articugen.core.geometry import invert_rigid
from articugen.core.records import DepthMaps, LabelledMesh, Views
from articugen.rendering.foreign import depth_ranges, import_library, missing_driver, unseen

SYSTEM_PACKAGES = "-t bookworm-backports mesa-vulkan-drivers libx11-6"

CV_FROM_SAPIEN = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float64)
"""SAPIEN's cameras look along x, with y to the left and z up."""


def render(mesh: LabelledMesh, views: Views) -> DepthMaps:
    """Render `mesh` in each of `views`: depth only, `face` is None.

    Raises:
        MissingExtra, MissingDriver: SAPIEN or a Vulkan driver cannot be used.
        ValueError: a part of the mesh does not lie in front of a pinhole camera.
    """
    with warnings.catch_warnings():
        # It warns on import that it falls back to the Vulkan loader it brings along, which is fine.
        warnings.simplefilter("ignore")
        sapien = import_library("sapien", "sapien", SYSTEM_PACKAGES)
    depth = unseen(views)
    if len(mesh.faces) == 0:
        return DepthMaps(depth, None, views)

    ranges = depth_ranges(mesh, views)
    scene = _empty_scene(sapien)
    camera = sapien.render.RenderCameraComponent(views.width, views.height)
    body = sapien.render.RenderBodyComponent()
    vertices = mesh.vertices.astype(np.float32)
    # each triangle in both windings, since SAPIEN always culls back faces
    triangles = np.concatenate([mesh.faces, mesh.faces[:, ::-1]]).astype(np.uint32)
    normals, uv = np.zeros_like(vertices), np.zeros_like(vertices[:, :2])
    material = sapien.render.RenderMaterial()
    body.attach(sapien.render.RenderShapeTriangleMesh(vertices, triangles, normals, uv, material))
    entities = [_entity(sapien, camera), _entity(sapien, body)]
    for entity in entities:
        scene.add_entity(entity)
    try:
        for k, (near, far) in enumerate(ranges):
            T_world_camera = invert_rigid(views.T_camera_world[k])
            camera.entity.set_pose(sapien.Pose(T_world_camera @ CV_FROM_SAPIEN))
            fx, fy, cx, cy = views.fx[k], views.fy[k], views.cx[k], views.cy[k]
            if views.projection == "pinhole":
                camera.set_perspective_parameters(near, far, fx, fy, cx, cy, 0.0)
            else:
                left, right = -cx / fx, (views.width - cx) / fx
                bottom, top = (cy - views.height) / fy, cy / fy
                camera.set_orthographic_parameters(near, far, left, right, bottom, top)
            scene.update_render()
            camera.take_picture()
            position = camera.get_picture("Position")  # (H, W, 4): right, up, back; depth buffer
            depth[k] = np.where(position[..., 3] < 1.0, -position[..., 2], np.inf)
    finally:
        for entity in entities:
            scene.remove_entity(entity)
    return DepthMaps(depth, None, views)


@cache
def _empty_scene(sapien: ModuleType) -> Any:
    """Return the one scene of this process, since the first picture in a scene takes seconds
    (shaders)."""
    try:
        return sapien.Scene([sapien.render.RenderSystem()])
    except RuntimeError as error:
        raise missing_driver("sapien", SYSTEM_PACKAGES, error) from error


def _entity(sapien: ModuleType, component: Any) -> Any:
    entity = sapien.Entity()
    entity.add_component(component)
    return entity
