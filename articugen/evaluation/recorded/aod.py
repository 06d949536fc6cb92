"""Sequences of the Articulated Object Dataset (Michel et al., BMVC 2015):

    <root>/test/Laptop_Seq_1/depth_filled/00000.png, mask/00000_000p.png, info/info_00000_000.txt

Depth has 16 bits, millimetres. The camera looks along -z, with y up; poses are turned to ours, in
which it looks along +z. A mask is 1 where its part is seen. Part 0 is taken for the base.
"""

from pathlib import Path

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import InvalidSource
from articugen.core.geometry import transform
from articugen.evaluation.recorded.frames import (
    BACKGROUND,
    FARTHEST,
    Frame,
    Recording,
    contents,
    picture,
    seen_by,
    surfaces_seen,
)
from articugen.pictures.contact_sheet import evenly

DEPTH = ("depth_filled", "depth_noseg")

_FOCAL, _CX, _CY = 540.0, 323.65, 240.81  # as CAPTRA's authors have it (Weng et al., ICCV 2021)
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def read(folder: Path, count: int) -> Recording:
    """Return up to `count` images of a sequence; raises as `read_recording`."""
    images = next(p for p in (folder / name for name in DEPTH) if p.is_dir())
    numbers = sorted(path.stem for path in images.glob("*.png"))
    if not numbers:
        raise InvalidSource(f"{images}: holds no <number>.png")
    frames = []
    for number in evenly(numbers, count):
        poses = [_pose(folder / "info" / f"info_{number}_{p:03d}.txt") for p in range(2)]
        if poses[0] is None or poses[1] is None:
            continue  # a part is out of the image
        depth = picture(images / f"{number}.png") / 1000.0
        height = len(depth)
        part = np.full(depth.shape, BACKGROUND)
        for p in range(2):
            mask = picture(folder / "mask" / f"{number}_{p:03d}.png")
            if mask.shape != depth.shape:
                raise InvalidSource(f"{folder}: mask {number} is of another size than the depth")
            part[mask == 1] = p
        points = seen_by(depth, _FOCAL, _FOCAL, _CX, height - 1 - _CY)
        there = np.isfinite(points[..., 2])
        frames.append(Frame(points[there], part[there], _FLIP @ np.array(poses)))
    if not frames:
        raise InvalidSource(f"{folder}: no image has a pose of every part")
    return Recording(folder.name, surfaces_seen(frames), frames)


def _pose(path: Path) -> Floats | None:
    """Return (4, 4) from the part's frame to the camera's, metres; None where the part is not in
    the image."""
    words = contents(path).decode("utf-8", "replace").split()
    if "rotation:" not in words:
        return None
    try:
        at, then = words.index("rotation:") + 1, words.index("center:") + 1
        R, t = (np.array(words[k : k + n], np.float64) for k, n in ((at, 9), (then, 3)))
        pose = transform(R.reshape(3, 3), t.reshape(3))
        if not (np.abs(pose) < FARTHEST).all():
            raise ValueError
    except ValueError:
        raise InvalidSource(f"{path}: no pose (rotation: nine numbers, center: three)") from None
    return pose
