"""Run folders: the recipe, what it ran on, metrics as JSON lines, checkpoints without pickled code.

<runs>/<category>/<number>/recipe.yaml, run.json, metrics.jsonl, latest.pt, best.pt; depth.pt and
depth.jsonl of the third stage; what TensorBoard reads.

Everything is believed only if it is as it was written: a file that is not gives one sentence.

Where several seeds raced, race.json says who won and why, seeds/<seed> are run folders themselves,
and the winner's metrics and checkpoints are the run's.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from articugen import __version__
from articugen.errors import ArticugenError, InvalidCheckpoint, InvalidRecipe, MachineFault
from articugen.learning import processes, tensorboard
from articugen.learning.evaluation.paper import variant
from articugen.learning.ppd.discriminator import Discriminator
from articugen.learning.ppd.learner import Learner
from articugen.learning.ppd.model import PPD
from articugen.learning.ppd.settings import TrainRecipe, parse_train_recipe
from articugen.learning.tensors import CURE, check_adam, check_weights, read_tensors, write_tensors
from articugen.recipe_files import resolved
from articugen.store.files import (
    UnfitFile,
    cannot_write,
    make_folder,
    read_regular,
    whole_name,
    write_atomically,
)
from articugen.store.manifest import this_commit, this_machine

FORMAT = "articugen ppd checkpoint 2"
LATEST, BEST, METRICS = "latest.pt", "best.pt", "metrics.jsonl"
MOST_BYTES = 1 << 28
"""That a recipe, run.json or metrics may have."""

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Told(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Data(_Told):
    folder: str
    content_sha256: Sha256


class _About(_Told):
    """run.json."""

    category: str
    seed: int
    recipe_sha256: Sha256
    data: _Data
    articugen: str
    commit: str | None
    torch: str
    machine: dict[str, str | int]


class _Line(_Told):
    """A line of the metrics. What was measured may be no finite number; nothing else may."""

    iteration: int = Field(ge=0)
    stage: int = Field(default=0, ge=0)
    terms: dict[str, float] = {}
    validation: dict[str, float] = {}
    learning_rate: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    seconds: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)


Told = TypeVar("Told", bound=BaseModel)


@dataclass(frozen=True)
class Checkpoint:
    """Everything that training goes on from.

    Attributes:
        recipe, category, seed: what is trained.
        iteration: how many are done.
        model, critic, optimizer, critic_optimizer: state dicts.
        best: the lowest validation loss so far, or inf.
    """

    recipe: TrainRecipe
    category: str
    seed: int
    iteration: int
    model: dict[str, Tensor]
    critic: dict[str, Tensor]
    optimizer: dict[str, Any]
    critic_optimizer: dict[str, Any]
    best: float

    @staticmethod
    def of(
        recipe: TrainRecipe, category: str, seed: int, iteration: int, learner: Learner, best: float
    ) -> "Checkpoint":
        """Where a learner stands."""
        return Checkpoint(
            recipe,
            category,
            seed,
            iteration,
            learner.model.state_dict(),
            learner.critic.state_dict(),
            learner.descent.adam.state_dict(),
            learner.critic_descent.adam.state_dict(),
            best,
        )

    def write(self, path: Path) -> None:
        """Write it in one step."""
        data = {**vars(self), "recipe": self.recipe.model_dump(mode="json")}
        write_tensors(path, data, FORMAT)

    @property
    def residual_direction(self) -> bool:
        """Whether r^z counts at this point of the schedule."""
        return self.recipe.schedule.at(max(self.iteration - 1, 0))[1].residual_direction

    def generator(self) -> PPD:
        """The model with its weights, ready for predictions."""
        model = PPD(self.recipe.model)
        model.load_state_dict(self.model)
        return model.eval()


def about(checkpoint: Checkpoint) -> dict[str, Any]:
    """What was trained, as an evaluation tells it."""
    recipe = checkpoint.recipe
    return {
        "category": checkpoint.category,
        "recipe": recipe.name,
        "variant": variant(recipe),
        "seed": checkpoint.seed,
        "iterations": checkpoint.iteration,
        "commit": this_commit(),
    }


def read_checkpoint(path: Path) -> Checkpoint:
    """A checkpoint; only tensors and plain data are read, never pickled code.

    Raises:
        InvalidCheckpoint: there is none, it is damaged, or not one of ours.
    """
    data = read_tensors(path, FORMAT)
    try:
        recipe = parse_train_recipe(data.pop("recipe", None), str(path))
        point = Checkpoint(recipe=recipe, **data)
    except (TypeError, InvalidRecipe):
        raise InvalidCheckpoint(f"{path}: a checkpoint that lacks something; {CURE}") from None
    kinds = (type(point.category), type(point.seed), type(point.iteration), type(point.best))
    if kinds != (str, int, int, float) or not 0 <= point.iteration <= recipe.schedule.iterations:
        raise InvalidCheckpoint(f"{path}: a checkpoint that makes no sense; {CURE}")
    with torch.device("meta"):  # shapes alone: whatever its recipe says, it costs nothing
        model, critic = PPD(recipe.model), Discriminator()
    check_weights(point.model, model, path)
    check_weights(point.critic, critic, path)
    check_adam(point.optimizer, model, path)
    check_adam(point.critic_optimizer, critic, path)
    return point


class RunFolder:
    """One run's files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.writes = processes.is_first()
        """Of several processes one writes; what the others are told to write is dropped."""

    def __fspath__(self) -> str:
        """Its path, so that it can be given for one."""
        return str(self.path)

    def __repr__(self) -> str:
        return f"RunFolder({self.path})"

    @staticmethod
    def new(
        runs: Path,
        recipe: TrainRecipe,
        *,
        category: str,
        seed: int,
        data: dict[str, Any],
        name: str | None = None,
    ) -> "RunFolder":
        """A folder under `runs`, the next number or `name`; `data` says what it is trained on."""
        taken = [int(p.name) for p in runs.glob("*") if p.name.isdecimal()]
        path = runs / (name or f"{max(taken, default=-1) + 1:03d}")
        try:
            make_folder(runs)
            path.mkdir()
        except OSError as error:
            raise ArticugenError(f"{path}: cannot be made ({error.strerror})") from None
        about = {
            "category": category,
            "seed": seed,
            "recipe_sha256": recipe.sha256(),
            "data": data,
            "articugen": __version__,
            "commit": this_commit(),
            "torch": torch.__version__,
            "machine": this_machine(),
        }
        write_atomically(path / "recipe.yaml", recipe.text().encode())
        write_atomically(path / "run.json", (json.dumps(about, indent=1) + "\n").encode())
        return RunFolder(path)

    @staticmethod
    def existing(path: Path) -> "RunFolder":
        """A run's folder that is there already.

        Raises:
            InvalidCheckpoint: it has no checkpoint to go on from.
        """
        if not (path / LATEST).is_file():
            raise InvalidCheckpoint(f"{path}: has no {LATEST} to go on from; start a new run")
        run = RunFolder(path)
        if run.writes:
            run.remove_temporary()
        return run

    def remove_temporary(self) -> None:
        """Remove what a process that was killed while it wrote has left."""
        ours = ("recipe.yaml", "run.json", "race.json", METRICS, LATEST, BEST)
        for path in self.path.glob(".*.partial"):
            if whole_name(path.name) in (*ours, "depth.pt", "depth.jsonl"):
                path.unlink(missing_ok=True)

    def recipe(self) -> TrainRecipe:
        """The recipe that the run was started with.

        Raises:
            InvalidCheckpoint: there is none, or it is another.
        """
        path = self.path / "recipe.yaml"
        _read(path)  # looked at before the YAML reader gets it

        def extends(_: str) -> NoReturn:
            raise InvalidRecipe(f"{path}: a run's recipe extends no other")

        try:
            recipe = parse_train_recipe(resolved(path, extends), str(path))
        except (InvalidRecipe, RecursionError, ValueError):
            raise InvalidCheckpoint(
                f"{path}: damaged; restore it from a copy, or start a new run"
            ) from None
        if recipe.sha256() != self.about()["recipe_sha256"]:
            raise InvalidCheckpoint(
                f"{path}: not the recipe that the run was started with; restore it, or start a "
                "new run"
            )
        return recipe

    def about(self) -> dict[str, Any]:
        """What run.json says of the run.

        Raises:
            InvalidCheckpoint: there is none.
        """
        path = self.path / "run.json"
        return _parsed(_About, _read(path), str(path)).model_dump()

    def log(self, record: dict[str, Any], name: str = METRICS) -> None:
        """Append one line to the metrics.

        Raises:
            MachineFault: the disk is full, or the like.
        """
        if not self.writes:
            return
        path = self.path / name
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
            if name == METRICS:
                tensorboard.add(self.path, record)
        except OSError as error:
            raise MachineFault(cannot_write(path, error)) from None

    def keep(self, point: Checkpoint, name: str) -> None:
        """Write a checkpoint."""
        if self.writes:
            point.write(self.path / name)

    def metrics(self, name: str = METRICS) -> list[dict[str, Any]]:
        """The lines of the metrics; a last one that was cut short is none.

        Raises:
            InvalidCheckpoint: a line is damaged.
        """
        path = self.path / name
        if not os.path.lexists(path):
            return []
        lines = _read(path).split(b"\n")[:-1]
        told = ((f"{path}: line {n}", line) for n, line in enumerate(lines, start=1))
        return [_parsed(_Line, line, at).model_dump(exclude_unset=True) for at, line in told]

    def forget_after(self, iteration: int, name: str = METRICS) -> None:
        """Drop metrics of iterations that will be done again."""
        if not self.writes:
            return
        kept = [r for r in self.metrics(name) if r["iteration"] <= iteration]
        text = "".join(json.dumps(record) + "\n" for record in kept)
        write_atomically(self.path / name, text.encode())
        if name == METRICS:
            tensorboard.forget_after(self.path, iteration)


def _read(path: Path) -> bytes:
    """A file of a run's folder."""
    try:
        return read_regular(path, MOST_BYTES)
    except UnfitFile as error:
        raise InvalidCheckpoint(f"{path}: {error.strerror}; move it away") from None
    except OSError as error:
        raise InvalidCheckpoint(
            f"{path}: cannot be read ({error.strerror}): no run's folder, or a damaged one; start "
            "a new run with: articugen train"
        ) from None


def _parsed(model: type[Told], text: bytes, where: str) -> Told:
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        what = f"{key}: {first['msg']}" if key else first["msg"]
        raise InvalidCheckpoint(
            f"{where}: damaged ({what}); restore it from a copy, or start a new run"
        ) from None
