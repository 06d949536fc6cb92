"""What is sampled within one object's instances: the shares of places where samples agree."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import CORNERS, apply, invert_rigid, voxel_centres
from articugen.core.near import Sorted, any_within, by_cell, nearest_within
from articugen.core.recipe import Recipe
from articugen.core.records import FREE, Floats, dequantize, is_material
from articugen.core.schema import Instance
from articugen.verify.bounds import (
    ANY_SURFACE,
    BOUNDS,
    CLOSE,
    MOST_NOISE,
    NEAR,
    OFF_PLANE,
    SAME_SURFACE,
    STEEPEST,
)


@dataclass(frozen=True)
class Share:
    """`agree` of `judged` places agree; `sentence` says with what, {share} in it how many."""

    bound: str
    sentence: str
    agree: int
    judged: int

    @property
    def is_refused(self) -> bool:
        return BOUNDS[self.bound].refuses(self.agree, self.judged)

    def in_words(self) -> str:
        return self.sentence.format(share=f"{self.agree / self.judged:.0%}")


def _share(bound: str, sentence: str, agree: NDArray[np.bool_]) -> Share:
    return Share(bound, sentence, int(agree.sum()), agree.size)


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of an instance, in the unit frame, made ready once for all checks."""

    row: Instance

    @cached_property
    def surface(self) -> Floats:
        """(S, 3) surface points."""
        return dequantize(self.row.surface_points)

    @cached_property
    def near_surface(self) -> Sorted:
        """The surface points, to be asked which are near."""
        return by_cell(self.surface)

    @cached_property
    def queries(self) -> tuple[Floats, NDArray[np.uint8]]:
        """Query points (n, 3) and their labels (n,)."""
        points = np.concatenate([self.row.uniform_points, self.row.near_points])
        return dequantize(points), np.concatenate([self.row.uniform_label, self.row.near_label])


def _grids_agree(samples: Samples, _: Recipe) -> Iterator[Share]:
    """Check that a query point far from the surface is in a cell whose centre is on its side of it.

    Nothing else is sure: a gap or a panel may lie between all centres of a grid, and enclosed space
    may end without a surface.
    """
    points, label = (_some(some, 8000) for some in samples.queries)
    away = np.zeros(len(points), np.bool_)
    for resolution, grid in sorted(samples.row.occupancy.items()) if len(samples.surface) else ():
        reach = math.hypot(0.5 * math.sqrt(3.0) / resolution, _spacing(len(samples.surface)))
        close = np.flatnonzero(~away)  # what was away by a wider reach still is
        away[close] = ~any_within(samples.near_surface, points[close], reach)
        for what, judged in (("free", label == FREE), ("occupied", is_material(label))):
            yield _share(
                what,
                f"occupancy_{resolution} agrees at {{share}} of the query points far from the "
                f"surface that are {what}",
                (_cells(grid, points[away & judged]) == FREE) == (what == "free"),
            )


def _grids_filled(samples: Samples, _: Recipe) -> Iterator[Share]:
    """Voxels of a part lie where other samples are occupied, close by by the same part.

    The other way about proves nothing: a thin panel may lie between all voxels' centres.
    """
    row, (points, label) = samples.row, samples.queries
    occupied = by_cell(np.concatenate([points[label > 0], samples.surface]))
    labels = np.concatenate([label[label > 0], row.surface_part + np.uint8(1)])
    material = is_material(labels)
    # in which one of the uniform points lies, but for exp(-6)
    ball = max(ANY_SURFACE, (18.0 / (4.0 * math.pi * max(len(row.uniform_points), 1))) ** (1 / 3))
    for part in range(len(row.part_motion)):
        of_part = labels == part + 1
        for resolution, grid in sorted(row.occupancy.items()):
            voxels = _some(np.flatnonzero(grid == part + 1), 400)
            centres = voxel_centres(resolution, voxels)
            yield _share(
                "filling",
                f"only {{share}} of the voxels of part {part} in occupancy_{resolution} are where "
                "the points show anything",
                any_within(occupied, centres, ball),
            )
            met = centres[any_within(occupied, centres, CLOSE, material)]
            yield _share(
                "parts",
                f"only {{share}} of the voxels of part {part} in occupancy_{resolution} are "
                "close to other samples of that part",
                any_within(occupied, met, 3.0 * CLOSE, of_part),
            )


def _covered(samples: Samples, _: Recipe) -> Iterator[Share]:
    """Check that the centre of a cell that is all inside is inside, and of one that is all free,
    free.

    But for films finer than the sub-samples that pass just through the centre.
    """
    for resolution, coverage in sorted(samples.row.coverage.items()):
        inside = samples.row.occupancy[resolution] > 0
        for value, wanted in ((255, True), (0, False)):
            yield _share(
                "coverage",
                f"occupancy_{resolution} agrees at {{share}} of the cells of which "
                f"coverage_{resolution} is {value}",
                inside[coverage == value] == wanted,
            )


def _near(samples: Samples, recipe: Recipe) -> Iterator[Share]:
    """Points near the surface are near the surface points."""
    if not len(samples.surface):
        return
    near = dequantize(_some(samples.row.near_points))
    reach = max(ANY_SURFACE, _spacing(len(samples.surface))) + 4.0 * float(
        np.max(recipe.sampling.near_sigma)
    )
    yield _share(
        "near",
        "only {share} of near_points are near surface_points",
        any_within(samples.near_surface, near, reach),
    )


def _zero_level(samples: Samples, _: Recipe) -> Iterator[Share]:
    """Just in front of a surface point is free, just behind it occupied.

    Unless another part lies in front, whose own surface no view sees: a shut laptop's.
    """
    row, surface, (points, label) = samples.row, samples.surface, samples.queries
    nearest = nearest_within(samples.near_surface, points, NEAR)
    points, label, nearest = points[nearest >= 0], label[nearest >= 0], nearest[nearest >= 0]
    ahead = np.einsum("ni,ni->n", points - surface[nearest], row.surface_normals[nearest] / 127.0)
    beside = np.linalg.norm(points - surface[nearest], axis=1)
    clear = (np.abs(ahead) > OFF_PLANE) & (np.abs(ahead) > STEEPEST * beside)
    part = row.surface_part[nearest] + 1
    shown = (ahead < 0.0) | (label == FREE) | (label == part)
    yield _share(
        "zero level",
        "surface_points bound what is occupied at {share} of the places that decide it",
        ((label == FREE) == (ahead > 0.0))[clear & shown],
    )
    inside = clear & is_material(label) & (ahead < 0.0)  # thin walls enclose space close by
    yield _share(
        "inner part",
        "surface_part agrees with the labels just inside at {share} of the places",
        (label == part)[inside],
    )


def _partial_parts(samples: Samples, recipe: Recipe) -> Iterator[Share]:
    row = samples.row
    wanted = recipe.sampling
    if wanted.depth_noise > MOST_NOISE or wanted.kinect_metres or not len(samples.surface):
        return
    partial = dequantize(row.partial_points).reshape(-1, 3)
    nearest = nearest_within(samples.near_surface, partial, SAME_SURFACE)
    is_known = nearest >= 0
    yield _share(
        "partial parts",
        "partial_part agrees with surface_part at {share} of the places",
        row.partial_part.ravel()[is_known] == row.surface_part[nearest[is_known]],
    )
    yield _share(
        "seen",
        "only {share} of partial_points are near surface_points",
        any_within(samples.near_surface, partial, max(ANY_SURFACE, _spacing(len(samples.surface)))),
    )


def flow_shares(samples: Samples, canonical: Samples) -> Iterator[Share]:
    """`part_motion` brings each part's surface back to where the canonical pose has something."""
    grids = canonical.row.occupancy
    if not grids or not len(canonical.surface):
        return
    grid = grids[max(grids)]
    back = invert_rigid(samples.row.part_motion)
    reach = max(ANY_SURFACE, _spacing(len(canonical.surface)))
    for part in range(1, len(back)):
        moved = apply(back[part], _some(samples.surface[samples.row.surface_part == part]))
        met = any_within(canonical.near_surface, moved, reach)
        met[~met] = (_about(grid, moved[~met]) > 0).any(axis=1)
        yield _share(
            "flow",
            f"part_motion[{part}] brings {{share}} of the part's surface back to the canonical "
            "pose",
            met,
        )


def _spacing(count: int) -> float:
    """Within that of a place on a surface of area 3, the unit cube's in the middle of what objects
    have, lies one of `count` surface points, but for a chance of exp(-6)."""
    return math.sqrt(6.0 * 3.0 / (math.pi * max(count, 1)))


def _cells(grid: NDArray[np.uint8], points: Floats) -> NDArray[np.uint8]:
    """Return (n,) the label of the cell of the grid (R, R, R) that each point (n, 3) lies in."""
    size = len(grid)
    x, y, z = np.clip(((points + 0.5) * size).astype(int), 0, size - 1).T
    return grid[x, y, z]


ShareCheck = Callable[[Samples, Recipe], Iterator[Share]]

SHARE_CHECKS: dict[str, ShareCheck] = {
    "grids": _grids_agree,
    "filling": _grids_filled,
    "coverage": _covered,
    "near": _near,
    "zero level": _zero_level,
    "partial parts": _partial_parts,
}


def _some(rows: NDArray[Any], most: int = 1000) -> NDArray[Any]:
    """Return at most `most` of the rows, spread evenly: enough for a share."""
    return rows[:: len(rows) // most + 1]


def _about(grid: NDArray[np.uint8], points: Floats) -> NDArray[np.uint8]:
    """Return (n, 8) the labels of the 8 voxels whose centres surround each point (n, 3)."""
    first = np.floor((points + 0.5) * len(grid) - 0.5).astype(int)
    around = np.clip(first[:, None] + CORNERS, 0, len(grid) - 1)
    x, y, z = np.moveaxis(around, 2, 0)
    return grid[x, y, z]
