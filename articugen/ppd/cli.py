"""PPD's commands: a thin face, each calls one function. articugen/cli.py registers them."""

# Everything heavy is imported where it is used: --help should not wait for torch.
# ruff: noqa: PLC0415
import json
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from articugen.errors import ArticugenError, InvalidCheckpoint, MissingExtra

if TYPE_CHECKING:
    from rich.progress import TaskID

    from articugen.ppd.train import Progress

Said = Callable[..., AbstractContextManager[None]]

_said: Said
_out = Console(highlight=False)
_err = Console(stderr=True, highlight=False)


def register(app: typer.Typer, said_in_one_sentence: Said) -> None:
    """Add the commands to the command line; `said_in_one_sentence` prints our errors."""
    global _said  # noqa: PLW0603
    _said = said_in_one_sentence
    app.command(
        epilog="Examples:\n\narticugen train --category laptop --data data/laptop\n\n"
        "articugen train --category laptop --data data/laptop --resume runs/laptop/000"
    )(train)
    app.command(epilog="Example: articugen evaluate runs/laptop --data data/laptop")(evaluate)
    app.command(
        epilog="Examples:\n\narticugen predict runs/laptop data/laptop/test-00000.h5 --row 3\n\n"
        "articugen predict runs/laptop cloud.npy --out rig"
    )(predict)


def train(
    category: Annotated[str, typer.Option("--category", "-c", help="What the data set holds.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="The folder of the data set.")],
    recipe: Annotated[
        str, typer.Option("--recipe", "-r", help="A name under recipes/, or a YAML file.")
    ] = "ppd_quick",
    runs: Annotated[Path, typer.Option(help="Runs go to <runs>/<category>/<number>.")] = Path(
        "runs"
    ),
    seed: Annotated[int, typer.Option(help="Of weights and batches; the first of several.")] = 0,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="How many race; the best on held-out objects wins.",
            show_default="the recipe's",
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", min=0, help="Seeds at a time; 0 means one a CPU core.")
    ] = 0,
    resume: Annotated[
        Path | None, typer.Option(help="Go on with this run instead; its recipe and seed hold.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda or cuda:1.")] = "cpu",
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves it to torch.")] = 0,
) -> None:
    """Train PPD on a data set, or go on with a run."""
    with _said("interrupted; the last checkpoint is kept, go on with --resume"):
        torch = _torch()
        from articugen.ppd.race import race
        from articugen.ppd.runs import RunFolder
        from articugen.ppd.settings import load_train_recipe
        from articugen.ppd.train import train as run_training

        if threads:
            torch.set_num_threads(threads)
        settings = load_train_recipe(recipe)
        if seeds is not None:
            settings = settings.with_seeds(seeds)
        if resume is not None:
            settings, seed = RunFolder(resume).recipe(), RunFolder(resume).about()["seed"]
        if device.startswith("cuda") and not torch.cuda.is_available():
            raise ArticugenError(f"--device {device}: torch sees no such GPU; use --device cpu")
        if settings.seeds.count > 1:
            at_once = (jobs or os.cpu_count() or 1) if device == "cpu" else 1
            run_training = partial(race, jobs=min(at_once, settings.seeds.count))
        with _ProgressBar() as on_progress:
            run = run_training(
                settings,
                category=category,
                data=data,
                runs=runs / category,
                seed=seed,
                resume=resume,
                device=device,
                on_progress=on_progress,
            )
        _out.print(f"done: {run.path}", soft_wrap=True)
        _out.print(f"next: articugen evaluate {run.path} --data {data}", soft_wrap=True)


def evaluate(
    run: Annotated[Path, typer.Argument(help="A run's folder, or that of a category's runs.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="The folder of the data set.")],
    resolution: Annotated[int, typer.Option(min=8, max=256, help="Of the meshes' grid.")] = 32,
    label_poses: Annotated[
        str, typer.Option(help="Whose poses vote for labels: canonical or all.")
    ] = "canonical",
    states: Annotated[
        int | None,
        typer.Option(min=1, help="Random states a test object.", show_default="all"),
    ] = None,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves it to torch.")] = 0,
) -> None:
    """Evaluate a run's last checkpoint on the test objects, as the paper does."""
    with _said():
        torch = _torch()
        from articugen.files import write_atomically
        from articugen.ppd.evaluate import Protocol
        from articugen.ppd.evaluate import evaluate as run_evaluation
        from articugen.ppd.reconstruct import reconstruction_from
        from articugen.ppd.report import markdown
        from articugen.ppd.runs import LATEST, read_checkpoint
        from articugen.records import dequantize

        if threads:
            torch.set_num_threads(threads)
        if label_poses not in ("canonical", "all"):
            raise ArticugenError(f"--label-poses {label_poses}: canonical or all")
        folder = _newest(run)
        checkpoint = read_checkpoint(folder / LATEST)
        see = reconstruction_from(checkpoint, resolution)
        with _err.status("evaluating ...") as status:
            result = run_evaluation(
                data,
                lambda instance: see(dequantize(instance.surface_points)),
                Protocol(label_poses=label_poses, test_states=states),
                on_object=lambda name: status.update(f"evaluated {name}"),
            )
        table = markdown(result, checkpoint.category)
        write_atomically(folder / "evaluation.json", (json.dumps(result, indent=1) + "\n").encode())
        write_atomically(folder / "evaluation.md", table.encode())
        _out.print(table, soft_wrap=True, markup=False)
        _out.print(f"written: {folder}/evaluation.json, evaluation.md", soft_wrap=True)


def predict(
    run: Annotated[Path, typer.Argument(help="A run's folder, or that of a category's runs.")],
    cloud: Annotated[
        Path, typer.Argument(help="A shard, or (n, 3) points in the unit frame as .npy.")
    ],
    row: Annotated[int, typer.Option(min=0, help="Which instance of the shard.")] = 0,
    out: Annotated[Path, typer.Option(help="The folder for meshes and URDF.")] = Path("rig"),
    resolution: Annotated[int, typer.Option(min=8, max=256, help="Of the meshes' grid.")] = 64,
) -> None:
    """Segment and rig a shape: a mesh for each part, and a URDF with the predicted joints."""
    with _said():
        _torch()
        from articugen.ppd.predict import cloud_from, write_rig
        from articugen.ppd.reconstruct import reconstruction_from
        from articugen.ppd.runs import LATEST, read_checkpoint

        checkpoint = read_checkpoint(_newest(run) / LATEST)
        found = reconstruction_from(checkpoint, resolution)(cloud_from(cloud, row))
        path = write_rig(found, out)
        for i in sorted(set(found.part.tolist())):
            kind = ("fixed", "revolute", "prismatic")[found.kind[i]]
            _out.print(f"part {i}: {kind}, state {found.state[i]:.3f}")
        _out.print(f"written: {path}", soft_wrap=True)


def _torch():
    try:
        import torch
    except ImportError:
        raise MissingExtra("torch", "ppd") from None
    return torch


def _newest(run: Path) -> Path:
    """The run itself, or the newest of the numbered runs in a folder."""
    if (run / "run.json").is_file():
        return run
    numbered = sorted((p for p in run.glob("*") if p.name.isdigit()), key=lambda p: int(p.name))
    if not numbered:
        raise InvalidCheckpoint(f"{run}: holds no run; make one with: articugen train")
    return numbered[-1]


class _ProgressBar:
    """A bar with rate and time left on a terminal; a line at each validation elsewhere."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        self.bar = Bar(
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f} iterations"),
            TextColumn("{task.fields[told]}"),
            TimeRemainingColumn(),
            console=_err,
            disable=not _err.is_terminal,
        )
        self.tasks: dict[int | None, TaskID] = {}

    def __enter__(self) -> "Callable[[Progress], None]":
        self.bar.start()
        return self._tell

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def _tell(self, progress: "Progress") -> None:
        if progress.seed not in self.tasks:
            self.tasks[progress.seed] = self.bar.add_task("", total=None, told="")
        task = self.tasks[progress.seed]
        who = "" if progress.seed is None else f"seed {progress.seed}: "
        self.bar.update(task, completed=progress.iteration, total=progress.iterations)
        if progress.terms:
            speed = self.bar.tasks[task].speed or 0.0
            told = f"{who}rec {progress.terms['rec']:.2f}, {speed:.2f}/s"
            self.bar.update(task, told=told)
        if progress.validation:
            values = ", ".join(f"{k} {v:.4f}" for k, v in progress.validation.items())
            line = f"{who}{progress.iteration}/{progress.iterations} held-out objects: {values}"
            self.bar.console.print(line, soft_wrap=True)
