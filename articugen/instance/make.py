"""One instance: the order of the stages, as a story.

`preparing.prepare` makes what all instances of an object share, `make_instance` makes one of them.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen import fusion
from articugen.core.arrays import Bools, Bytes, Floats, Indices
from articugen.core.backends import backend_named
from articugen.core.geometry import bounds
from articugen.core.records import FREE, JointKind, LabelledMesh, dequantize, is_material, quantize
from articugen.core.schema import Instance
from articugen.instance import articulation, sampling
from articugen.instance.preparing import Grid, Prepared, names_of, pose
from articugen.instance.sharp import sharp_points
from articugen.rendering.images import images
from articugen.rendering.views import random_pinhole_views

FEWEST_SURFACE_POINTS = 1024  # drawn even where fewer are stored: near points are drawn around them


def make_instance(p: Prepared, state_index: int) -> Instance:
    """Return the instance of the object at its `state_index`-th joint state.

    Raises:
        RejectedInstance: nothing of it can be seen.
    """
    mesh, fields = pose(p, state_index, overlay=p.overlay)
    surface = _surface(p, state_index, mesh, fields)
    wanted, sharp, colliding = p.recipe.sampling, None, p.extras.colliding
    if p.extras.edges is not None:
        edges = p.extras.edges.moved(fields.part_motion)
        rng = p.rng(state_index, "sharp")
        sharp = sharp_points(edges, fields.is_free_before, wanted.sharp_points, surface, rng=rng)
    joint_name, part_name, part_semantic = names_of(p.obj)
    occupancy = {r: _labelled_grid(grid, fields, r) for r, grid in p.grids.items()}
    return Instance(
        object_id=p.obj.object_id, state_index=state_index,
        center=p.unit.center, scale=p.unit.scale, **_joint_fields(p, state_index),
        joint_name=joint_name, part_name=part_name, part_semantic=part_semantic,
        part_motion=fields.part_motion, occupancy=occupancy,
        coverage=_coverage(p, state_index, mesh, fields, occupancy) if wanted.coverage else {},
        **_sampled_fields("surface", surface, wanted.surface_points),
        surface_color=_surface_color(p, surface, fields) if wanted.surface_color else None,
        **_query_fields(p, state_index, surface, sharp, fields),
        **(_sampled_fields("sharp", sharp, wanted.sharp_points) if sharp else {}),
        collision_depth=colliding and float(colliding.depths(fields.material).max()),
        **_image_fields(p, mesh, fields),
        **_partial_fields(p, state_index, mesh),
    )  # fmt: skip


def _labelled_grid(grid: Grid, fields: fusion.PosedFields, resolution: int) -> Bytes:
    """Return the labels of all voxels, by what is known of them in every pose."""
    label = grid.fixed.copy()
    material = fields.material
    for part in reversed(range(1, len(material.own))):  # where they overlap the first one counts
        inside = material.holds(part, grid.points, grid.within(material.box(part)))
        label[inside] = part + 1
    label = fields.with_enclosed(grid.points, label)
    return label.reshape(resolution, resolution, resolution)


def _coverage(
    p: Prepared,
    state_index: int,
    mesh: LabelledMesh,
    fields: fusion.PosedFields,
    occupancy: dict[int, Bytes],
) -> dict[int, Bytes]:
    """Return the share of each cell that is inside, x 255, for each grid.

    Sub-samples of the finest grid serve every coarser one that divides it.
    """
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
    """Return the fields that describe the joints; lengths in the unit frame."""
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


def _surface(
    p: Prepared, state_index: int, mesh: LabelledMesh, fields: fusion.PosedFields
) -> sampling.SurfacePoints:
    """Surface points: those that are stored, and enough to draw near points around."""
    count = max(p.recipe.sampling.surface_points, FEWEST_SURFACE_POINTS)
    rng = p.rng(state_index, "surface")

    def is_free(points: Floats, face: Indices) -> Bools:
        return fields.is_free_before(points, mesh.part_of_face[face])

    return sampling.surface_points(mesh, p.seen, is_free, count, rng=rng)


def _sampled_fields(
    stem: str, sampled: sampling.SurfacePoints, count: int
) -> dict[str, NDArray[Any]]:
    """Return the first `count` points as they are stored, in the fields of that stem."""
    return {
        f"{stem}_points": quantize(sampled.points[:count]),
        f"{stem}_normals": np.round(sampled.normals[:count] * 127.0).astype(np.int8),
        f"{stem}_part": sampled.part[:count],
    }


def _surface_color(
    p: Prepared, surface: sampling.SurfacePoints, fields: fusion.PosedFields
) -> Bytes:
    assert p.extras.paint is not None
    n = p.recipe.sampling.surface_points
    shown = surface.face[:n], surface.points[:n], surface.part[:n]
    return p.extras.paint.at(*shown, fields.part_motion)


def _query_fields(
    p: Prepared,
    state_index: int,
    surface: sampling.SurfacePoints,
    sharp: sampling.SurfacePoints | None,
    fields: fusion.PosedFields,
) -> dict[str, NDArray]:
    """Query points are rounded to what is stored first, so that their labels are exact."""
    wanted = p.recipe.sampling
    uniform = p.rng(state_index, "uniform").random((wanted.uniform_points, 3)) - 0.5
    rng, around = p.rng(state_index, "near"), surface.points
    if sharp is not None and wanted.near_sharp:  # around the surface, and then around sharp edges
        edges = round(wanted.near_sharp * wanted.near_points)
        plain = np.arange(wanted.near_points - edges) % len(surface.points)
        at_edges = np.arange(edges) % len(sharp.points)
        around = np.concatenate([surface.points[plain], sharp.points[at_edges]])
    near = sampling.near_points(around, wanted.near_points, wanted.near_sigma, rng=rng)
    stored = {"uniform": quantize(uniform), "near": quantize(near)}
    points = {f"{name}_points": points for name, points in stored.items()}
    labels = {f"{n}_label": fields.labels(dequantize(points)) for n, points in stored.items()}
    together = points | labels
    if p.extras.ends is not None:
        ends, still = fusion.posed_ends(p.extras.ends, fields.material), np.eye(4)[None]
        for n, points in stored.items():
            far = fusion.distances(dequantize(points), ends, still, wanted.signed_distance)
            together[f"{n}_distance"] = np.where(is_material(labels[f"{n}_label"]), -far, far)
    return together


def _partial_fields(p: Prepared, state_index: int, mesh: LabelledMesh) -> dict[str, NDArray]:
    wanted = p.recipe.sampling
    rng = p.rng(state_index, "partial")
    views = p.extras.sensors or random_pinhole_views(
        wanted.partial_views, wanted.partial_resolution, bounds(mesh.vertices), rng=rng
    )
    maps = backend_named(p.recipe.views.backend).render_parts(mesh, views, closed=p.closed)
    points, part = sampling.partial_clouds(maps, mesh.part_of_face, wanted, rng=rng)
    return {
        "partial_points": quantize(points),
        "partial_part": part,
        "partial_T_camera_world": views.T_camera_world,
        "partial_intrinsics": views.intrinsics,
    }


def _image_fields(
    p: Prepared, mesh: LabelledMesh, fields: fusion.PosedFields
) -> dict[str, NDArray]:
    views = p.extras.cameras
    if views is None:
        return {}
    wanted = p.recipe.images
    paint = p.extras.paint if wanted.colours == "model" else None

    def colours(face: Indices, points: Floats) -> Bytes:
        assert paint is not None
        return paint.at(face, points, mesh.part_of_face[face], fields.part_motion)

    drawn = images(mesh, views, wanted.fields, closed=p.closed, colours=paint and colours)
    return {f"image_{name}": image for name, image in drawn.items()} | {
        "image_T_camera_world": views.T_camera_world,
        "image_intrinsics": views.intrinsics,
    }
