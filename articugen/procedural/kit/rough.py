"""How a model is written as badly as real ones are, while its exact solids stay what they are.

Level 1: triangles twice with both windings, a mesh a solid, hidden faces left open, thin panels as
sheets. Level 2, as rough as real soups: faces cut into many, solids into open pieces, walls inside
of walls, pieces that run into others, decals. What is added lies where no line of sight leads, or,
a decal, is a sheet that the truth has as well.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import area_vectors, unit_normals
from articugen.core.portable import dot, norm, product
from articugen.core.seeding import generator
from articugen.procedural.kit.model import Model, ModelLink
from articugen.procedural.kit.solids import Sheet, Solid

ROUGH = 2  # the level

SHEET_LIMIT = 0.013
"""Panels thinner than this part of the object's longest side become sheets."""

_LIFT = 2e-4  # of a decal over its face, as part of the longest side
_DECALS = 3  # of a link, at most
_SUNK = 4  # hidden faces from which a solid goes on into another, at most
_FINEST = 4  # parts that an edge is cut into, at most
_NOWHERE = 1e-6  # metres: thinner gaps than that hide what is behind them

_Mesh = tuple[Floats, NDArray[np.integer]]
"""Vertices (n, 3), metres, and triangles (m, 3)."""


@dataclass(frozen=True, eq=False)
class _Cells:
    """The convex cells of several solids: whose each is, its planes (m, 4), its box (C, 2, 3)."""

    owners: tuple[Solid, ...]
    planes: tuple[Floats, ...]
    boxes: Floats

    @staticmethod
    def of(solids: Iterable[Solid]) -> "_Cells":
        cells = [
            (s, *cell) for s in solids for cell in zip(s.half_spaces, s.cell_bounds, strict=True)
        ]
        owners, planes, boxes = zip(*cells, strict=True) if cells else ((), (), ())
        return _Cells(owners, planes, np.array(boxes).reshape(-1, 2, 3))

    def hiding(self, solid: Solid) -> NDArray[np.intp]:
        """Return (F,) the cell of another solid that each face of `solid` lies wholly on or in, or
        -1."""
        corners = solid.vertices[solid.faces]
        outside = corners + _NOWHERE * unit_normals(corners)[:, None]
        lowest = outside.min(axis=(0, 1)) - _NOWHERE
        highest = outside.max(axis=(0, 1)) + _NOWHERE
        meets = np.all((self.boxes[:, 0] <= highest) & (self.boxes[:, 1] >= lowest), axis=1)
        hidden = np.full(len(corners), -1)
        for c in np.flatnonzero(meets):
            if self.owners[c] is solid:
                continue
            planes, (low, high) = self.planes[c], self.boxes[c]
            near = np.all((outside >= low - 1e-7) & (outside <= high + 1e-7), axis=(1, 2))
            near &= hidden < 0
            if near.any():
                over = product(outside[near], planes[:, :3].T) - planes[:, 3]
                hidden[np.flatnonzero(near)[np.all(over <= 1e-7, axis=(1, 2))]] = c
        return hidden


def decorated(model: Model, object_id: str) -> Model:
    """Return the model with decals on some of its large faces, but on none that looks down, which
    may be what it stands on: thin solids that become sheets."""
    longest = float(np.max(model.bounds[1] - model.bounds[0]))
    links = []
    for link in model.links:
        rng = generator(0, object_id, link.name, "decals")
        solids = [solid for solid in link.solids if solid.sheet is None]
        cells = _Cells.of(solids)
        corners = np.concatenate([
            np.empty((0, 3, 3)),
            *(s.vertices[s.faces[cells.hiding(s) < 0]] for s in solids),
        ])  # fmt: skip
        sides = area_vectors(corners)
        large = np.flatnonzero((norm(sides) > (longest / 15) ** 2) & (sides[:, 2] > -1e-9))
        chosen = rng.permutation(large)[: rng.integers(_DECALS + 1)]
        decals = (_decal(corners[i], rng.uniform(0.3, 0.9), _LIFT * longest) for i in chosen)
        links.append(replace(link, solids=(*link.solids, *decals)))
    return Model(tuple(links), model.joints)


def _decal(triangle: Floats, size: float, lift: float) -> Solid:
    """Return a plate on a triangle (3, 3): the parallelogram at its widest corner, `size` of it."""
    edges = norm(np.roll(triangle, -1, axis=0) - triangle)
    a, b, c = np.roll(triangle, -((int(np.argmax(edges)) + 2) % 3), axis=0)
    corners = np.array([a, (a + b) / 2, (b + c) / 2, (a + c) / 2])
    corners = corners.mean(axis=0) + size * (corners - corners.mean(axis=0))
    up = lift * unit_normals(triangle[None])[0]
    sides = ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
    faces = ((3, 2, 1, 0), (4, 5, 6, 7), *sides)
    sheet = Sheet((corners + up / 2)[[[0, 1, 2], [0, 2, 3]]], lift, seen=1)
    return Solid(np.concatenate([corners, corners + up]), (faces,), sheet)


def meshes(link: ModelLink, object_id: str, level: int) -> Iterator[tuple[str, _Mesh]]:
    """Yield a name and a mesh, in the object's frame at q = 0, for each piece of a link, whose
    solids are written as their sheets where they have such; `level` 1 or 2, see above."""
    cells = _Cells.of(s for s in link.solids if s.sheet is None)
    rough = _Rough(generator(0, object_id, link.name, "rough"), cells)
    for k, solid in enumerate(link.solids):
        if solid.sheet is not None:
            vertices = solid.sheet.drawn.reshape(-1, 3)
            pieces = [(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))]
        else:
            hiding = cells.hiding(solid) if k % 2 else np.full(len(solid.faces), -1)
            # Every second solid keeps all its faces, so that no two drop their common one.
            pieces = [(solid.vertices, solid.faces[hiding < 0])]
            if level == ROUGH:
                pieces = rough.pieces(solid, hiding)
        for n, (vertices, faces) in enumerate(pieces):
            if len(faces):
                both = np.stack([faces, faces[:, ::-1]], axis=1).reshape(-1, 3)
                yield f"{link.name}-{k}" + (f"-{n}" if n else ""), (vertices, both)


class _Rough:
    """Roughness of one link: drawn once, and again for each of its solids."""

    def __init__(self, rng: np.random.Generator, cells: _Cells) -> None:
        size = np.ptp(cells.boxes, axis=(0, 1)).max() if len(cells.boxes) else 1.0
        self.rng, self.cells = rng, cells
        self.longest_edge = size * rng.uniform(0.05, 0.3)
        self.open_share, self.double_share = rng.uniform(0.0, 0.8), rng.uniform(0.0, 0.6)

    def pieces(self, solid: Solid, hiding: NDArray[np.intp]) -> list[_Mesh]:
        """Return the meshes of a solid of which some faces (-1) are drawn, others hidden."""
        rng, corners = self.rng, solid.vertices[solid.faces]
        drawn = [corners]
        if rng.random() < self.open_share:
            shown = corners[hiding < 0]
            along = dot(shown.mean(axis=1), rng.uniform(-1.0, 1.0, 3))
            drawn = np.array_split(shown[np.argsort(along, kind="stable")], rng.integers(1, 5))
            hidden = np.flatnonzero(hiding >= 0)[:_SUNK]
            drawn += [self._sunk(corners[i], int(hiding[i])) for i in hidden]
        if rng.random() < self.double_share:
            drawn += [_shrunken(solid, rng.uniform(0.6, 0.95))]
        return [_cut(triangles, self.longest_edge) for triangles in drawn]

    def _sunk(self, triangle: Floats, cell: int) -> Floats:
        """Return (6, 3, 3) walls that go on from a hidden face into the cell that hides it."""
        planes, down = self.cells.planes[cell], unit_normals(triangle[None])[0]
        foot = triangle.mean(axis=0) + 0.9 * (triangle - triangle.mean(axis=0))
        room = planes[:, 3] - product(foot, planes[:, :3].T)  # (3, m)
        speed = dot(planes[:, :3], down)
        ahead = speed > 1e-9
        deep = max(_NOWHERE, (room[:, ahead] / speed[ahead]).min() * self.rng.uniform(0.3, 0.9))
        tip = foot + deep * down
        walls = [(foot[i - 1], foot[i], tip[i], tip[i - 1]) for i in range(3)]
        return np.array([(q[0], q[k], q[k + 1]) for q in walls for k in (1, 2)])


def _shrunken(solid: Solid, size: float) -> Floats:
    """Return (n, 3, 3) faces of each cell of a solid, drawn together towards the cell's middle."""
    triangles = []
    for cell, corners in zip(solid.cells, solid.cell_corners, strict=True):
        middle = corners.mean(axis=0)
        fans = [(f[0], f[k], f[k + 1]) for f in cell for k in range(1, len(f) - 1)]
        triangles.append(middle + size * (solid.vertices[np.array(fans)] - middle))
    return np.concatenate(triangles)


def _cut(triangles: Floats, longest_edge: float) -> _Mesh:
    """Cut triangles (n, 3, 3) into k x k alike, k as their longest edge asks, whatever their
    neighbours are cut into."""
    edges = norm(np.roll(triangles, -1, axis=1) - triangles).max(axis=1, initial=0.0)
    parts = np.clip(np.ceil(edges / longest_edge), 1, _FINEST).astype(int)
    vertices, faces, base = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for k in np.unique(parts):
        weights, pattern = _lattice(int(k))
        some = triangles[parts == k]
        placed = (some[:, None] * weights[None, :, :, None]).sum(axis=2)  # (n, v, 3)
        starts = base + np.arange(len(some)) * len(weights)
        vertices.append(placed.reshape(-1, 3))
        faces.append((starts[:, None, None] + pattern).reshape(-1, 3))
        base += len(some) * len(weights)
    return np.concatenate(vertices), np.concatenate(faces)


def _lattice(k: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return the barycentric weights (v, 3) of a triangle cut k times a side, and its k^2 parts."""
    index = {
        (i, j): n for n, (i, j) in enumerate((i, j) for i in range(k + 1) for j in range(k + 1 - i))
    }
    weights = np.array([(k - i - j, i, j) for i, j in index], np.float64) / k
    up = [((i, j), (i + 1, j), (i, j + 1)) for i, j in index if i + j < k]
    down = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in index if i + j < k - 1]
    return weights, np.array([[index[corner] for corner in part] for part in up + down])
