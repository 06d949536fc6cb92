"""What a camera sees, lit by a soft sky and a lamp over the viewer's left shoulder."""

import numpy as np
from PIL import Image

from articugen.core.arrays import Floats
from articugen.core.colours import linear
from articugen.pictures.camera import Camera
from articugen.pictures.light import SurfaceCloud, occlusion, occlusion_in_detail

Picture = Image.Image

PAPER = "#ffffff"
SUPERSAMPLING = 2


def shaded(
    seen: tuple[Floats, Floats, Floats],
    camera: Camera,
    coarse: SurfaceCloud,
    fine: SurfaceCloud,
    floor: float,
) -> Picture:
    """Return the picture of a surface that stands on a white floor, `SUPERSAMPLING` times smaller.

    Args:
        seen: depth (H, W), inf where nothing is; unit normals (H, W, 3); linear colour (H, W, 3).
        coarse, fine: points of that surface, which hide the sky from each other.
        floor: its height.
    """
    depth, normals, colour = seen
    hit = np.isfinite(depth)
    pixels = np.broadcast_to(linear(PAPER), colour.shape).copy()
    hidden = np.zeros(np.count_nonzero(hit))
    if len(coarse.points):
        pixels *= (1.0 - 0.5 * _shadow(coarse, camera, floor))[..., None]
        at = camera.eye + depth[hit][:, None] * camera.rays[hit]
        hidden = occlusion_in_detail(at, normals[hit], coarse, fine)
    facing = normals[hit]
    lamp = camera.T_camera_world[:3, :3].T @ np.array([-0.45, -0.65, -0.6])
    direct = np.clip(facing @ (lamp / np.linalg.norm(lamp)), 0.0, 1.0)
    sky = 0.75 + 0.25 * facing[:, 2]
    toward_us = np.clip(facing @ -camera.T_camera_world[2, :3], 0.0, 1.0)
    light = 0.15 + 0.85 * (1.0 - hidden) ** 1.2
    light *= 0.42 * sky + 0.58 * direct + 0.13 * toward_us
    pixels[hit] = colour[hit] * light[:, None]
    size = camera.size // SUPERSAMPLING
    small = pixels.reshape(size, SUPERSAMPLING, size, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return Image.fromarray((np.clip(small, 0.0, 1.0) ** (1 / 2.2) * 255).round().astype(np.uint8))


def _shadow(cloud: SurfaceCloud, camera: Camera, floor: float) -> Floats:
    """Return (H, W) how much of the sky the object hides from the floor under each pixel."""
    count, reach = 48, 0.9
    at = np.linspace(-reach, reach, count)
    x, y = np.meshgrid(at, at, indexing="ij")
    receivers = np.stack([x.ravel(), y.ravel(), np.full(x.size, floor - 0.012)], axis=1)
    up = np.broadcast_to((0.0, 0.0, 1.0), receivers.shape).copy()
    hidden = occlusion(receivers, up, cloud).reshape(count, count)
    hidden = np.clip(hidden - 0.04, 0.0, None)  # fades out before the tile's edge
    rays = camera.rays
    t = (floor - camera.eye[2]) / np.minimum(rays[..., 2], -1e-6)
    on_floor = camera.eye[:2] + t[..., None] * rays[..., :2]
    return _bilinear(hidden, (on_floor + reach) / (2 * reach) * (count - 1))


def _bilinear(grid: Floats, at: Floats) -> Floats:
    at = np.clip(at, 0.0, len(grid) - 1.001)
    low = at.astype(np.int64)
    (i, j), (u, v) = np.moveaxis(low, -1, 0), np.moveaxis(at - low, -1, 0)
    near = (1 - v) * grid[i, j] + v * grid[i, j + 1]
    far = (1 - v) * grid[i + 1, j] + v * grid[i + 1, j + 1]
    return (1 - u) * near + u * far
