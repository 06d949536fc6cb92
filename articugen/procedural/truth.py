"""The exact occupancy of a procedural object at any joint state, read from its `solids.json`.

Every solid is a union of convex cells; a cell is the space behind all of its planes. Nothing is
sampled and nothing approximated: these are the very polyhedra that the OBJ files show. A sheet
counts as the slab that it stands for.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.geometry import bounds, cross
from articugen.core.jit import dot, helper, kernel, vector
from articugen.core.portable import norm, turned
from articugen.procedural import build_model
from articugen.procedural.kit.writer import truth_file

_Cells = tuple[Floats, NDArray[np.int64], Floats]
"""What the kernels read: planes, first_plane and boxes of `Truth`, all in one frame."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The convex cells of all links, each in its link's frame. C cells, M planes.

    Attributes:
        links: the names of the links that have cells, the fixed body first.
        link_of_cell: (C,) index into `links`, ascending.
        first_plane: (C + 1,) cell c has the planes first_plane[c] to first_plane[c + 1] - 1.
        planes: (M, 4) rows (nx, ny, nz, d): behind is n . x <= d, metres.
        boxes: (C, 2, 3) the box around each cell, metres.
    """

    links: tuple[str, ...]
    link_of_cell: NDArray[np.int64]
    first_plane: NDArray[np.int64]
    planes: Floats
    boxes: Floats

    def of(self, links: NDArray[np.bool_]) -> "Truth":
        """Return the cells of some of the links alone; `links` has a value for each."""
        cells = np.flatnonzero(links[self.link_of_cell])
        first = self.first_plane
        planes = [self.planes[first[c] : first[c + 1]] for c in cells]
        return replace(
            self,
            link_of_cell=self.link_of_cell[cells],
            first_plane=np.cumsum([0, *map(len, planes)]),
            planes=np.concatenate([np.zeros((0, 4)), *planes]),
            boxes=self.boxes[cells],
        )

    def inside(self, points: Floats, T_world_link: Mapping[str, Floats]) -> NDArray[np.int64]:
        """Return where each world point (N, 3) lies: 0 for free space, k + 1 for `links[k]`.

        Where links cross, as those of no bundled object do, the first one counts.

        Args:
            T_world_link: the (4, 4) transform of every link, by its name.
        """
        holds = self.holds(points, T_world_link)
        return np.where(holds.any(axis=1), holds.argmax(axis=1) + 1, 0)

    def holds(self, points: Floats, T_world_link: Mapping[str, Floats]) -> NDArray[np.bool_]:
        """Return (N, links) whether each world point lies in each link."""
        cells = self._posed(T_world_link)
        points = np.ascontiguousarray(points, np.float64)
        return _holds(points, cells, self.link_of_cell, len(self.links))

    def enclosed(
        self, points: Floats, directions: Floats, T_world_link: Mapping[str, Floats]
    ) -> NDArray[np.bool_]:
        """Return (N,) whether the rays of each point meet a cell along all `directions` (K, 3), as
        those of a point in one do.

        With the opposite of the viewing directions: the points that no view sees free.
        """
        cells = self._posed(T_world_link)
        both = (np.ascontiguousarray(array, np.float64) for array in (points, directions))
        return _enclosed(*both, cells)

    def _posed(self, T_world_link: Mapping[str, Floats]) -> _Cells:
        """Return the cells in the world frame."""
        T = np.array([T_world_link[name] for name in self.links])[self.link_of_cell]
        center = T[:, :3, 3] + turned(T[:, :3, :3], self.boxes.mean(axis=1))
        half = turned(np.abs(T[:, :3, :3]), np.ptp(self.boxes, axis=1) / 2)
        per_plane = np.repeat(T, np.diff(self.first_plane), axis=0)
        normals = turned(per_plane[:, :3, :3], self.planes[:, :3])
        offsets = self.planes[:, 3] + np.sum(normals * per_plane[:, :3, 3], axis=1)
        slack = 1e-12  # Metres: the box may not be smaller than its cell through rounding.
        boxes = np.stack([center - half - slack, center + half + slack], axis=1)
        return np.c_[normals, offsets], self.first_plane, boxes


def truth_of(
    category: str,
    object_id: str,
    *,
    messy: int = 0,
    varied: bool = False,
    sheet_thickness: float | None = None,
) -> Truth:
    """Return the truth of one bundled object; see `build_model` and `read_truth`."""
    model = build_model(category, object_id, varied=varied)
    data = truth_file(model, object_id=object_id, category=category, messy=messy)
    return read_truth(data, sheet_thickness=sheet_thickness)


def read_truth(data: bytes, *, sheet_thickness: float | None = None) -> Truth:
    """Read the truth in a `solids.json`.

    Args:
        data: its bytes.
        sheet_thickness: metres given to sheets that are drawn without any; by default that of the
            panels they stand for.
    """
    content = json.loads(data)
    links = {name: _cells(link, sheet_thickness) for name, link in content["links"].items()}
    cells = [cell for of_link in links.values() for cell in of_link]
    counts = [len(of_link) for of_link in links.values()]
    planes = [planes for planes, _ in cells]
    return Truth(
        links=tuple(links),
        link_of_cell=np.repeat(np.arange(len(links)), counts),
        first_plane=np.cumsum([0, *map(len, planes)]),
        planes=np.concatenate(planes),
        boxes=np.array([box for _, box in cells]),
    )


def _cells(link: dict[str, Any], sheet_thickness: float | None) -> list[tuple[Floats, Floats]]:
    """Return (planes, box) of every cell of a link, its sheets included."""
    cells = [(np.array(cell["half_spaces"]), np.array(cell["box"])) for cell in link["cells"]]
    for sheet in link["sheets"]:
        thickness = sheet["thickness"]
        if sheet_thickness is not None and not sheet["backed"]:
            thickness = sheet_thickness
        cells += [_slab(np.array(t), thickness) for t in sheet["triangles"]]
    return cells


def _slab(triangle: Floats, thickness: float) -> tuple[Floats, Floats]:
    """Return the prism of a triangle (3, 3) that reaches half of `thickness` to either side."""
    edges = np.roll(triangle, -1, axis=0) - triangle
    normal = cross(edges[0], edges[1])
    normal /= norm(normal)
    sides = cross(edges, normal)
    sides /= norm(sides)[:, None]
    across = normal * thickness / 2
    normals = np.stack([normal, -normal, *sides])
    on_plane = np.stack([triangle[0] + across, triangle[0] - across, *triangle])
    box = bounds(np.concatenate([triangle + across, triangle - across]))
    return np.c_[normals, np.sum(normals * on_plane, axis=1)], box


@kernel
def _holds(points, cells, link_of_cell, link_count):  # pragma: no cover - compiled
    """Return which links hold each point."""
    planes, first_plane, boxes = cells
    holds = np.zeros((len(points), link_count), np.bool_)
    for i in range(len(points)):
        x, y, z = points[i]
        for c in range(len(boxes)):
            # Scalars, not rows: a view made in this loop would cost more than all else.
            if x < boxes[c, 0, 0] or y < boxes[c, 0, 1] or z < boxes[c, 0, 2]:
                continue
            if x > boxes[c, 1, 0] or y > boxes[c, 1, 1] or z > boxes[c, 1, 2]:
                continue
            if holds[i, link_of_cell[c]]:
                continue
            behind = True
            for m in range(first_plane[c], first_plane[c + 1]):
                if planes[m, 0] * x + planes[m, 1] * y + planes[m, 2] * z > planes[m, 3]:
                    behind = False
                    break
            if behind:
                holds[i, link_of_cell[c]] = True
    return holds


@kernel
def _enclosed(points, directions, cells):  # pragma: no cover - compiled
    """Return which points' rays all meet a cell."""
    planes, first_plane, boxes = cells
    enclosed = np.ones(len(points), np.bool_)
    for i in range(len(points)):
        last = 0  # The cell that stopped the ray before will often stop the next one.
        p = vector(points, i)
        for j in range(len(directions)):
            way = vector(directions, j)
            per_metre = 1.0 / way[0], 1.0 / way[1], 1.0 / way[2]
            for k in range(len(boxes)):
                c = last if k == 0 else k - (k <= last)
                if _meets_box(p, way, per_metre, boxes, c) and _meets_cell(
                    p, way, planes, first_plane[c], first_plane[c + 1]
                ):
                    last = c
                    break
            else:
                enclosed[i] = False
                break
    return enclosed


@helper
def _meets_box(point, direction, per_metre, boxes, c):  # pragma: no cover - compiled
    """Return whether the ray meets box c: clipped by three slabs (Kay and Kajiya 1986)."""
    start, end = 0.0, np.inf
    for k in range(3):
        if direction[k] == 0.0:
            if point[k] < boxes[c, 0, k] or point[k] > boxes[c, 1, k]:
                return False
            continue
        a = (boxes[c, 0, k] - point[k]) * per_metre[k]
        b = (boxes[c, 1, k] - point[k]) * per_metre[k]
        start, end = max(start, min(a, b)), min(end, max(a, b))
        if start > end:
            return False
    return True


@helper
def _meets_cell(point, direction, planes, first, last):  # pragma: no cover - compiled
    """Return whether the ray meets the convex cell of planes `first` to `last` - 1: clipped by them
    (Cyrus and Beck 1978)."""
    start, end = 0.0, np.inf
    for m in range(first, last):
        normal = vector(planes, m)
        room, speed = planes[m, 3] - dot(normal, point), dot(normal, direction)
        if speed > 0.0:
            end = min(end, room / speed)
        elif speed < 0.0:
            start = max(start, room / speed)
        elif room < 0.0:
            return False
        if start > end:
            return False
    return True
