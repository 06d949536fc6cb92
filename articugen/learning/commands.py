"""What the commands of learning do, as functions that a notebook can call as well."""

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from articugen.errors import MissingExtra

try:
    import torch  # noqa: F401
except ImportError:
    raise MissingExtra("torch", "ppd") from None

from articugen.learning import loop
from articugen.learning.evaluation.evaluate import Protocol
from articugen.learning.evaluation.evaluate import evaluate as evaluate_as_paper
from articugen.learning.loop import Progress
from articugen.learning.ppd.reconstruct import reconstruction_from
from articugen.learning.ppd.settings import TrainRecipe, load_train_recipe, parse_train_recipe
from articugen.learning.race import race
from articugen.learning.runs import LATEST, RunFolder, about, read_checkpoint
from articugen.recipe_files import find, resolved_mapping
from articugen.records import dequantize
from articugen.store.manifest import Manifest

FolderLike = str | os.PathLike[str]
RecipeLike = str | Path | Mapping[str, Any] | TrainRecipe


def train(
    data: FolderLike,
    recipe: RecipeLike | None = None,
    *,
    runs: FolderLike = "runs",
    seed: int = 0,
    jobs: int = 0,
    device: str = "cpu",
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> RunFolder:
    """Train on a data set; the run's folder is <runs>/<category>/<number>."""
    settings = _recipe(recipe or "ppd_quick")
    category = Manifest.read(Path(data)).category
    run_training = loop.train
    if settings.seeds.count > 1:
        at_once = (jobs or os.cpu_count() or 1) if device == "cpu" else 1
        run_training = partial(race, jobs=min(at_once, settings.seeds.count))
    return run_training(
        settings,
        category=category,
        data=Path(data),
        runs=Path(runs) / category,
        seed=seed,
        device=device,
        on_progress=on_progress,
    )


def _recipe(given: RecipeLike) -> TrainRecipe:
    if isinstance(given, TrainRecipe):
        return given
    if isinstance(given, Mapping):
        data = resolved_mapping(given, lambda base: find(base, learner=True))
        return parse_train_recipe({"name": "own"} | data, "the recipe that is given")
    return load_train_recipe(given)


def evaluate(
    run: FolderLike,
    data: FolderLike,
    *,
    resolution: int | None = None,
    states: int | None = None,
) -> dict[str, Any]:
    """Evaluate a run's last checkpoint on the test objects, as the paper does."""
    checkpoint = read_checkpoint(Path(run) / LATEST)
    see = reconstruction_from(checkpoint, resolution or 32)
    occupancy = checkpoint.recipe.data.occupancy
    result = evaluate_as_paper(
        Path(data),
        lambda instance: see(dequantize(instance.surface_points)),
        protocol=Protocol(label_poses="canonical", test_states=states, occupancy=occupancy),
        category=checkpoint.category,
    )
    return {"run": about(checkpoint), **result}
