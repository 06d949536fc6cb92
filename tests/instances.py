"""Small valid instances in closed form, for tests that need shards but no stage of the pipeline.

The object is a box with a lid on a hinge and a knob that slides on the lid: three parts, a revolute
joint, and a prismatic joint that hangs on the revolute one. Every label is exact.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import (
    apply,
    fibonacci_sphere,
    invert_rigid,
    look_along,
    rotation_about,
    transform,
    voxel_centres,
)
from articugen.core.recipe import Articulation, Recipe, Sampling
from articugen.core.records import Floats, Normalization, quantize
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.evaluation.reconstruction import Reconstruction, truth

LOWER = np.array([[0.0, -0.3, 0.0], [0.0, -0.3, 0.085], [0.1, -0.06, 0.145]])
UPPER = np.array([[0.6, 0.3, 0.08], [0.6, 0.3, 0.145], [0.2, 0.06, 0.2]])
"""(P, 3) corners of the three boxes in the canonical pose, metres: base, lid, knob."""

HINGE, HINGE_AXIS = np.array([0.0, 0.0, 0.085]), np.array([0.0, -1.0, 0.0])
SLIDE_FROM, SLIDE_AXIS = np.array([0.15, 0.0, 0.145]), np.array([1.0, 0.0, 0.0])
LIMITS = np.array([[0.0, np.radians(100.0)], [0.0, 0.3]])

SMALL = Recipe(
    name="small",
    articulation=Articulation(states=3, revolute_degrees=(0, 100)),
    sampling=Sampling(
        grids=(8, 16, 32),
        surface_points=2048,
        uniform_points=1024,
        near_points=2048,
        partial_views=2,
        partial_points=256,
        partial_resolution=64,
    ),
)

_MANY = {"grids": (16, 32, 64), "surface_points": 8192, "uniform_points": 8192, "near_points": 8192}
RICH = SMALL.model_copy(update={"sampling": SMALL.sampling.model_copy(update=_MANY)})


@dataclass(frozen=True)
class _Boxes:
    """The posed boxes in the unit frame; `lower` and `upper` are canonical."""

    lower: Floats
    upper: Floats
    motion: Floats

    def label(self, points: Floats) -> NDArray[np.uint8]:
        label = np.zeros(points.shape[:-1], np.uint8)
        for part, T in enumerate(invert_rigid(self.motion)):
            at = apply(T, points)
            label[((at > self.lower[part]) & (at < self.upper[part])).all(axis=-1)] = part + 1
        return label

    def surface(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Floats, Floats, NDArray[np.uint8]]:
        """(points, outward normals, parts): uniform by area, none inside another box."""
        size = self.upper - self.lower
        area = np.stack([size[:, (k + 1) % 3] * size[:, (k + 2) % 3] for k in range(3)], axis=1)
        weight = np.repeat(area, 2, axis=1).ravel()
        face = rng.choice(len(weight), 3 * count, p=weight / weight.sum())
        part, axis, side = face // 6, face % 6 // 2, face % 2
        points = self.lower[part] + rng.random((len(face), 3)) * size[part]
        each = np.arange(len(face))
        points[each, axis] = np.where(side, self.upper[part, axis], self.lower[part, axis])
        normals = np.zeros_like(points)
        normals[each, axis] = 2.0 * side - 1.0
        T = self.motion[part]
        points = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
        normals = np.einsum("nij,nj->ni", T[:, :3, :3], normals)
        kept = np.flatnonzero(self.label(points + 1e-6 * normals) == 0)[:count]
        return points[kept], normals[kept], part[kept].astype(np.uint8)

    def hits(self, eye: Floats, rays: Floats) -> tuple[Floats, NDArray[np.uint8]]:
        """(distance along each ray or inf, part): the slab test."""
        distance = np.full(len(rays), np.inf)
        seen = np.zeros(len(rays), np.uint8)
        for part, T in enumerate(invert_rigid(self.motion)):
            with np.errstate(divide="ignore"):
                pace = 1.0 / (rays @ T[:3, :3].T)
            ends = (np.stack([self.lower[part], self.upper[part]]) - apply(T, eye))[:, None] * pace
            enters, leaves = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
            nearer = (enters < leaves) & (enters < distance)
            distance[nearer], seen[nearer] = enters[nearer], part
        return distance, seen


def hinged_box(
    states: Sequence[tuple[float, float]] = ((0.0, 0.0), (0.5, 0.1), (1.2, 0.25), (1.7, 0.02)),
    *,
    object_id: str = "box-0",
    recipe: Recipe = SMALL,
    seed: int = 0,
) -> tuple[Instance, ...]:
    """One instance for each (hinge angle in rad, slide in metres); the first is canonical."""
    motions = np.stack([part_motions(*state) for state in states])
    corners = np.stack(
        [apply(T, box) for motion in motions for T, box in zip(motion, _corners(), strict=True)]
    )
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    unit = Normalization((low + high) / 2, float((high - low).max()) / (1.0 - recipe.padding))
    return tuple(
        _instance(object_id, index, np.array(state), unit, recipe, seed)
        for index, state in enumerate(states)
    )


def part_motions(angle: float, slide: float) -> Floats:
    """(P, 4, 4) of base, lid and knob from the canonical pose, world frame, metres."""
    turn = rotation_about(HINGE_AXIS, angle)
    lid = transform(turn, HINGE - turn @ HINGE)
    return np.stack([np.eye(4), lid, lid @ transform(translation=slide * SLIDE_AXIS)])


def _corners() -> Floats:
    pick = np.array([[(i >> k) & 1 for k in range(3)] for i in range(8)])
    return np.where(pick[None] == 1, UPPER[:, None], LOWER[:, None])


def _instance(
    object_id: str, index: int, state: Floats, unit: Normalization, recipe: Recipe, seed: int
) -> Instance:
    rng = generator(seed, object_id, index)
    ask = recipe.sampling
    motion = unit.rigid_to_unit(part_motions(*state))
    boxes = _Boxes(unit.to_unit(LOWER), unit.to_unit(UPPER), motion)
    points, normals, part = boxes.surface(ask.surface_points, rng)
    uniform = quantize(rng.random((ask.uniform_points, 3)) - 0.5)
    near = quantize(points[: ask.near_points] + rng.normal(0.0, ask.near_sigma, (len(points), 3)))
    views = [_partial(boxes, d, recipe, rng) for d in fibonacci_sphere(ask.partial_views)]
    to_unit_length = np.array([1.0, 1.0 / unit.scale])
    return Instance(
        object_id=object_id,
        state_index=index,
        center=unit.center,
        scale=unit.scale,
        joint_kind=np.array([1, 2], np.uint8),
        joint_parent=np.array([0, 1], np.uint8),
        joint_state=state * to_unit_length,
        joint_lower=LIMITS[:, 0] * to_unit_length,
        joint_upper=LIMITS[:, 1] * to_unit_length,
        joint_axis=np.stack([HINGE_AXIS, motion[1, :3, :3] @ SLIDE_AXIS]),
        joint_pivot=np.stack([unit.to_unit(HINGE), apply(motion[1], unit.to_unit(SLIDE_FROM))]),
        part_motion=motion,
        occupancy={r: boxes.label(voxel_centres(r)).reshape(r, r, r) for r in ask.grids},
        surface_points=quantize(points),
        surface_normals=np.round(127.0 * normals).astype(np.int8),
        surface_part=part,
        uniform_points=uniform,
        uniform_label=boxes.label(uniform / 65535.0 - 0.5),
        near_points=near,
        near_label=boxes.label(near / 65535.0 - 0.5),
        partial_points=quantize(np.stack([view[0] for view in views])),
        partial_part=np.stack([view[1] for view in views]),
        partial_T_camera_world=np.stack([view[2] for view in views]),
        partial_intrinsics=np.tile(_intrinsics(ask.partial_resolution), (len(views), 1)),
    )


def _intrinsics(size: int) -> Floats:
    return np.array([1.5 * size, 1.5 * size, size / 2, size / 2])


def _partial(
    boxes: _Boxes, direction: Floats, recipe: Recipe, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.uint8], Floats]:
    """(points, parts, T_camera_world): some of the pixels whose centres see something."""
    size = recipe.sampling.partial_resolution
    fx, fy, cx, cy = _intrinsics(size)
    eye = 2.5 * direction
    T_camera_world = look_along(-direction, eye)
    v, u = np.divmod(np.arange(size * size), size) + np.array([[0.5], [0.5]])
    in_camera = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=1)
    rays = in_camera @ T_camera_world[:3, :3]
    depth, part = boxes.hits(eye, rays)
    seen = np.flatnonzero(np.isfinite(depth))
    chosen = rng.choice(seen, recipe.sampling.partial_points)
    return eye + depth[chosen, None] * rays[chosen], part[chosen], T_camera_world


def changed(row: Instance, **fields: Any) -> Instance:
    """The row with other fields."""
    return replace(row, **fields)


def without_knob(row: Instance, **fields: Any) -> Instance:
    """Make the knob of a box a piece of its lid: one joint, two parts; with other fields."""
    names = ("kind", "parent", "state", "lower", "upper", "axis", "pivot")
    most = {"surface_part": 1, "partial_part": 1, "uniform_label": 2, "near_label": 2}
    return changed(
        row,
        part_motion=row.part_motion[:2],
        occupancy={r: np.minimum(grid, 2) for r, grid in row.occupancy.items()},
        **{f"joint_{name}": getattr(row, f"joint_{name}")[:1] for name in names},
        **{name: np.minimum(getattr(row, name), number) for name, number in most.items()},
        **fields,
    )


def assert_same(one: Instance, other: Instance, *fields: str) -> None:
    """Assert that two instances have the same fields of the same type and, at least in the named
    fields, the same values."""
    left, right = one.arrays(), other.arrays()
    assert left.keys() == right.keys()
    for name in fields or left:
        assert np.asarray(left[name]).dtype == np.asarray(right[name]).dtype, name
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)


def edited(
    row: Instance, name: str, edit: Callable[[NDArray[Any]], NDArray[Any] | None]
) -> Instance:
    """The row with one field edited, in place or by what `edit` returns."""
    array = np.array(getattr(row, name))
    result = edit(array)
    return changed(row, **{name: array if result is None else result})


def put(index: Any, value: Any) -> Callable[[NDArray[Any]], None]:
    """What `edited` does to set some of a field's numbers."""
    return lambda array: array.__setitem__(index, value)


def nothing(instance: Instance) -> Reconstruction:
    """Return the true joints and motions without a surface anywhere."""
    found, empty = truth(instance, min(instance.occupancy)), np.zeros((0, 3, 3))
    nowhere = np.zeros_like(found.occupied)
    return replace(found, triangles=empty, part=np.zeros(0, int), whole=empty, occupied=nowhere)
