"""Scenes of ArtGS, and of PARIS, which it follows: an object in two states, in images.

The start is the canonical pose, the end the state in which the joints are furthest from it. Of the
cameras, which both states share, every eighth is for the test. Each loader finds files of its own
in an object's folder: ArtGS <end>/<views>/{rgba,depth}/ and transforms_*.json, PARIS <end>/<views>/
and <end>/camera_*.json, both the truth in gt/trans.json.
"""

from typing import Any

import numpy as np

from articugen.core.geometry import invert_rigid
from articugen.export.formats import Format
from articugen.export.items import Item, LeftOut, canonical, file_name, of_objects
from articugen.export.target import Files
from articugen.pictures.layout import png_of
from articugen.store.rows import Row

_TEST = 8
_MILLI = 1000.0
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def _write(item: Item, target: Files) -> None:
    start = canonical(item.rows)
    if not {"image_rgba", "image_depth"} <= set(start.fields) or len(start.images.rgba) < 2:
        raise LeftOut(
            f"{start.object_id}: no images with depth and rgba of two cameras or more are stored; "
            "make the data with images.views"
        )
    end = max(  # the joints farthest from the canonical pose, in shares of their ranges
        item.rows,
        key=lambda row: sum(abs(j.state) / max(j.upper - j.lower, 1e-9) for j in row.joints),
    )
    if end.state_index == start.state_index:
        raise LeftOut(f"{start.object_id}: has one state, of two that are needed")
    folder = f"{file_name(start.split)}/{file_name(start.object_id)}"
    ends = (("start", 0.0, start), ("end", 1.0, end))
    every = range(len(start.images.rgba))
    tests = list(every[_TEST - 1 :: _TEST]) or [every[-1]]
    train = [k for k in every if k not in tests]
    # PARIS examines `val` while it trains, ArtGS has none
    for views, cameras in {"train": train, "val": tests, "test": tests}.items():
        frames = {word: _frames(row, f"{word}/{views}", time, cameras) for word, time, row in ends}
        for word, _, row in ends:
            _write_images(row, f"{folder}/{word}/{views}", cameras, views != "val", target)
            fx, fy, cx, cy = row.images.intrinsics[0].tolist()
            named = {f"{n:04d}": one["transform_matrix"] for n, one in enumerate(frames[word])}
            K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
            target.write_json(f"{folder}/{word}/camera_{views}.json", {"K": K, **named})
            if views != "val":
                some = {**_angles(row), "frames": frames[word]}
                target.write_json(f"{folder}/transforms_{views}_{word}.json", some)
        if views != "val":
            both = {**_angles(start), "frames": frames["start"] + frames["end"]}
            target.write_json(f"{folder}/transforms_{views}.json", both)
    target.write_json(f"{folder}/gt/trans.json", _truth(start, end))


def _write_images(row: Row, folder: str, cameras: list[int], depth: bool, target: Files) -> None:
    """Number the images of these cameras from 0 on; ArtGS's, which have depths, in `rgba`, too."""
    for number, k in enumerate(cameras):
        rgba = png_of(row.images.rgba[k])
        target.write(f"{folder}/{number:04d}.png", rgba)
        if depth:
            thousandths = np.round(_MILLI * row.images.depth[k]).astype(np.uint16)
            target.write(f"{folder}/rgba/{number:04d}.png", rgba)
            target.write(f"{folder}/depth/{number:04d}.png", png_of(thousandths))


def _frames(row: Row, folder: str, time: float, cameras: list[int]) -> list[dict[str, Any]]:
    """Name images, and where their cameras, which look along -z, y up, are in the unit frame."""
    return [
        {
            "file_path": f"{folder}/rgba/{number:04d}.png",
            "time": time,
            "transform_matrix": (invert_rigid(row.images.T_camera_world[k]) @ _OPENGL).tolist(),
        }
        for number, k in enumerate(cameras)
    ]


def _angles(row: Row) -> dict[str, float]:
    fx, fy, _, _ = row.images.intrinsics[0]
    size = row.images.rgba.shape[1]
    return {
        "camera_angle_x": 2.0 * float(np.arctan2(size, 2.0 * fx)),
        "camera_angle_y": 2.0 * float(np.arctan2(size, 2.0 * fy)),
    }


def _truth(start: Row, end: Row) -> dict[str, Any]:
    """Return each joint's axis at the start and how far it moves, in degrees or the unit frame's
    unit."""
    moved = []
    for joint, other in zip(start.joints, end.joints, strict=True):
        kind, unit = ("rotate", 180.0 / np.pi) if joint.kind == "revolute" else ("translate", 1.0)
        axis = {"o": np.asarray(joint.pivot).tolist(), "d": np.asarray(joint.axis).tolist()}
        span = {"l": joint.state_unit * unit, "r": other.state_unit * unit}
        moved.append({"type": kind, "axis": axis, kind: span})
    return {"trans_info": moved[0] if len(moved) == 1 else moved}


FORMAT = Format(
    "ArtGS, PARIS: two states of an object in RGBA and depth images, with cameras",
    of_objects,
    _write,
)
