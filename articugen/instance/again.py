"""Objects read from a source, and those of a data set made again from it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from articugen.core.arrays import Bytes
from articugen.core.errors import ArticugenError, InvalidArgument, InvalidSource, RejectedInstance
from articugen.core.files import check_place
from articugen.core.geometry import apply
from articugen.core.recipe import Recipe
from articugen.core.records import ArticulatedObject, LabelledMesh, Mesh, ResolvedObject
from articugen.fusion import SOLIDS, PosedSolids, closed_piece, face_areas, welded
from articugen.fusion.isosurface import extract_mesh
from articugen.instance import articulation
from articugen.instance.preparing import Prepared, pose, prepare
from articugen.meshes.distances import nearest
from articugen.meshes.mesh_file import check_format, export
from articugen.meshes.painting import coloured_like, laid_like, settled
from articugen.meshes.simpler import simpler, united
from articugen.sources import readers
from articugen.sources.refs import CategorySettings, ObjectRef
from articugen.sources.source import open_source
from articugen.store.manifest import Manifest

OF = (*SOLIDS, "part")
"""What a mesh may be of."""


def resolved(ref: ObjectRef, recipe: Recipe) -> ResolvedObject:
    """Read a model and settle which of its joints move, how far, and from which pose on.

    Raises:
        InvalidSource: it cannot be read; the sentence says why.
        NotOfCategory: nothing of it moves in the recipe's sense.
    """
    return _resolved(readers.load(ref, colours=recipe.shows_colours), ref.settings, recipe)


def _resolved(obj: ArticulatedObject, settings: CategorySettings, recipe: Recipe) -> ResolvedObject:
    choice = {"canonical": settings.canonical, "movable": settings.movable}
    return articulation.resolve(obj, recipe.articulation, **choice)


def source_again(
    manifest: Manifest, object_id: str, *, colours: bool = False
) -> tuple[ArticulatedObject, ObjectRef]:
    """Return the model that an object of the data set was made of, with its `colours` even where
    the data have none, and its reference.

    Raises:
        ArticugenError: no such object; its source is gone or has changed; other code made it.
    """
    entry = next((o for o in manifest.objects if o.key.object_id == object_id), None)
    if entry is None:
        raise InvalidSource(
            f"no object {object_id!r} in this data set; articugen inspect names some"
        )
    ref = open_source(manifest.source).find(manifest.category, object_id)
    same_code = entry.key.model_copy(update={"generator": ref.generator_by(manifest.recipe)})
    changed = same_code.difference(entry.key)
    if changed:
        raise ArticugenError(f"{object_id}: {changed}; only such a version can make it again")
    recipe = Recipe.model_validate_json(manifest.recipe)
    obj = readers.load(ref, colours=colours or recipe.shows_colours)
    unseen = colours and not recipe.shows_colours  # then files of colours count in no digest
    if (readers.digest(ref) if unseen else obj.sha256) != entry.input_sha256:
        raise InvalidSource(f"{object_id}: its files under {ref.location} have changed since")
    return obj, ref


def prepared_again(manifest: Manifest, object_id: str, *, colours: bool = False) -> Prepared:
    """Make again what the instances of one object of the data set share; see `source_again`. With
    `colours` its `extras` have them where the model, or we for a bundled one, state some."""
    recipe = Recipe.model_validate_json(manifest.recipe)
    obj, ref = source_again(manifest, object_id, colours=colours)
    if colours:
        stated = ref.is_made or any(link.mesh.colours is not None for link in obj.links)
        sampling = recipe.sampling.model_copy(update={"surface_color": stated})
        images = recipe.images.model_copy(update={"colours": "parts"})
        recipe = recipe.model_copy(update={"sampling": sampling, "images": images})
    return prepare(_resolved(obj, ref.settings, recipe), recipe.for_one_object(), manifest.seed)


def write_meshes(
    folder: Path, object_id: str, state_index: int, resolution: int, path: Path, of: str
) -> dict[Path, int]:
    """Write watertight meshes of one instance, unit frame: of its material, of that and the space
    that no view sees, or of each `part` <name>_<part>; files and the numbers of their faces.

    Raises:
        InvalidArgument: `of` is none of OF.
        ArticugenError: as `prepared_again`; no such state; a file cannot be written.
    """
    if of not in OF:
        raise InvalidArgument(f"a mesh is of {', '.join(OF[:-1])} or {OF[-1]}, not {of!r}")
    check_format(path)
    check_place(path)
    prepared = prepared_again(Manifest.read(folder), object_id)
    if state_index >= len(prepared.states):
        raise ArticugenError(f"{object_id} has the states 0 to {len(prepared.states) - 1}")
    if of == "part":
        motion = prepared.material(prepared.states[state_index]).part_motion
        alone = list(part_meshes(prepared, resolution))
        meshes = {
            path.with_stem(f"{path.stem}_{k}"): Mesh(apply(motion[k], mesh.vertices), mesh.faces)
            for k, mesh in enumerate(alone)
        }
    else:
        meshes = {path: extract_mesh(pose(prepared, state_index)[1].solid(of), resolution)}
    for place, mesh in meshes.items():
        export(mesh, place)
    return {place: len(mesh.faces) for place, mesh in meshes.items()}


def part_meshes(
    prepared: Prepared, resolution: int, *, within: float = 0.0, colours: bool = False
) -> Iterator[Mesh]:
    """Yield each part's own solid, watertight, canonical pose, unit frame; or RejectedInstance. In
    the `colours` and pictures of the faces that it is of, if it is prepared with some.

    Of a part all of whose faces belong to closed pieces it is their union, which is exact; of
    another the zero level of its field. With fewer faces if it may lie `within` so much of that."""
    whole, paint = prepared.mesh, prepared.extras.paint if colours else None
    for part in range(len(prepared.own)):
        its = whole.part_of_face == part
        if paint is None:
            mesh, _ = _part_mesh(prepared, part, resolution, None)
            yield simpler(mesh, within) if within else mesh
            continue
        texture = paint.texture and paint.texture.of(its)
        area = face_areas(whole.vertices, whole.faces[its])
        some, texture = settled(paint.flat[its], texture, area)
        mesh, is_exact = _part_mesh(prepared, part, resolution, some)
        faces = whole.vertices[whole.faces[its]]
        if is_exact:  # each of its faces is in one of the part's
            mesh = replace(mesh, colours=some[nearest(mesh.triangles.mean(axis=1), faces)[1]])
        else:
            mesh = coloured_like(mesh, faces, some)
        mesh = simpler(mesh, within) if within else mesh
        yield laid_like(mesh, paint.corners[its], some, texture) if texture else mesh


def _part_mesh(
    prepared: Prepared, part: int, resolution: int, colours: Bytes | None
) -> tuple[Mesh, bool]:
    """Return the mesh of a part, and whether it is the union of closed pieces, each in one of the
    `colours` of the part's faces."""
    solid, count = prepared.own[part], (prepared.mesh.part_of_face == part).sum()
    closed = closed_meshes(prepared, part, colours) if solid.closed else ()
    if sum(len(piece.faces) for piece in closed) == count and (exact := united(closed)):
        return exact, True
    alone = PosedSolids((solid,), np.eye(4)[None], prepared.recipe.fusion)
    try:
        return extract_mesh(alone, resolution), False
    except RejectedInstance as error:
        raise RejectedInstance(f"part {part}: {error}") from None


def closed_meshes(prepared: Prepared, part: int, colours: Bytes | None = None) -> tuple[Mesh, ...]:
    """Return the closed pieces of which a part is modelled, canonical pose, unit frame, in the
    `colours` of the part's faces."""
    whole = prepared.mesh
    its = whole.part_of_face == part
    alone = LabelledMesh(whole.vertices, whole.faces[its], whole.part_of_face[its])
    number, place = closed_piece(alone), welded(alone.vertices)
    corner = alone.vertices[np.unique(place, return_index=True)[1]]
    meshes = []
    for piece in np.unique(number[number >= 0]):
        used, faces = np.unique(place[alone.faces[number == piece]], return_inverse=True)
        some = None if colours is None else colours[number == piece]
        meshes.append(Mesh(corner[used], faces.reshape(-1, 3).astype(np.int32), some))
    return tuple(meshes)
