"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

import numpy as np

from articugen.inspection.likeness import chamfer
from articugen.inspection.report.skin import skin
from articugen.meshes.crossings import crossings
from articugen.pictures.surfels import OrientedPoints


def skins() -> None:
    skin(OrientedPoints(np.eye(3), np.eye(3), np.zeros(3, np.uint8)), 0.5, 0.5)


def clouds() -> None:
    chamfer(np.zeros((3, 1), np.float32), np.zeros((1, 3, 1), np.float32))


def checks() -> None:
    crossings(np.zeros((1, 3, 3)), 1)
