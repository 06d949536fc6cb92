"""What all instances of an object share, made once, and the object posed.

Everything random comes from `seeding.generator(seed, category, object, state, stage)`, so that an
instance is the same whoever makes it, when, and in whatever order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from articugen import fusion
from articugen.core.arrays import Bools, Bytes, Floats, Indices
from articugen.core.backends import Overlay, backend_named
from articugen.core.errors import RejectedInstance
from articugen.core.geometry import apply, bounds, voxel_centres
from articugen.core.recipe import Recipe
from articugen.core.records import (
    ArticulatedObject,
    DepthMaps,
    JointState,
    LabelledMesh,
    Normalization,
    PosedObject,
    ResolvedObject,
    Views,
)
from articugen.core.schema import stored_name
from articugen.core.seeding import generator
from articugen.instance import articulation
from articugen.instance.painted import Paint
from articugen.instance.sharp import SharpEdges, sharp_edges
from articugen.instance.swept import swept_box
from articugen.meshes.bvh import Bvh, joined_trees
from articugen.rendering.views import fusion_views, plain_pinhole_views

MOST_PARTS = 254  # labels are uint8: 0 free, k + 1 material of part k, 255 enclosed
MOST_DRAWS = 100  # of a joint state, for one in which parts are not in one another
SMALL, SLIT = 0.25, 0.02**2
"""An object shorter than that share of its frame, and slits of more than that area, unit frame, are
worth a note."""
NEAREST = 0.7  # of cameras that are held, so that the images' edges cut some of the object


@dataclass(frozen=True, eq=False)
class Grid:
    """The voxel centres of a grid, and what is known of them in every pose.

    Attributes:
        points: (R^3, 3) float32, x slowest.
        fixed: (R^3,) uint8: the material of part 0 alone, which never moves.
    """

    points: NDArray[np.float32]
    fixed: Bytes

    @staticmethod
    def of(resolution: int, fixed: fusion.OwnSolid, recipe: Recipe) -> "Grid":
        points = voxel_centres(resolution).astype(np.float32)
        alone = fusion.PosedSolids((fixed,), np.eye(4)[None], recipe.fusion)
        return Grid(points, alone.labels(points))

    def within(self, box: Floats) -> Indices:
        """Return the flat indices of the voxels whose centres lie in the box (2, 3), and some
        around."""
        resolution = round(len(self.points) ** (1 / 3))
        low, high = np.clip(np.floor((box + 0.5) * resolution).astype(int), 0, resolution - 1)
        x, y, z = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
        return ((x[:, None, None] * resolution + y[:, None]) * resolution + z).ravel()


@dataclass(frozen=True, eq=False)
class Prepared:
    """Work that all instances of an object share, in the unit frame.

    Attributes:
        obj: with the recipe's joints, see `articulation.resolve`.
        recipe, seed: what the instances are made with.
        states: one for each instance; 0 is the canonical pose.
        canonical: the object in its canonical pose, world frame.
        unit: the object's own unit frame.
        mesh: all parts in the canonical pose, sheets thickened, faces outwards; part 0's first.
        seen: (F,) whether a face can be seen at all.
        bvh: of all parts.
        views: the views that are fused.
        closed: (F,) whether a face belongs to a closed solid, whose inner side nobody sees.
        static: the depth maps of part 0 alone, which every instance shares.
        overlay: what the moving parts of one instance after the other are drawn over part 0 in;
            None where the backend has none, or the posed object is not examined.
        own: each part alone, part 0 first.
        grids: by resolution.
        extras: what the recipe asks for besides.
    """

    obj: ResolvedObject
    recipe: Recipe
    seed: int
    states: tuple[JointState, ...]
    canonical: PosedObject
    unit: Normalization
    mesh: LabelledMesh
    seen: Bools
    bvh: Bvh
    views: Views
    closed: Bools
    static: DepthMaps
    overlay: Overlay | None
    own: tuple[fusion.OwnSolid, ...]
    grids: dict[int, Grid]
    extras: "Extras"

    def rng(self, *path: str | int) -> np.random.Generator:
        return generator(self.seed, self.obj.category, self.obj.object_id, *path)

    def material(self, state: JointState) -> fusion.PosedSolids:
        """Return the parts' own solids, each moved to where it is in a state."""
        motion = articulation.motions_of(self.obj, [state], self.canonical)[0]
        return fusion.PosedSolids(self.own, self.unit.rigid_to_unit(motion), self.recipe.fusion)


@dataclass(frozen=True, eq=False)
class Extras:
    """Fields that only some recipes ask for; None if not.

    Attributes:
        ends: where the material of each part ends, for distances.
        edges: sharp ones, in the canonical pose.
        colliding: the parts, to be asked how deep they are in one another.
        cameras: of the images.
        sensors: depth cameras that all instances share.
        paint: colours of the faces.
    """

    ends: LabelledMesh | None
    edges: SharpEdges | None
    colliding: fusion.Colliding | None
    cameras: Views | None
    sensors: Views | None
    paint: Paint | None


def prepare(
    obj: ResolvedObject, recipe: Recipe, seed: int, *, reach: Sequence[JointState] = ()
) -> Prepared:
    """Prepare everything that the instances of `obj` share.

    Args:
        obj: what `articulation.resolve` makes of an object and the recipe.
        reach: states besides the recipe's that the views must hold as well, the unit frame need
            not.

    Raises:
        RejectedInstance: the object has no faces, too many parts, or, where the recipe asks for
            states without collisions, hardly any of those.
        TypeError: the object was not resolved; a fault of the caller.
    """
    if not isinstance(obj, ResolvedObject):
        raise TypeError(
            f"{obj.object_id}: was never resolved; call articulation.resolve(obj, "
            "recipe.articulation) first"
        )
    if obj.part_count > MOST_PARTS:
        raise RejectedInstance(f"{obj.part_count} parts; at most {MOST_PARTS} can be labelled")
    states = [articulation.canonical_state(obj)]
    for index in range(1, recipe.articulation.states + 1):
        rng = generator(seed, obj.category, obj.object_id, index, "joints")
        states.append(_next_state(obj, recipe, states, rng))
    prepared = _prepared(obj, recipe, seed, tuple(states), reach)
    before = np.inf if recipe.articulation.collision == "reject" else 0.0
    while prepared.unit.scale < before:  # in a smaller frame parts are deeper in one another
        before = prepared.unit.scale
        apart, again = _states_apart(prepared)
        if again:
            note = f"{again} of {len(states)} states drawn again, parts were in one another"
            noted = replace(obj, notes=(*obj.notes, note))
            prepared = _prepared(noted, recipe, seed, apart, reach)
    return prepared


def _next_state(
    obj: ResolvedObject, recipe: Recipe, states: Sequence[JointState], rng: np.random.Generator
) -> JointState:
    """Draw the state after `states`, of which there is at least the canonical one."""
    before = states[-1] if recipe.articulation.one_at_a_time else None
    return articulation.sample_joint_state(obj, rng=rng, before=before, turn=len(states) - 1)


def _prepared(
    obj: ResolvedObject,
    recipe: Recipe,
    seed: int,
    states: tuple[JointState, ...],
    reach: Sequence[JointState],
) -> Prepared:
    canonical = articulation.forward_kinematics(obj, states[0])
    motions = articulation.motions_of(obj, (*states, *reach), canonical)
    world = canonical_mesh(obj, canonical)
    unit = _unit_frame(world, motions[: len(states)], recipe.padding)
    soup = LabelledMesh(unit.to_unit(world.vertices), world.faces, world.part_of_face)

    parts = [solid_part(soup.part(k), recipe) for k in range(obj.part_count)]
    mesh = LabelledMesh.joined([part.mesh for part in parts])
    if not len(mesh.faces):
        raise RejectedInstance("the object has no faces: those of its links have no area")
    notes = (*_small_note(obj, states, world, unit), *_slit_note(obj, parts, recipe))
    obj = replace(obj, notes=(*obj.notes, *notes))
    motions = unit.rigid_to_unit(motions)
    views = fusion_views(recipe.views, swept_box(mesh, motions))
    backend = backend_named(recipe.views.backend)
    static = backend.render(parts[0].mesh, views)
    fixed = own_solid(parts[0], recipe, static)
    solids = (fixed, *(own_solid(part, recipe) for part in parts[1:]))
    bvh = joined_trees([part.tree for part in parts])
    paint = Paint.of(obj, soup, parts) if recipe.shows_colours else None
    rng = partial(generator, seed, obj.category, obj.object_id)
    swept = swept_box(mesh, motions[: len(states)])  # the same for any reach
    return Prepared(
        obj=obj, recipe=recipe, seed=seed, states=states, canonical=canonical, unit=unit,
        mesh=mesh, seen=np.concatenate([part.seen for part in parts]), bvh=bvh, views=views,
        closed=np.concatenate([part.closed for part in parts]), static=static,
        overlay=None if recipe.fusion.rule == "rigid" else backend.overlay_on(static), own=solids,
        grids={r: Grid.of(r, solids[0], recipe) for r in recipe.sampling.grids},
        extras=_extras(mesh, solids, bvh, swept, recipe, rng, paint),
    )  # fmt: skip


def _unit_frame(world: LabelledMesh, motions: Floats, padding: float) -> Normalization:
    """Return the frame that holds the faces in all poses, but for those that have no area in it."""
    counted = world
    while True:
        box = swept_box(counted, motions)
        extent = float(np.max(box[1] - box[0]))
        if not extent > 0.0:
            raise RejectedInstance("the object has no extent: all its vertices coincide")
        unit = Normalization(box.mean(axis=0), extent / (1.0 - padding))
        areas = fusion.face_areas(unit.to_unit(world.vertices), world.faces)
        some = areas > fusion.NO_AREA
        if np.count_nonzero(some) in (0, len(counted.faces)):
            return unit
        counted = LabelledMesh(world.vertices, world.faces[some], world.part_of_face[some])


def _small_note(
    obj: ResolvedObject, states: Sequence[JointState], world: LabelledMesh, unit: Normalization
) -> tuple[str, ...]:
    """Note, on an object that is small in its frame, which joint takes it farthest through that."""
    size = float(np.ptp(bounds(world.vertices), axis=0).max() / unit.scale)
    if size >= SMALL:
        return ()
    sweeps = []
    for j, joint in enumerate(obj.moving_joints):
        alone = [JointState(np.where(np.arange(len(s.q)) == j, s.q, 0.0)) for s in states]
        canonical = articulation.forward_kinematics(obj, alone[0])
        box = swept_box(world, articulation.motions_of(obj, alone, canonical))
        sweeps.append((np.ptp(box, axis=0).max(), joint))
    farthest = max(sweeps, key=lambda sweep: sweep[0])[1]
    span = f"{farthest.lower:g} to {farthest.upper:g}"
    return (
        f"{size:.2g} of the unit frame long in its canonical pose, since joint {farthest.name!r} "
        f"({farthest.kind}, {span}) takes it through the rest; narrow it with articulation in the "
        "recipe",
    )


def _slit_note(
    obj: ResolvedObject, parts: Sequence[fusion.SolidPart], recipe: Recipe
) -> tuple[str, ...]:
    """Note the slits that are no more since sheets have a thickness."""
    names = names_of(obj)[1]
    narrow = [name for name, part in zip(names, parts, strict=True) if part.slit > SLIT]
    if not narrow:
        return ()
    thick = recipe.fusion.sheet_thickness
    return (
        f"slits narrower than fusion.sheet_thickness ({thick:.2g}) are closed or narrowed, since "
        f"sheets become that thick: {', '.join(narrow)}",
    )


def pose(
    p: Prepared, state_index: int, *, overlay: Overlay | None = None
) -> tuple[LabelledMesh, fusion.PosedFields]:
    """Return the object's surface and its fields at its `state_index`-th joint state, unit frame.

    With `overlay` the fields hold until the next call that is given the same; without, for good.
    """
    material = p.material(p.states[state_index])
    mesh = p.mesh.moved(material.part_motion)
    if p.recipe.fusion.rule == "rigid":
        return mesh, fusion.PosedFields(material, material)
    backend = backend_named(p.recipe.views.backend)
    if drawing := overlay or backend.overlay_on(p.static):
        first = int(np.searchsorted(mesh.part_of_face, 1))
        moving = LabelledMesh(mesh.vertices, mesh.faces[first:], mesh.part_of_face[first:])
        maps = drawing.draw(moving.compact(), closed=p.closed[first:], first_face=first)
    else:
        maps = backend.render(mesh, p.views)
    field = fusion.fuse(
        maps,
        mesh,
        p.recipe.fusion,
        bvh=p.bvh,
        part_motion=material.part_motion,
        thin=p.own[0].field.thin,  # where what the views say of part 0 is checked
    )
    return mesh, fusion.PosedFields(field, material)


def _states_apart(p: Prepared) -> tuple[tuple[JointState, ...], int]:
    """Return the states of `p`, those that collide too deeply drawn again, and how many were."""
    colliding, bound = p.extras.colliding, p.recipe.articulation.collision_depth
    assert colliding is not None
    canonical = colliding.depths(p.material(p.states[0]))
    states, again = [p.states[0]], 0
    for index in range(1, len(p.states)):
        rng = p.rng(index, "joints")
        for draw in range(MOST_DRAWS):  # the first is that of `p`
            state = _next_state(p.obj, p.recipe, states, rng)
            if not fusion.too_deep(colliding.depths(p.material(state)), canonical, bound):
                states.append(state)
                again += draw > 0
                break
        else:
            raise RejectedInstance(
                f"in {MOST_DRAWS} joint states one after the other parts are more than {bound:g} "
                "deep in one another; set articulation.collision to label, or raise "
                "articulation.collision_depth"
            )
    return tuple(states), again


def _extras(
    mesh: LabelledMesh,
    solids: Sequence[fusion.OwnSolid],
    bvh: Bvh,
    swept: Floats,
    recipe: Recipe,
    rng: Callable[[str], np.random.Generator],
    paint: Paint | None,
) -> Extras:
    """Return what the recipe asks for besides; `swept` (2, 3) holds the object in all its
    states."""
    sampling, images = recipe.sampling, recipe.images
    ends = edges = colliding = cameras = sensors = None
    if sampling.signed_distance:
        still = np.tile(np.eye(4), (len(solids), 1, 1))
        ends = fusion.own_ends(mesh, fusion.PosedSolids(solids, still, recipe.fusion))
    if sampling.sharp_points:
        edges = sharp_edges(mesh, sampling.sharp_degrees)
    if recipe.articulation.collision != "ignore":
        colliding = fusion.Colliding.of(mesh, bvh, rng=rng("collision"))
    if images.views:
        cameras = plain_pinhole_views(images.views, images.resolution, swept, rng=rng("images"))
    if sampling.partial_cameras == "held":
        still = mesh.part(0).vertices  # perhaps none; they see some of it in each state
        sensors = plain_pinhole_views(
            *(sampling.partial_views, sampling.partial_resolution, swept),
            still=(bounds(still) if len(still) else swept).mean(axis=0),
            nearest=NEAREST, rng=rng("partial"),
        )  # fmt: skip
    return Extras(ends, edges, colliding, cameras, sensors, paint)


def canonical_mesh(obj: ArticulatedObject, posed: PosedObject) -> LabelledMesh:
    """Return all links in the canonical pose, world frame, metres; the links of part 0 first."""
    part_of_link = obj.part_of_link
    pieces = []
    for index in np.argsort(part_of_link, kind="stable"):
        mesh = obj.links[index].mesh
        part = np.full(len(mesh.faces), part_of_link[index], np.uint8)
        pieces.append(
            LabelledMesh(apply(posed.T_world_link[index], mesh.vertices), mesh.faces, part)
        )
    joined = LabelledMesh.joined(pieces)
    if not len(joined.faces):
        raise RejectedInstance("the object has no faces: its links carry no visual geometry")
    return joined


def solid_part(soup: LabelledMesh, recipe: Recipe) -> fusion.SolidPart:
    """Return one part alone in the canonical pose, judged by the recipe's views of it."""
    return fusion.solid_part(soup, recipe.fusion, partial(_render_alone, recipe))


def own_solid(
    part: fusion.SolidPart, recipe: Recipe, maps: DepthMaps | None = None
) -> fusion.OwnSolid:
    """Return the solid of a part alone, by `maps` of it, or by the recipe's views of it."""
    return fusion.seen_alone(part, recipe.fusion, partial(_render_alone, recipe), maps)


def _render_alone(recipe: Recipe, mesh: LabelledMesh, box: Floats) -> DepthMaps:
    views = fusion_views(recipe.views, box)
    return backend_named(recipe.views.backend).render(mesh, views, keep_depth=False)


def names_of(obj: ArticulatedObject) -> tuple[tuple[str, ...], ...]:
    """Return (J,) names of the joints, (P,) names and (P,) semantics of each part's first link."""
    joints = obj.moving_joints
    first = [obj.links[0], *(obj.links[obj.link_index[joint.child]] for joint in joints)]
    return (
        tuple(stored_name(joint.name) for joint in joints),
        tuple(stored_name(link.name) for link in first),
        tuple(stored_name(link.semantic) for link in first),
    )
