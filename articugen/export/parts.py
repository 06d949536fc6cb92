"""The parts of a data set's objects, canonical pose: boxes and watertight meshes in the unit frame,
joints in metres.

A shard holds samples, no surface. So a part's mesh comes from the part's own solid, made again from
its model as `verify --replay` does; or, where that cannot be, from the finest grid that is stored.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import ArticugenError, RejectedInstance
from articugen.core.geometry import apply, bounds, invert_rigid
from articugen.core.records import Mesh
from articugen.export.items import LeftOut, Options, canonical
from articugen.meshes.marching_cubes import zero_level
from articugen.meshes.painting import Look
from articugen.pictures.layout import png_of
from articugen.store.dataset import DataSet
from articugen.store.rows import Row, RowJoint

_WITHIN = 1e-4  # of the surface that was extracted, unit frame: finer than that is exact


class PartSolid(NamedTuple):
    """A part's watertight mesh, and the closed ones that its model consists of, unit frame."""

    mesh: Mesh
    closed: tuple[Mesh, ...] = ()


def part_solids(rows: DataSet, options: Options, *, colours: bool = False) -> tuple[PartSolid, ...]:
    """Make the solid of each part of the rows' object, part 0 first; with the `colours` and
    pictures of the model, where it states some and is read.

    Raises:
        LeftOut: a part has no voxel; or the canonical pose is not there.
        ArticugenError: the model cannot be made again; see `again.prepared_again`.
    """
    if options.from_grids:
        return tuple(map(PartSolid, _from_grid(canonical(rows))))
    from articugen.instance import again  # noqa: PLC0415 - the stages take a second

    object_id = rows[0].object_id
    try:
        if rows.manifest is None:
            raise ArticugenError(f"{rows.path}: has no manifest, so its models cannot be found")
        prepared = again.prepared_again(rows.manifest, object_id, colours=colours)
    except ArticugenError as error:
        raise ArticugenError(
            f"{error}; or take the parts from the stored grids, with --from-grids"
        ) from error
    try:
        meshes = again.part_meshes(prepared, options.resolution, within=_WITHIN, colours=colours)
        return tuple(
            PartSolid(mesh, again.closed_meshes(prepared, part)) for part, mesh in enumerate(meshes)
        )
    except RejectedInstance as error:
        raise LeftOut(f"{object_id}: {error}") from error


def picture_of(look: Look) -> bytes:
    """Return the picture of faces as a PNG, b"" where they are in one colour."""
    return b"" if look.picture is None else png_of(look.picture)


def _from_grid(row: Row) -> Iterator[Mesh]:
    if not row.grids:
        raise LeftOut(f"{row.object_id}: no occupancy grid is stored")
    resolution = max(row.grids)
    label = row.grids[resolution]
    for part in range(len(row.parts)):
        inside = label == part + 1
        if not inside.any():
            raise LeftOut(f"{row.object_id}: part {part} has no voxel in the {resolution}^3 grid")
        yield zero_level(np.where(inside, 1.0, -1.0))


def part_boxes(rows: DataSet) -> Floats:
    """Return (P, 2, 3) boxes of an object's parts in the canonical pose: of all stored points on
    them and in their material, brought back from every state, so that what a shut drawer hides
    counts.

    Raises:
        LeftOut: no point is on or in a part.
    """
    boxes = np.array([[[np.inf] * 3, [-np.inf] * 3]] * len(rows[0].parts))
    for row in rows:
        clouds = [(row.surface.points, row.surface.part), (row.partial.points, row.partial.part)]
        clouds += [(g.points, g.label - np.uint8(1)) for g in (row.uniform, row.near)]
        points = np.concatenate([points.reshape(-1, 3) for points, _ in clouds])
        part = np.concatenate([part.ravel() for _, part in clouds])
        for k, box in enumerate(boxes):
            of_it = points[part == k]
            if len(of_it):
                low, high = bounds(apply(invert_rigid(row.parts[k].motion), of_it))
                box[:] = np.minimum(box[0], low), np.maximum(box[1], high)
    for k in np.flatnonzero(boxes[:, 0, 0] > boxes[:, 1, 0]):
        raise LeftOut(
            f"{rows[0].object_id}: no stored point is on or in part {k}, so that its size is "
            "unknown; leave the object out of the data"
        )
    return boxes


def metric_joints(row: Row) -> tuple[RowJoint, ...]:
    """Return the joints of an object in the world frame, from its canonical pose, where all states
    are 0: named as in the model's file or by a made-up name, none twice, pivots in metres.

    The range is that of the data, widened to the canonical pose where that lies outside.
    """
    names = unique(joint.name or f"joint_{joint.part}" for joint in row.joints)
    return tuple(
        replace(
            joint,
            name=name,
            pivot=row.to_metres(joint.pivot),
            axis=np.asarray(joint.axis) / np.linalg.norm(joint.axis),
            lower=min(joint.lower, 0.0),
            upper=max(joint.upper, 0.0),
        )
        for name, joint in zip(names, row.joints, strict=True)
    )


def part_names(row: Row) -> tuple[str, ...]:
    """Name each part, no name twice."""
    return unique(part.name or f"part_{k}" for k, part in enumerate(row.parts))


def unique(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names, but those that were there before with a number behind; no control
    characters."""
    taken: set[str] = set()
    unlike = []
    for name in names:
        plain = "".join(c if c.isprintable() else "_" for c in name)
        number, chosen = 2, plain
        while chosen in taken:
            number, chosen = number + 1, f"{plain}_{number}"
        taken.add(chosen)
        unlike.append(chosen)
    return tuple(unlike)
