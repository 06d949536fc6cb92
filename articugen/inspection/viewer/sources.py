"""Sources of the viewer: a shard, a data set, a model or a folder of models."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from articugen.core.errors import ArticugenError, InvalidSource, NotOfCategory
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
from articugen.store.shards import open_shard


class Source(Protocol):
    """Objects to view.

    Attributes:
        title: where they come from.
        objects: their ids.
    """

    title: str
    objects: Sequence[str]

    def shown(self, object_id: str) -> Shown:
        """Show one of them; ArticugenError if it cannot be read, or nothing can be made of it."""
        ...


class StoredObjects:
    """The objects of a data set, in the order of its shards."""

    def __init__(self, data: DataSet) -> None:
        self.title, self._data = str(data.path), data
        self.objects: Sequence[str] = [name for name, _ in data.by_object()]
        if not self.objects:
            raise InvalidSource(f"{data.path}: holds no instance; make some with generate")

    def shown(self, object_id: str) -> Shown:
        (path, *_) = self._data.of(object_id).shards
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
            maker = self._maker(path, object_id)
        except ArticugenError as error:
            why = str(error)
        joints = _joints_of_maker(maker) if maker else _joints_of_instance(first)
        return Shown(
            object_id, joints, states, read,
            image_size=self._recipe.sampling.partial_resolution, split=split, maker=maker, why=why,
        )  # fmt: skip

    @cached_property
    def _recipe(self) -> Recipe:
        return self._data.recipe

    def _maker(self, shard: Path, object_id: str) -> Maker:
        """Return what makes more states, if the source is what it was; else ArticugenError."""
        manifest = self._data.manifest
        if manifest is None and (shard.parent / MANIFEST_NAME).is_file():
            beside = Manifest.read(shard.parent)
            manifest = beside if shard.name in {s.name for s in beside.shards} else None
        if manifest is None:
            raise InvalidSource(f"{shard.parent}: has no {MANIFEST_NAME} that names the source")
        obj, settings = again.source_again(manifest, object_id)
        model = Model(obj, settings.canonical, tuple(settings.movable))
        recipe = Recipe.model_validate_json(manifest.recipe)
        return Maker(model, recipe.for_one_object(), manifest.seed)


def _joints_of_maker(maker: Maker) -> list[Joint]:
    return [
        Joint(
            joint.name,
            joint.kind.stored,
            min(joint.lower, 0.0),
            max(joint.upper, 0.0),
            joint.mimic.joint if joint.mimic else "",
        )
        for joint in maker.joints
    ]


def _joints_of_instance(instance: Instance) -> list[Joint]:
    names = instance.joint_name or ("",) * len(instance.joint_kind)
    joints = []
    for j, name in enumerate(names):
        kind = JointKind(int(instance.joint_kind[j]))
        length = instance.scale if kind == JointKind.PRISMATIC else 1.0
        lower, upper = instance.joint_lower[j] * length, instance.joint_upper[j] * length
        joints.append(Joint(name, kind, min(float(lower), 0.0), max(float(upper), 0.0)))
    return joints


class ModelObjects:
    """Models as a source gives them, and what `generate` would make of them."""

    def __init__(
        self, source: str, category: str | None = None, recipe: str | None = None, seed: int = 0
    ) -> None:
        self.title, self._recipe, self._seed = source, recipe, seed
        refs = models(source, category)
        self._category = refs[0].category
        self.objects: Sequence[str] = [ref.object_id for ref in refs]
        self._source = source

    def shown(self, object_id: str) -> Shown:
        model = load(self._source, object_id, category=self._category)
        try:
            maker = Maker(model, self._recipe, self._seed)
        except NotOfCategory as error:
            raise NotOfCategory(f"{object_id}: {error}") from None
        return Shown(
            object_id,
            _joints_of_maker(maker),
            np.array([state.q for state in maker.prepared.states]),
            lambda state: maker[state].instance,
            image_size=maker.recipe.sampling.partial_resolution,
            maker=maker,
        )


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
        return StoredObjects(open_data_set(place))
    if not place.exists() and path not in source_files():
        raise InvalidSource(
            f"{path}: there is no such shard, folder, URDF or source; correct its path"
        )
    return ModelObjects(path, category, recipe, seed)
