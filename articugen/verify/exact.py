"""What is exact within one object's instances, and has to be right to its last digits."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from articugen.core.geometry import apply, bounds, joint_motion
from articugen.core.near import by_cell, nearest_within
from articugen.core.recipe import Recipe
from articugen.core.records import (
    ENCLOSED,
    STORED_KINDS,
    Floats,
    JointKind,
    Views,
    dequantize,
    is_material,
)
from articugen.core.schema import Instance
from articugen.verify.bounds import (
    FEWEST_FOR_EXTENT,
    FIXED_POINT,
    INSIDE_CUBE,
    LEAST_EXTENT,
    TOLERANCES,
)

_LOOKED_AT, _SPECKS = 500, 0.004
"""Query points whose distance is compared with that to each surface point, and the share of them
that may be farther: of soups, views err in specks of the surface. Of 240 sound clouds of messy,
rough and varied objects none has more than 0.0004, most and real ones 0."""

# Values.


def _numbers(row: Instance, _: Recipe) -> Iterator[str]:
    limits = ("joint_lower", "joint_upper")
    for name, array in row.arrays().items():
        if name in limits or isinstance(array, str | tuple):  # names are no numbers
            continue
        if np.issubdtype(np.asarray(array).dtype, np.inexact) and not np.isfinite(array).all():
            yield f"{name} has numbers that are not finite"
    if not (row.joint_lower <= row.joint_upper).all():  # as where one is not a number
        yield "joint_lower and joint_upper are not ranges"
    if not row.scale > 0.0:
        yield f"scale is {row.scale}"
    if not np.isin(row.joint_kind, STORED_KINDS).all():
        yield f"joint_kind is none of {', '.join(f'{k:d} {k}' for k in STORED_KINDS)}"
    parts = np.arange(1, len(row.joint_kind) + 1)
    if (row.joint_parent > len(parts)).any() or (row.joint_parent == parts).any():
        yield "joint_parent names a part that is not there, or the joint's own"


def _counts(row: Instance, recipe: Recipe) -> Iterator[str]:
    """Check that every field that the recipe asks for is there, in its numbers, and no other."""
    have = {name: np.shape(value) for name, value in row.arrays().items()}
    fields, shapes = recipe.fields(), recipe.instance_shapes()
    for name in sorted(have.keys() - shapes.keys()):
        yield f"{name} is there, which the recipe does not ask for"
    for name, wanted in shapes.items():
        if name not in have and fields[name].asked_by:  # older shards lack names
            yield f"{name} is missing, which the recipe asks for"
        shape = have.get(name, wanted)
        if any(n not in (None, size) for n, size in zip(wanted, shape, strict=True)):
            numbers = ", ".join(map(str, wanted)).replace("None", "any")
            yield f"{name} has shape {shape} where the recipe asks for ({numbers})"


def _labels(row: Instance, recipe: Recipe) -> Iterator[str]:
    parts = len(row.part_motion)
    enclosed = recipe.fusion.rule != "rigid"
    labels = {"uniform_label": row.uniform_label, "near_label": row.near_label}
    labels |= {f"occupancy_{r}": grid for r, grid in row.occupancy.items()}
    for name, label in labels.items():
        known = label[label != ENCLOSED] if enclosed else label
        if known.size and known.max() > parts:
            yield f"{name} has label {known.max()} of {parts} parts"
    for name in ("surface_part", "sharp_part", "partial_part"):
        part = getattr(row, name)
        if part is not None and part.size and part.max() >= parts:
            yield f"{name} has part {part.max()} of {parts} parts"


def _normals(row: Instance, _: Recipe) -> Iterator[str]:
    for stem, normals in (("surface", row.surface_normals), ("sharp", row.sharp_normals)):
        length = np.ones(0) if normals is None else np.linalg.norm(normals / 127.0, axis=1)
        off = TOLERANCES["normal"].exceeded_by(np.abs(length - 1.0))
        if off.any():
            yield f"{off.sum()} {stem} normals are not of unit length ({length[off][0]:.3f})"


def _joint_range(row: Instance, _: Recipe) -> Iterator[str]:
    if row.state_index == 0:  # the canonical pose may lie outside of what is sampled
        return
    beyond = np.maximum(row.joint_lower - row.joint_state, row.joint_state - row.joint_upper)
    for j in np.flatnonzero(TOLERANCES["range"].exceeded_by(beyond)):
        yield (
            f"joint {j} is at {row.joint_state[j]:.6g}, outside of its range "
            f"{row.joint_lower[j]:.6g} to {row.joint_upper[j]:.6g}"
        )


# Geometry.


def _rigid(row: Instance, _: Recipe) -> Iterator[str]:
    for name in ("part_motion", "partial_T_camera_world", "image_T_camera_world"):
        T = getattr(row, name)
        if T is None:
            continue
        R = T[:, :3, :3]
        skew = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        bad = TOLERANCES["unit"].exceeded_by(skew)
        bad |= (np.linalg.det(R) < 0.0) | (T[:, 3] != (0, 0, 0, 1)).any(axis=1)
        if bad.any():
            yield f"{name}[{np.argmax(bad)}] is not a rigid motion"


def _motion(row: Instance, _: Recipe) -> Iterator[str]:
    if _moved(row.part_motion[0]):
        yield "part_motion[0] is not the identity: the fixed part moves"
    for j, axis in enumerate(row.joint_axis):
        if TOLERANCES["unit"].exceeded_by(abs(np.linalg.norm(axis) - 1.0)):
            yield f"joint_axis[{j}] is not of unit length"
            continue
        turns = row.joint_kind[j] != JointKind.PRISMATIC
        motion = joint_motion(turns, axis, row.joint_state[j], row.joint_pivot[j])
        expected = motion @ row.part_motion[row.joint_parent[j]]
        error = np.abs(expected - row.part_motion[j + 1]).max()
        if TOLERANCES["motion"].exceeded_by(error):
            yield f"part_motion[{j + 1}] differs by {error:.2g} from what its joint does"


def _moved(part_motion: Floats) -> bool:
    """Return whether any of the (..., 4, 4) motions is one."""
    return bool(TOLERANCES["unit"].exceeded_by(np.abs(part_motion - np.eye(4)).max()))


def _inside_box(row: Instance, recipe: Recipe) -> Iterator[str]:
    half = 0.5 * (1.0 - recipe.padding) + recipe.fusion.sheet_thickness
    occupied = dequantize(row.uniform_points[row.uniform_label > 0])
    for name, points, tolerance in (
        ("surface_points", dequantize(row.surface_points), "box"),
        ("occupied uniform_points", occupied, "occupied box"),
    ):
        beyond = np.maximum.reduce([np.abs(column) for column in points.T]) - half
        out = TOLERANCES[tolerance].exceeded_by(beyond)
        if out.any():
            yield f"{out.sum()} {name} lie outside of the box of half edge {half:.4f}"


def _cameras(row: Instance, recipe: Recipe) -> Iterator[str]:
    size = recipe.sampling.partial_resolution
    for c, (fx, fy, cx, cy) in enumerate(row.partial_intrinsics):
        points = dequantize(row.partial_points[c])
        points = points[(np.abs(points) < INSIDE_CUBE).all(axis=1)]
        x, y, z = apply(row.partial_T_camera_world[c], points).T
        if not (fx > 0.0 and fy > 0.0 and (z > 0.0).all()):
            yield f"camera {c} has points behind it, or no focal length"
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        pixel, rounding = np.stack([u, v]), FIXED_POINT * max(fx, fy) / z
        outside = np.maximum(-pixel, pixel - size) - rounding
        off_centre = np.abs(pixel - np.floor(pixel) - 0.5) - rounding
        if TOLERANCES["pixel"].exceeded_by(outside).any():
            yield f"camera {c} has points outside of its image of {size} x {size}"
        elif TOLERANCES["pixel"].exceeded_by(off_centre).any():
            yield f"camera {c} has points that are not on the ray of a pixel's centre"


# What only some recipes ask for.


def _distances(row: Instance, recipe: Recipe) -> Iterator[str]:
    """They have the sign of their labels, and no surface point is nearer than they say."""
    surface = dequantize(row.surface_points)
    for stem in ("uniform", "near"):
        far, label = getattr(row, f"{stem}_distance"), getattr(row, f"{stem}_label")
        if far is None:
            continue
        if ((far < 0.0) & ~is_material(label) | (far > 0.0) & is_material(label)).any():
            yield f"{stem}_distance has another sign than the labels say"
        if np.abs(far).max(initial=0.0) > recipe.sampling.signed_distance * (1.0 + 1e-6):
            yield f"{stem}_distance goes beyond the recipe's signed_distance"
        step = max(1, len(far) // _LOOKED_AT)
        points = dequantize(getattr(row, f"{stem}_points")[::step])
        nearest = nearest_within(by_cell(surface), points, recipe.sampling.signed_distance)
        there = np.flatnonzero(nearest >= 0)
        reach = np.linalg.norm(surface[nearest[there]] - points[there], axis=1)
        beyond = TOLERANCES["distance"].exceeded_by(np.abs(far[::step][there]) - reach)
        if beyond.sum() > _SPECKS * len(points):
            yield f"{stem}_distance is greater than that to a surface point"


def _images(row: Instance, recipe: Recipe) -> Iterator[str]:
    """They show the same silhouette, of parts that are there, inside the box that holds all."""
    shown = {}
    if row.image_depth is not None:
        shown["depth"] = row.image_depth != 0.0
    if row.image_part is not None:
        shown["part"] = row.image_part != 0
        if row.image_part.max(initial=0) > len(row.part_motion):
            yield f"image_part has part {row.image_part.max() - 1} of {len(row.part_motion)} parts"
    if row.image_normal is not None:
        shown["normal"] = row.image_normal.any(axis=3)
    if row.image_rgba is not None:
        shown["rgba"] = row.image_rgba[..., 3] != 0
    for name, silhouette in list(shown.items())[1:]:
        first = next(iter(shown))
        if not np.array_equal(silhouette, shown[first]):
            yield f"image_{name} and image_{first} show something at different pixels"
    if row.image_depth is None:
        return
    assert row.image_intrinsics is not None
    assert row.image_T_camera_world is not None
    sizes = row.image_depth.shape[2:0:-1]
    cameras = Views("pinhole", row.image_T_camera_world, *row.image_intrinsics.T, *sizes)
    half = 0.5 * (1.0 - recipe.padding) + recipe.fusion.sheet_thickness
    for view, depth in enumerate(row.image_depth):
        i, j = np.nonzero(depth)
        beyond = np.abs(cameras.points(view, i, j, depth[i, j].astype(np.float64))) - half
        if TOLERANCES["image"].exceeded_by(beyond).any():
            yield f"image_depth of camera {view} shows points outside of the object's box"


# The instances of one object.


def _states(rows: Sequence[Instance], _: Recipe) -> Iterator[tuple[int | None, str]]:
    states = [row.state_index for row in rows]
    if len(set(states)) != len(states) or 0 not in states:
        yield None, "state_index repeats, or the canonical pose, 0, is missing"
    for row in rows:
        if row.state_index == 0:
            if row.joint_state.any():
                yield 0, "the canonical pose has joints that are not at 0"
            if _moved(row.part_motion):
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
            off = np.abs(getattr(row, name)[fixed] - getattr(first, name)[fixed])
            if TOLERANCES["fixed joint"].exceeded_by(off).any():
                yield row.state_index, f"{name} of a joint on the fixed part moves"


def _fills_box(rows: Sequence[Instance], recipe: Recipe) -> Iterator[tuple[int | None, str]]:
    points = dequantize(np.concatenate([row.surface_points for row in rows]))
    if len(points) < FEWEST_FOR_EXTENT:
        return
    low, high = bounds(points)
    extent = (high - low).max()
    if extent < LEAST_EXTENT * (1.0 - recipe.padding):
        yield None, f"all instances together extend over {extent:.3f}, not {1 - recipe.padding:.3f}"


def _fixed_part(rows: Sequence[Instance], _: Recipe) -> Iterator[tuple[int | None, str]]:
    """Check that where part 0 has material in one pose it has in all, or a moving part's lies in
    it."""
    for resolution, first in rows[0].occupancy.items():
        inside = first == 1
        for row in rows[1:]:
            grid = row.occupancy.get(resolution, first)
            gone = (inside & ~is_material(grid)) | ((grid == 1) & ~is_material(first))
            if gone.any():
                yield (
                    row.state_index,
                    f"{gone.sum()} voxels of occupancy_{resolution} are material of part 0, which "
                    f"never moves, in this pose or in that of instance {rows[0].state_index} alone",
                )


InstanceCheck = Callable[[Instance, Recipe], Iterator[str]]
ObjectCheck = Callable[[Sequence[Instance], Recipe], Iterator[tuple[int | None, str]]]

VALUE_CHECKS: dict[str, InstanceCheck] = {"numbers": _numbers, "counts": _counts, "labels": _labels}
GEOMETRY_CHECKS: dict[str, InstanceCheck] = {
    "normals": _normals,
    "joint range": _joint_range,
    "rigid": _rigid,
    "motion": _motion,
    "box": _inside_box,
    "cameras": _cameras,
    "distances": _distances,
    "images": _images,
}
OBJECT_CHECKS: dict[str, ObjectCheck] = {
    "states": _states,
    "shared": _shared,
    "fills box": _fills_box,
    "fixed part": _fixed_part,
}
