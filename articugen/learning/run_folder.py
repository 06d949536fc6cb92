"""Run folders: the recipe, what it ran on, metrics as JSON lines, checkpoints without pickled code.

<runs>/<category>/<number>/recipe.yaml, run.json, metrics.jsonl,
latest.safetensors, best.safetensors; what TensorBoard reads.

Everything is believed only if it is as it was written: a file that is not gives one sentence.

Where several seeds raced, race.json says who won and why, seeds/<seed> are run folders themselves,
and the winner's metrics and checkpoints are the run's.
"""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from articugen.core.content import VERSION
from articugen.core.errors import ArticugenError, InvalidCheckpoint, InvalidRecipe
from articugen.core.files import (
    locked,
    make_folder,
    read_or_refuse,
    sync,
    whole_name,
    write_atomically,
    writing,
)
from articugen.core.yaml_files import fault_in, resolved
from articugen.learning.method import Learner, find_method, parse_recipe
from articugen.learning.recipe import TrainRecipe
from articugen.learning.sealed import CURE, write_arrays
from articugen.learning.tensors import check_like, in_numpy, read_tensors
from articugen.store.provenance import this_commit, this_machine

FORMAT = "articugen checkpoint 5"
LATEST, BEST, METRICS = "latest.safetensors", "best.safetensors", "metrics.jsonl"
MOST_BYTES = 1 << 28
"""That a recipe, run.json or metrics may have."""

GROUPS = ("validation", "terms")
"""Of the numbers in a line of the metrics."""

CPU, META = torch.device("cpu"), torch.device("meta")


Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Data(_Record):
    """Data set that it is trained on; `also`: further data sets."""

    folder: str
    content_sha256: Sha256
    also: list["_Data"] = []


class _About(_Record):
    """run.json."""

    category: str
    seed: int
    recipe_sha256: Sha256
    data: _Data
    articugen: str
    commit: str | None
    torch: str
    machine: dict[str, str | int]


class _Line(_Record):
    """A line of the metrics. What was measured may be no finite number; nothing else may."""

    iteration: int = Field(ge=0)
    stage: int = Field(default=0, ge=0)
    terms: dict[str, float] = {}
    validation: dict[str, float] = {}
    learning_rate: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    seconds: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)


Record = TypeVar("Record", bound=BaseModel)


@dataclass(frozen=True)
class Checkpoint:
    """State from which training goes on.

    Attributes:
        recipe, category, seed: what is trained.
        iteration: how many are done.
        best: the lowest validation loss so far, or inf.
        state: the learner's own, see `method.Learner.state`.
    """

    recipe: TrainRecipe
    category: str
    seed: int
    iteration: int
    best: float
    state: dict[str, Any]

    def write(self, path: Path) -> None:
        """Write it in one step."""
        write_arrays(path, in_numpy({**vars(self), "recipe": self.recipe.plain()}), FORMAT)

    def learner(self) -> Learner:
        """Return the learner, on the CPU, ready for predictions or to go on."""
        learner = find_method(self.recipe.method).start(self.recipe, seed=0, device=CPU)
        learner.load(self.state)
        return learner

    def about(self) -> dict[str, Any]:
        """Return what was trained, as an evaluation states it."""
        budget = self.recipe.budget
        return {
            "category": self.category,
            "method": self.recipe.method,
            "recipe": self.recipe.name,
            "variant": self.recipe.variant,
            "seed": self.seed,
            "iterations": self.iteration,
            "recipe_sha256": budget.recipe_sha256 if budget else self.recipe.sha256(),
            "budget": budget.seconds if budget else None,
            "commit": this_commit(),
        }


def read_checkpoint(path: Path) -> Checkpoint:
    """Return a checkpoint; only tensors and plain data are read, never pickled code.

    Raises:
        InvalidCheckpoint: there is none, it is damaged, or not one of ours.
    """
    data = read_tensors(path, FORMAT)
    recipe = data.pop("recipe", None)
    try:
        recipe = parse_recipe(recipe, "its recipe")
        point = Checkpoint(recipe=recipe, **data)
    except (TypeError, InvalidRecipe) as error:
        if recipe and isinstance(error, InvalidRecipe):  # another version could be trained with it
            raise InvalidCheckpoint(f"{path}: {error}; train it again") from None
        raise InvalidCheckpoint(f"{path}: a checkpoint that lacks something; {CURE}") from None
    kinds = [type(x) for x in (point.category, point.seed, point.iteration, point.best)]
    if not (kinds == [str, int, int, float] and 0 <= point.iteration <= recipe.schedule.iterations):
        raise InvalidCheckpoint(f"{path}: a checkpoint that makes no sense; {CURE}")
    learner = find_method(recipe.method).start(recipe, seed=0, device=META)
    check_like(point.state, learner.state(), path)  # shapes alone: whatever it says costs nothing
    return point


def newest(run: str | os.PathLike[str]) -> Path:
    """Return the run itself, or the newest of the numbered runs in a folder.

    Raises:
        InvalidCheckpoint: there is none.
    """
    run = Path(run)
    if (run / "run.json").is_file():
        return run
    numbered = [p for p in run.glob("*") if p.name.isdecimal() and (p / "run.json").is_file()]
    if not numbered:
        raise InvalidCheckpoint(f"{run}: holds no run; make one with: articugen train")
    return max(numbered, key=lambda p: int(p.name))


class RunFolder:
    """One run's files."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __fspath__(self) -> str:
        return str(self.path)

    def __repr__(self) -> str:
        return f"RunFolder({self.path})"

    @staticmethod
    def new(runs: Path, name: str | None, recipe: TrainRecipe, **about: Any) -> "RunFolder":
        """Make a folder under `runs`, the next number or `name`.

        Args:
            about: what run.json says of `category`, `seed` and `data`.
        """
        taken = (int(p.name) for p in runs.glob("*") if p.name.isdecimal())
        path = runs / (name or f"{max(taken, default=-1) + 1:03d}")
        make_folder(runs)
        try:
            path.mkdir()
        except OSError as error:
            if isinstance(error, FileExistsError) and not name:  # another run was faster
                return RunFolder.new(runs, name, recipe, **about)
            raise ArticugenError(f"{path}: cannot be made ({error.strerror})") from None
        about |= {"recipe_sha256": recipe.sha256(), "articugen": VERSION, "commit": this_commit()}
        about |= {"torch": torch.__version__, "machine": this_machine()}
        write_atomically(path / "recipe.yaml", recipe.text().encode())
        write_atomically(path / "run.json", (json.dumps(about, indent=1) + "\n").encode())
        return RunFolder(path)

    @staticmethod
    def existing(path: Path) -> "RunFolder":
        """Return a run's folder that is there already, perhaps without a checkpoint as yet.

        Raises:
            InvalidCheckpoint: it has nothing to go on from.
            ArticugenError: another process trains there.
        """
        if not (path / "run.json").is_file() and not (path / LATEST).is_file():
            raise InvalidCheckpoint(f"{path}: has no {LATEST} to go on from; start a new run")
        run, ours = RunFolder(path), ("recipe.yaml", "run.json", "race.json", METRICS, LATEST, BEST)
        with locked(path):
            for left in path.glob(".*.partial"):  # by a process that was killed while it wrote
                if whole_name(left.name) in ours:
                    left.unlink(missing_ok=True)
        return run

    def recipe(self) -> TrainRecipe:
        """Return the recipe that the run was started with.

        Raises:
            InvalidCheckpoint: there is none, or it is another.
        """
        path = self.path / "recipe.yaml"
        _read(path)  # looked at before the YAML reader gets it

        def extends(_: str) -> NoReturn:
            raise InvalidRecipe(f"{path}: a run's recipe extends no other")

        try:
            recipe = parse_recipe(resolved(path, extends), str(path))
        except (InvalidRecipe, RecursionError, ValueError):
            raise InvalidCheckpoint(
                f"{path}: damaged, or of an earlier version; restore it from a copy, or start a "
                "new run"
            ) from None
        if recipe.sha256() != self.about()["recipe_sha256"]:
            raise InvalidCheckpoint(
                f"{path}: not the recipe that the run was started with; restore it, or start a "
                "new run"
            )
        return recipe

    def about(self) -> dict[str, Any]:
        """Return the contents of run.json.

        Raises:
            InvalidCheckpoint: there is none.
        """
        path = self.path / "run.json"
        return _parsed(_About, _read(path), str(path)).model_dump()

    def log(self, record: dict[str, Any]) -> None:
        """Append one line to the metrics.

        Raises:
            MachineFault: the disk is full, or the like.
        """
        path = self.path / METRICS
        with writing(path), path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")

    @contextmanager
    def metrics_from(self, iteration: int) -> Iterator[Callable[[dict[str, Any]], None]]:
        """Yield what appends a line to the metrics, and its numbers to what TensorBoard reads,
        where that is installed. What there is of later iterations is dropped first: they are done
        again.

        Raises:
            ArticugenError: another process trains here.
            MachineFault: the disk is full, or the like.
        """
        with locked(self.path), _board(self.path, iteration) as add_scalars:
            kept = [r for r in self.metrics() if r["iteration"] <= iteration]
            text = "".join(json.dumps(record) + "\n" for record in kept)
            write_atomically(self.path / METRICS, text.encode())

            def log(record: dict[str, Any]) -> None:
                self.log(record)
                add_scalars(record)

            yield log

    def keep(self, point: Checkpoint, name: str) -> None:
        """Write a checkpoint; the metrics up to there are on the disk before it is."""
        with suppress(FileNotFoundError):
            sync(self.path / METRICS)
        point.write(self.path / name)

    def metrics(self) -> list[dict[str, Any]]:
        """Return the lines of the metrics; a last one that was cut short is none.

        Raises:
            InvalidCheckpoint: a line is damaged.
        """
        path = self.path / METRICS
        if not os.path.lexists(path):
            return []
        lines = _read(path).split(b"\n")[:-1]
        numbered = ((f"{path}: line {n}", line) for n, line in enumerate(lines, start=1))
        return [_parsed(_Line, line, at).model_dump(exclude_unset=True) for at, line in numbered]

    def seconds(self) -> float:
        """Return what the iterations took, of all seeds where several raced: CPU time, or the
        clock's on a GPU."""
        raced = sorted(self.path.glob("seeds/*"))
        if raced:
            return sum(RunFolder(path).seconds() for path in raced)
        return max((line.get("seconds", 0.0) for line in self.metrics()), default=0.0)


@contextmanager
def _board(folder: Path, after: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield what appends the numbers of a record for TensorBoard, by the names they have there;
    what was written of iterations later than `after` is dropped.

    TensorBoard's own writer would write from a thread, whose faults end in a traceback.
    """
    if not find_spec("tensorboard"):
        yield lambda _: None
        return
    from tensorboard.summary.writer.record_writer import RecordWriter  # noqa: PLC0415 - an extra

    events = import_module("tensorboard.compat.proto.event_pb2")
    summaries = import_module("tensorboard.compat.proto.summary_pb2")

    seconds, rest = divmod(time.time_ns(), 10**9)  # files are read in the order of their names
    path = folder / f"events.out.tfevents.{seconds:010d}.{rest:09d}.{os.getpid()}"

    def append(**event: Any) -> None:
        with writing(path):
            writer.write(events.Event(wall_time=time.time(), **event).SerializeToString())
            writer.flush()  # a process that is killed leaves no gap in the curve

    def add(record: dict[str, Any]) -> None:
        numbers = {f"{g}/{n}": x for g in GROUPS for n, x in record.get(g, {}).items()}
        numbers |= {n: record[n] for n in ("learning_rate",) if n in record}
        values = [summaries.Summary.Value(tag=name, simple_value=x) for name, x in numbers.items()]
        append(step=record["iteration"], summary=summaries.Summary(value=values))

    with writing(path):
        writer = RecordWriter(path.open("xb"))
    try:
        append(file_version="brain.Event:2")
        append(step=after + 1, session_log=events.SessionLog(status=events.SessionLog.START))
        yield add
    finally:
        with suppress(OSError):  # where the disk is full the JSON lines are what says so
            writer.close()


def _read(path: Path) -> bytes:
    """Return a file of a run's folder."""
    cure = "no run's folder, or a damaged one; start a new run with: articugen train"
    return read_or_refuse(path, MOST_BYTES, InvalidCheckpoint, cure)


def _parsed(model: type[Record], text: bytes, where: str) -> Record:
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise InvalidCheckpoint(
            f"{where}: damaged ({fault_in(error)}); restore it from a copy, or start a new run"
        ) from None
