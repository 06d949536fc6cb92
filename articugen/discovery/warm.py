"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.records import JointKind
from articugen.discovery.discover import discover
from articugen.discovery.groups import group_instances
from articugen.discovery.ownership import Ownership, parts_of_surface


def joints() -> None:
    floor = _sheet(np.eye(3)[:2], np.zeros(3))
    walls = [_sheet(0.5 * np.eye(3)[1:], np.array([x, 0.0, 0.3])) for x in (0.0, 0.2)]
    poses = [np.concatenate([floor, wall]) for wall in walls]
    facing = np.repeat(np.eye(3)[[2, 0]], len(floor), axis=0)
    group_instances([(pose, facing) for pose in poses])
    discover(poses, normals=[facing] * 2, kinds=[JointKind.PRISMATIC])
    motion = np.tile(np.eye(4), (2, 2, 1, 1))
    part = parts_of_surface(poses, [facing] * 2, motion)
    Ownership.of(poses, part, motion)


def _sheet(across: Floats, middle: Floats) -> Floats:
    """Return (400, 3) points of a square, spanned by two vectors."""
    at = np.linspace(-0.5, 0.5, 20)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) @ across + middle
