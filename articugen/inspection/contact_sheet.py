"""A contact sheet: some objects, each in some of its joint states, coloured by part.

The picture is drawn from the stored surface points alone, so what is wrong in a shard shows.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from articugen.errors import ArticugenError
from articugen.geometry import apply
from articugen.inspection.surfels import Camera, Surfels, draw, framed, occlusion_at, surfels
from articugen.records import Instance, dequantize
from articugen.shards import open_shard

Array = NDArray[np.float64]
T = TypeVar("T")

COLOURS = ("#d9d4cb", "#4477aa", "#ddaa33", "#bb5566", "#44aa99", "#882255", "#88ccee", "#999933")
"""Of part 0, 1, ...: pairs that readers with any colour vision tell apart (after Paul Tol)."""

PAPER, INK, GREY = "#ffffff", "#333333", "#8a8a8a"

TILE, MARGIN, CAPTION = 288, 10, 22
SUPERSAMPLING = 2

AZIMUTHS = tuple(np.radians((-35.0, 35.0, 145.0, 215.0)))
ELEVATION = float(np.radians(27.0))


@dataclass(frozen=True, eq=False)
class _Tile:
    instance: Instance
    points: Array
    discs: Surfels


@dataclass(frozen=True, eq=False)
class _Row:
    category: str
    title: str
    tiles: tuple[_Tile, ...]

    @property
    def points(self) -> Array:
        return np.concatenate([tile.points for tile in self.tiles])


def contact_sheet(shards: Sequence[Path], path: Path, *, objects: int = 4, states: int = 6) -> None:
    """Draw `objects` rows of `states` instances each, chosen evenly from `shards`, as a PNG.

    The first instance of a row is the canonical pose; the others are in the order of how far
    their joints have moved. A category is seen from the side that shows most of its parts.

    Raises:
        CorruptShard: a shard cannot be read.
        ArticugenError: there is nothing to draw, or `path` cannot be written.
    """
    chosen = _chosen(shards, objects, states)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        tiles = pool.map(_tile, [instance for _, _, row in chosen for instance in row])
        rows = [_Row(c, title, tuple(next(tiles) for _ in row)) for c, title, row in chosen]
        azimuth = {c: _best_azimuth([r for r in rows if r.category == c]) for c, _, _ in chosen}
        pictures = pool.map(
            _picture,
            [tile for row in rows for tile in row.tiles],
            [c for row in rows for c in [_camera(row, azimuth[row.category])] * len(row.tiles)],
            [float(row.points[:, 2].min()) for row in rows for _ in row.tiles],
        )
        sheet = _sheet(rows, list(pictures))
    try:
        sheet.save(path, "PNG", optimize=True)
    except OSError as error:
        raise ArticugenError(f"{path}: cannot be written: {error.strerror}") from None


def _chosen(
    shards: Sequence[Path], objects: int, states: int
) -> list[tuple[str, str, list[Instance]]]:
    """(category, title, instances) of each row."""
    where: dict[tuple[str, str, str], list[tuple[Path, int]]] = {}
    for path in shards:
        with open_shard(path) as shard:
            category, split = (str(shard.attributes[name]) for name in ("category", "split"))
            for index, object_id in enumerate(shard.object_ids()):
                where.setdefault((category, split, object_id), []).append((path, index))
    keys = _evenly(sorted(where, key=lambda key: (key[1] != "train", key)), objects)
    rows = []
    for category, split, object_id in keys:
        places = where[category, split, object_id]
        moved = [_moved(*place) for place in places]
        order = [places[i] for i in np.argsort(moved, kind="stable")]
        instances = [_read(*place) for place in _evenly(order, states)]
        if len(instances[0].surface_points) > 1:
            rows.append((category, f"{object_id}  {split}", instances))
    if not rows:
        raise ArticugenError(
            f"{shards[0].parent}: no surface points to draw; ask for some in the recipe"
        )
    return rows


def _evenly(items: Sequence[T], count: int) -> list[T]:
    picked = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[round(i)] for i in picked]


def _moved(path: Path, index: int) -> float:
    """How far the joints have moved, the canonical pose before all others."""
    with open_shard(path) as shard:
        if shard.read("state_index", index) == 0:
            return -np.inf
        q, upper = shard.read("joint_state", index), shard.read("joint_upper", index)
        return float(np.abs(q / np.where(upper == 0.0, 1.0, upper)).sum())


def _read(path: Path, index: int) -> Instance:
    with open_shard(path) as shard:
        return shard.instance(index)


def _tile(instance: Instance) -> _Tile:
    points = dequantize(instance.surface_points)
    normals = instance.surface_normals.astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return _Tile(instance, points, surfels(points, normals, instance.surface_part))


def _camera(row: _Row, azimuth: float) -> Camera:
    return framed(row.points, azimuth, ELEVATION, SUPERSAMPLING * TILE, fill=0.86)


def _best_azimuth(rows: Sequence[_Row]) -> float:
    return max(AZIMUTHS, key=lambda azimuth: sum(_seen(row.tiles[-1], azimuth) for row in rows))


def _seen(tile: _Tile, azimuth: float) -> float:
    """How much of the parts can be seen from this side: their fractions, added up."""
    camera = framed(tile.points, azimuth, ELEVATION, 128, fill=0.9)
    depth, _, _ = draw(tile.discs, np.zeros((len(tile.points), 0)), camera)
    x, y, z = apply(camera.T_camera_world, tile.points).T
    column = (camera.focal * x / z + camera.cx).astype(int)
    row = (camera.focal * y / z + camera.cy).astype(int)
    part = tile.instance.surface_part
    seen = np.bincount(part[z < depth[row, column] + tile.discs.spacing], minlength=256)
    return float((seen / np.maximum(np.bincount(part, minlength=256), 1)).sum())


def _picture(tile: _Tile, camera: Camera, floor: float) -> Image.Image:
    """One tile, lit by a soft sky and a lamp over the viewer's left shoulder."""
    palette = np.array([_linear(COLOURS[k % len(COLOURS)]) for k in range(256)])
    of_points = np.concatenate(
        [palette[tile.instance.surface_part], tile.discs.light[:, None]], axis=1
    )
    depth, normals, values = draw(tile.discs, of_points, camera)
    lamp = camera.T_camera_world[:3, :3].T @ np.array([-0.45, -0.65, -0.6])
    direct = np.clip(normals @ (lamp / np.linalg.norm(lamp)), 0.0, 1.0)
    sky = 0.75 + 0.25 * normals[..., 2]
    open_ = 0.15 + 0.85 * values[..., 3] ** 1.2
    toward_us = np.clip(normals @ -camera.T_camera_world[2, :3], 0.0, 1.0)
    lit = open_ * (0.42 * sky + 0.58 * direct + 0.13 * toward_us)
    surface = values[..., :3] * lit[..., None]
    ground = _linear(PAPER) * (1.0 - 0.5 * _shadow(tile, camera, floor))[..., None]
    pixels = np.where(np.isfinite(depth)[..., None], surface, ground)
    size = camera.size // SUPERSAMPLING
    small = pixels.reshape(size, SUPERSAMPLING, size, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return Image.fromarray((np.clip(small, 0.0, 1.0) ** (1 / 2.2) * 255).round().astype(np.uint8))


def _shadow(tile: _Tile, camera: Camera, floor: float) -> Array:
    """(H, W) how much of the sky the object hides from the floor under each pixel."""
    count, reach = 72, 0.9
    at = np.linspace(-reach, reach, count)
    x, y = np.meshgrid(at, at, indexing="ij")
    receivers = np.stack([x.ravel(), y.ravel(), np.full(x.size, floor - 0.012)], axis=1)
    up = np.broadcast_to((0.0, 0.0, 1.0), receivers.shape).copy()
    hidden = occlusion_at(receivers, up, tile.discs).reshape(count, count)
    hidden = np.clip(hidden - 0.04, 0.0, None)  # fades out before the tile's edge
    rays = camera.rays()
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
    columns = max(len(row.tiles) for row in rows)
    height = TILE + 2 * CAPTION
    sheet = Image.new("RGB", (2 * MARGIN + columns * TILE, 2 * MARGIN + len(rows) * height), PAPER)
    pen = ImageDraw.Draw(sheet)
    left = iter(pictures)
    for r, row in enumerate(rows):
        top = MARGIN + r * height
        pen.text((MARGIN + 6, top + 2), row.title, GREY, ImageFont.load_default(14))
        for c, tile in enumerate(row.tiles):
            x = MARGIN + c * TILE
            sheet.paste(next(left), (x, top + CAPTION))
            _write_state(pen, tile.instance, x + TILE // 2, top + CAPTION + TILE)
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
