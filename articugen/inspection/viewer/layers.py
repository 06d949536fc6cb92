"""What can be seen of an instance, as plain arrays: points, lines and surfaces, unit frame.

Colours are those of the report: `colour_of` a part.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bytes, Floats
from articugen.core.colours import PALETTE, colour_of, rgb
from articugen.core.geometry import apply, invert_rigid
from articugen.core.records import FREE, JointKind, Mesh, dequantize
from articugen.core.schema import Instance
from articugen.pictures.portrait import oriented_points

INK, FREE_COLOUR, ENCLOSED_COLOUR = "#333333", "#7fb4e6", "#5f5f5f"

NORMAL_LENGTH, NORMALS = 0.02, 2048  # unit frame; how many of an instance's points get one
AXIS_REACH, ARROW = 0.32, 0.03
"""From the pivot to either end of an axis, and the length of its head, unit frame."""

FRUSTUM = 0.2  # from a camera's eye to the picture that is drawn before it, unit frame
FULL = 0.75  # spacings that a surface point is wide, so that points behind hardly show through
QUERY = 0.008  # a query point's diameter, unit frame
_LIGHT = np.array([0.35, -0.25, 0.9]) / np.linalg.norm([0.35, -0.25, 0.9])
_SHADE = 0.45  # of a colour, by how its surface faces the light


@dataclass(frozen=True, eq=False)
class Points:
    """`points` (n, 3) with their `colours` (n, 3) uint8; `size`, unit frame, is a diameter."""

    points: Floats
    colours: Bytes
    size: float


@dataclass(frozen=True, eq=False)
class Lines:
    """`ends` (n, 2, 3) with the `colours` (n, 2, 3) uint8 there; `width` in pixels."""

    ends: Floats
    colours: Bytes
    width: float


@dataclass(frozen=True, eq=False)
class Solid:
    """`vertices` (V, 3), `faces` (F, 3), one `colour`. `T` (4, 4) is where it stands: the same one
    elsewhere is not sent again."""

    vertices: Floats
    faces: NDArray[np.int32]
    colour: tuple[int, int, int]
    T: Floats = field(default_factory=lambda: np.eye(4))


Drawn: TypeAlias = Points | Lines | Solid


LABEL_COLOURS = np.concatenate([[rgb(FREE_COLOUR)], PALETTE[:254], [rgb(ENCLOSED_COLOUR)]])
LABEL_COLOURS = LABEL_COLOURS.astype(np.uint8)
"""(256, 3) by label: 0 free, k + 1 material of part k, 255 enclosed."""


def surface(instance: Instance) -> list[Drawn]:
    """Return the surface points in the colours of their parts, paler where they face the light."""
    normals = instance.surface_normals / 127.0
    light = 1.0 - _SHADE * (0.5 - 0.5 * normals @ _LIGHT)
    colours = (PALETTE[instance.surface_part] * light[:, None]).astype(np.uint8)
    size = FULL * oriented_points(instance).spacing() if len(colours) > 1 else QUERY
    return [Points(dequantize(instance.surface_points), colours, size)]


def normals(instance: Instance) -> list[Drawn]:
    """Outward normals at some of the surface points."""
    some = slice(NORMALS)
    start = dequantize(instance.surface_points[some])
    end = start + NORMAL_LENGTH * instance.surface_normals[some] / 127.0
    colours = PALETTE[instance.surface_part[some]] // 2
    return [Lines(np.stack([start, end], 1), np.stack([colours, colours], 1), 1.5)]


def voxels(instance: Instance, resolution: int) -> list[Drawn]:
    """Return the occupied voxels of a stored grid, a point each as wide as they are."""
    grid = instance.occupancy[resolution]
    at = np.argwhere(grid != FREE)
    return [Points((at + 0.5) / resolution - 0.5, LABEL_COLOURS[grid[tuple(at.T)]], 1 / resolution)]


def queries(instance: Instance, *, inside: bool) -> list[Drawn]:
    """Return the uniform and near query points that are inside, in their labels' colours, or
    outside."""
    points = np.concatenate([instance.uniform_points, instance.near_points])
    label = np.concatenate([instance.uniform_label, instance.near_label])
    chosen = (label != FREE) == inside
    return [Points(dequantize(points[chosen]), LABEL_COLOURS[label[chosen]], QUERY)]


def partial(instance: Instance, image_size: int) -> list[Drawn]:
    """Return the points that the depth cameras see, by part, with the frusta of the cameras.

    Args:
        image_size: pixels along the edge of their pictures.
    """
    points = dequantize(instance.partial_points).reshape(-1, 3)
    colours = PALETTE[instance.partial_part.reshape(-1)]
    cameras = zip(instance.partial_T_camera_world, instance.partial_intrinsics, strict=True)
    edges = [_frustum(T, intrinsics, image_size) for T, intrinsics in cameras]
    ends = np.concatenate(edges) if edges else np.zeros((0, 2, 3))
    ink = np.broadcast_to(np.array(rgb(INK), np.uint8), ends.shape)
    return [Points(points, colours, 0.01), Lines(ends, ink, 2.0)]


def _frustum(T_camera_world: Floats, intrinsics: Floats, size: int) -> Floats:
    """Return (8, 2, 3) the edges of a camera's frustum, as far as the picture that is drawn."""
    fx, fy, cx, cy = intrinsics
    u, v = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float64).T
    in_camera = FRUSTUM * np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(4)], axis=1)
    corners = apply(invert_rigid(T_camera_world), in_camera)
    eye = apply(invert_rigid(T_camera_world), np.zeros(3))
    rays = np.stack([np.broadcast_to(eye, (4, 3)), corners], axis=1)
    return np.concatenate([rays, np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)])


def meshes(parts: Sequence[Mesh], T_part: Floats) -> list[Drawn]:
    """Return a surface for each part, canonical in `parts`, moved by its own `T_part` (P, 4, 4)."""
    return [
        Solid(mesh.vertices, mesh.faces, rgb(colour_of(k)), T=T)
        for k, (mesh, T) in enumerate(zip(parts, T_part, strict=True))
        if len(mesh.faces)
    ]


def joints(instance: Instance) -> list[Drawn]:
    """Return each joint's axis as an arrow, and its pivot, in the colour of the part that it moves.
    Of a hinge the whole line is drawn, of a slide the half that it opens along."""
    pivots, directions = instance.joint_pivot, instance.joint_axis
    revolute = instance.joint_kind == JointKind.REVOLUTE
    tail = pivots - AXIS_REACH * directions * revolute[:, None]
    tip = pivots + AXIS_REACH * directions
    across = np.cross(directions, np.where(np.abs(directions[:, 2:]) < 0.9, [0, 0, 1], [1, 0, 0]))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    ends = [np.stack([tail, tip], axis=1)]
    for sign in (1, -1):
        ends.append(np.stack([tip, tip - ARROW * (directions - sign * 0.5 * across)], axis=1))
    dark = (PALETTE[1 : 1 + len(pivots)] * 0.7).astype(np.uint8)
    both = np.tile(dark, (3, 1))
    return [
        Lines(np.concatenate(ends), np.stack([both, both], axis=1), 3.0),
        Points(pivots, dark, 0.02),
    ]
