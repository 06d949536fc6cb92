"""A contact sheet: some objects, each in some of its joint states, coloured by part.

The pictures are drawn from stored data alone. The surface points of many instances of an object are
brought to its canonical pose by the stored motions of their parts, which makes a dense cloud, and
from there to each pose that is drawn. So what is wrong in a shard shows: points that are off as
specks, a wrong `part_motion` or part label as a blurred or doubled part. But what is wrong in one
instance shows in all pictures of its object.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from articugen.errors import ArticugenError
from articugen.geometry import apply, invert_rigid
from articugen.inspection.camera import Camera, framed
from articugen.inspection.light import Cloud, occlusion, occlusion_in_detail
from articugen.inspection.surfels import Sample, Surfels, draw, surfels
from articugen.records import Instance, dequantize
from articugen.shards import Shard, open_shard

Array = NDArray[np.float64]
T = TypeVar("T")

Place = tuple[Path, int]
"""A shard and an instance's index in it."""

Chosen = tuple[str, str, list[Place]]
"""The category and title of a row, and where its object's instances are."""

POOLED = 16
"""The points of so many instances of an object, or of all that there are, make its pictures."""

COLOURS = ("#d9d4cb", "#4477aa", "#ddaa33", "#bb5566", "#44aa99", "#882255", "#88ccee", "#999933")
"""Of part 0, 1, ...: pairs that readers with any colour vision tell apart (after Paul Tol)."""

PAPER, INK, GREY = "#ffffff", "#333333", "#8a8a8a"

TILE, MARGIN, CAPTION = 288, 10, 22
SUPERSAMPLING = 2

AZIMUTHS = tuple(np.radians((-35.0, 35.0, 145.0, 215.0)))
ELEVATION = float(np.radians(27.0))


@dataclass(frozen=True, eq=False)
class _Row:
    """`instances` to draw; `discs` in the canonical pose, from the points of many instances."""

    category: str
    title: str
    instances: tuple[Instance, ...]
    discs: Surfels

    @property
    def points(self) -> Array:
        return np.concatenate([dequantize(i.surface_points) for i in self.instances])

    @property
    def floor(self) -> float:
        return float(self.points[:, 2].min())


def contact_sheet(shards: Sequence[Path], path: Path, *, objects: int = 4, states: int = 6) -> None:
    """Draw `objects` rows of `states` instances each, chosen evenly from `shards`, as a PNG.

    The first instance of a row is the canonical pose; the others are in the order of how far
    their joints have moved. A category is seen from the side that shows most of its parts.

    Raises:
        CorruptShard: a shard cannot be read.
        ArticugenError: there is nothing to draw, or `path` cannot be written.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        rows = list(pool.map(lambda chosen: _row(chosen, states), _chosen(shards, objects)))
        names = {row.category for row in rows}
        seen_from = {c: _best_azimuth([row for row in rows if row.category == c]) for c in names}
        cameras = [_camera(row, seen_from[row.category]) for row in rows]
        tiles = [(r, i, c) for r, c in zip(rows, cameras, strict=True) for i in r.instances]
        sheet = _sheet(rows, list(pool.map(lambda tile: _picture(*tile), tiles)))
    try:
        sheet.save(path, "PNG", optimize=True)
    except OSError as error:
        raise ArticugenError(f"{path}: cannot be written: {error.strerror}") from None


def _chosen(shards: Sequence[Path], objects: int) -> list[Chosen]:
    where: dict[tuple[str, str, str], list[Place]] = {}
    for path in shards:
        with open_shard(path) as shard:
            if shard.fields["surface_points"][1] < 2:
                continue
            category, split = (str(shard.attributes[name]) for name in ("category", "split"))
            for index, object_id in enumerate(shard.object_ids()):
                where.setdefault((category, split, object_id), []).append((path, index))
    if not where:
        raise ArticugenError(
            f"{shards[0].parent}: no surface points to draw; ask for some in the recipe"
        )
    keys = _evenly(sorted(where, key=lambda key: (key[1] != "train", key)), objects)
    return [
        (category, f"{object_id}  {split}", where[category, split, object_id])
        for category, split, object_id in keys
    ]


def _row(chosen: Chosen, states: int) -> _Row:
    category, title, places = chosen
    with ExitStack() as stack:
        opened = {path: stack.enter_context(open_shard(path)) for path in {p for p, _ in places}}
        rows = sorted(((opened[path], index) for path, index in places), key=lambda r: _moved(*r))
        drawn = tuple(shard.instance(index) for shard, index in _evenly(rows, states))
        pooled = [_at_rest(shard.instance(index)) for shard, index in _evenly(rows, POOLED)]
    return _Row(category, title, drawn, surfels(pooled))


def _evenly(items: Sequence[T], count: int) -> list[T]:
    picked = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[round(i)] for i in picked]


def _moved(shard: Shard, index: int) -> float:
    """How far the joints have moved, the canonical pose before all others."""
    if shard.read("state_index", index) == 0:
        return -np.inf
    q, upper = shard.read("joint_state", index), shard.read("joint_upper", index)
    return float(np.abs(q / np.where(upper == 0.0, 1.0, upper)).sum())


def _sample(instance: Instance) -> Sample:
    normals = instance.surface_normals.astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Sample(dequantize(instance.surface_points), normals, instance.surface_part)


def _at_rest(instance: Instance) -> Sample:
    """Its points in the canonical pose."""
    return _sample(instance).moved(invert_rigid(instance.part_motion))


def _camera(row: _Row, azimuth: float) -> Camera:
    return framed(row.points, azimuth, ELEVATION, SUPERSAMPLING * TILE, fill=0.86)


def _best_azimuth(rows: Sequence[_Row]) -> float:
    posed = [surfels([_sample(row.instances[-1])]) for row in rows]  # its own points will do
    return max(AZIMUTHS, key=lambda azimuth: sum(_seen(discs, azimuth) for discs in posed))


def _seen(discs: Surfels, azimuth: float) -> float:
    """How much of the parts can be seen from this side: their fractions, added up."""
    camera = framed(discs.points, azimuth, ELEVATION, 128, fill=0.9)
    depth, _, _ = draw(discs, np.zeros((len(discs.points), 0)), camera)
    x, y, z = apply(camera.T_camera_world, discs.points).T
    column = (camera.focal * x / z + camera.cx).astype(int)
    row = (camera.focal * y / z + camera.cy).astype(int)
    seen = np.bincount(discs.part[z < depth[row, column] + discs.spacing], minlength=256)
    return float((seen / np.maximum(np.bincount(discs.part, minlength=256), 1)).sum())


def _picture(row: _Row, instance: Instance, camera: Camera) -> Image.Image:
    """One tile, lit by a soft sky and a lamp over the viewer's left shoulder."""
    discs = row.discs.moved(instance.part_motion)
    own = _sample(instance)
    coarse = Cloud(own.points, own.normals, np.full(len(own.points), own.spacing() ** 2))
    palette = np.array([_linear(COLOURS[k % len(COLOURS)]) for k in range(256)])
    depth, normals, colour = draw(discs, palette[discs.part], camera)
    hit = np.isfinite(depth)
    pixels = _linear(PAPER) * (1.0 - 0.5 * _shadow(coarse, camera, row.floor))[..., None]
    at = camera.eye + depth[hit][:, None] * camera.rays[hit]
    hidden = occlusion_in_detail(at, normals[hit], coarse, discs.cloud)
    pixels[hit] = colour[hit] * _lit(normals[hit], 1.0 - hidden, camera)[:, None]
    size = camera.size // SUPERSAMPLING
    small = pixels.reshape(size, SUPERSAMPLING, size, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return Image.fromarray((np.clip(small, 0.0, 1.0) ** (1 / 2.2) * 255).round().astype(np.uint8))


def _lit(normals: Array, sky_seen: Array, camera: Camera) -> Array:
    """(n,) how bright white paper would be."""
    lamp = camera.T_camera_world[:3, :3].T @ np.array([-0.45, -0.65, -0.6])
    direct = np.clip(normals @ (lamp / np.linalg.norm(lamp)), 0.0, 1.0)
    sky = 0.75 + 0.25 * normals[:, 2]
    toward_us = np.clip(normals @ -camera.T_camera_world[2, :3], 0.0, 1.0)
    open_ = 0.15 + 0.85 * sky_seen**1.2
    return open_ * (0.42 * sky + 0.58 * direct + 0.13 * toward_us)


def _shadow(cloud: Cloud, camera: Camera, floor: float) -> Array:
    """(H, W) how much of the sky the object hides from the floor under each pixel."""
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


def _bilinear(grid: Array, at: Array) -> Array:
    at = np.clip(at, 0.0, len(grid) - 1.001)
    low = at.astype(np.int64)
    (i, j), (u, v) = np.moveaxis(low, -1, 0), np.moveaxis(at - low, -1, 0)
    near = (1 - v) * grid[i, j] + v * grid[i, j + 1]
    far = (1 - v) * grid[i + 1, j] + v * grid[i + 1, j + 1]
    return (1 - u) * near + u * far


def _linear(colour: str) -> Array:
    """An #rrggbb colour as linear light."""
    return (np.frombuffer(bytes.fromhex(colour[1:]), np.uint8) / 255.0) ** 2.2


def _sheet(rows: Sequence[_Row], pictures: Sequence[Image.Image]) -> Image.Image:
    columns = max(len(row.instances) for row in rows)
    height = TILE + 2 * CAPTION
    sheet = Image.new("RGB", (2 * MARGIN + columns * TILE, 2 * MARGIN + len(rows) * height), PAPER)
    pen = ImageDraw.Draw(sheet)
    left = iter(pictures)
    for r, row in enumerate(rows):
        top = MARGIN + r * height
        pen.text((MARGIN + 6, top + 2), row.title, GREY, ImageFont.load_default(14))
        for c, instance in enumerate(row.instances):
            x = MARGIN + c * TILE
            sheet.paste(next(left), (x, top + CAPTION))
            _write_state(pen, instance, x + TILE // 2, top + CAPTION + TILE)
    return sheet


def _write_state(pen: ImageDraw.ImageDraw, instance: Instance, middle: int, top: int) -> None:
    """The joint states, centred at `middle`, each after a dot in the colour of its part."""
    font = ImageFont.load_default(14)
    texts = [_state(instance, j) for j in range(len(instance.joint_state))]
    widths = [16 + pen.textlength(text, font) for text in texts]
    x = middle - (sum(widths) + 12 * (len(widths) - 1)) / 2
    for j, (text, width) in enumerate(zip(texts, widths, strict=True)):
        pen.ellipse((x, top + 4, x + 10, top + 14), COLOURS[(j + 1) % len(COLOURS)])
        pen.text((x + 16, top), text, INK, font)
        x += width + 12


def _state(instance: Instance, joint: int) -> str:
    q = float(instance.joint_state[joint])
    if instance.joint_kind[joint] == 1:
        return f"{np.degrees(q):.0f}°"
    return f"{100.0 * q * instance.scale:.0f} cm"
