"""Sources of the viewer: a shard, a data set, a model or a folder of models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from articugen.core import records
from articugen.core.errors import ArticugenError, InvalidArgument, InvalidSource, NotOfCategory
from articugen.core.recipe import Recipe
from articugen.core.records import JointKind
from articugen.core.schema import Instance
from articugen.inspection.viewer.shown import Joint, Shown
from articugen.instance import again
from articugen.instance.maker import Maker, Model, load, models
from articugen.sources.source_file import source_files
from articugen.store.dataset import DataSet
from articugen.store.dataset import open as open_data_set
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.rows import RowJoint
from articugen.store.shards import open_shard


@dataclass(frozen=True, eq=False)
class Source:
    """Objects to view.

    Attributes:
        title: where they come from.
        objects: their ids.
        shown: shows one of them; ArticugenError if it cannot be read, or nothing can be made of it.
    """

    title: str
    objects: Sequence[str]
    shown: Callable[[str], Shown]


def _shown_as_stored(data: DataSet, object_id: str) -> Shown:
    its = data.of(object_id)
    path = its.shards[0]
    with open_shard(path) as shard:
        order = shard.read("state_index")
        rows = [row for row, name in enumerate(shard.object_ids()) if name == object_id]
        rows.sort(key=lambda row: int(order[row]))
        first = shard.instance(rows[0])
        length = np.where(first.joint_kind == JointKind.PRISMATIC, first.scale, 1.0)
        states = shard.read("joint_state")[rows] * length
        split = str(shard.attributes["split"])

    def read(state: int) -> Instance:
        with open_shard(path) as shard:
            return shard.instance(rows[state])

    maker, why = None, ""
    try:
        maker = _maker(data, path, object_id)
    except ArticugenError as error:
        why = str(error)
    stored = [_joint(joint, JointKind[joint.kind.upper()]) for joint in its[0].joints]
    return Shown(
        object_id, _joints_of(maker) if maker else stored, states, read,
        image_size=data.recipe.sampling.partial_resolution, split=split, maker=maker, why=why,
    )  # fmt: skip


def _maker(data: DataSet, shard: Path, object_id: str) -> Maker:
    """Return what makes more states, if the source is what it was; else ArticugenError."""
    manifest = data.manifest
    if manifest is None and (shard.parent / MANIFEST_NAME).is_file():
        beside = Manifest.read(shard.parent)
        manifest = beside if shard.name in {s.name for s in beside.shards} else None
    if manifest is None:
        raise InvalidSource(f"{shard.parent}: has no {MANIFEST_NAME} that names the source")
    obj, ref = again.source_again(manifest, object_id)
    model = Model(obj, ref.settings.canonical, tuple(ref.settings.movable))
    recipe = Recipe.model_validate_json(manifest.recipe)
    return Maker(model, recipe.for_one_object(), manifest.seed)


def _joints_of(maker: Maker) -> list[Joint]:
    return [_joint(j, j.kind.stored, j.mimic.joint if j.mimic else "") for j in maker.joints]


def _joint(joint: RowJoint | records.Joint, kind: JointKind, follows: str = "") -> Joint:
    return Joint(joint.name, kind, min(joint.lower, 0.0), max(joint.upper, 0.0), follows)


def _modelled(source: str, category: str | None, recipe: str | None, seed: int) -> Source:
    """Return models as a source gives them, and what `generate` would make of them."""
    refs = models(source, category)

    def shown(object_id: str) -> Shown:
        model = load(source, object_id, category=refs[0].category)
        try:
            maker = Maker(model, recipe, seed)
        except NotOfCategory as error:
            raise NotOfCategory(f"{object_id}: {error}") from None
        return Shown(
            object_id,
            _joints_of(maker),
            np.array([state.q for state in maker.prepared.states]),
            lambda state: maker[state].instance,
            image_size=maker.recipe.sampling.partial_resolution,
            maker=maker,
        )

    return Source(source, [ref.object_id for ref in refs], shown)


def source_of(
    path: str, *, category: str | None = None, recipe: str | None = None, seed: int = 0
) -> Source:
    """Return the source to show: a shard, a data set's folder, a model, a folder of them or a
    source's name.

    Args:
        category, recipe, seed: of models: what they are, and how instances are made.

    Raises:
        ArticugenError: there is no such thing, or it cannot be read.
    """
    place = Path(path)
    patterns = (MANIFEST_NAME, "*.h5", f"*/{MANIFEST_NAME}")
    if place.suffix == ".h5" or any(match for pattern in patterns for match in place.glob(pattern)):
        if category or recipe or seed:
            raise InvalidArgument(f"{path} is a data set: no --category, --recipe or --seed")
        data = open_data_set(place)
        if not data.objects:
            raise InvalidSource(f"{data.path}: holds no instance; make some with generate")
        return Source(str(data.path), data.objects, partial(_shown_as_stored, data))
    if not place.exists() and path not in source_files():
        raise InvalidSource(
            f"{path}: there is no such shard, folder, URDF or source; correct its path"
        )
    return _modelled(path, category, recipe, seed)
