"""Closed shapes with what goes wrong in real meshes, one fault each, and both truths of them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from articugen.core.geometry import transform
from articugen.core.records import Floats, LabelledMesh
from tests.benchmarks.cases import GENERIC, iou, soup
from tests.benchmarks.scores import TRUTHS
from tests.shapes import Convex, box, two_sided

Shapes = list[trimesh.Trimesh]
NEAR_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class Trial:
    """A shape in line with nothing.

    Attributes:
        mesh: as a method gets it.
        truth: by "material" the solids alone, by "visible" with the space that nothing sees.
    """

    name: str
    mesh: LabelledMesh
    truth: dict[str, Convex]

    def points(self, count: int) -> Floats:
        """(count, 3): half of them uniform in the unit cube, half near the surface."""
        rng = np.random.default_rng(0)
        mesh = trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, process=False)
        near = np.asarray(trimesh.sample.sample_surface(mesh, count // 2, seed=1)[0])
        near = near + NEAR_SIGMA * rng.normal(size=near.shape)
        return np.concatenate([rng.random((count - count // 2, 3)) - 0.5, near])

    def scores(self, inside: Callable, count: int) -> dict[str, float]:
        """IoU with both truths."""
        points = self.points(count)
        got = inside(points)
        return {name: iou(got, self.truth[name].inside(points)) for name in TRUTHS}


def trials() -> tuple[Trial, ...]:
    drum = trimesh.creation.cylinder(0.25, 0.5, sections=96)
    outer, inner = (0.5, 0.45, 0.4), (0.3, 0.25, 0.2)
    boxes = [box(outer), box(inner)]
    return (
        _trial("two-sided", [two_sided(drum)], [drum]),
        _trial("half flipped", [_half_flipped(drum)], [drum]),
        _trial("nested", boxes, boxes),
        _trial("hollow", [boxes[0], _flipped(boxes[1])], _walls(outer, inner), boxes),
        _trial("detached", _crumbs(), _crumbs()),
    )


def _trial(name: str, given: Shapes, solids: Shapes, filled: Shapes | None = None) -> Trial:
    """`filled`: the solids with what they enclose, where that is more."""
    turn = transform(GENERIC)
    pieces, solids, filled = (
        [mesh.copy().apply_transform(turn) for mesh in meshes]
        for meshes in (given, solids, filled or solids)
    )
    mesh = soup([(m.vertices, m.faces) for m in pieces])
    return Trial(name, mesh, {"material": Convex.of(*solids), "visible": Convex.of(*filled)})


def _half_flipped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A random half of the faces, finer than before, looks inwards."""
    fine = mesh.subdivide()
    faces = np.array(fine.faces)
    turned = np.random.default_rng(0).permutation(len(faces))[: len(faces) // 2]
    faces[turned] = faces[turned, ::-1]
    return trimesh.Trimesh(fine.vertices, faces, process=False)


def _flipped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def _walls(outer: tuple[float, ...], inner: tuple[float, ...]) -> Shapes:
    """Six slabs that fill a box but for a box in its middle."""
    walls, rest = [], np.array(outer)
    for axis in range(3):
        size = rest.copy()
        size[axis] = (outer[axis] - inner[axis]) / 2.0
        center = np.zeros(3)
        center[axis] = (outer[axis] + inner[axis]) / 4.0
        walls += [box(size, center), box(size, -center)]
        rest[axis] = inner[axis]
    return walls


def _crumbs() -> Shapes:
    """Twelve boxes and drums of 0.03 to 0.1, apart from each other."""
    crumbs = []
    for k, at in enumerate(np.ndindex(3, 2, 2)):
        center = (np.array(at) - (1.0, 0.5, 0.5)) * (0.3, 0.4, 0.4)
        if k % 2:
            crumbs.append(box((0.03 + 0.005 * k, 0.05, 0.1), center))
        else:
            crumb = trimesh.creation.cylinder(0.02 + 0.002 * k, 0.08, sections=24)
            crumbs.append(crumb.apply_translation(center))
    return crumbs
