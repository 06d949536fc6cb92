"""What must hold within one object's instances, judged from the stored numbers alone.

Bounds on exact things are tight. Bounds on sampled things are fractions that a sound object, thin
sheets and narrow gaps included, keeps by a wide margin, and that a real fault (swapped instances,
mirrored grids, inverted motions, a surface beside the field's zero level) does not.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from articugen.geometry import apply, invert_rigid, rotation_about, transform
from articugen.recipe import Recipe
from articugen.records import ENCLOSED, Floats, Instance, dequantize, is_material

ROUNDING = 1e-9
"""What rounding may do to rigid motions and unit vectors in float64."""

NEAR = 0.004
"""A query point so close to a surface point is judged by that point's tangent plane."""


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong; `state_index` is None where it concerns the whole object."""

    state_index: int | None
    check: str
    sentence: str


def faults(rows: Sequence[Instance], recipe: Recipe) -> Iterator[Fault]:
    """Everything wrong with `rows`, all instances of one object made by `recipe`."""
    for row in rows:
        wrong = list(_of(row, recipe, VALUE_CHECKS))
        # Geometry computed from senseless values would only repeat, or hide, what is wrong.
        yield from wrong or _of(row, recipe, GEOMETRY_CHECKS)
    for check, judge in OBJECT_CHECKS.items():
        yield from (Fault(state, check, sentence) for state, sentence in judge(rows, recipe))


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
    if not np.isin(row.joint_kind, (1, 2)).all():
        yield "joint_kind is neither 1 nor 2"
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
    if row.joint_kind[j] == 2:
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


def _grids_agree(row: Instance, _: Recipe) -> Iterator[str]:
    """Where the 8 finest voxels about a point agree, its own label is mostly theirs."""
    *coarser, finest = sorted(row.occupancy) or [0]
    if finest == 0:
        return
    labelled = {f"occupancy_{r}": (_centres(r), row.occupancy[r].ravel()) for r in coarser}
    labelled["uniform_label"] = dequantize(row.uniform_points), row.uniform_label
    for name, (points, label) in labelled.items():
        about = _about(row.occupancy[finest], points)
        clear = (about == about[:, :1]).all(axis=1)
        for wanted in (*range(len(row.part_motion) + 1), ENCLOSED):
            judged = label[clear & (about[:, 0] == wanted)]
            if len(judged) >= 20 and (share := (judged == wanted).mean()) < 0.6:
                yield (
                    f"{name} agrees with occupancy_{finest} at {share:.0%} of the places that are "
                    f"clearly of label {wanted}"
                )


def _grids_filled(row: Instance, _: Recipe) -> Iterator[str]:
    """Voxels of a part lie where other samples are occupied, and are about as many.

    The other way about proves nothing: a thin panel may lie between all voxels' centres.
    """
    if len(row.uniform_points) < 4000:  # too sparse to reach every place deep inside
        return
    points, label = _queries(row)
    occupied = np.concatenate([points[label > 0], dequantize(row.surface_points)])
    for resolution, grid in sorted(row.occupancy.items()):
        for part in range(len(row.part_motion)):
            voxels = np.argwhere(grid == part + 1)
            if len(voxels) < 20:
                continue
            centres = (_some(voxels) + 0.5) / resolution - 0.5
            if (share := (_nearest(occupied, centres, 0.05) >= 0).mean()) < 0.8:
                yield (
                    f"only {share:.0%} of the voxels of part {part} in occupancy_{resolution} are "
                    "where the points show anything"
                )
        share, expected = (grid > 0).mean(), (row.uniform_label > 0).mean()
        # the plates of a shut laptop, 3 % of the cube, can miss every centre of a coarse grid
        least = 0.1 * expected if resolution == max(row.occupancy) else 0.0
        if expected >= 0.02 and not least <= share <= 0.1 + 3.0 * expected:
            yield f"occupancy_{resolution} is {share:.0%} full, uniform_label {expected:.0%}"


def _covered(row: Instance, _: Recipe) -> Iterator[str]:
    """The centre of a cell that is all inside is inside, and of one that is all free it is free.

    But for films finer than the sub-samples that pass just through the centre.
    """
    for resolution, coverage in sorted(row.coverage.items()):
        inside = row.occupancy[resolution] > 0
        for value, wanted in ((255, True), (0, False)):
            judged = inside[coverage == value]
            if len(judged) >= 20 and (share := (judged == wanted).mean()) < 0.9:
                yield (
                    f"occupancy_{resolution} agrees at {share:.0%} of the cells of which "
                    f"coverage_{resolution} is {value}"
                )


def _near(row: Instance, recipe: Recipe) -> Iterator[str]:
    """Points near the surface are near the surface points."""
    if len(row.surface_points) < 1000 or not len(row.near_points):
        return
    reach = 0.05 + 4.0 * recipe.sampling.near_sigma
    near = dequantize(_some(row.near_points))
    met = _nearest(dequantize(row.surface_points), near, reach) >= 0
    if met.mean() < 0.9:
        yield f"only {met.mean():.0%} of near_points are near surface_points"


def _zero_level(row: Instance, _: Recipe) -> Iterator[str]:
    """Just in front of a surface point is free, just behind it occupied."""
    points, label = _queries(row)
    surface = dequantize(row.surface_points)
    nearest = _nearest(surface, points, NEAR)
    points, label, nearest = points[nearest >= 0], label[nearest >= 0], nearest[nearest >= 0]
    ahead = np.einsum("ni,ni->n", points - surface[nearest], row.surface_normals[nearest] / 127.0)
    beside = np.linalg.norm(points - surface[nearest], axis=1)
    clear = (np.abs(ahead) > 0.001) & (np.abs(ahead) > 0.5 * beside)
    if clear.sum() >= 30 and (share := ((label == 0) == (ahead > 0.0))[clear].mean()) < 0.75:
        yield f"surface_points bound what is occupied at {share:.0%} of the places one can tell"
    inside = clear & is_material(label) & (ahead < 0.0)  # thin walls enclose space close by
    same = label == row.surface_part[nearest] + 1
    if inside.sum() >= 20 and (share := same[inside].mean()) < 0.6:
        yield f"surface_part agrees with the labels just inside at {share:.0%} of the places"


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


def _partial_parts(row: Instance, recipe: Recipe) -> Iterator[str]:
    if recipe.sampling.depth_noise > 0.003:
        return
    nearest = _nearest(
        dequantize(row.surface_points), dequantize(row.partial_points).reshape(-1, 3), 0.01
    )
    found = nearest >= 0
    same = row.partial_part.ravel()[found] == row.surface_part[nearest[found]]
    if found.sum() >= 30 and (share := same.mean()) < 0.6:
        yield f"partial_part agrees with surface_part at {share:.0%} of the places"
    if row.surface_points.shape[0] >= 1000 and found.size >= 100 and found.mean() < 0.02:
        yield "partial_points are nowhere near surface_points"


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
    if extent < 0.75 * (1.0 - recipe.padding):
        yield None, f"all instances together extend over {extent:.3f}, not {1 - recipe.padding:.3f}"


def _flow(rows: Sequence[Instance], _: Recipe) -> Iterator[tuple[int | None, str]]:
    """`part_motion` brings each part's surface back to where the canonical pose has something."""
    canonical = next((row for row in rows if row.state_index == 0), None)
    if canonical is None or len(canonical.surface_points) < 1000 or not canonical.occupancy:
        return
    surface = dequantize(canonical.surface_points)
    grid = canonical.occupancy[max(canonical.occupancy)]
    for row in rows:
        points = dequantize(row.surface_points)
        back = invert_rigid(row.part_motion)
        for part in range(1, len(back)):
            moved = apply(back[part], _some(points[row.surface_part == part]))
            met = _nearest(surface, moved, 0.05) >= 0
            met[~met] = (_about(grid, moved[~met]) > 0).any(axis=1)
            if len(met) >= 50 and met.mean() < 0.8:
                yield (
                    row.state_index,
                    f"part_motion[{part}] brings {met.mean():.0%} of the part's surface back to "
                    "the canonical pose",
                )


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
    "grids": _grids_agree,
    "filling": _grids_filled,
    "coverage": _covered,
    "near": _near,
    "zero level": _zero_level,
    "cameras": _cameras,
    "partial parts": _partial_parts,
}
OBJECT_CHECKS: dict[str, ObjectCheck] = {
    "states": _states,
    "shared": _shared,
    "fills box": _fills_box,
    "flow": _flow,
    "fixed part": _fixed_part,
}


def _queries(row: Instance) -> tuple[Floats, NDArray[np.uint8]]:
    """All query points (n, 3) in the unit frame and their labels."""
    points = np.concatenate([row.uniform_points, row.near_points])
    return dequantize(points), np.concatenate([row.uniform_label, row.near_label])


def _some(rows: NDArray[Any]) -> NDArray[Any]:
    """At most 200 of the rows, spread evenly: enough for a share."""
    return rows[:: len(rows) // 200 + 1]


@cache
def _centres(resolution: int) -> Floats:
    """Voxel centres (R^3, 3), x slowest."""
    at = (np.arange(resolution) + 0.5) / resolution - 0.5
    return np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)


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
