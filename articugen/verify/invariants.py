"""What must hold within one object's instances, judged from the stored numbers alone.

Bounds on exact things are tight. Of sampled things a share must agree, see `BOUNDS`: one that a
sound object, thin sheets and narrow gaps included, keeps by a wide margin, and that a real fault
(swapped instances, mirrored grids, inverted motions, a surface beside the field's zero level) does
not. A share is refused only where chance can hardly explain it, so a few samples never are.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from articugen.geometry import apply, invert_rigid, rotation_about, transform, voxel_centres
from articugen.recipe import Recipe
from articugen.records import (
    ENCLOSED,
    FREE,
    STORED_KINDS,
    Floats,
    Instance,
    JointKind,
    dequantize,
    is_material,
)

ROUNDING = 1e-9
"""What rounding may do to rigid motions and unit vectors in float64."""

NEAR = 0.004
"""A query point so close to a surface point is judged by that point's tangent plane."""


CLOSE = 0.02
"""A voxel so close to a sample in the material has one of its own part within three times that."""


LEAST_EXTENT = 0.75
"""Of the box, that the surface points of all instances reach; 0.96 at least in sound sets, 0.5 in
an object of half the size."""


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong; `state_index` is None where it concerns the whole object."""

    state_index: int | None
    check: str
    sentence: str


CHANCE = 1e-9
"""That a share is refused though the true one is what it must be. An instance has some hundred
shares: one that is sound is refused with a chance below 1e-6."""


@dataclass(frozen=True)
class Bound:
    """What the share of places that agree must be.

    Attributes:
        least: the true share of any sound object is at least that.
        sound: the least share measured in sound instances, of those that could be refused;
            `python -m tests.benchmarks.soundness` measures it again.
        faulty: the greatest share that gives away one of the faults of tests/test_invariants.py.
        per: so many places tell no more than one. Points are drawn each for itself; voxels beside
            each other lie in the same plate, or in the same gap.
    """

    least: float
    sound: float
    faulty: float
    per: int = 1

    def refuses(self, agree: int, judged: int) -> bool:
        """Whether a true share of `least` would hardly show as `agree` of `judged` places or less.

        By Chernoff's bound of the binomial distribution: of n draws, each of probability p, a share
        of q or less agrees with a chance of exp(-n D) at most, D the divergence of q from p.
        """
        share = agree / max(judged, 1)
        if judged == 0 or share >= self.least:
            return False
        divergence = (1.0 - share) * math.log((1.0 - share) / (1.0 - self.least))
        if share > 0.0:
            divergence += share * math.log(share / self.least)
        return judged / self.per * divergence > -math.log(CHANCE)


BOUNDS = {
    "free": Bound(least=0.9, sound=0.99, faulty=0.01),
    "occupied": Bound(least=0.8, sound=0.91, faulty=0.4),
    "filling": Bound(least=0.8, sound=0.87, faulty=0.4, per=4),
    "parts": Bound(least=0.6, sound=0.73, faulty=0.1, per=4),
    "coverage": Bound(least=0.8, sound=0.92, faulty=0.65, per=4),
    "near": Bound(least=0.9, sound=0.99, faulty=0.75),
    "zero level": Bound(least=0.8, sound=0.88, faulty=0.45),
    "inner part": Bound(least=0.7, sound=0.96, faulty=0.1),
    "partial parts": Bound(least=0.7, sound=0.91, faulty=0.1),
    "seen": Bound(least=0.6, sound=0.78, faulty=0.25),
    "flow": Bound(least=0.8, sound=0.92, faulty=0.6),
}
"""For each kind of share; `sound` by 230 sets of three instances each."""


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

    @property
    def could_be_refused(self) -> bool:
        """Whether so many places were judged that it would be refused if none agreed."""
        return BOUNDS[self.bound].refuses(0, self.judged)

    def told(self) -> str:
        return self.sentence.format(share=f"{self.agree / self.judged:.0%}")


def faults(rows: Sequence[Instance], recipe: Recipe) -> Iterator[Fault]:
    """Everything wrong with `rows`, all instances of one object made by `recipe`."""
    sensible = []
    for row in rows:
        wrong = list(_of(row, recipe, VALUE_CHECKS))
        # Geometry computed from senseless values would only repeat, or hide, what is wrong.
        yield from wrong or _of(row, recipe, GEOMETRY_CHECKS)
        sensible += [] if wrong else [row]
    yield from _refused(shares(sensible, recipe))
    for check, judge in OBJECT_CHECKS.items():
        yield from (Fault(state, check, sentence) for state, sentence in judge(rows, recipe))


def shares(rows: Sequence[Instance], recipe: Recipe) -> Iterator[tuple[int, str, Share]]:
    """(state_index, check, share) of everything sampled in all instances of one object."""
    canonical = next((row for row in rows if row.state_index == 0), None)
    for row in rows:
        for check, judge in SHARE_CHECKS.items():
            yield from ((row.state_index, check, share) for share in judge(row, recipe))
        if canonical is not None:
            yield from ((row.state_index, "flow", share) for share in _flow(row, canonical))


def _refused(found: Iterator[tuple[int, str, Share]]) -> Iterator[Fault]:
    """The instances whose shares are refused, and the object where only all of them together
    tell."""
    alike: dict[tuple[str, str], list[tuple[int, Share]]] = {}
    for state, check, share in found:
        alike.setdefault((check, share.sentence), []).append((state, share))
    for (check, sentence), several in alike.items():
        alone = [Fault(state, check, s.told()) for state, s in several if s.is_refused]
        agree, judged = (sum(getattr(s, n) for _, s in several) for n in ("agree", "judged"))
        pooled = Share(several[0][1].bound, sentence, agree, judged)
        yield from alone or ([Fault(None, check, pooled.told())] if pooled.is_refused else [])


def _share(bound: str, sentence: str, agree: NDArray[np.bool_]) -> Share:
    return Share(bound, sentence, int(agree.sum()), agree.size)


def _of(row: Instance, recipe: Recipe, checks: dict[str, "InstanceCheck"]) -> Iterator[Fault]:
    for check, judge in checks.items():
        yield from (Fault(row.state_index, check, sentence) for sentence in judge(row, recipe))


# Values.


def _numbers(row: Instance, _: Recipe) -> Iterator[str]:
    limits = ("joint_lower", "joint_upper")
    for name, array in row.arrays().items():
        if name in limits or isinstance(array, str | tuple):  # names are no numbers
            continue
        if not np.isfinite(array).all():
            yield f"{name} has numbers that are not finite"
    if (
        np.isnan([row.joint_lower, row.joint_upper]).any()
        or (row.joint_lower > row.joint_upper).any()
    ):
        yield "joint_lower and joint_upper are not ranges"
    if not row.scale > 0.0:
        yield f"scale is {row.scale}"
    if not np.isin(row.joint_kind, STORED_KINDS).all():
        yield f"joint_kind is none of {', '.join(f'{k:d} {k}' for k in STORED_KINDS)}"
    own = np.arange(1, len(row.joint_kind) + 1)
    if (row.joint_parent > len(own)).any() or (row.joint_parent == own).any():
        yield "joint_parent names a part that is not there, or the joint's own"


def _counts(row: Instance, recipe: Recipe) -> Iterator[str]:
    ask = recipe.sampling
    wanted = {
        "surface_points": (ask.surface_points,),
        "uniform_points": (ask.uniform_points,),
        "near_points": (ask.near_points,),
        "partial_points": (ask.partial_views, ask.partial_points),
    }
    for name, shape in wanted.items():
        have = getattr(row, name).shape[:-1]
        if have != shape:
            yield f"{name} has {have} points where the recipe asks for {shape}"
    grids = {"occupancy": ask.grids, "coverage": ask.grids if ask.coverage else ()}
    for name, resolutions in grids.items():
        have = sorted(getattr(row, name))
        if have != sorted(resolutions):
            yield f"{name} has grids {have}, not {sorted(resolutions)}"


def _labels(row: Instance, recipe: Recipe) -> Iterator[str]:
    parts = len(row.part_motion)
    enclosed = recipe.fusion.rule != "rigid"
    labels = {"uniform_label": row.uniform_label, "near_label": row.near_label}
    labels |= {f"occupancy_{r}": grid for r, grid in row.occupancy.items()}
    for name, label in labels.items():
        known = label[label != ENCLOSED] if enclosed else label
        if known.size and known.max() > parts:
            yield f"{name} has label {known.max()} of {parts} parts"
    for name in ("surface_part", "partial_part"):
        part = getattr(row, name)
        if part.size and part.max() >= parts:
            yield f"{name} has part {part.max()} of {parts} parts"


def _normals(row: Instance, _: Recipe) -> Iterator[str]:
    length = np.linalg.norm(row.surface_normals / 127.0, axis=1)
    off = np.abs(length - 1.0) > 0.01  # rounding to 1/127 changes a length by 0.0069 at most
    if off.any():
        yield f"{off.sum()} surface normals are not of unit length ({length[off][0]:.3f})"


def _joint_range(row: Instance, _: Recipe) -> Iterator[str]:
    if row.state_index == 0:  # the canonical pose may lie outside of what is sampled
        return
    low, high = row.joint_lower - ROUNDING, row.joint_upper + ROUNDING
    for j in np.flatnonzero((row.joint_state < low) | (row.joint_state > high)):
        yield (
            f"joint {j} is at {row.joint_state[j]:.6g}, outside of its range "
            f"{row.joint_lower[j]:.6g} to {row.joint_upper[j]:.6g}"
        )


# Geometry.


def _rigid(row: Instance, _: Recipe) -> Iterator[str]:
    for name in ("part_motion", "partial_T_camera_world"):
        T = getattr(row, name)
        R = T[:, :3, :3]
        skew = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        bad = (skew > ROUNDING) | (np.linalg.det(R) < 0.0) | (T[:, 3] != (0, 0, 0, 1)).any(axis=1)
        if bad.any():
            yield f"{name}[{np.argmax(bad)}] is not a rigid motion"


def _motion(row: Instance, _: Recipe) -> Iterator[str]:
    if np.abs(row.part_motion[0] - np.eye(4)).max() > ROUNDING:
        yield "part_motion[0] is not the identity: the fixed part moves"
    for j, axis in enumerate(row.joint_axis):
        if abs(np.linalg.norm(axis) - 1.0) > ROUNDING:
            yield f"joint_axis[{j}] is not of unit length"
            continue
        expected = _joint_motion(row, j) @ row.part_motion[row.joint_parent[j]]
        error = np.abs(expected - row.part_motion[j + 1]).max()
        if error > 1e3 * ROUNDING:
            yield f"part_motion[{j + 1}] differs by {error:.2g} from what its joint does"


def _joint_motion(row: Instance, j: int) -> Floats:
    """(4, 4) what joint j at its state does to what hangs on it, unit frame."""
    axis, pivot, q = row.joint_axis[j], row.joint_pivot[j], row.joint_state[j]
    if row.joint_kind[j] == JointKind.PRISMATIC:
        return transform(translation=q * axis)
    R = rotation_about(axis, q)
    return transform(R, pivot - R @ pivot)


def _inside_box(row: Instance, recipe: Recipe) -> Iterator[str]:
    half = 0.5 * (1.0 - recipe.padding) + recipe.fusion.sheet_thickness + 0.002
    occupied = dequantize(row.uniform_points[row.uniform_label > 0])
    for name, points, slack in (
        ("surface_points", dequantize(row.surface_points), 0.0),
        ("occupied uniform_points", occupied, 0.02),
    ):
        out = np.abs(points).max(axis=1, initial=0.0) > half + slack
        if out.any():
            yield f"{out.sum()} {name} lie outside of the box of half edge {half:.4f}"


def _cameras(row: Instance, recipe: Recipe) -> Iterator[str]:
    size = recipe.sampling.partial_resolution
    for c, (fx, fy, cx, cy) in enumerate(row.partial_intrinsics):
        points = dequantize(row.partial_points[c])
        # Depth noise may push points out of the cube; they are stored on its faces, off their ray.
        points = points[(np.abs(points) < 0.4999).all(axis=1)]
        x, y, z = apply(row.partial_T_camera_world[c], points).T
        if not (fx > 0.0 and fy > 0.0 and (z > 0.0).all()):
            yield f"camera {c} has points behind it, or no focal length"
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        slack = 1e-3 + 5e-5 * max(fx, fy) / z  # what fixed point does to a pixel
        pixel = np.stack([u, v])
        if ((pixel < -slack) | (pixel > size + slack)).any():
            yield f"camera {c} has points outside of its image of {size} x {size}"
        elif (np.abs(pixel - np.floor(pixel) - 0.5) > slack).any():
            yield f"camera {c} has points that are not on the ray of a pixel's centre"


# Shares.


def _grids_agree(row: Instance, _: Recipe) -> Iterator[Share]:
    """A query point far from the surface is in a cell whose centre is on its side of it.

    Nothing else is sure: a gap or a panel may lie between all centres of a grid, and enclosed space
    may end without a surface.
    """
    surface = dequantize(row.surface_points)
    points, label = (_some(each, 8000) for each in _queries(row))
    for resolution, grid in sorted(row.occupancy.items()):
        reach = math.hypot(0.5 * math.sqrt(3.0) / resolution, _spacing(len(surface)))
        away = _nearest(surface, points, reach) < 0
        for what, judged in (("free", label == FREE), ("occupied", is_material(label))):
            yield _share(
                what,
                f"occupancy_{resolution} agrees at {{share}} of the query points far from the "
                f"surface that are {what}",
                (_cells(grid, points[away & judged]) == FREE) == (what == "free"),
            )


def _grids_filled(row: Instance, _: Recipe) -> Iterator[Share]:
    """Voxels of a part lie where other samples are occupied, close by by the same part.

    The other way about proves nothing: a thin panel may lie between all voxels' centres.
    """
    points, label = _queries(row)
    surface = dequantize(row.surface_points)
    occupied = np.concatenate([points[label > 0], surface])
    held = is_material(label)
    solid = np.concatenate([points[held], surface])
    own = np.concatenate([label[held], row.surface_part + np.uint8(1)])
    for resolution, grid in sorted(row.occupancy.items()):
        for part in range(len(row.part_motion)):
            voxels = _some(np.flatnonzero(grid == part + 1), 400)
            centres = voxel_centres(resolution, voxels)
            yield _share(
                "filling",
                f"only {{share}} of the voxels of part {part} in occupancy_{resolution} are where "
                "the points show anything",
                _nearest(occupied, centres, _ball(len(row.uniform_points))) >= 0,
            )
            met = centres[_nearest(solid, centres, CLOSE) >= 0]
            yield _share(
                "parts",
                f"only {{share}} of the voxels of part {part} in occupancy_{resolution} are "
                "close to other samples of that part",
                _nearest(solid[own == part + 1], met, 3.0 * CLOSE) >= 0,
            )


def _covered(row: Instance, _: Recipe) -> Iterator[Share]:
    """The centre of a cell that is all inside is inside, and of one that is all free it is free.

    But for films finer than the sub-samples that pass just through the centre.
    """
    for resolution, coverage in sorted(row.coverage.items()):
        inside = row.occupancy[resolution] > 0
        for value, wanted in ((255, True), (0, False)):
            yield _share(
                "coverage",
                f"occupancy_{resolution} agrees at {{share}} of the cells of which "
                f"coverage_{resolution} is {value}",
                inside[coverage == value] == wanted,
            )


def _near(row: Instance, recipe: Recipe) -> Iterator[Share]:
    """Points near the surface are near the surface points."""
    if not len(row.surface_points):
        return
    surface, near = dequantize(row.surface_points), dequantize(_some(row.near_points))
    reach = max(0.05, _spacing(len(surface))) + 4.0 * recipe.sampling.near_sigma
    yield _share(
        "near",
        "only {share} of near_points are near surface_points",
        _nearest(surface, near, reach) >= 0,
    )


def _zero_level(row: Instance, _: Recipe) -> Iterator[Share]:
    """Just in front of a surface point is free, just behind it occupied.

    Unless another part lies in front, whose own surface no view sees: a shut laptop's.
    """
    points, label = _queries(row)
    surface = dequantize(row.surface_points)
    nearest = _nearest(surface, points, NEAR)
    points, label, nearest = points[nearest >= 0], label[nearest >= 0], nearest[nearest >= 0]
    ahead = np.einsum("ni,ni->n", points - surface[nearest], row.surface_normals[nearest] / 127.0)
    beside = np.linalg.norm(points - surface[nearest], axis=1)
    clear = (np.abs(ahead) > 0.001) & (np.abs(ahead) > 0.5 * beside)
    own = row.surface_part[nearest] + 1
    shown = (ahead < 0.0) | (label == FREE) | (label == own)
    yield _share(
        "zero level",
        "surface_points bound what is occupied at {share} of the places one can tell",
        ((label == FREE) == (ahead > 0.0))[clear & shown],
    )
    inside = clear & is_material(label) & (ahead < 0.0)  # thin walls enclose space close by
    yield _share(
        "inner part",
        "surface_part agrees with the labels just inside at {share} of the places",
        (label == own)[inside],
    )


def _partial_parts(row: Instance, recipe: Recipe) -> Iterator[Share]:
    if recipe.sampling.depth_noise > 0.003 or not len(row.surface_points):
        return
    surface, seen = dequantize(row.surface_points), dequantize(row.partial_points).reshape(-1, 3)
    nearest = _nearest(surface, seen, 0.01)
    found = nearest >= 0
    yield _share(
        "partial parts",
        "partial_part agrees with surface_part at {share} of the places",
        row.partial_part.ravel()[found] == row.surface_part[nearest[found]],
    )
    yield _share(
        "seen",
        "only {share} of partial_points are near surface_points",
        _nearest(surface, seen, max(0.05, _spacing(len(surface)))) >= 0,
    )


def _flow(row: Instance, canonical: Instance) -> Iterator[Share]:
    """`part_motion` brings each part's surface back to where the canonical pose has something."""
    if not canonical.occupancy or not len(canonical.surface_points):
        return
    surface, points = dequantize(canonical.surface_points), dequantize(row.surface_points)
    grid = canonical.occupancy[max(canonical.occupancy)]
    back = invert_rigid(row.part_motion)
    for part in range(1, len(back)):
        moved = apply(back[part], _some(points[row.surface_part == part]))
        met = _nearest(surface, moved, max(0.05, _spacing(len(surface)))) >= 0
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


def _ball(count: int) -> float:
    """The radius of a ball in which one of `count` uniform points lies, but for exp(-6)."""
    return max(0.05, (6.0 * 3.0 / (4.0 * math.pi * max(count, 1))) ** (1 / 3))


def _cells(grid: NDArray[np.uint8], points: Floats) -> NDArray[np.uint8]:
    """(n,) the label of the cell of the grid (R, R, R) that each point (n, 3) lies in."""
    size = len(grid)
    x, y, z = np.clip(((points + 0.5) * size).astype(int), 0, size - 1).T
    return grid[x, y, z]


# The instances of one object.


def _states(rows: Sequence[Instance], _: Recipe) -> Iterator[tuple[int | None, str]]:
    states = [row.state_index for row in rows]
    if len(set(states)) != len(states) or 0 not in states:
        yield None, "state_index repeats, or the canonical pose, 0, is missing"
    for row in rows:
        if row.state_index == 0:
            if row.joint_state.any():
                yield 0, "the canonical pose has joints that are not at 0"
            if np.abs(row.part_motion - np.eye(4)).max() > ROUNDING:
                yield 0, "the canonical pose has parts that moved"


def _shared(rows: Sequence[Instance], _: Recipe) -> Iterator[tuple[int | None, str]]:
    first = rows[0]
    for name in ("center", "scale", "joint_kind", "joint_parent", "joint_lower", "joint_upper"):
        for row in rows:
            if not np.array_equal(getattr(row, name), getattr(first, name)):
                yield row.state_index, f"{name} differs from the object's other instances"
    fixed = first.joint_parent == 0
    for row in rows:
        for name in ("joint_axis", "joint_pivot"):
            if not np.allclose(getattr(row, name)[fixed], getattr(first, name)[fixed], atol=1e-9):
                yield row.state_index, f"{name} of a joint on the fixed part moves"


def _fills_box(rows: Sequence[Instance], recipe: Recipe) -> Iterator[tuple[int | None, str]]:
    points = dequantize(np.concatenate([row.surface_points for row in rows]))
    if len(points) < 1000:
        return
    extent = np.ptp(points, axis=0).max()
    if extent < LEAST_EXTENT * (1.0 - recipe.padding):
        yield None, f"all instances together extend over {extent:.3f}, not {1 - recipe.padding:.3f}"


def _fixed_part(rows: Sequence[Instance], _: Recipe) -> Iterator[tuple[int | None, str]]:
    """Where part 0 has material in one pose it has in all, or a moving part's lies in it."""
    for resolution, first in rows[0].occupancy.items():
        held = first == 1
        for row in rows[1:]:
            grid = row.occupancy.get(resolution, first)
            gone = (held & ~is_material(grid)) | ((grid == 1) & ~is_material(first))
            if gone.any():
                yield (
                    row.state_index,
                    f"{gone.sum()} voxels of occupancy_{resolution} are material of part 0, which "
                    f"never moves, in this pose or in that of instance {rows[0].state_index} alone",
                )


InstanceCheck = Callable[[Instance, Recipe], Iterator[str]]
ShareCheck = Callable[[Instance, Recipe], Iterator[Share]]
ObjectCheck = Callable[[Sequence[Instance], Recipe], Iterator[tuple[int | None, str]]]

VALUE_CHECKS: dict[str, InstanceCheck] = {
    "numbers": _numbers,
    "counts": _counts,
    "labels": _labels,
}
GEOMETRY_CHECKS: dict[str, InstanceCheck] = {
    "normals": _normals,
    "joint range": _joint_range,
    "rigid": _rigid,
    "motion": _motion,
    "box": _inside_box,
    "cameras": _cameras,
}
SHARE_CHECKS: dict[str, ShareCheck] = {
    "grids": _grids_agree,
    "filling": _grids_filled,
    "coverage": _covered,
    "near": _near,
    "zero level": _zero_level,
    "partial parts": _partial_parts,
}
OBJECT_CHECKS: dict[str, ObjectCheck] = {
    "states": _states,
    "shared": _shared,
    "fills box": _fills_box,
    "fixed part": _fixed_part,
}


def _queries(row: Instance) -> tuple[Floats, NDArray[np.uint8]]:
    """All query points (n, 3) in the unit frame and their labels."""
    points = np.concatenate([row.uniform_points, row.near_points])
    return dequantize(points), np.concatenate([row.uniform_label, row.near_label])


def _some(rows: NDArray[Any], most: int = 1000) -> NDArray[Any]:
    """At most so many of the rows, spread evenly: enough for a share."""
    return rows[:: len(rows) // most + 1]


@numba.njit(cache=True, nogil=True)
def _about(grid, points):  # pragma: no cover - compiled
    """(n, 8) the labels of the 8 voxels whose centres surround each point (n, 3)."""
    size = len(grid)
    labels = np.empty((len(points), 8), np.uint8)
    for n in range(len(points)):
        x, y, z = [int(np.floor((p + 0.5) * size - 0.5)) for p in points[n]]
        for corner in range(8):
            i = min(max(x + (corner & 1), 0), size - 1)
            j = min(max(y + (corner >> 1 & 1), 0), size - 1)
            k = min(max(z + (corner >> 2), 0), size - 1)
            labels[n, corner] = grid[i, j, k]
    return labels


@numba.njit(cache=True, nogil=True)
def _nearest(points, queries, radius):  # pragma: no cover - compiled
    """(n,) the index of the point nearest to each query (n, 3) within `radius`, or -1.

    Points are sorted into cells no smaller than `radius`, so that 27 of them are searched.
    """
    cells = max(1, min(64, int(1.0 / radius)))
    head = np.full((cells, cells, cells), -1, np.int32)
    following = np.empty(len(points), np.int32)
    for i in range(len(points)):
        x, y, z = [min(max(int((p + 0.5) * cells), 0), cells - 1) for p in points[i]]
        following[i] = head[x, y, z]
        head[x, y, z] = i
    found = np.full(len(queries), -1, np.int64)
    for k in range(len(queries)):
        best = radius * radius
        a, b, c = [min(max(int((q + 0.5) * cells), 0), cells - 1) for q in queries[k]]
        for x in range(max(a - 1, 0), min(a + 2, cells)):
            for y in range(max(b - 1, 0), min(b + 2, cells)):
                for z in range(max(c - 1, 0), min(c + 2, cells)):
                    i = head[x, y, z]
                    while i >= 0:
                        d = 0.0
                        for axis in range(3):
                            d += (points[i, axis] - queries[k, axis]) ** 2
                        if d <= best:
                            best = d
                            found[k] = i
                        i = following[i]
    return found
