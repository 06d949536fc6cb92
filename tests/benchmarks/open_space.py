"""What is open to the outside through a wide enough opening, found from the exact solids alone.

The truth for the rule `reachable`, by other means than articugen/reachable.py: a ball that rolls in
from outside (opening by reconstruction, Serra 1988) on a grid of exact occupancy, and exact lines
of sight from the points asked to what it swept. The rule passes openings of its width and none of
half the width; in between, and a little way into crevices, it says nothing. So there are two balls:

    outside: what a view sees free, and what the ball of the whole width sweeps, corners included
    inside: solids, and what the ball of half the width does not come near
    undecided: the rest
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from articugen.core.records import Floats, Views
from tests.benchmarks.cases import Bools, Scene

INSIDE, OUTSIDE, UNDECIDED = 0, 1, 2

RESOLUTION = 256
CORNER = 0.74
"""Radii from a ball to the corner it lies in: sqrt(3) - 1."""

_HALF_DIAGONAL = np.sqrt(3.0) / 2.0


@dataclass(frozen=True, eq=False)
class OpenSpace:
    """Free voxels of a part of the unit cube: surely open to the outside, or maybe.

    Attributes:
        resolution: voxels a side of the unit cube.
        first: (3,) the voxel of the unit cube that the arrays begin with.
        surely, maybe: (a, b, c) around the object.
    """

    scene: Scene
    resolution: int
    first: NDArray[np.int64]
    surely: Bools
    maybe: Bools

    def verdict(self, points: Floats, views: Views) -> NDArray[np.uint8]:
        """(n,) INSIDE, OUTSIDE or UNDECIDED; seen free is meant by exact rays from `views`."""
        verdict = np.full(len(points), OUTSIDE, np.uint8)
        dark = np.flatnonzero(self.scene.unseen(points, views))
        verdict[dark] = INSIDE
        dark = dark[~self.scene.solid(points[dark])]
        cells = self.scene.truth._posed(self.scene.T_world_link)
        unit = self.scene.prepared.unit
        for reached, is_so in ((self.maybe, UNDECIDED), (self.surely, OUTSIDE)):
            near = _looks_into(
                points[dark], reached, self.resolution, self.first, cells, unit.scale, unit.center
            )
            verdict[dark[near]] = is_so
        return verdict


def open_space(scene: Scene, opening: float, resolution: int = RESOLUTION) -> OpenSpace:
    """Roll both balls through the exact free space.

    Args:
        opening: the recipe's, in the unit frame.
        resolution: voxels a side of the unit cube; at least four should fit into half the opening.
    """
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - optional

    radius = opening * resolution / 2.0
    margin = int(np.ceil(2.0 * radius)) + 2  # free all around, wide enough for either ball
    boxes = scene.prepared.unit.to_unit(scene.truth._posed(scene.T_world_link)[2])
    first = np.floor((boxes[:, 0].min(axis=0) + 0.5) * resolution).astype(np.int64) - margin
    last = np.ceil((boxes[:, 1].max(axis=0) + 0.5) * resolution).astype(np.int64) + margin
    x, y, z = ((np.arange(a, b) + 0.5) / resolution - 0.5 for a, b in zip(first, last, strict=True))
    solid = np.empty((len(x), len(y), len(z)), np.bool_)
    for i in range(len(x)):
        at = np.stack(np.meshgrid(x[i], y, z, indexing="ij"), axis=-1).reshape(-1, 3)
        solid[i] = scene.solid(at).reshape(len(y), len(z))
    clearance = np.asarray(distance_transform_edt(~solid), np.float32)
    # a distance to the centre of a solid voxel is that to the solid, or more by half a diagonal
    wide = _rolled(clearance > radius + _HALF_DIAGONAL, radius)
    wide = _spread(wide, ~solid, round(CORNER * radius) - 1)
    narrow = _rolled(clearance > radius / 2.0, radius / 2.0)
    narrow = _spread(narrow, ~solid, round(2.0 * radius))
    return OpenSpace(scene, resolution, first, wide, narrow | wide)


def _rolled(centers: Bools, radius: float) -> Bools:
    """What a ball sweeps whose centre may go to `centers` from the grid's corner."""
    from scipy.ndimage import distance_transform_edt, label  # noqa: PLC0415 - optional

    connected = np.asarray(label(centers)[0])  # type: ignore[index]
    away = np.asarray(distance_transform_edt(connected != connected[0, 0, 0]))
    return away <= radius


def _spread(reached: Bools, free: Bools, steps: int) -> Bools:
    """`reached`, and the free voxels to which at most so many steps lead from it."""
    from scipy.ndimage import binary_dilation  # noqa: PLC0415 - optional

    reached &= free
    if steps <= 0:  # which scipy takes for: until nothing changes
        return reached
    return np.asarray(binary_dilation(reached, np.ones((3, 3, 3)), steps, mask=free), np.bool_)


@njit(cache=True)
def _looks_into(points, reached, resolution, first, cells, scale, center):
    """Whether a straight line through free space leads from each point of the unit frame to the
    centre of a reached voxel, its own or one of the 26 around. Cells are in the world frame."""
    planes, first_plane, boxes = cells
    n = reached.shape
    found = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        at = np.floor((points[i] + 0.5) * resolution).astype(np.int64) - first
        start = points[i] * scale + center
        for step in range(27):
            x = at[0] + step % 3 - 1
            y = at[1] + step // 3 % 3 - 1
            z = at[2] + step // 9 - 1
            if min(x, y, z) < 0 or x >= n[0] or y >= n[1] or z >= n[2] or not reached[x, y, z]:
                continue
            middle = np.array([x + 0.5, y + 0.5, z + 0.5]) + first
            goal = (middle / resolution - 0.5) * scale + center
            clear = True
            for c in range(len(boxes)):
                if _crosses(
                    start, goal - start, boxes[c], planes, first_plane[c], first_plane[c + 1]
                ):
                    clear = False
                    break
            if clear:
                found[i] = True
                break
    return found


@njit(cache=True)
def _crosses(start, way, box, planes, first, last):
    """Whether the way from `start` to `start + way` goes through a convex cell (Cyrus, Beck)."""
    for k in range(3):
        if (
            max(start[k], start[k] + way[k]) < box[0, k]
            or min(start[k], start[k] + way[k]) > box[1, k]
        ):
            return False
    enter, leave = 0.0, 1.0
    for m in range(first, last):
        room = planes[m, 3] - (
            planes[m, 0] * start[0] + planes[m, 1] * start[1] + planes[m, 2] * start[2]
        )
        speed = planes[m, 0] * way[0] + planes[m, 1] * way[1] + planes[m, 2] * way[2]
        if speed > 0.0:
            leave = min(leave, room / speed)
        elif speed < 0.0:
            enter = max(enter, room / speed)
        elif room < 0.0:
            return False
        if enter > leave:
            return False
    return True
