"""ArtGS's scenes (and PARIS's and DTA's, which it follows): an object in two states, in images.

<split>/<object>/{start,end}/{rgba,depth}/<camera>.png and transforms_{train,test}_{start,end}.json.
The start is the canonical pose, the end the state in which the joints are furthest from it. Of the
cameras, which both states share, every eighth is for the test.
"""

import io
import json

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from articugen.export.formats import Format, Item, LeftOut
from articugen.export.items import canonical, file_name, of_objects
from articugen.export.target import Target
from articugen.geometry import invert_rigid
from articugen.store.rows import Row

_TEST = 8
_MILLI = 1000.0
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def _write(item: Item, target: Target) -> None:
    start = canonical(item.rows)
    if not {"image_rgba", "image_depth"} <= set(start.fields):
        raise LeftOut(
            f"{start.object_id}: no images with depth and rgba are stored; make the data with "
            "images.views"
        )
    end = max(item.rows, key=_opened)
    if end.state_index == start.state_index:
        raise LeftOut(f"{start.object_id}: has one state, of two that are needed")
    folder = f"{file_name(start.split)}/{file_name(start.object_id)}"
    for word, time, row in (("start", 0.0, start), ("end", 1.0, end)):
        for camera in range(len(row.images.rgba)):
            name = f"{folder}/{word}/{{}}/{camera:03d}.png"
            depth = np.round(_MILLI * row.images.depth[camera]).astype(np.uint16)
            target.write(name.format("rgba"), _png(row.images.rgba[camera]))
            target.write(name.format("depth"), _png(depth))
        for split, cameras in _splits(len(row.images.rgba)).items():
            told = json.dumps(_transforms(row, word, time, cameras), indent=1).encode()
            target.write(f"{folder}/transforms_{split}_{word}.json", told + b"\n")


def _opened(row: Row) -> float:
    """How far the joints are from the canonical pose, in shares of their ranges."""
    return sum(abs(j.state) / max(j.upper - j.lower, 1e-9) for j in row.joints)


def _splits(cameras: int) -> dict[str, list[int]]:
    tests = [k for k in range(cameras) if k % _TEST == _TEST - 1]
    return {"train": [k for k in range(cameras) if k not in tests], "test": tests}


def _transforms(row: Row, word: str, time: float, cameras: list[int]) -> dict[str, object]:
    fx, fy, _, _ = row.images.intrinsics[0]
    size = row.images.rgba.shape[1]
    return {
        "camera_angle_x": 2.0 * float(np.arctan2(size, 2.0 * fx)),
        "camera_angle_y": 2.0 * float(np.arctan2(size, 2.0 * fy)),
        "frames": [
            {
                "file_path": f"{word}/rgba/{k:03d}.png",
                "time": time,
                "transform_matrix": _to_world(row.images.T_camera_world[k]).tolist(),
            }
            for k in cameras
        ],
    }


def _to_world(T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) from a camera that looks along -z, y up, to the unit frame."""
    return invert_rigid(T_camera_world) @ _OPENGL


def _png(image: NDArray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()


FORMAT = Format(
    "ArtGS, PARIS: two states of an object in RGBA and depth images, with cameras",
    of_objects,
    _write,
)
