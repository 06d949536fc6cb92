"""How far stored labels agree with the exact solids of the bundled objects.

The solids are read from `solids.json` beside an object's URDF, and moved by the stored motions of
its parts, so that a wrong `part_motion` shows as well. No stage of the pipeline takes part but the
one that says where links stand in the canonical pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from articugen.core.arrays import Bools, Floats
from articugen.core.errors import ArticugenError
from articugen.core.geometry import fibonacci_sphere
from articugen.core.portable import product
from articugen.core.recipe import Recipe
from articugen.core.records import Normalization, ResolvedObject, dequantize, is_material
from articugen.core.schema import Instance
from articugen.inspection.report.facts import ObjectFacts
from articugen.instance import articulation
from articugen.instance.again import resolved
from articugen.pictures.contact_sheet import evenly
from articugen.procedural.truth import Truth, truth_of
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source
from articugen.store.manifest import Manifest
from articugen.store.shards import open_shard

OBJECTS, STATES = 4, 2
"""Objects of a data set, and instances of each, that are compared with their solids."""

SIGHTS = 2000
"""A place that no solid holds counts as sealed inside of a part where none of this many lines of
sight leads out of that part."""

BEHIND = 1e-4
"""From a surface point to what is certainly inside, ten times the rounding of what is stored."""


@dataclass(frozen=True)
class Agreement:
    """Counts over instances; a pair is (both, either) or (right, asked).

    Attributes:
        uniform, near: points labelled as material, and in the exact solids.
        part: points in just one part, labelled as material, and those with that part's label.
        surface: surface points with their own part's solid right behind them, and all.
    """

    object_id: str
    state_index: int
    uniform: tuple[int, int]
    near: tuple[int, int]
    part: tuple[int, int]
    surface: tuple[int, int]


@dataclass(frozen=True)
class Measured:
    """Measures, or in one sentence why there are none."""

    instances: tuple[Agreement, ...]
    why_not: str = ""

    def total(self, name: str) -> float:
        """Return the share of "uniform", "near", "part" or "surface", over all instances
        together."""
        one, other = np.sum([getattr(instance, name) for instance in self.instances], axis=0)
        return float(one / max(other, 1))

    def worst(self, name: str) -> float:
        """Return the least share of any instance."""
        pairs = (getattr(instance, name) for instance in self.instances)
        return min(one / max(other, 1) for one, other in pairs)


def measured(objects: Sequence[ObjectFacts], manifest: Manifest | None) -> Measured:
    """Some instances against the exact solids, where the data set is of bundled objects."""
    if manifest is None:
        return Measured((), "A shard alone does not say which files its object came from.")
    try:
        source = open_source(manifest.source)
        if not source.is_made:
            return Measured(
                (), f"The models of {manifest.source} are not ours: no exact solids are known."
            )
        entries = {(o.key.split, o.key.object_id): o.input_sha256 for o in manifest.objects}
        agreements: list[Agreement] = []
        recipe = Recipe.model_validate_json(manifest.recipe)
        for about in evenly(objects, OBJECTS):
            ref = source.find(manifest.category, about.object_id)
            obj = resolved(ref, recipe)
            if obj.sha256 != entries.get((about.split, about.object_id)):
                return Measured(
                    (), f"{about.object_id} is generated otherwise by this version of articugen."
                )
            agreements += _compared(ref, obj, about, recipe)
    except (ArticugenError, ValueError) as error:
        return Measured((), f"The models could not be made again: {error}")
    return Measured(tuple(agreements))


_Links = dict[str, tuple[int, Floats]]
"""The part of each link, by its name, and its transform (4, 4) to the world, canonical pose."""


def _compared(
    ref: ObjectRef, obj: ResolvedObject, about: ObjectFacts, recipe: Recipe
) -> list[Agreement]:
    posed = articulation.forward_kinematics(obj, articulation.canonical_state(obj))
    pairs = zip(obj.part_of_link.tolist(), posed.T_world_link, strict=True)
    links: _Links = dict(zip((link.name for link in obj.links), pairs, strict=True))
    thickness = recipe.fusion.sheet_thickness * about.scale
    truth = truth_of(
        ref.category, ref.object_id, messy=ref.messy, varied=ref.varied, sheet_thickness=thickness
    )
    parts = np.array([links[name][0] for name in truth.links])
    alone = [truth.of(parts == part) for part in range(len(about.parts))]
    rows = np.linspace(0, len(about.rows) - 1, min(STATES, len(about.rows)) + 1)[1:]
    with open_shard(about.shard) as shard:
        instances = [shard.instance(about.rows[round(i)]) for i in rows]
    return [_agreement(_Scene(links, alone, instance), instance) for instance in instances]


class _Scene:
    """The exact solids of each part, posed by what the shard says of an instance."""

    def __init__(self, links: _Links, alone: Sequence[Truth], instance: Instance) -> None:
        self.unit, self.alone = Normalization(instance.center, instance.scale), alone
        motion, centre = np.array(instance.part_motion), instance.center  # of world points, metres
        shift = centre - motion[:, :3, :3] @ centre
        motion[:, :3, 3] = instance.scale * motion[:, :3, 3] + shift
        self.T_world_link = {name: product(motion[part], T) for name, (part, T) in links.items()}

    def holds(self, points: Floats) -> Bools:
        """Return (n, P) whether each part's solids hold each point of the unit frame."""
        world = np.ascontiguousarray(self.unit.to_world(points))
        by_part = [truth.holds(world, self.T_world_link).any(axis=1) for truth in self.alone]
        return np.stack(by_part, axis=1)

    def sealed(self, points: Floats) -> Bools:
        """Return (n,) whether one part alone hides the point from all sides."""
        is_sealed = np.zeros(len(points), np.bool_)
        world, ways = self.unit.to_world(points), fibonacci_sphere(SIGHTS)
        for truth in self.alone:
            rest = np.flatnonzero(~is_sealed)
            is_sealed[rest] = truth.enclosed(world[rest], ways, self.T_world_link)
        return is_sealed


def _agreement(scene: _Scene, instance: Instance) -> Agreement:
    pairs: dict[str, tuple[int, int]] = {}
    right = judged = 0
    for kind, stored, label in (
        ("uniform", instance.uniform_points, instance.uniform_label),
        ("near", instance.near_points, instance.near_label),
    ):
        points, ours = dequantize(stored), is_material(label)
        holds = scene.holds(points)
        exact = np.array(holds.any(axis=1))
        exact[~exact] = scene.sealed(points[~exact])
        pairs[kind] = (int((ours & exact).sum()), int((ours | exact).sum()))
        one = (holds.sum(axis=1) == 1) & ours
        judged += int(one.sum())
        right += int(np.sum(label[one] == holds[one].argmax(axis=1) + 1))
    normals = instance.surface_normals / 127.0
    behind = scene.holds(dequantize(instance.surface_points) - BEHIND * normals)
    by_part = int(behind[np.arange(len(behind)), instance.surface_part].sum())
    return Agreement(
        instance.object_id,
        instance.state_index,
        part=(right, judged),
        surface=(by_part, len(behind)),
        **pairs,
    )
