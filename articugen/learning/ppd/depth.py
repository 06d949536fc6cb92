"""The third stage: an encoder for what one depth camera sees (Section 4.4).

A new encoder learns to give, from a partial cloud, the latent vector that the first one gives for
the complete cloud of the same instance; the loss is their mean squared difference. The decoders
stay as they are. As in `train`, an iteration's random numbers depend on its number alone.
"""

import dataclasses
import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from articugen.errors import CorruptShard, InvalidCheckpoint, TrainingDiverged
from articugen.learning.dataset import PackedSplit, index_on, load_split, unpacked
from articugen.learning.evaluation.surfaces import Floats
from articugen.learning.loop import (
    VALIDATION_GRID,
    Progress,
    batch_rows,
    draw,
    split_objects,
    validate,
)
from articugen.learning.ppd.model import PPD
from articugen.learning.ppd.settings import DepthSettings
from articugen.learning.ppd.shape import Encoder
from articugen.learning.runs import LATEST, Checkpoint, RunFolder, read_checkpoint
from articugen.learning.tensors import CURE, check_adam, check_weights, read_tensors, write_tensors
from articugen.records import Instance, dequantize
from articugen.seeding import generator

DEPTH, DEPTH_METRICS = "depth.pt", "depth.jsonl"
_FORMAT = "articugen ppd depth encoder 2"


def train_depth(
    run: RunFolder,
    data: Path,
    *,
    device: str = "cpu",
    stop_after: int | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Path:
    """Train the encoder for partial clouds of a run, or go on with it; its recipe says how long.

    Args:
        run: whose last checkpoint has the first encoder and the decoders.
        data: the folder of a data set of the same category.
        stop_after: stop after so many iterations, as an interruption would.

    Returns:
        The file of the encoder, in the run's folder.

    Raises:
        CorruptShard: the data cannot be trained on, for instance has no partial clouds.
        InvalidCheckpoint: the run has no checkpoint.
        TrainingDiverged: the loss is no longer a finite number.
    """
    where = torch.device(device)
    point = read_checkpoint(run.path / LATEST)
    plan, every = point.recipe.depth, point.recipe.schedule
    model = point.generator().to(where)
    training, held_out = _data(point, data, where)
    target = latents(model, training, point.recipe.data.surface_points)
    student, optimizer, first = _student(run, point, where)
    run.forget_after(first, DEPTH_METRICS)

    for iteration in range(first, min(plan.iterations, stop_after or plan.iterations)):
        for group in optimizer.param_groups:
            group["lr"] = _learning_rate(plan, iteration)
        rng = torch.Generator(where).manual_seed(draw(point.seed, "depth", iteration))
        rows = batch_rows(iteration, plan.batch, len(training), point.seed)
        at = index_on(where, rows)
        camera = torch.randint(training.partial.shape[1], at.shape, generator=rng, device=where)
        loss = mse_loss(student(unpacked(training.partial[at, camera])), target[at])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

        done = iteration + 1
        last = done in (plan.iterations, stop_after)
        told = checked = None
        if done % every.log_every == 0 or last:
            told = {"latent": float(loss.detach())}
            if not math.isfinite(told["latent"]):
                raise TrainingDiverged(
                    f"iteration {done}: the difference of the latents is not a finite number; "
                    "lower depth.learning_rate"
                )
            run.log({"iteration": done, "terms": told}, DEPTH_METRICS)
        if len(held_out) and (done % every.validate_every == 0 or last):
            checked = _validate(point, model, student, held_out)
            run.log({"iteration": done, "validation": checked}, DEPTH_METRICS)
        if done % every.save_every == 0 or last:
            _write(run.path / DEPTH, point, done, student, optimizer)
        on_progress(Progress(done, plan.iterations, told, checked))
    return run.path / DEPTH


def read_depth_model(folder: Path, point: Checkpoint) -> PPD:
    """The model of a run's checkpoint with the encoder for partial clouds, ready for predictions.

    Raises:
        InvalidCheckpoint: there is no such encoder, or it was trained to match other weights.
    """
    path = folder / DEPTH
    if not path.is_file():
        raise InvalidCheckpoint(
            f"{folder}: has no encoder for partial clouds; make one with: articugen train-depth"
        )
    model = point.generator()
    data = _read(path)
    if data["of"] != weights_sha256(point):
        raise InvalidCheckpoint(
            f"{path}: belongs to other weights than {LATEST}; make it again: articugen train-depth"
        )
    model.encoder.load_state_dict(data["encoder"])
    return model


def seen_by_a_camera(instance: Instance) -> Floats:
    """(M, 3) what one of the instance's depth cameras sees, always the same one.

    Raises:
        CorruptShard: it has none.
    """
    cameras = len(instance.partial_points)
    if not cameras:
        raise CorruptShard(
            f"{instance.object_id}: has no partial clouds; set sampling.partial_views and make the "
            "data set again"
        )
    chosen = generator(0, "camera", instance.object_id, instance.state_index).integers(cameras)
    return dequantize(instance.partial_points[chosen])


def weights_sha256(point: Checkpoint) -> str:
    """The digest of a model's weights."""
    digest = hashlib.sha256()
    for name, value in sorted(point.model.items()):
        digest.update(name.encode())
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()


@torch.no_grad()
def latents(model: PPD, split: PackedSplit, points: int) -> Tensor:
    """(I, 512) what the first encoder makes of each instance's complete cloud."""
    blocks = split.surface[:, :points].split(64)
    return torch.cat([model.encoder(unpacked(block)) for block in blocks])


def _data(point: Checkpoint, data: Path, device: torch.device) -> tuple[PackedSplit, PackedSplit]:
    """The training instances, and those of the objects that are held out, as in `train`."""
    ask = point.recipe.data
    grids = {VALIDATION_GRID} if ask.validation_objects else set[int]()
    everything = load_split(data, "train", ask, grids, category=point.category, partial=True)
    kept, out = split_objects(everything.object_id, ask.validation_objects)
    return everything.of(kept).to(device), everything.of(out).to(device)


def _student(
    run: RunFolder, point: Checkpoint, device: torch.device
) -> tuple[Encoder, torch.optim.Adam, int]:
    """The encoder, its optimiser, and how many iterations they have behind them."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(draw(point.seed, "depth weights"))
        student = Encoder().to(device)
    optimizer = torch.optim.Adam(student.parameters(), point.recipe.depth.learning_rate)
    path = run.path / DEPTH
    if not path.is_file():
        return student, optimizer, 0
    data = _read(path)
    if data["of"] != weights_sha256(point):  # of an earlier state of the run
        return student, optimizer, 0
    student.load_state_dict(data["encoder"])
    optimizer.load_state_dict(data["optimizer"])
    return student, optimizer, data["iteration"]


def _read(path: Path) -> dict[str, Any]:
    """What `_write` has written.

    Raises:
        InvalidCheckpoint: it is damaged, or not one of ours.
    """
    data = read_tensors(path, _FORMAT)
    whole = data.keys() == {"of", "iteration", "encoder", "optimizer"}
    if not (whole and isinstance(data["of"], str) and type(data["iteration"]) is int):
        raise InvalidCheckpoint(f"{path}: lacks something; {CURE}")
    with torch.device("meta"):
        encoder = Encoder()
    check_weights(data["encoder"], encoder, path)
    check_adam(data["optimizer"], encoder, path)
    return data


def _write(
    path: Path, point: Checkpoint, done: int, student: Encoder, optimizer: torch.optim.Adam
) -> None:
    data = {
        "of": weights_sha256(point),
        "iteration": done,
        "encoder": student.state_dict(),
        "optimizer": optimizer.state_dict(),
    }
    write_tensors(path, data, _FORMAT)


@torch.no_grad()
def _validate(
    point: Checkpoint, model: PPD, student: Encoder, held_out: PackedSplit
) -> dict[str, float]:
    """`latent`, the loss, over all cameras; `rec` and `iou` (see `validate`) from the first one."""
    target = latents(model, held_out, point.recipe.data.surface_points)
    each = [mse_loss(student(unpacked(seen)), target) for seen in held_out.partial.unbind(1)]
    first, model.encoder = model.encoder, student
    seen = dataclasses.replace(held_out, surface=held_out.partial[:, 0])
    ask = point.recipe.data.model_copy(update={"surface_points": seen.surface.shape[1]})
    checked = validate(model, seen, ask, point.residual_direction)
    model.encoder = first
    return {"latent": float(torch.stack(each).mean()), **checked}


def _learning_rate(plan: DepthSettings, iteration: int) -> float:
    share = 0.5 * (1.0 + math.cos(math.pi * iteration / max(plan.iterations - 1, 1)))
    return plan.learning_rate * (0.01 + 0.99 * share)
