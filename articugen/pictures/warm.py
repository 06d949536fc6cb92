"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

import numpy as np

from articugen.pictures.camera import framed
from articugen.pictures.light import SurfaceCloud, occlusion_in_detail
from articugen.pictures.splats import draw
from articugen.pictures.surfels import OrientedPoints, surfels


def discs() -> None:
    sample = OrientedPoints(np.eye(3), np.eye(3), np.zeros(3, np.uint8))
    draw(surfels([sample]), np.zeros((3, 3)), framed(np.eye(3), 0.0, 0.0, 8, fill=0.5))


def light() -> None:
    cloud = SurfaceCloud(np.eye(3), np.eye(3), np.ones(3))
    occlusion_in_detail(np.eye(3), np.eye(3), cloud, cloud)
