"""Closed polygons in the plane: (n, 2) metres, counter-clockwise, no vertex repeated.

A line of a laptop's edge, of a lens or of a door starts here; `solids` gives it a third dimension.
"""

from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from articugen.core.arrays import Floats
from articugen.core.portable import arctan2, product, sin_cos


def rectangle(width: float, height: float, center: ArrayLike = (0.0, 0.0)) -> Floats:
    """Four corners; `width` along x, `height` along y."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5
    return half * (width, height) + np.asarray(center, dtype=np.float64)


def rounded_rectangle(
    width: float,
    height: float,
    radius: float | ArrayLike,
    center: ArrayLike = (0.0, 0.0),
    segments: int = 4,
) -> Floats:
    """Return a rectangle whose corners are arcs of `segments` chords; 4 * (segments + 1) vertices.

    Args:
        radius: of every corner, or (4,) in the order (-x, -y), (+x, -y), (+x, +y), (-x, +y). It is
            kept above 1e-5 m and below half of the shorter side, so that outlines that differ
            only in size and radius have parallel edges, corner by corner.
    """
    radii = np.clip(np.broadcast_to(radius, (4,)), 1e-5, 0.499 * min(width, height))[:, None, None]
    corners = rectangle(width, height)[:, None]
    outline = corners * (1.0 - radii / np.abs(corners)) + radii * _arcs(segments)
    return outline.reshape(-1, 2) + np.asarray(center, dtype=np.float64)


@cache
def _arcs(segments: int) -> Floats:
    """Return (4, segments + 1, 2) a unit circle by quarters, from -x on; nobody writes into it."""
    arc = np.linspace(0.0, np.pi / 2, segments + 1)
    sine, cosine = sin_cos(arc + np.pi + np.arange(4.0)[:, None] * np.pi / 2)
    return np.stack([cosine, sine], axis=2)


def circle(radius: float, sides: int = 32, center: ArrayLike = (0.0, 0.0)) -> Floats:
    """Return a regular polygon inscribed in the circle; the first vertex lies at half a step from
    +x."""
    return ellipse(radius, radius, sides, center)


def ellipse(a: float, b: float, sides: int = 32, center: ArrayLike = (0.0, 0.0)) -> Floats:
    """Return a polygon inscribed in the ellipse with half-axes `a` along x and `b` along y."""
    angles = (np.arange(sides) + 0.5) * (2.0 * np.pi / sides)
    sine, cosine = sin_cos(angles)
    return np.stack([cosine, sine], axis=1) * (a, b) + np.asarray(center, dtype=np.float64)


def matched(outer: Floats, inner: Floats, center: ArrayLike = (0.0, 0.0)) -> tuple[Floats, Floats]:
    """Both outlines with a vertex in each direction from `center` in which either has one.

    The result fits `solids.ring`: a round hole in a square panel. Both must be star-shaped about
    `center`.
    """
    middle = np.asarray(center, dtype=np.float64)
    shapes = [outer - middle, inner - middle]
    angles = np.concatenate([arctan2(s[:, 1], s[:, 0]) for s in shapes]) % (2.0 * np.pi)
    angles = np.sort(angles)
    kept = angles[np.diff(angles, append=angles[0] + 2.0 * np.pi) > 1e-4]
    return _seen_from_origin(shapes[0], kept) + middle, _seen_from_origin(shapes[1], kept) + middle


def _seen_from_origin(outline: Floats, angles: Floats) -> Floats:
    """Return where rays from the origin at `angles` meet a star-shaped outline."""
    sine, cosine = sin_cos(angles)
    direction = np.stack([cosine, sine], axis=1)
    start, end = outline, np.roll(outline, -1, axis=0)
    normal = np.stack([end[:, 1] - start[:, 1], start[:, 0] - end[:, 0]], axis=1)
    distance = np.sum(normal * start, axis=1)
    side_start = direction[:, :1] * start[:, 1] - direction[:, 1:] * start[:, 0]
    side_end = direction[:, :1] * end[:, 1] - direction[:, 1:] * end[:, 0]
    facing = product(direction, normal.T)
    crosses = (side_start <= 1e-12) & (side_end >= -1e-12) & (facing > 0.0)
    reach = np.where(crosses, distance / np.where(crosses, facing, 1.0), np.inf).min(axis=1)
    if not np.all(np.isfinite(reach)):
        raise ValueError("an outline is not star-shaped about its center")
    return direction * reach[:, None]


def convex_pieces(outline: Floats) -> list[list[int]]:
    """Cut a simple polygon into convex ones, each a counter-clockwise list of vertex indices.

    Ears are clipped, then neighbours merged while their union stays convex (Hertel and Mehlhorn
    1983): at most four times as many pieces as needed.
    """
    pieces = _ears(outline)
    while True:
        pairs = combinations(range(len(pieces)), 2)
        unions = ((i, j, _union(pieces[i], pieces[j])) for i, j in pairs)
        convex = ((i, j, union) for i, j, union in unions if union and _is_convex(outline[union]))
        i, j, union = next(convex, (0, 0, None))
        if union is None:
            return pieces
        pieces[i] = union
        del pieces[j]


def _turn(a: Floats, b: Floats, c: Floats) -> float:
    return float((b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]))


def _is_convex(polygon: Floats) -> bool:
    n = len(polygon)
    return all(_turn(polygon[i - 1], polygon[i], polygon[(i + 1) % n]) > -1e-14 for i in range(n))


def _ears(outline: Floats) -> list[list[int]]:
    left = list(range(len(outline)))
    if _is_convex(outline):
        return [left]
    pieces = []
    while len(left) > 3:
        for k in range(len(left)):
            i, j, m = left[k - 1], left[k], left[(k + 1) % len(left)]
            a, b, c = outline[i], outline[j], outline[m]
            if _turn(a, b, c) <= 1e-14:
                continue
            others = outline[[v for v in left if v not in (i, j, m)]]
            if not any(
                min(_turn(a, b, p), _turn(b, c, p), _turn(c, a, p)) >= -1e-14 for p in others
            ):
                pieces.append([i, j, m])
                del left[k]
                break
        else:
            raise ValueError("an outline crosses itself or runs clockwise")
    return [*pieces, left]


def _union(p: list[int], q: list[int]) -> list[int] | None:
    """Two polygons joined along their one common edge; None where they have none."""
    for i, a in enumerate(p):
        b = p[(i + 1) % len(p)]
        if a in q and b in q and q[(q.index(b) + 1) % len(q)] == a:
            j = q.index(a)
            return [*p[: i + 1], *(q[(j + k) % len(q)] for k in range(1, len(q) - 1)), *p[i + 1 :]]
    return None
