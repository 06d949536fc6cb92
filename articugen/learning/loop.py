"""Training, in one readable loop. Several processes may run it together: see `processes`.

An iteration's random numbers depend on the seed and its number alone, so a run that was stopped and
resumed draws the same curve as one that was not.
"""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from articugen.errors import InvalidCheckpoint
from articugen.learning import processes
from articugen.learning.dataset import PackedSplit, load_split, unpacked, voxel_centres
from articugen.learning.ppd.learner import Learner
from articugen.learning.ppd.model import PPD
from articugen.learning.ppd.objective import Terms
from articugen.learning.ppd.settings import DataSettings, TrainRecipe
from articugen.learning.runs import BEST, LATEST, Checkpoint, RunFolder, read_checkpoint
from articugen.seeding import generator as seeded
from articugen.store.manifest import Manifest

VALIDATION_GRID = 32
VALIDATION_INSTANCES = 64


@dataclass(frozen=True)
class Progress:
    """What is told of an iteration; `terms` and `validation` only where they were computed."""

    iteration: int
    iterations: int
    terms: dict[str, float] | None = None
    validation: dict[str, float] | None = None
    seed: int | None = None
    """Which of the seeds that race, if any do."""


def train(
    recipe: TrainRecipe,
    *,
    category: str,
    data: Path,
    runs: Path,
    seed: int = 0,
    resume: Path | None = None,
    stop_after: int | None = None,
    device: str = "cpu",
    name: str | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> RunFolder:
    """Train a model of one category.

    Args:
        recipe: everything that decides the run, besides the data and the seed.
        data: the data set's folder.
        runs: where a new, numbered run folder is made.
        seed: of the weights, the batches and everything drawn.
        resume: the folder of a run to go on with instead.
        stop_after: stop after so many iterations, as an interruption would.
        name: of the new run's folder, instead of a number.
        on_progress: called after each iteration.

    Raises:
        CorruptShard: the data cannot be trained on.
        InvalidCheckpoint: the run cannot be resumed with this recipe.
        TrainingDiverged: a term is no longer a finite number; the message says which.
    """
    where = torch.device(device)
    processes.check_batch(recipe.schedule.batch)
    training, held_out = _data(recipe, data, category, where)
    run, start = _run_and_start(recipe, category, data, runs, seed, resume, name)
    learner = _learner(recipe, seed, start, where)
    plan, best = recipe.schedule, start.best if start else math.inf
    first = start.iteration if start else 0
    stage_index, _ = plan.at(first)
    since = time.perf_counter()

    for iteration in range(first, min(plan.iterations, stop_after or plan.iterations)):
        index, stage = plan.at(iteration)
        if index != stage_index:
            stage_index = index
            learner.begin_stage()
        rate = _learning_rate(recipe, iteration)

        rng = torch.Generator(where).manual_seed(draw(seed, "batch", iteration))
        rows = batch_rows(iteration, plan.batch, len(training), seed)
        batch = training.batch(rows, recipe.data, stage.resolution, rng).share()
        residual = stage.residual_direction
        terms = learner.learn(
            batch, rng, iteration=iteration, rate=rate, residual_direction=residual
        )

        done = iteration + 1
        last = done == plan.iterations
        tells = done % plan.log_every == 0 or last
        validates = len(held_out) > 0 and (done % plan.validate_every == 0 or last)
        saves = done % plan.save_every == 0 or last or done == stop_after
        if tells or validates or saves:
            learner.check()
        told = _values(terms) if tells else None
        if told:
            seconds = round(time.perf_counter() - since, 2)
            about = {"terms": told, "learning_rate": rate, "seconds": seconds}
            run.log({"iteration": done, "stage": index, **about})
        checked = None
        if validates and run.writes:
            checked = validate(learner.model, held_out, recipe.data, residual)
            run.log({"iteration": done, "validation": checked})
        better = checked is not None and checked["rec"] < best
        if better or saves:
            best = checked["rec"] if checked and better else best
            point = Checkpoint.of(recipe, category, seed, done, learner, best)
            if better:
                run.keep(point, BEST)
            run.keep(point, LATEST)
        on_progress(Progress(done, plan.iterations, told, checked))
    processes.wait()
    return run


@torch.no_grad()
def validate(
    model: PPD, held_out: PackedSplit, ask: DataSettings, residual_direction: bool
) -> dict[str, float]:
    """How well unseen objects are reconstructed on their 32^3 grid, parts composed by the maximum.

    `rec` is the mean binary cross-entropy, `iou` the mean over instances of |A and B| / |A or B|.
    """
    model.eval()
    count = min(VALIDATION_INSTANCES, len(held_out))
    entropy, overlap = [], []
    device = held_out.surface.device
    cells = torch.arange(VALIDATION_GRID**3, device=device)
    for row in np.linspace(0, len(held_out) - 1, count).astype(int):
        cloud = unpacked(held_out.surface[row : row + 1, : ask.surface_points])
        occupied = held_out.grids[VALIDATION_GRID][row] > 0
        predicted = model(cloud, residual_direction=residual_direction)
        points = voxel_centres(cells, VALIDATION_GRID)[None]
        fields = model.fields(predicted.shape, model.motion(predicted.pose), points)
        logit = fields.product.amax(1)[0]
        entropy.append(
            nn.functional.binary_cross_entropy_with_logits(logit, occupied.to(logit.dtype))
        )
        both, either = (logit > 0) & occupied, (logit > 0) | occupied
        overlap.append(both.sum() / either.sum().clamp(min=1))
    model.train()
    return {
        "rec": float(torch.stack(entropy).mean()),
        "iou": float(torch.stack(overlap).mean()),
    }


def _data(
    recipe: TrainRecipe, data: Path, category: str, device: torch.device
) -> tuple[PackedSplit, PackedSplit]:
    """The training instances, and those of the objects that are held out."""
    joints = (len(recipe.model.revolute), len(recipe.model.prismatic))
    grids = {stage.resolution for stage in recipe.schedule.stages if recipe.data.grid_points}
    grids |= {VALIDATION_GRID} if recipe.data.validation_objects else set()
    everything = load_split(data, "train", recipe.data, grids, category=category, joints=joints)
    kept, held_out = split_objects(everything.object_id, recipe.data.validation_objects)
    return everything.of(kept).to(device), everything.of(held_out).to(device)


def split_objects(object_ids: Iterable[str], held_out: int) -> tuple[list[str], list[str]]:
    """(for training, held out): the same whatever the seed; at most a quarter is held out.

    Where there are two objects, one is; a single one is trained on.
    """
    objects = sorted(set(map(str, object_ids)))
    count = min(held_out, max(len(objects) // 4, 1), len(objects) - 1)
    chosen = seeded(0, "validation").permutation(len(objects))[:count]
    out = {objects[i] for i in chosen}
    return [o for o in objects if o not in out], sorted(out)


def new_run(
    recipe: TrainRecipe, category: str, data: Path, runs: Path, seed: int, name: str | None = None
) -> RunFolder:
    """A new run's folder, which tells what it is trained on."""
    told = {"folder": str(data), "content_sha256": Manifest.read(data).content_sha256}
    return RunFolder.new(runs, recipe, category=category, seed=seed, data=told, name=name)


def _run_and_start(
    recipe: TrainRecipe,
    category: str,
    data: Path,
    runs: Path,
    seed: int,
    resume: Path | None,
    name: str | None,
) -> tuple[RunFolder, Checkpoint | None]:
    if resume is None:
        path = processes.of_first(
            lambda: str(new_run(recipe, category, data, runs, seed, name).path)
        )
        return RunFolder(Path(path)), None
    run = RunFolder.existing(resume)
    start = read_checkpoint(run.path / LATEST)
    if (start.recipe.sha256(), start.category, start.seed) != (recipe.sha256(), category, seed):
        raise InvalidCheckpoint(
            f"{resume}: was started with another recipe, category or seed; start a new run"
        )
    if run.about()["data"]["content_sha256"] != Manifest.read(data).content_sha256:
        raise InvalidCheckpoint(f"{resume}: was started on other data than {data}; start a new run")
    run.forget_after(start.iteration)
    return run, start


def _learner(
    recipe: TrainRecipe, seed: int, start: Checkpoint | None, device: torch.device
) -> Learner:
    """A new one, or where the checkpoint left it; at a stage's beginning Adams are new."""
    learner = Learner(recipe, draw(seed, "weights"), device)
    if start:
        learner.model.load_state_dict(start.model)
        learner.critic.load_state_dict(start.critic)
        if start.iteration != _first_of(recipe, recipe.schedule.at(start.iteration)[0]):
            learner.descent.adam.load_state_dict(start.optimizer)
            learner.critic_descent.adam.load_state_dict(start.critic_optimizer)
    return learner


def _values(terms: Terms) -> dict[str, float]:
    """The means over the processes, read from the device at once."""
    values = torch.stack([value.detach() for value in terms.values()])
    processes.average([values])
    return dict(zip(terms, values.tolist(), strict=True))


def _first_of(recipe: TrainRecipe, stage: int) -> int:
    return sum(s.iterations for s in recipe.schedule.stages[:stage])


def _learning_rate(recipe: TrainRecipe, iteration: int) -> float:
    plan = recipe.schedule
    if plan.final_learning_rate is None:
        return plan.learning_rate
    share = 0.5 * (1.0 + math.cos(math.pi * iteration / max(plan.iterations - 1, 1)))
    return plan.final_learning_rate + share * (plan.learning_rate - plan.final_learning_rate)


def draw(seed: int, *path: str | int) -> int:
    """A number for torch's generators, from the seed and what it is for."""
    return int(seeded(seed, "ppd", *path).integers(2**63))


def batch_rows(iteration: int, batch: int, count: int, seed: int) -> list[int]:
    """The instances of a batch: epochs one after the other, each in an order of its own."""
    rows: list[int] = []
    at = iteration * batch
    while len(rows) < batch:
        epoch, offset = divmod(at + len(rows), count)
        order = seeded(seed, "ppd", "epoch", epoch).permutation(count)
        rows += order[offset : offset + batch - len(rows)].tolist()
    return rows
