"""Run folders: the recipe, what it ran on, metrics as JSON lines, checkpoints without pickled code.

<runs>/<category>/<number>/recipe.yaml, run.json, metrics.jsonl, latest.pt, best.pt; depth.pt and
depth.jsonl of the third stage; what TensorBoard reads.

Where several seeds raced, race.json says who won and why, seeds/<seed> are run folders themselves,
and the winner's metrics and checkpoints are the run's.
"""

import io
import json
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile

import torch
import yaml
from torch import Tensor, nn

from articugen import __version__
from articugen.errors import ArticugenError, InvalidCheckpoint
from articugen.files import write_atomically
from articugen.manifest import this_commit, this_machine
from articugen.ppd import boards, processes
from articugen.ppd.learner import Learner
from articugen.ppd.model import PPD
from articugen.ppd.paper import variant
from articugen.ppd.settings import TrainRecipe, parse_train_recipe

FORMAT = "articugen ppd checkpoint 1"
LATEST, BEST, METRICS = "latest.pt", "best.pt", "metrics.jsonl"


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
    recipe = parse_train_recipe(data.pop("recipe"), str(path))
    try:
        point = Checkpoint(recipe=recipe, **data)
    except TypeError:
        raise InvalidCheckpoint(f"{path}: a checkpoint that lacks something; train again") from None
    with torch.random.fork_rng(devices=[]):
        check_weights(point.model, PPD(recipe.model), path)
    return point


def read_tensors(path: Path, wanted: str) -> dict[str, Any]:
    """What was saved at `path`, in the format `wanted`; see `read_checkpoint`."""
    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise InvalidCheckpoint(f"{path}: cannot be read ({error.strerror or error})") from None
    except (UnpicklingError, RuntimeError, ValueError, EOFError, KeyError, BadZipFile):
        raise InvalidCheckpoint(f"{path}: not a checkpoint, or damaged; train again") from None
    if not isinstance(data, dict) or data.pop("format", None) != wanted:
        raise InvalidCheckpoint(f"{path}: not a checkpoint of this version; train again")
    return data


def write_tensors(path: Path, data: dict[str, Any], form: str) -> None:
    """Write tensors and plain data in one step."""
    buffer = io.BytesIO()
    torch.save({"format": form, **data}, buffer)
    write_atomically(path, buffer.getvalue())


def check_weights(weights: dict[str, Tensor], network: nn.Module, path: Path) -> None:
    """Raise InvalidCheckpoint where they are not this network's."""
    have = {name: value.shape for name, value in weights.items()}
    if have != {name: value.shape for name, value in network.state_dict().items()}:
        raise InvalidCheckpoint(f"{path}: its weights are those of another recipe; train again")


class RunFolder:
    """One run's files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.writes = processes.is_first()
        """Of several processes one writes; what the others are told to write is dropped."""

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
        taken = [int(p.name) for p in runs.glob("*") if p.name.isdigit()]
        path = runs / (name or f"{max(taken, default=-1) + 1:03d}")
        try:
            path.mkdir(parents=True)
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
        return RunFolder(path)

    def recipe(self) -> TrainRecipe:
        path = self.path / "recipe.yaml"
        return parse_train_recipe(yaml.safe_load(path.read_text(encoding="utf-8")), str(path))

    def about(self) -> dict[str, Any]:
        """What run.json says of the run.

        Raises:
            InvalidCheckpoint: there is none.
        """
        try:
            return json.loads((self.path / "run.json").read_bytes())
        except (OSError, ValueError):
            raise InvalidCheckpoint(f"{self.path}: is no run's folder, or a damaged one") from None

    def log(self, record: dict[str, Any], name: str = METRICS) -> None:
        """Append one line to the metrics."""
        if not self.writes:
            return
        with (self.path / name).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        if name == METRICS:
            boards.add(self.path, record)

    def keep(self, point: Checkpoint, name: str) -> None:
        """Write a checkpoint."""
        if self.writes:
            point.write(self.path / name)

    def metrics(self, name: str = METRICS) -> list[dict[str, Any]]:
        path = self.path / name
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        return [json.loads(line) for line in lines if line.endswith("}")]

    def forget_after(self, iteration: int, name: str = METRICS) -> None:
        """Drop metrics of iterations that will be done again."""
        if not self.writes:
            return
        kept = [r for r in self.metrics(name) if r["iteration"] <= iteration]
        text = "".join(json.dumps(record) + "\n" for record in kept)
        write_atomically(self.path / name, text.encode())
        if name == METRICS:
            boards.forget_after(self.path, iteration)
