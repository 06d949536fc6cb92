"""What ovens, washing machines and drawers share: front plates, rods, handles, knobs and feet.

Fronts face +x, y runs from left to right along them, z is up. A handle or a knob is made at the
origin on the plane x = 0, standing towards +x, and then shifted to its place. Metres.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from articugen.core.arrays import Floats
from articugen.core.geometry import rotation_about, transform
from articugen.core.portable import arctan2, cos, norm, sin
from articugen.procedural.kit.outlines import circle, rounded_rectangle
from articugen.procedural.kit.solids import (
    Solid,
    along_x,
    along_y,
    block,
    box,
    cylinder,
    prism,
    ring,
    stack,
    sweep,
)


@dataclass(frozen=True)
class Rect:
    """A rectangle on a front: y from `y0` to `y1`, z from `z0` to `z1`."""

    y0: float
    z0: float
    y1: float
    z1: float

    @property
    def width(self) -> float:
        return self.y1 - self.y0

    @property
    def height(self) -> float:
        return self.z1 - self.z0

    @property
    def center(self) -> tuple[float, float]:
        return (self.y0 + self.y1) / 2, (self.z0 + self.z1) / 2

    def shrunk(self, y: float, z: float | None = None) -> "Rect":
        """Moved in by `y` at both sides and by `z` (or `y`) at top and bottom."""
        z = y if z is None else z
        return Rect(self.y0 + y, self.z0 + z, self.y1 - y, self.z1 - z)

    def outline(self, radius: float = 0.0, segments: int = 4) -> Floats:
        """Return (n, 2) in (y, z); outlines with equal `segments` fit `solids.ring`."""
        return rounded_rectangle(self.width, self.height, radius, self.center, segments)


def plate(rect: Rect, x0: float, x1: float, *, radius: float = 0.0, bevel: float = 0.0) -> Solid:
    """Return a front plate between x0 and x1: corners rounded by `radius`, the outer edge
    bevelled."""
    lower, upper = (rect.y0, rect.z0, x0), (rect.y1, rect.z1, x1)
    return along_x(block(lower, upper, radius=radius, bevel=(0.0, bevel), segments=4))


def plank(rect: Rect, x0: float, x1: float, *, panel: bool = False) -> Solid:
    """Build a plain board between x0 and x1; a thin `panel` may be written as a sheet."""
    return box((x0, rect.y0, rect.z0), (x1, rect.y1, rect.z1), panel=panel)


def frame(
    outer: Rect,
    inner: Rect,
    x0: float,
    x1: float,
    *,
    outer_radius: float = 0.0,
    inner_radius: float = 0.0,
    segments: int = 4,
) -> Solid:
    """Build a plate with a rectangular hole; both corners may be rounded."""
    sizes = (outer.outline(outer_radius, segments), inner.outline(inner_radius, segments))
    return along_x(ring(*sizes, x0, x1))


def leaning(rect: Rect, back: float, foot: float, head: float) -> tuple[Solid, Floats]:
    """Build a board from x = `back` to x = `foot` at its lower and `head` at its upper edge.

    Returns:
        The board, and the transform (4, 4) that puts what stands at the origin, looking along +x,
        on the middle of its face.
    """
    outline = np.array([(rect.z0, back), (rect.z1, back), (rect.z1, head), (rect.z0, foot)])
    R = rotation_about((0, 1, 0), -arctan2(foot - head, rect.height))
    return (
        along_y(prism(outline, rect.y0, rect.y1)),
        transform(R, ((foot + head) / 2, *rect.center)),
    )


def lathe(inner: ArrayLike, outer: ArrayLike, sides: int = 32) -> Solid:
    """Build a shell of revolution around z: bowls, domes, hoops.

    Args:
        inner, outer: (k, 2) points (radius, height) from one rim to the other. Quad i, between
            points i and i + 1 of both, must be convex.
        sides: meridian planes.
    """
    profile = np.stack([np.asarray(inner, float), np.asarray(outer, float)], axis=1)
    k = len(profile)
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    radius, height = profile[None, ..., 0], profile[None, ..., 1]
    x, y = (radius * f(angle)[:, None, None] for f in (cos, sin))
    vertices = np.stack([x, y, np.broadcast_to(height, x.shape)], axis=-1).reshape(-1, 3)
    cells, meridians = [], np.arange(len(vertices)).reshape(sides, k, 2).tolist()
    for here, there in zip(meridians, [*meridians[1:], meridians[0]], strict=True):
        for i in range(k - 1):  # of each point first the inner shell's vertex, then the outer's
            near, far = ((*m[i], m[i + 1][1], m[i + 1][0]) for m in (here, there))
            around = zip((*near[1:], near[0]), near, far, (*far[1:], far[0]), strict=True)
            cells.append((near, far[::-1], *(tuple(face) for face in around)))
    solid = Solid(vertices, tuple(cells))
    if solid.volume > 0.0:
        return solid
    return Solid(vertices, tuple(tuple(face[::-1] for face in cell) for cell in solid.cells))


def rod(path: ArrayLike, radius: float, sides: int = 8) -> Solid:
    """Build a round bar along a polyline (n, 3)."""
    points = np.asarray(path, dtype=np.float64)
    first = np.abs(points[1] - points[0])
    up = (0.0, 0.0, 1.0) if first[2] < 0.9 * norm(first) else (1.0, 0.0, 0.0)
    return sweep(points, circle(radius, sides), up=up)


def tapered(radii: ArrayLike, heights: ArrayLike, sides: int = 16) -> Solid:
    """Circles around z, one for each height, joined by cones."""
    return stack([circle(r, sides) for r in np.asarray(radii)], list(np.asarray(heights)))


def knob(kind: str, radius: float, reach: float, sides: int = 16) -> list[Solid]:
    """Build a control or furniture knob.

    Args:
        kind: plain, grip, cone, ball, square or mushroom.
        radius, reach: half its width, and how far it stands out.
    """
    if kind == "grip":
        half = np.array((0.24, 0.96)) * radius
        skirt = cylinder(radius, 0.0, 0.45 * reach, sides=sides, bevel=0.1 * reach)
        bar = block((*-half, 0.3 * reach), (*half, reach), bevel=(0.0, 0.1 * radius))
        return [along_x(skirt), along_x(bar)]
    if kind == "square":
        lower, upper = (-radius, -radius, 0.0), (radius, radius, reach)
        return [along_x(block(lower, upper, bevel=(0.0, 0.2 * min(radius, reach))))]
    shape = np.array(_KNOB_PROFILES[kind]) * (radius, reach)
    return [along_x(tapered(shape[:, 0], shape[:, 1], sides))]


_KNOB_PROFILES = {
    "plain": ((1.0, 0.0), (1.0, 0.85), (0.88, 1.0)),
    "cone": ((1.0, 0.0), (0.72, 0.9), (0.6, 1.0)),
    "ball": ((0.5, 0.0), (0.45, 0.3), (0.85, 0.45), (1.0, 0.65), (0.85, 0.88), (0.45, 1.0)),
    "mushroom": ((0.45, 0.0), (0.45, 0.5), (1.0, 0.62), (1.0, 0.82), (0.8, 1.0)),
}
"""(radius, height) of the circles of each round knob, in units of its radius and reach."""


def handle(
    kind: str, length: float, reach: float, thickness: float, *, upright: bool = False
) -> list[Solid]:
    """Build a pull along y (or z where `upright`), its middle at the origin.

    Args:
        kind: bar, flat, arch, cup or strip.
        length, reach: its extent along y and x.
        thickness: of the bar or the wall.
    """
    half, r = length / 2, thickness / 2
    if kind == "bar":
        posts = [0.8 * half, -0.8 * half]
        solids = [rod([(reach - r, -half, 0), (reach - r, half, 0)], r, 10)]
        solids += [rod([(0, y, 0), (reach - r, y, 0)], 0.8 * r, 8) for y in posts]
    elif kind == "flat":
        solids = [plate(Rect(-half, -r, half, r), reach - thickness, reach, bevel=0.2 * r)]
        for y in (half - thickness, -half):
            solids.append(box((0, y, -r), (reach - r, y + thickness, r)))
    elif kind == "arch":
        s = np.linspace(-1.0, 1.0, 13)
        bow = (reach - r) * (1.0 - np.abs(s * s * s))
        solids = [rod(np.c_[bow, s * (half - r), np.zeros(13)], r, 8)]
    elif kind == "cup":
        solids = _cup(half, reach, thickness)
    else:
        lip = np.array([(-r, 0), (r, 0), (r, reach), (-3 * r, reach), (-3 * r, reach - 2 * r)])
        corner = np.array([(-r, reach - 2 * r)])
        solids = [along_y(prism(np.concatenate([lip, corner]), -half, half))]
    return [s.moved(_UPRIGHT) for s in solids] if upright else solids


_UPRIGHT = transform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
"""Turns y to z: about x by a right angle."""


def _cup(half: float, reach: float, wall: float) -> list[Solid]:
    """Build a bin pull: a quarter of a tube, open below, closed at both ends."""
    angles = np.linspace(0.0, np.pi / 2, 7)
    arc = np.stack([cos(angles), sin(angles)], axis=1)  # (z, x), from the plane to the lip
    middle = np.array((reach / 2, 0.0))
    shell = np.concatenate([arc * reach, arc[::-1] * (reach - wall)]) - middle
    side = np.concatenate([arc * reach, [(0.0, 0.0)]]) - middle
    spans = ((-half, -half + wall), (half - wall, half))
    return [along_y(prism(shell, -half, half)), *(along_y(prism(side, *span)) for span in spans)]


def row(center: float, half: float, count: int) -> list[float]:
    """`count` places spread over center - half .. center + half, each in the middle of its part."""
    return [center + half * ((2 * k + 1) / count - 1.0) for k in range(count)]
