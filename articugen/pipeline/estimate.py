"""What a run will take: rough figures for `--dry-run`, corrected by what the folder tells.

Fitted by eye to CPU seconds of a few bundled objects; once a folder has objects made by the recipe,
their own times decide. What decides most is how many instances there are.
"""

from collections.abc import Sequence

from articugen.core.recipe import Recipe, Sampling
from articugen.store.manifest import ObjectEntry, ShardEntry

STARTUP = 3.0
"""Seconds until a worker has imported what it needs; once a run."""


_SHRUNK_BY: dict[str | int, int] = {"R": 25, "H": 20}
"""What gzip makes of the grids and images of a drawer's cabinet, by a letter of their shapes."""


def run_seconds(recipe: Recipe, objects: int, workers: int, done: Sequence[ObjectEntry]) -> float:
    """Of the clock, to make `objects` objects; `done` are some that this recipe made before."""
    if objects == 0:
        return 0.0
    each = object_seconds(recipe, recipe.articulation.states + 1) * _pace(recipe, done)
    rounds = objects / max(1, min(workers, objects))
    return STARTUP + each * rounds


def object_seconds(recipe: Recipe, instances: int) -> float:
    """Of one worker, for one object."""
    return _shared_seconds(recipe) + instances * _instance_seconds(recipe)


def instance_bytes(recipe: Recipe, done: Sequence[ShardEntry] = ()) -> int:
    """Of an instance in its shard; `done` are some that this recipe made before."""
    if done:
        return sum(shard.bytes for shard in done) // sum(shard.instances for shard in done)
    fields, sizes = recipe.fields(), recipe.instance_bytes()
    shrunk = {
        name: max(_SHRUNK_BY.get(letter, 1) for letter in field.shape)
        for name, field in fields.items()
    }
    samples = (n for n, shape in recipe.instance_shapes().items() if shape and None not in shape)
    return sum(sizes[name] // shrunk[name] for name in samples) + 2000


def _pace(recipe: Recipe, done: Sequence[ObjectEntry]) -> float:
    """How much longer than estimated the objects took that this recipe made here before."""
    expected = sum(object_seconds(recipe, entry.instances) for entry in done)
    taken = sum(entry.seconds for entry in done)
    return taken / expected if taken > 0 and expected > 0 else 1.0


def _shared_seconds(recipe: Recipe) -> float:
    pixels = recipe.views.count * recipe.views.resolution**2
    return 0.6 + pixels * 7.5e-8 + _voxels(recipe.sampling) * 3.3e-7


def _instance_seconds(recipe: Recipe) -> float:
    sampling = recipe.sampling
    points = 2.2e-6 * sampling.surface_points + 1.2e-6 * sampling.near_points
    partial = 2e-3 * sampling.partial_views
    return 0.01 + 3.5e-4 * recipe.views.count + points + partial + 7e-8 * _voxels(sampling)


def _voxels(sampling: Sampling) -> int:
    return sum(resolution**3 for resolution in sampling.grids)
