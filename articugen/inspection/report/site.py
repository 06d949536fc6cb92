"""A data set on one page: a folder that opens from the disk or any host, each object to be turned.

Its index is the report, with all objects on it. An object's scene is a script, since a page on a
disk may load those, but read no other file. Files are called by the digest of what they hold: a
former site stays whole until the new index is there.
"""

import hashlib
import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import quote

import numpy as np
from PIL import Image

from articugen.core.arrays import Floats
from articugen.core.errors import ArticugenError, printable
from articugen.core.files import UnfitFile, locked, whole_name
from articugen.core.place import Folder
from articugen.core.processes import in_order
from articugen.core.records import dequantize
from articugen.core.schema import Instance
from articugen.inspection.report import sections
from articugen.inspection.report.facts import Facts, ObjectFacts, facts, merged
from articugen.inspection.report.markup import Markup, el, hint, join, text
from articugen.inspection.report.page import Section, document, drawable, sections_of, webp
from articugen.inspection.report.truth import Measured, measured
from articugen.inspection.report.turnable import turnable
from articugen.pictures.contact_sheet import portraits
from articugen.pictures.layout import in_columns
from articugen.pictures.shading import Picture
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.shards import open_shard
from articugen.store.shelf import shards_of

PICTURE, POOLED = 176, 3  # of a tile: pixels along an edge, instances whose points make it
VIEWS, DEPTH = 4, 144  # of the stored depth images: how many are shown, pixels along an edge
SOURCES = "'self' file:"  # where the page's files are: with it, on a host or on a disk
_INDEX, _OBJECTS = "index.html", "objects"
_OURS = re.compile(r"[0-9a-f]{16}\.(js|webp)")


@dataclass(frozen=True, eq=False)
class Site:
    """A site that was written.

    Attributes:
        folder: where it is.
        objects, bytes: how many objects, and how large all files are.
    """

    folder: Path
    objects: int
    bytes: int


def site(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    jobs: int = 1,
    on_shard: Callable[[int, int, str], None] = lambda *_: None,
) -> Site:
    """Write a data set as a folder of static files, which shows all its objects in a browser.

    Args:
        data: the folder of a data set, or a shard.
        out: a folder that is empty, not there yet, or holds a former site, which it replaces.
        jobs: worker processes; 0 does it in this one.
        on_shard: called with the number of shards that are done, how many there are, and a name.

    Raises:
        ArticugenError: `out` holds something else, or another process writes into it.
        CorruptShard: a shard or the manifest cannot be read.
        MachineFault: `out` cannot be written.
    """
    path, folder = Path(data), Path(out)
    shards = shards_of(path)
    manifest = Manifest.read(path) if (path / MANIFEST_NAME).is_file() else None
    with locked(folder):
        place = _taken(folder)
        about: list[Facts] = []
        truths: list[Measured] = []
        tiles: list[tuple[str, Markup]] = []
        written: dict[str, int] = {}
        work = partial(_of_shard, manifest=manifest, entries=sections.entries_of(manifest))
        done = in_order(work, shards, workers=jobs, name=lambda path: path.name)
        for number, (fact, pages) in enumerate(done, 1):
            about.append(fact)
            for page in pages:
                truths.append(page.truth)
                tiles.append((page.key, page.tile))
                for name, content in page.files.items():
                    place.write(f"{_OBJECTS}/{name}", content)
                    written[name] = len(content)
            on_shard(number, len(shards), shards[number - 1].name)
        whole = merged(about)
        instances = tuple(one for truth in truths for one in truth.instances)
        truth = Measured(instances, truths[0].why_not if truths else "")
        tiles.sort(key=lambda tile: tile[0])
        every = join(
            el("noscript", hint("Turning, search and order need JavaScript.")),
            el("div", *(tile for _, tile in tiles), class_="wall"),
        )
        index = _document(
            f"{whole.about['category']}: a data set",
            sections.header(path, whole, manifest),
            [("all", "All objects", every), *sections_of(whole, manifest, truth)],
        )
        place.write(_INDEX, index)
        old = [name for name in place.list(_OBJECTS) if _OURS.fullmatch(whole_name(name) or name)]
        place.delete(f"{_OBJECTS}/{name}" for name in old if name not in written)
    return Site(folder, len(tiles), len(index) + sum(written.values()))


def _taken(folder: Path) -> Folder:
    """Return the folder, once it is known to hold a site or nothing."""
    place, names = Folder(folder), set(os.listdir(folder))
    try:
        index = place.read(_INDEX) or b""
    except UnfitFile:
        index = b""
    if names and text(SOURCES).encode() not in index[:2000]:
        raise ArticugenError(
            f"{folder}: holds something else ({min(names)}); choose an empty or new folder"
        )
    if not names:  # if this is killed, the next call knows whose folder it is
        unfinished = [("all", "Not finished", hint("This site is still being written."))]
        place.write(_INDEX, _document("A data set", el("header"), unfinished))
    return place


def _document(title: str, header: Markup, parts: Sequence[Section]) -> bytes:
    return document(
        title, header, parts, "what the data set holds", scripts=("viewer.js", "site.js"),
        sources=SOURCES, complete="This folder is complete: it opens without a network.",
    ).encode()  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Page:
    """An object of a site: its tile, and the files it needs by their names."""

    key: str
    tile: Markup
    files: dict[str, bytes]
    truth: Measured


def _of_shard(
    path: Path, *, manifest: Manifest | None, entries: sections.Entries
) -> tuple[Facts, list[_Page]]:
    about, pages = facts([path]), []
    for one in about.objects:
        if manifest:  # with this object alone, as a page goes through all that it lists
            entry = entries.get((one.split, one.object_id))
            manifest = manifest.model_copy(update={"objects": (entry,) if entry else ()})
        pages.append(_page(str(about.about["category"]), one, manifest))
    return about, pages


def _page(category: str, about: ObjectFacts, manifest: Manifest | None) -> _Page:
    files: dict[str, bytes] = {}

    def named(content: bytes, suffix: str) -> str:
        name = f"{hashlib.sha256(content).hexdigest()[:16]}.{suffix}"
        files[name] = content
        return f"{_OBJECTS}/{name}"

    truth = measured([about], manifest)
    lines = sections.one_object(about, manifest, truth)
    scene = turnable([about]) or {"name": printable(about.object_id), "split": about.split}
    cameras = _cameras(about)
    views = {"image": named(webp(cameras[0]), "webp"), "text": cameras[1]} if cameras else None
    page = {**scene, "lines": [list(map(printable, line)) for line in lines], "views": views}
    # JSON is JavaScript as it stands, all beyond ASCII being spelt out
    script = named(f"articugen.loaded({json.dumps(page, separators=(',', ':'))});\n".encode(), "js")
    image = None
    for drawn in portraits(drawable(category, [about]), states=3, pooling=POOLED, size=PICTURE):
        source = named(webp(drawn.pictures[len(drawn.pictures) // 2]), "webp")
        image = el("img", src=source, alt="", width=PICTURE, height=PICTURE, loading="lazy")
    key = printable(f"{about.split}/{about.object_id}")
    side = float(np.nan_to_num(about.box).max())
    size = f"; longest edge {side:.3g} (model's unit)" if side else ""
    tile = el(
        "a", image, el("b", about.object_id),
        el("span", about.split, size, class_="hint"),
        href=f"#object={quote(key)}", class_="card tile", data_key=key, data_split=about.split,
        data_size=f"{side:.6g}", data_joints=len(about.joints), data_script=script,
    )  # fmt: skip
    return _Page(key, tile, files, truth)


def _cameras(about: ObjectFacts) -> tuple[Picture, str] | None:
    """Return what depth cameras saw of one state of an object, beside each other, and a caption;
    None where nothing of it is stored."""
    row = min(1, len(about.rows) - 1)  # the first random state, if any
    with open_shard(about.shard) as shard:
        instance = shard.instance(about.rows[row])
    if instance.image_depth is not None:
        maps, what = list(instance.image_depth[:VIEWS]), "Stored depth images"
    else:
        maps, what = _of_points(instance), "Stored partial clouds"
    if not maps or not any(depth.any() for depth in maps):
        return None
    tiles = [Image.fromarray(_grey(depth)).resize((DEPTH, DEPTH)) for depth in maps]
    return in_columns(tiles, VIEWS), f"{what} of state {row + 1}: what is nearer is brighter."


def _of_points(instance: Instance) -> list[Floats]:
    """Return depth maps (DEPTH, DEPTH) of the first partial clouds, each point two pixels wide."""
    maps = []
    clouds = dequantize(instance.partial_points[: VIEWS * bool(instance.partial_points.size)])
    cameras = instance.partial_T_camera_world, instance.partial_intrinsics
    for points, T, (fx, fy, cx, cy) in zip(clouds, *cameras, strict=False):
        x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
        pixels = np.stack([fy * y / z + cy, fx * x / z + cx])
        low, high = pixels.min(axis=1, keepdims=True), pixels.max(axis=1, keepdims=True)
        scale = (DEPTH - 8) / max(float((high - low).max()), 1e-9)
        rows, columns = (scale * (pixels - (low + high) / 2) + DEPTH / 2).astype(int)
        depth = np.full((DEPTH, DEPTH), np.inf)
        for down, right in np.ndindex(2, 2):
            np.minimum.at(depth, (rows + down, columns + right), z)
        maps.append(np.where(np.isfinite(depth), depth, 0.0))
    return maps


def _grey(depth: Floats) -> np.ndarray:
    """Return a depth map as bytes: 0 where nothing is, the nearest brightest."""
    hit = depth > 0.0
    low, high = (depth[hit].min(), depth[hit].max()) if hit.any() else (0.0, 1.0)
    share = (depth - low) / max(float(high - low), 1e-9)
    return np.where(hit, 255 - 190 * share, 0).astype(np.uint8)
