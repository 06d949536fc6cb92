"""One object, one instance: the order of the stages, as a story.

`prepare` makes what all instances of an object share, `make_instance` makes one of them. Everything
random comes from `seeding.generator(seed, category, object, state, stage)`, so that an instance is
the same whoever makes it, when, and in whatever order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from articugen import fusion
from articugen.core.backends import Backend, Overlay, backend_named
from articugen.core.errors import RejectedInstance
from articugen.core.geometry import apply, bounds, box_corners, voxel_centres
from articugen.core.recipe import Recipe, Sampling
from articugen.core.records import (
    FREE,
    ArticulatedObject,
    DepthMaps,
    Floats,
    JointKind,
    JointState,
    LabelledMesh,
    Normalization,
    PosedObject,
    ResolvedObject,
    Views,
    dequantize,
    quantize,
)
from articugen.core.schema import Instance, stored_name
from articugen.core.seeding import generator
from articugen.instance import articulation, sampling
from articugen.instance.sharp import SharpEdges, sharp_edges, sharp_points
from articugen.instance.swept import swept_box
from articugen.rendering.images import images
from articugen.rendering.views import fusion_views, plain_pinhole_views, random_pinhole_views

MOST_PARTS = 254
"""Labels are uint8: 0 free, k + 1 material of part k, 255 enclosed."""

MOST_DRAWS = 100
"""Of a joint state, for one in which parts are not in one another."""

SMALL, SLIT = 0.25, 0.02**2
"""An object shorter than that share of its frame, and slits of more than that area, unit frame, are
worth a note."""

FEWEST_SURFACE_POINTS = 1024
"""Drawn even where fewer are stored: near points are drawn around them."""


@dataclass(frozen=True, eq=False)
class Grid:
    """The voxel centres of a grid, and what is known of them in every pose.

    Attributes:
        points: (R^3, 3) float32, x slowest.
        fixed: (R^3,) uint8: the material of part 0 alone, which never moves.
    """

    points: NDArray[np.float32]
    fixed: NDArray[np.uint8]

    def within(self, box: Floats) -> NDArray[np.intp]:
        """The flat indices of the voxels whose centres lie in the box (2, 3), and some around."""
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
            None where the backend has none, or the posed object is not looked at.
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
    seen: NDArray[np.bool_]
    bvh: fusion.Bvh
    views: Views
    closed: NDArray[np.bool_]
    static: DepthMaps
    overlay: Overlay | None
    own: tuple[fusion.OwnSolid, ...]
    grids: dict[int, Grid]
    extras: "Extras"

    def rng(self, *path: str | int) -> np.random.Generator:
        return generator(self.seed, self.obj.category, self.obj.object_id, *path)


@dataclass(frozen=True, eq=False)
class Extras:
    """Fields that only some recipes ask for; None if not.

    Attributes:
        visible: the faces that can be seen at all, for distances.
        edges: sharp ones, in the canonical pose.
        colliding: the parts, to be asked how deep they are in one another.
        cameras: of the images.
    """

    visible: fusion.Bvh | None
    edges: SharpEdges | None
    colliding: fusion.Colliding | None
    cameras: Views | None


def prepare(
    obj: ResolvedObject, recipe: Recipe, seed: int, *, reach: Sequence[JointState] = ()
) -> Prepared:
    """Everything that the instances of `obj` share.

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
    states = _joint_states(obj, recipe.articulation.states, seed)
    prepared = _prepared(obj, recipe, seed, states, reach)
    if recipe.articulation.collision == "reject":
        apart, again = _states_apart(prepared)
        if again:
            note = f"{again} of {len(states)} states drawn again, parts were in one another"
            obj = replace(obj, notes=(*obj.notes, note))
            prepared = _prepared(obj, recipe, seed, apart, reach)
    return prepared


def _prepared(
    obj: ResolvedObject,
    recipe: Recipe,
    seed: int,
    states: tuple[JointState, ...],
    reach: Sequence[JointState],
) -> Prepared:
    posed = [articulation.forward_kinematics(obj, state) for state in states]
    motions = np.stack([articulation.part_motions(p, posed[0]) for p in posed])
    world = _canonical_mesh(obj, posed[0])
    unit = _normalization(swept_box(world, motions), recipe.padding)
    soup = LabelledMesh(unit.to_unit(world.vertices), world.faces, world.part_of_face)

    parts = [solid_part(soup.part(k), recipe) for k in range(obj.part_count)]
    mesh = LabelledMesh.joined([part.mesh for part in parts])
    if not len(mesh.faces):
        raise RejectedInstance("the object has no faces: those of its links have no area")
    notes = (*_small_note(obj, states, world, unit), *_slit_note(obj, parts, recipe))
    obj = replace(obj, notes=(*obj.notes, *notes))
    further = [articulation.forward_kinematics(obj, state) for state in reach]
    motions = np.stack([articulation.part_motions(p, posed[0]) for p in (*posed, *further)])
    swept = swept_box(mesh, unit.rigid_to_unit(motions))
    views = fusion_views(recipe.views, swept)
    static = _render(parts[0].mesh, views, recipe)
    fixed = fusion.seen_by(static, parts[0], recipe.fusion)
    own = (fixed, *(own_solid(part, recipe) for part in parts[1:]))
    looked_at = recipe.fusion.rule != "rigid"
    seen = np.concatenate([part.seen for part in parts])
    bvh = fusion.joined_bvh(parts)
    rng = partial(generator, seed, obj.category, obj.object_id)
    sampled = swept_box(mesh, unit.rigid_to_unit(motions[: len(posed)]))  # the same for any reach
    return Prepared(
        obj=obj,
        recipe=recipe,
        seed=seed,
        states=states,
        canonical=posed[0],
        unit=unit,
        mesh=mesh,
        seen=seen,
        bvh=bvh,
        views=views,
        closed=np.concatenate([part.closed for part in parts]),
        static=static,
        overlay=_backend(recipe).overlay_on(static) if looked_at else None,
        own=own,
        grids={r: _grid(r, own, recipe) for r in recipe.sampling.grids},
        extras=_extras(mesh, seen, bvh, sampled, recipe, rng),
    )


def _small_note(
    obj: ResolvedObject, states: Sequence[JointState], world: LabelledMesh, unit: Normalization
) -> tuple[str, ...]:
    """On an object that is small in its frame: which joint takes it farthest through that."""
    size = float(np.ptp(bounds(world.vertices), axis=0).max() / unit.scale)
    if size >= SMALL:
        return ()
    sweeps = []
    for j, joint in enumerate(obj.moving_joints):
        alone = [JointState(np.where(np.arange(len(s.q)) == j, s.q, 0.0)) for s in states]
        posed = [articulation.forward_kinematics(obj, state) for state in alone]
        motions = np.stack([articulation.part_motions(p, posed[0]) for p in posed])
        sweeps.append((np.ptp(swept_box(world, motions), axis=0).max(), joint))
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
    """On slits that are no more since sheets have a thickness."""
    _, names, _ = _names(obj)
    narrow = [name for name, part in zip(names, parts, strict=True) if part.slit > SLIT]
    if not narrow:
        return ()
    thick = recipe.fusion.sheet_thickness
    return (
        f"slits narrower than fusion.sheet_thickness ({thick:.2g}) are closed or narrowed, since "
        f"sheets become that thick: {', '.join(narrow)}",
    )


def make_instance(p: Prepared, state_index: int) -> Instance:
    """Return the instance of the object at its `state_index`-th joint state.

    Raises:
        RejectedInstance: nothing of it can be seen.
    """
    mesh, fields = pose(p, state_index, overlay=p.overlay)
    surface = _surface(p, state_index, mesh, fields)
    sharp = _sharp(p, state_index, surface, fields)
    joint_name, part_name, part_semantic = _names(p.obj)
    occupancy = {r: _labelled_grid(grid, fields, r) for r, grid in p.grids.items()}
    return Instance(
        object_id=p.obj.object_id,
        state_index=state_index,
        center=p.unit.center,
        scale=p.unit.scale,
        **_joint_fields(p, state_index),
        joint_name=joint_name,
        part_name=part_name,
        part_semantic=part_semantic,
        part_motion=fields.part_motion,
        occupancy=occupancy,
        coverage=_coverage(p, state_index, mesh, fields, occupancy),
        **_surface_fields(p, surface),
        **_query_fields(p, state_index, surface, sharp, fields),
        **_sharp_fields(sharp),
        collision_depth=_collision_depth(p, fields),
        **_image_fields(p, mesh),
        **_partial_fields(p, state_index, mesh),
    )


def pose(
    p: Prepared, state_index: int, *, overlay: Overlay | None = None
) -> tuple[LabelledMesh, fusion.PosedFields]:
    """Return the object's surface and its fields at its `state_index`-th joint state, unit frame.

    With `overlay` the fields hold until the next call that is given the same; without, for good.
    """
    posed = articulation.forward_kinematics(p.obj, p.states[state_index])
    motion = p.unit.rigid_to_unit(articulation.part_motions(posed, p.canonical))
    mesh = p.mesh.moved(motion)
    material = fusion.PosedSolids(p.own, motion, p.recipe.fusion)
    if p.recipe.fusion.rule == "rigid":
        return mesh, fusion.PosedFields(material, material)
    drawing = overlay or _backend(p.recipe).overlay_on(p.static)
    maps = _draw_moving(p, mesh, drawing) if drawing else _render(mesh, p.views, p.recipe)
    field = fusion.fuse(
        maps,
        mesh,
        p.recipe.fusion,
        bvh=p.bvh,
        part_motion=motion,
        thin=p.own[0].field.thin,  # where what the views say of part 0 is checked
    )
    return mesh, fusion.PosedFields(field, material)


def _joint_states(obj: ArticulatedObject, count: int, seed: int) -> tuple[JointState, ...]:
    random = [
        articulation.sample_joint_state(
            obj, rng=generator(seed, obj.category, obj.object_id, index, "joints")
        )
        for index in range(1, count + 1)
    ]
    return (articulation.canonical_state(obj), *random)


def _states_apart(p: Prepared) -> tuple[tuple[JointState, ...], int]:
    """Return the states of `p`, those in which parts are too deep in one another drawn again, and
    how many were."""
    assert p.extras.colliding is not None
    bound = p.recipe.articulation.collision_depth
    canonical = _depths(p, p.states[0])
    states, again = [p.states[0]], 0
    for index in range(1, len(p.states)):
        rng = p.rng(index, "joints")
        drawn = (articulation.sample_joint_state(p.obj, rng=rng) for _ in range(MOST_DRAWS))
        for draw, state in enumerate(drawn):  # the first is that of `p`
            if not fusion.too_deep(_depths(p, state), canonical, bound):
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


def _depths(p: Prepared, state: JointState) -> Floats:
    """Return (P, P) how deep the parts are in one another in a state."""
    assert p.extras.colliding is not None
    posed = articulation.forward_kinematics(p.obj, state)
    motion = p.unit.rigid_to_unit(articulation.part_motions(posed, p.canonical))
    return p.extras.colliding.depths(fusion.PosedSolids(p.own, motion, p.recipe.fusion))


def _extras(
    mesh: LabelledMesh,
    seen: NDArray[np.bool_],
    bvh: fusion.Bvh,
    swept: Floats,
    recipe: Recipe,
    rng: Callable[[str], np.random.Generator],
) -> Extras:
    """What the recipe asks for besides; `swept` (2, 3) holds the object in all its states."""
    sampling, images = recipe.sampling, recipe.images
    visible = edges = colliding = cameras = None
    if sampling.signed_distance:
        corners = mesh.vertices[mesh.faces[seen]]
        visible = fusion.build(corners, mesh.part_of_face[seen], len(bvh.roots) - 1)
    if sampling.sharp_points:
        edges = sharp_edges(mesh, sampling.sharp_degrees)
    if recipe.articulation.collision != "ignore":
        colliding = fusion.Colliding.of(mesh, bvh, rng=rng("collision"))
    if images.views:
        cameras = plain_pinhole_views(images.views, images.resolution, swept, rng=rng("images"))
    return Extras(visible, edges, colliding, cameras)


def _canonical_mesh(obj: ArticulatedObject, posed: PosedObject) -> LabelledMesh:
    """All links in the canonical pose, world frame, metres; the links of part 0 first."""
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


def _normalization(box: Floats, padding: float) -> Normalization:
    """One frame for all instances: the longest edge of their common box becomes 1 - padding."""
    extent = float(np.max(box[1] - box[0]))
    if not extent > 0.0:
        raise RejectedInstance("the object has no extent: all its vertices coincide")
    return Normalization(box.mean(axis=0), extent / (1.0 - padding))


def solid_part(soup: LabelledMesh, recipe: Recipe) -> fusion.SolidPart:
    """Return one part alone in the canonical pose, judged by the recipe's views of it."""
    return fusion.solid_part(soup, recipe.fusion, partial(_render_alone, recipe))


def own_solid(part: fusion.SolidPart, recipe: Recipe) -> fusion.OwnSolid:
    """What the recipe's views of a part alone say of it."""
    return fusion.seen_alone(part, recipe.fusion, partial(_render_alone, recipe))


def _render_alone(recipe: Recipe, mesh: LabelledMesh, box: Floats) -> DepthMaps:
    views = fusion_views(recipe.views, box)
    return _backend(recipe).render(mesh, views, keep_depth=False)


def _render(mesh: LabelledMesh, views: Views, recipe: Recipe) -> DepthMaps:
    return _backend(recipe).render(mesh, views)


def _backend(recipe: Recipe) -> Backend:
    return backend_named(recipe.views.backend)


def _draw_moving(p: Prepared, mesh: LabelledMesh, overlay: Overlay) -> DepthMaps:
    first = int(np.searchsorted(mesh.part_of_face, 1))
    moving = LabelledMesh(mesh.vertices, mesh.faces[first:], mesh.part_of_face[first:])
    return overlay.draw(moving.compact(), closed=p.closed[first:], first_face=first)


def _grid(resolution: int, own: Sequence[fusion.OwnSolid], recipe: Recipe) -> Grid:
    points = voxel_centres(resolution).astype(np.float32)
    fixed = fusion.PosedSolids(own[:1], np.eye(4)[None], recipe.fusion)
    return Grid(points, fixed.labels(points))


def _labelled_grid(grid: Grid, fields: fusion.PosedFields, resolution: int) -> NDArray[np.uint8]:
    """As `fields.labels` of all voxels, from what is known of them in every pose."""
    label = grid.fixed.copy()
    material = fields.material
    for part in reversed(range(1, len(material.own))):  # where they overlap the first one counts
        corners = apply(material.part_motion[part], box_corners(material.own[part].box))
        held = material.holds(part, grid.points, grid.within(bounds(corners)))
        label[held] = part + 1
    label = fields.with_enclosed(grid.points, label)
    return label.reshape(resolution, resolution, resolution)


def _coverage(
    p: Prepared,
    state_index: int,
    mesh: LabelledMesh,
    fields: fusion.PosedFields,
    occupancy: dict[int, NDArray[np.uint8]],
) -> dict[int, NDArray[np.uint8]]:
    """The share of each cell that is inside, x 255, for each grid; none unless the recipe asks.

    Sub-samples of the finest grid serve every coarser one that divides it.
    """
    if not p.recipe.sampling.coverage:
        return {}
    coverage, counted = {}, {}
    finest = max(occupancy, default=1)
    for r in sorted(occupancy, reverse=True):
        base = finest if finest % r == 0 else r
        if base not in counted:
            counted[base] = sampling.solid_counts(
                occupancy[base] != FREE,
                fusion.touched(mesh, base) > 0,
                lambda points: fields.labels(points) != FREE,
                rng=p.rng(state_index, "coverage", base),
            )
        counts, most = counted[base]
        k = base // r
        inside = counts.reshape(r, k, r, k, r, k).sum(axis=(1, 3, 5))
        coverage[r] = ((2 * 255 * inside + most * k**3) // (2 * most * k**3)).astype(np.uint8)
    return coverage


def _joint_fields(p: Prepared, state_index: int) -> dict[str, NDArray]:
    """What describes the joints; lengths in the unit frame."""
    state = p.states[state_index]
    posed = articulation.forward_kinematics(p.obj, state)
    joints = p.obj.moving_joints
    part_of_link = dict(zip((link.name for link in p.obj.links), p.obj.part_of_link, strict=True))
    length = np.array([p.unit.scale if j.kind == JointKind.PRISMATIC else 1.0 for j in joints])
    return {
        "joint_kind": np.array([j.kind.stored for j in joints], np.uint8),
        "joint_parent": np.array([part_of_link[j.parent] for j in joints], np.uint8),
        "joint_state": state.q / length,
        "joint_lower": np.array([j.lower for j in joints]) / length,
        "joint_upper": np.array([j.upper for j in joints]) / length,
        "joint_axis": posed.axes,
        "joint_pivot": p.unit.to_unit(posed.pivots),
    }


def _names(obj: ArticulatedObject) -> tuple[tuple[str, ...], ...]:
    """Return (J,) names of the joints, (P,) names and (P,) semantics of each part's first link."""
    joints = obj.moving_joints
    first = [obj.links[0], *(obj.links[obj.link_index[joint.child]] for joint in joints)]
    return (
        tuple(stored_name(joint.name) for joint in joints),
        tuple(stored_name(link.name) for link in first),
        tuple(stored_name(link.semantic) for link in first),
    )


def _surface(
    p: Prepared, state_index: int, mesh: LabelledMesh, fields: fusion.PosedFields
) -> sampling.SurfacePoints:
    """Surface points: those that are stored, and enough to draw near points around."""
    count = max(p.recipe.sampling.surface_points, FEWEST_SURFACE_POINTS)
    rng = p.rng(state_index, "surface")

    def is_free(points: Floats, face: NDArray[np.intp]) -> NDArray[np.bool_]:
        return fields.is_free_before(points, mesh.part_of_face[face])

    return sampling.surface_points(mesh, p.seen, is_free, count, rng=rng)


def _surface_fields(p: Prepared, surface: sampling.SurfacePoints) -> dict[str, NDArray]:
    stored = slice(p.recipe.sampling.surface_points)
    return {
        "surface_points": quantize(surface.points[stored]),
        "surface_normals": np.round(surface.normals[stored] * 127.0).astype(np.int8),
        "surface_part": surface.part[stored],
    }


def _query_fields(
    p: Prepared,
    state_index: int,
    surface: sampling.SurfacePoints,
    sharp: sampling.SurfacePoints | None,
    fields: fusion.PosedFields,
) -> dict[str, NDArray]:
    """Query points are rounded to what is stored first, so that their labels are exact."""
    wanted = p.recipe.sampling
    uniform = sampling.uniform_points(wanted.uniform_points, rng=p.rng(state_index, "uniform"))
    rng = p.rng(state_index, "near")
    around = _around(surface, sharp, wanted)
    near = sampling.near_points(around, wanted.near_points, wanted.near_sigma, rng=rng)
    stored = {"uniform": quantize(uniform), "near": quantize(near)}
    points = {f"{name}_points": points for name, points in stored.items()}
    labels = {f"{n}_label": fields.labels(dequantize(points)) for n, points in stored.items()}
    found = points | labels
    if p.extras.visible is not None:
        for n, points in stored.items():
            far = fusion.distances(
                dequantize(points), p.extras.visible, fields.part_motion, wanted.signed_distance
            )
            found[f"{n}_distance"] = np.where(labels[f"{n}_label"] == FREE, far, -far)
    return found


def _partial_fields(p: Prepared, state_index: int, mesh: LabelledMesh) -> dict[str, NDArray]:
    wanted = p.recipe.sampling
    rng = p.rng(state_index, "partial")
    views = random_pinhole_views(
        wanted.partial_views, wanted.partial_resolution, bounds(mesh.vertices), rng=rng
    )
    maps = _backend(p.recipe).render_parts(mesh, views, closed=p.closed)
    clouds = sampling.partial_clouds(
        maps, mesh.part_of_face, wanted.partial_points, wanted.depth_noise, rng=rng
    )
    return {
        "partial_points": quantize(clouds.points),
        "partial_part": clouds.part,
        "partial_T_camera_world": views.T_camera_world,
        "partial_intrinsics": np.stack([views.fx, views.fy, views.cx, views.cy], axis=1),
    }


def _around(
    surface: sampling.SurfacePoints, sharp: sampling.SurfacePoints | None, wanted: Sampling
) -> Floats:
    """What near points lie around: points of the surface, and then of sharp edges."""
    if sharp is None or not wanted.near_sharp:
        return surface.points
    edges = round(wanted.near_sharp * wanted.near_points)
    plain = np.arange(wanted.near_points - edges) % len(surface.points)
    at_edges = np.arange(edges) % len(sharp.points)
    return np.concatenate([surface.points[plain], sharp.points[at_edges]])


def _sharp(
    p: Prepared, state_index: int, surface: sampling.SurfacePoints, fields: fusion.PosedFields
) -> sampling.SurfacePoints | None:
    """Points on sharp edges, where the recipe asks for them."""
    if p.extras.edges is None:
        return None
    return sharp_points(
        p.extras.edges.moved(fields.part_motion),
        fields.is_free_before,
        p.recipe.sampling.sharp_points,
        surface,
        rng=p.rng(state_index, "sharp"),
    )


def _sharp_fields(sharp: sampling.SurfacePoints | None) -> dict[str, NDArray]:
    if sharp is None:
        return {}
    return {
        "sharp_points": quantize(sharp.points),
        "sharp_normals": np.round(sharp.normals * 127.0).astype(np.int8),
        "sharp_part": sharp.part,
    }


def _collision_depth(p: Prepared, fields: fusion.PosedFields) -> float | None:
    colliding = p.extras.colliding
    return None if colliding is None else float(colliding.depths(fields.material).max())


def _image_fields(p: Prepared, mesh: LabelledMesh) -> dict[str, NDArray]:
    views = p.extras.cameras
    if views is None:
        return {}
    drawn = images(mesh, views, p.recipe.images.fields, closed=p.closed)
    return {f"image_{name}": image for name, image in drawn.items()} | {
        "image_T_camera_world": views.T_camera_world,
        "image_intrinsics": np.stack([views.fx, views.fy, views.cx, views.cy], axis=1),
    }
