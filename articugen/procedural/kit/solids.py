"""Closed bodies that are known exactly: a mesh and, at the same time, a union of convex cells.

A `Solid` is a set of convex polyhedra that share whole faces. What two cells share is inside; the
other faces, wound outward, are its boundary: a watertight mesh without T-junctions. A point is
inside the solid if it is inside one of its cells, that is, behind all planes of one cell. Both are
read from the very same vertices, so the mesh has no error that its occupancy has not.

All builders take metres. Outlines lie in the x-y plane and are raised along z; `along_x` and
`along_y` turn the result.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import apply, cross, rotation_about, transform
from articugen.core.portable import arctan2, dot, norm, product, total, turned
from articugen.procedural.kit.outlines import circle, convex_pieces, rectangle, rounded_rectangle

Face = tuple[int, ...]
"""A convex, plane polygon: vertex indices, counter-clockwise seen from outside its cell."""

FLAT = 1e-9  # metres by which a vertex may lie off its face's plane
PLANE = FLAT / 10  # metres between the diagonals of a side that is one face

_ALMOST = 1.0 - 1e-6


@dataclass(frozen=True, eq=False)
class Sheet:
    """A surface that stands for a slab: all points within half of `thickness` along its normal.

    Attributes:
        triangles: (n, 3, 3) metres, one plane: the middle of the slab.
        thickness: metres.
        seen: the side that is drawn: 1 along the normal or -1 against it, of a slab that lies on
            something; 0 for the middle of one that is seen from both sides.
    """

    triangles: Floats
    thickness: float
    seen: int = 0

    @property
    def drawn(self) -> Floats:
        """(n, 3, 3) the triangles where messy models have them."""
        edges = self.triangles[0, 1:] - self.triangles[0, :1]
        normal = cross(edges[0], edges[1])
        return self.triangles + self.seen * self.thickness / 2 * normal / norm(normal)

    def moved(self, T: Floats) -> "Sheet":
        """Return the sheet after the rigid transform `T` (4, 4)."""
        return replace(self, triangles=apply(T, self.triangles))


@dataclass(frozen=True, eq=False)
class Solid:
    """A union of convex cells that share whole faces.

    Attributes:
        vertices: (V, 3) metres.
        cells: the faces of each cell.
        sheet: what `messy` models may write instead of a thin panel.
    """

    vertices: Floats
    cells: tuple[tuple[Face, ...], ...]
    sheet: Sheet | None = None

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """(F, 3) the boundary's triangles, wound outward."""
        outer: dict[frozenset[int], Face] = {}
        for cell in self.cells:
            for face in cell:
                key = frozenset(face)
                if outer.pop(key, None) is None:
                    outer[key] = face
        return _triangles(self.vertices, list(outer.values()))

    @cached_property
    def half_spaces(self) -> tuple[Floats, ...]:
        """Rows (m, 4) for each cell: (nx, ny, nz, d); inside is n . x <= d.

        Raises:
            ValueError: a cell is not convex.
        """
        planes = _planes(self.vertices, [face for cell in self.cells for face in cell])
        ends = np.cumsum([len(cell) for cell in self.cells])[:-1]
        by_cell = tuple(np.split(planes, ends))
        for corners, behind in zip(self.cell_corners, by_cell, strict=True):
            over = np.max(product(corners, behind[:, :3].T) - behind[:, 3])
            if over > FLAT:
                raise ValueError(
                    f"a cell is not convex: a vertex stands {over:.2e} m beyond a face"
                )
        return by_cell

    @property
    def cell_corners(self) -> list[Floats]:
        """(n, 3) the vertices of each cell."""
        return [self.vertices[sorted({v for face in cell for v in face})] for cell in self.cells]

    @cached_property
    def cell_bounds(self) -> Floats:
        """(cells, 2, 3) the box around each cell."""
        return np.array([[c.min(axis=0), c.max(axis=0)] for c in self.cell_corners])

    @property
    def volume(self) -> float:
        """Cubic metres: the sum over the cells."""
        fans = ((f[0], *edge) for cell in self.cells for f in cell for edge in pairwise(f[1:]))
        a, b, c = np.moveaxis(self.vertices[np.array(list(fans))], 1, 0)
        return float(np.sum(a * cross(b, c)) / 6.0)

    def moved(self, T: Floats) -> "Solid":
        """Build the solid after the rigid transform `T` (4, 4)."""
        sheet = None if self.sheet is None else self.sheet.moved(T)
        return Solid(apply(T, self.vertices), self.cells, sheet)

    def shifted(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """Build the solid moved by (x, y, z)."""
        return self.moved(transform(translation=(x, y, z)))

    def mirrored(self, axis: int) -> "Solid":
        """Build the mirror image: coordinate `axis` (0, 1 or 2) with the opposite sign."""
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        cells = tuple(tuple(face[::-1] for face in cell) for cell in self.cells)
        sheet = self.sheet and replace(self.sheet, triangles=self.sheet.triangles[:, ::-1] * sign)
        return Solid(self.vertices * sign, cells, sheet)


def along_x(solid: Solid) -> Solid:
    """Turn (x, y, z) to (z, x, y): an outline drawn as (y, z) and raised along x."""
    return solid.moved(transform(np.eye(3)[[2, 0, 1]]))


def along_y(solid: Solid) -> Solid:
    """Turn (x, y, z) to (y, z, x): an outline drawn as (z, x) and raised along y."""
    return solid.moved(transform(np.eye(3)[[1, 2, 0]]))


def box(lower: ArrayLike, upper: ArrayLike, *, panel: bool = False) -> Solid:
    """Build the axis-aligned box between two corners; a `panel` may be written as a sheet.

    Mark a box as a panel only if it is thin and no slit half as wide as its thickness, around its
    mid-surface, would open a view into a closed space.
    """
    a, b = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if np.any(b <= a):
        raise ValueError(f"a box from {a} to {b} is empty")
    thin = int(np.argmin(b - a))
    u, v = (thin + 1) % 3, (thin + 2) % 3
    outline = np.array([(a[u], a[v]), (b[u], a[v]), (b[u], b[v]), (a[u], b[v])])
    turned = (along_x, along_y, lambda solid: solid)[thin]
    return turned(prism(outline, a[thin], b[thin], panel=panel))


def prism(outline: Floats, z0: float, z1: float, *, panel: bool = False, seen: int = 0) -> Solid:
    """Build a simple polygon (n, 2), convex or not, raised from `z0` to `z1`.

    Args:
        panel: see `box`.
        seen: of a panel that lies on something, the side that is seen: 1 for z1, -1 for z0.
    """
    pieces = convex_pieces(outline)
    solid = _raised(outline, pieces, z0, z1)
    if not panel:
        return solid
    middle = _at_height(outline, (z0 + z1) / 2)
    triangles = _triangles(middle, [tuple(piece) for piece in pieces])
    return replace(solid, sheet=Sheet(middle[triangles], z1 - z0, seen))


def _raised(flat: Floats, pieces: Iterable[Sequence[int]], z0: float, z1: float) -> Solid:
    """Build a cell over each of some convex pieces, which count the vertices `flat` (n, 2)."""
    n, cells = len(flat), []
    for piece in pieces:
        after = (*piece[1:], piece[0])
        sides = [(i, j, j + n, i + n) for i, j in zip(piece, after, strict=True)]
        cells.append((tuple(piece[::-1]), tuple(i + n for i in piece), *sides))
    return Solid(np.concatenate([_at_height(flat, z) for z in (z0, z1)]), tuple(cells))


def _at_height(flat: Floats, z: float) -> Floats:
    return np.c_[flat, np.full(len(flat), z)]


def loft(rings: ArrayLike, *, closed: bool = False) -> Solid:
    """Build one cell between each ring and the next.

    Args:
        rings: (k, n, 3) plane convex polygons, counter-clockwise seen against the way on.
        closed: the last ring is followed by the first.
    """
    rings = np.asarray(rings, dtype=np.float64)
    k, n = rings.shape[:2]
    vertices = rings.reshape(-1, 3)
    numbers = np.arange(k * n).reshape(k, n)
    below, above = (
        (numbers, np.roll(numbers, -1, axis=0)) if closed else (numbers[:-1], numbers[1:])
    )
    after = np.roll(np.arange(n), -1)
    quads = np.stack([below, below[:, after], above[:, after], above], axis=2).reshape(-1, 4)
    sides = _sides(vertices, quads)
    cells = [
        (tuple(a[::-1]), tuple(b), *(face for side in sides[r * n : (r + 1) * n] for face in side))
        for r, (a, b) in enumerate(zip(below.tolist(), above.tolist(), strict=True))
    ]
    return Solid(vertices, tuple(cells))


def stack(outlines: Sequence[Floats], heights: Sequence[float]) -> Solid:
    """Convex outlines of equal length (n, 2), one at each height, upwards: bevels, cones, domes."""
    return loft([_at_height(o, z) for o, z in zip(outlines, heights, strict=True)])


def cylinder(radius: float, z0: float, z1: float, *, sides: int = 24, bevel: float = 0.0) -> Solid:
    """Build a regular prism around z, its edges cut at 45 degrees by `bevel`."""
    if bevel <= 0.0:
        return prism(circle(radius, sides), z0, z1)
    radii = (radius - bevel, radius, radius, radius - bevel)
    return stack([circle(r, sides) for r in radii], (z0, z0 + bevel, z1 - bevel, z1))


def block(
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    radius: float = 0.0,
    bevel: float | tuple[float, float] = 0.0,
    segments: int = 3,
) -> Solid:
    """Return a box whose vertical edges are rounded and whose horizontal edges are cut at 45
    degrees.

    Args:
        radius: of the vertical edges.
        bevel: of the horizontal edges, or (bottom, top).
    """
    a, b = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    middle, (width, depth, _) = (a + b)[:2] / 2, b - a
    bottom, top = np.broadcast_to(bevel, (2,))
    layers = [(bottom, a[2]), (0.0, a[2] + bottom), (0.0, b[2] - top), (top, b[2])]
    layers = [layer for k, layer in enumerate(layers) if (bottom, 1.0, 1.0, top)[k] > 0.0]
    outlines = [
        rounded_rectangle(width - 2 * d, depth - 2 * d, max(radius - d, d), middle, segments)
        if radius > 0.0
        else rectangle(width - 2 * d, depth - 2 * d, middle)
        for d, _ in layers
    ]
    return stack(outlines, [z for _, z in layers])


def ring(outer: Floats, inner: Floats, z0: float, z1: float) -> Solid:
    """Build the space between two outlines of equal length (n, 2), raised: frames, tubes, panels
    with a hole. Vertex i of both is joined by a cut, so each piece between two cuts must be convex
    (`outlines.matched` makes it so)."""
    n = len(outer)
    pieces = [(i, j, n + j, n + i) for i in range(n) for j in [(i + 1) % n]]
    return _raised(np.concatenate([outer, inner]), pieces, z0, z1)


def sweep(
    path: ArrayLike, section: ArrayLike, *, closed: bool = False, up: ArrayLike = (0.0, 0.0, 1.0)
) -> Solid:
    """Build a convex section carried along a polyline, mitred at its corners.

    Args:
        path: (n, 3).
        section: (m, 2), or (n, m, 2) one for each vertex of the path, counter-clockwise, in the
            plane across the path: its second coordinate along `up`, as far as it is across.
        closed: the path returns to its start; it must then lie in a plane across `up`.
    """
    points, section = np.asarray(path, dtype=np.float64), np.asarray(section, dtype=np.float64)
    n = len(points)
    sections = np.broadcast_to(section, (n, *section.shape[-2:]))
    way = np.roll(points, -1, axis=0) - points
    way /= np.maximum(norm(way), 1e-300)[:, None]
    if not closed:
        way[-1] = way[-2]
    v = np.asarray(up, dtype=np.float64)
    v = v - way[0] * dot(v, way[0])
    v /= norm(v)
    rings = np.empty((n, sections.shape[1], 3))
    for i, (t, before) in enumerate(zip(way, np.roll(way, 1, axis=0), strict=True)):
        before = t if i == 0 and not closed else before  # noqa: PLW2901
        v = v if i == 0 else _carried(v, before, t)
        across = cross(v, t)
        cut = t + before
        flat = product(sections[i], np.stack([across, v]))
        rings[i] = points[i] + flat - (dot(flat, cut) / dot(t, cut))[:, None] * t
    if closed and np.max(np.abs(dot(way, v))) > FLAT:
        raise ValueError("a closed path must lie in a plane across `up`")
    return loft(rings, closed=closed)


def _carried(v: Floats, before: Floats, after: Floats) -> Floats:
    """`v` turned by the least rotation that takes `before` to `after`."""
    axis = cross(before, after)
    sine = norm(axis)
    if sine < 1e-12:
        return v
    return turned(rotation_about(axis / sine, arctan2(sine, dot(before, after))), v)


def _sides(vertices: Floats, quads: NDArray[np.int64]) -> list[list[Face]]:
    """Return each quad (n, 4) between an edge of two rings, or two triangles where it is not plane.

    Of the two diagonals the one is taken that leaves the cell convex.
    """
    p, q, r, s = np.moveaxis(vertices[quads], 1, 0)
    normal = cross(r - p, s - q)
    height = dot(normal, q - p) / norm(normal)
    return [
        [(a, b, c, d)]
        if abs(h) < PLANE
        else [(a, b, d), (b, c, d)]
        if h > 0.0
        else [(a, b, c), (a, c, d)]
        for (a, b, c, d), h in zip(quads.tolist(), height.tolist(), strict=True)
    ]


def _planes(vertices: Floats, faces: list[Face]) -> Floats:
    """Return (len(faces), 4) each face's outward unit normal, by Newell's method, and its
    offset."""
    longest = max(map(len, faces))
    # Faces are made equally long by repeating their last vertex, which adds nothing to the sum.
    index = np.array([[*face, *[face[-1]] * (longest - len(face))] for face in faces])
    middle = vertices.mean(axis=0)
    points = vertices[index] - middle
    normals = cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    normals /= norm(normals)[:, None]
    lengths = np.array([len(face) for face in faces])[:, None]
    used = (np.arange(longest) < lengths)[:, :, None]
    centers = (points * used).sum(axis=1) / lengths
    return np.c_[normals, np.sum(normals * (centers + middle), axis=1)]


def _triangles(vertices: Floats, faces: list[Face]) -> NDArray[np.int32]:
    """Return the faces as triangles (n, 3), none of them flat though corners of a face may be."""
    quads = np.array([face for face in faces if len(face) == 4], np.int32).reshape(-1, 4)
    others = [t for face in faces if len(face) != 4 for t in _clipped(vertices, face)]
    p = vertices[quads]
    ways = p[:, [1, 2, 3, 0]] - p
    area = norm(cross(ways[:, [3, 0, 1, 2]], ways))
    # The diagonal that leaves the larger of the two smaller triangles; rounding decides no draw.
    cut_02 = np.minimum(area[:, 1], area[:, 3]) >= _ALMOST * np.minimum(area[:, 0], area[:, 2])
    turned = np.where(cut_02[:, None], quads, quads[:, [1, 2, 3, 0]])
    halves = np.stack([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    return np.concatenate([halves, np.array(others, np.int32).reshape(-1, 3)])


def _clipped(vertices: Floats, face: Face) -> list[Face]:
    """Return a convex polygon as triangles, cut off ear by ear, the fattest first.

    By plain numbers: for so few, arrays take six times as long.
    """
    left, p = list(face), vertices[list(face)].tolist()
    ears = [_ear(p[k - 2], p[k - 1], p[k]) for k in range(len(p))]
    ears = [*ears[1:], ears[0]]
    swept = [_crossed(p[k - 1], p[k]) for k in range(len(p))]
    triangles = []
    while (n := len(left)) > 3:
        whole = _length([total(along) for along in zip(*swept, strict=True)])
        # What stays must not be flat. Of equal ears the first is taken, whatever the rounding.
        most = whole * (1.0 - 1e-9)
        fatness = [fat if area < most else -1.0 for area, fat in ears]
        enough = _ALMOST * max(fatness)
        k = next((k for k, fat in enumerate(fatness) if fat >= enough), 0)
        before, after = k - 1, (k + 1) % n
        triangles.append((left[before], left[k], left[after]))
        ears[before] = _ear(p[k - 2], p[before], p[after])
        ears[after] = _ear(p[before], p[after], p[(k + 2) % n])
        swept[after] = _crossed(p[before], p[after])
        for row in (left, p, ears, swept):
            del row[k]
    return [*triangles, (left[0], left[1], left[2])]


def _crossed(a: Sequence[float], b: Sequence[float]) -> Sequence[float]:
    """Return the cross product of two vectors, of plain numbers."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _way(a: Sequence[float], b: Sequence[float]) -> Sequence[float]:
    return b[0] - a[0], b[1] - a[1], b[2] - a[2]


def _length(a: Sequence[float]) -> float:
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def _ear(a: Sequence[float], b: Sequence[float], c: Sequence[float]) -> tuple[float, float]:
    """Return twice the area of the triangle a, b, c, and that as a share of the square of its edge
    from a to c."""
    ac = _way(a, c)
    area = _length(_crossed(_way(a, b), _way(b, c)))
    return area, area / (ac[0] * ac[0] + ac[1] * ac[1] + ac[2] * ac[2])
