"""What is measured: bundled objects, posed, with their exact truth, and shapes of known thickness.

Everything is in the unit frame, in which each object's poses together just fit a cube of side 0.9.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import trimesh
from numba import njit
from numpy.typing import NDArray

from articugen.core.geometry import (
    apply,
    fibonacci_sphere,
    invert_rigid,
    rotation_about,
    transform,
    voxel_centres,
)
from articugen.core.recipe import Recipe, load_recipe
from articugen.core.records import ArticulatedObject, Floats, LabelledMesh, Views, dequantize
from articugen.core.schema import Instance
from articugen.fusion import reachable
from articugen.instance import make
from articugen.instance.again import resolved
from articugen.instance.preparing import Prepared
from articugen.procedural.truth import Truth, _meets_box, _meets_cell, truth_of
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source
from tests.procedural_truth import link_frames

Bools = NDArray[np.bool_]
Inside = Callable[[Floats], Bools]
"""Which of the points (n, 3) are inside: (n,)."""

VOXEL = 1.0 / 256.0

SIGHTS = 2000
"""Lines of sight that are tried out of a cavity."""

GENERIC = rotation_about(np.array([0.36, 0.48, 0.8]), 0.7)
"""A rotation that is in line with nothing."""


@dataclass(frozen=True, eq=False)
class Model:
    """An object as its recipe wants it. There is no truth for real ones, which are not ours."""

    ref: ObjectRef
    obj: ArticulatedObject
    recipe: Recipe
    real: bool = False
    messy: bool = False

    @property
    def name(self) -> str:
        return f"{self.ref.object_id}{' (messy)' if self.messy else ''}"


@dataclass(frozen=True, eq=False)
class Case:
    """A posed object.

    Attributes:
        mesh: its faces as the source gives them: not thickened, not turned, nothing dropped.
        asked: (n, 3) the points that an instance labels by its recipe: grids and query points.
        points: (m, 3) by kind, "uniform" and "near": where the truth is asked.
        scene: the exact solids, or None for real models.
        many: (k, 3) the points of the larger budget, or none.
    """

    model: Model
    state: int
    mesh: LabelledMesh
    asked: Floats
    points: dict[str, Floats]
    scene: "Scene | None"
    many: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def name(self) -> str:
        return f"{self.model.name} state {self.state}"


@dataclass(frozen=True, eq=False)
class Scene:
    """The exact solids of a posed object."""

    truth: Truth
    T_world_link: dict[str, Floats]
    prepared: Prepared

    def holds(self, points: Floats) -> Bools:
        """(n, P) whether the solids of each part hold each point."""
        by_link = self.truth.holds(self._world(points), self.T_world_link)
        obj = self.prepared.obj
        part = np.array([obj.part_of_link[obj.link_index[name]] for name in self.truth.links])
        return np.stack([by_link[:, part == k].any(axis=1) for k in range(obj.part_count)], axis=1)

    def solid(self, points: Floats) -> Bools:
        """(n,) inside a solid."""
        return np.any(self.holds(points), axis=1)

    def material(self, points: Floats, motion: Floats) -> Bools:
        """(n,) inside a solid, or sealed inside one part alone.

        A cavity is sealed where no straight line leads to what a flood from outside of the part
        gets to over voxels of 1/256, and none of `SIGHTS` lines of sight leads out of the part.

        Args:
            motion: (P, 4, 4) of the parts from the canonical pose, unit frame.
        """
        held = self.solid(points)
        for part, T in enumerate(invert_rigid(motion)):
            rest = np.flatnonzero(~held)
            mesh = self.prepared.mesh.part(part)
            open_to = reachable.flood(mesh, 256, self.prepared.bvh, np.eye(4)[None])
            rest = rest[~open_to.reaches(apply(T, points[rest]))]
            alone = self._of_part(part)
            world = self._world(points[rest])
            held[rest] = alone.enclosed(world, fibonacci_sphere(SIGHTS), self.T_world_link)
        return held

    def _of_part(self, part: int) -> Truth:
        """The truth of one part alone."""
        truth, obj = self.truth, self.prepared.obj
        mine = [obj.part_of_link[obj.link_index[name]] == part for name in truth.links]
        return truth.of(np.array(mine))

    def unseen(self, points: Floats, views: Views) -> Bools:
        """(n,) inside a solid, or behind solids from all `views` by exact ray casting."""
        hidden = self.solid(points)
        rest = np.flatnonzero(~hidden)
        world = self._world(points[rest])
        if views.projection == "orthographic":
            towards = -views.T_camera_world[:, 2, :3]
            hidden[rest] = self.truth.enclosed(world, towards, self.T_world_link)
            return hidden
        eyes = self._world(invert_rigid(views.T_camera_world)[:, :3, 3])
        cells = self.truth._posed(self.T_world_link)
        hidden[rest] = _hidden(world, eyes, in_image(points[rest], views), cells)
        return hidden

    def _world(self, points: Floats) -> Floats:
        return np.ascontiguousarray(self.prepared.unit.to_world(points))


def in_image(points: Floats, views: Views) -> Bools:
    """(n, K) which points project into which pinhole image."""
    inside = np.empty((len(points), len(views)), np.bool_)
    for k, T in enumerate(views.T_camera_world):
        x, y, z = apply(T, points).T
        u, v = views.fx[k] * x / z + views.cx[k], views.fy[k] * y / z + views.cy[k]
        inside[:, k] = (u >= 0) & (u < views.width) & (v >= 0) & (v < views.height)
    return inside


@njit(cache=True)
def _hidden(points, eyes, in_image, cells):
    """Whether a cell lies between each point and each eye whose image it is in."""
    planes, first_plane, boxes = cells
    hidden = np.ones(len(points), np.bool_)
    for i in range(len(points)):
        last = 0  # the cell that hid the point before will often hide it again
        for j in range(len(eyes)):
            if not in_image[i, j]:
                continue
            towards = eyes[j] - points[i]
            blocked = False
            for k in range(len(boxes)):
                c = (last + k) % len(boxes)
                if _meets_box(points[i], towards, boxes, c) and _meets_cell(
                    points[i], towards, planes, first_plane[c], first_plane[c + 1]
                ):
                    blocked, last = True, c
                    break
            if not blocked:
                hidden[i] = False
                break
    return hidden


def bundled(category: str, index: int, *, messy: bool) -> Model:
    """The bundled object number `index` of a category, clean or as badly written as real ones."""
    source = "procedural_messy" if messy else "procedural"
    ref = open_source(source).objects(category)[index]
    return _model(ref, messy=messy)


def real(folder: Path, category: str) -> Model:
    """A model that is not ours."""
    return _model(open_source(folder).objects(category)[0], real=True)


def _model(ref: ObjectRef, *, real: bool = False, messy: bool = False) -> Model:
    recipe = load_recipe(None, ref.category)
    return Model(ref, resolved(ref, recipe), recipe, real, messy)


def sampled(prepared: Prepared, state: int, count: int) -> Instance:
    """The instance at the `state`-th joint state with `count` points of each kind and no grids."""
    many = {"grids": (), "partial_views": 1}
    many |= dict.fromkeys(("surface_points", "uniform_points", "near_points"), count)
    sampling = prepared.recipe.sampling.model_copy(update=many)
    recipe = prepared.recipe.model_copy(update={"sampling": sampling})
    return make.make_instance(replace(prepared, recipe=recipe, grids={}), state)


def scene(model: Model, prepared: Prepared, state: int) -> Scene:
    """The exact solids of the posed object, sheets of no thickness as thick as the recipe says."""
    thickness = model.recipe.fusion.sheet_thickness * prepared.unit.scale
    truth = truth_of(
        model.ref.category, model.ref.object_id, messy=model.messy, sheet_thickness=thickness
    )
    return Scene(truth, link_frames(prepared.obj, prepared.states[state].q), prepared)


def case(model: Model, prepared: Prepared, state: int, count: int) -> Case:
    """The object at its `state`-th joint state; `count` points of each kind to judge by."""
    made = sampled(prepared, state, count)
    points = {"uniform": dequantize(made.uniform_points), "near": dequantize(made.near_points)}
    T = link_frames(prepared.obj, prepared.states[state].q)
    meshes = [(T[link.name], link.mesh) for link in model.obj.links]
    pieces = [(prepared.unit.to_unit(apply(X, m.vertices)), m.faces) for X, m in meshes]
    wanted = model.recipe.sampling
    grids = [voxel_centres(r) for r in wanted.grids]
    queried = [points["uniform"][: wanted.uniform_points], points["near"][: wanted.near_points]]
    exact = None if model.real else scene(model, prepared, state)
    return Case(model, state, soup(pieces), np.concatenate(grids + queried), points, exact)


def soup(pieces: list[tuple[Floats, NDArray]]) -> LabelledMesh:
    """One mesh of (vertices, faces) pieces, all of part 0."""
    return LabelledMesh.joined([LabelledMesh(v, f, np.zeros(len(f), np.uint8)) for v, f in pieces])


def pages() -> tuple[LabelledMesh, Floats, Floats]:
    """Five zero-thickness sheets that meet at an axis, in line with nothing.

    One connected piece, since some methods keep no more.

    Returns:
        The mesh, and feet (n, 3) on the sheets, away from their edges, with the normals (n, 3).
    """
    corners = np.array([[0.0, 0.0, -0.3], [0.4, 0.0, -0.3], [0.4, 0.0, 0.3], [0.0, 0.0, 0.3]])
    x, z = np.meshgrid(np.linspace(0.15, 0.35, 9), np.linspace(-0.2, 0.2, 9))
    feet = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    pieces, on_sheet, normals = [], [], []
    for k in range(5):
        R = GENERIC @ rotation_about((0.0, 0.0, 1.0), 2.0 * np.pi * k / 5)
        pieces.append((corners @ R.T, np.array([[0, 1, 2], [0, 2, 3]])))
        on_sheet.append(feet @ R.T)
        normals.append(np.broadcast_to(R[:, 1], feet.shape))
    return soup(pieces), np.concatenate(on_sheet), np.concatenate(normals)


def drum() -> tuple[LabelledMesh, Floats, Floats]:
    """A closed cylinder in line with nothing; points (n, 3) all over it, with normals (n, 3)."""
    mesh = trimesh.creation.cylinder(0.25, 0.5, sections=96, transform=transform(GENERIC))
    drawn = trimesh.sample.sample_surface(mesh, 400, seed=0)
    points, normals = np.asarray(drawn[0]), mesh.face_normals[drawn[1]]
    return soup([(mesh.vertices, mesh.faces)]), points, normals


def depth_along(inside: Inside, feet: Floats, normals: Floats, reach: float) -> Floats:
    """(n,) how much of the segment foot +- reach * normal is inside, in voxels of 1/256.

    100 even samples each, from a random start, so that the mean over the feet is unbiased.
    """
    start = np.random.default_rng(0).random((len(feet), 1))
    at = (np.arange(100) + start) / 50.0 - 1.0
    points = feet[:, None] + reach * at[:, :, None] * normals[:, None]
    held = inside(points.reshape(-1, 3)).reshape(len(feet), -1)
    return held.mean(axis=1) * 2.0 * reach / VOXEL
