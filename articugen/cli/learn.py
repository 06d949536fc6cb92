"""PPD's commands: a thin face, each calls one function. articugen/cli/data.py registers them."""

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

    from articugen.learning.loop import Progress

Said = Callable[..., AbstractContextManager[None]]

FEW_OBJECTS = 20
"""Fewer than the smallest category's 24."""

_said: Said
_out = Console(highlight=False)
_err = Console(stderr=True, highlight=False)


def register(app: typer.Typer, said_in_one_sentence: Said) -> None:
    """Add the commands to the command line; `said_in_one_sentence` prints our errors."""
    global _said  # noqa: PLW0603
    _said = said_in_one_sentence
    app.command(
        epilog="Examples:\n\narticugen train --category laptop --data data/laptop\n\n"
        "articugen train --category laptop --data data/laptop --set losses.vol=500\n\n"
        "articugen train --category laptop --data data/laptop --resume runs/laptop/000"
    )(train)
    app.command(epilog="Example: articugen train-depth runs/laptop --data data/laptop")(train_depth)
    app.command(epilog="Example: articugen evaluate runs/laptop --data data/laptop")(evaluate)
    app.command(epilog="Example: articugen tables runs/*")(tables)
    app.command(
        epilog="Examples:\n\narticugen predict runs/laptop data/laptop/test-00000.h5 --row 3\n\n"
        "articugen predict runs/laptop cloud.ply --fit --out rig"
    )(predict)


def train(
    category: Annotated[str, typer.Option("--category", "-c", help="What the data set holds.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="The folder of the data set.")],
    recipe: Annotated[
        str | None,
        typer.Option(
            "--recipe",
            "-r",
            help="A name under recipes/, or a YAML file.",
            show_default="ppd_quick",
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="SECTION.KEY=VALUE",
            help="Another value than the recipe's, as YAML; may be given several times.",
            show_default="none",
        ),
    ] = None,
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
        from articugen.recipe import check_category

        check_category(category)
        _prepare(device, threads)
        from articugen.learning import processes, tensorboard
        from articugen.learning.loop import train as run_training
        from articugen.learning.ppd.settings import load_train_recipe
        from articugen.learning.race import race
        from articugen.learning.runs import RunFolder
        from articugen.recipe_files import with_settings

        settings = with_settings(load_train_recipe(recipe or "ppd_quick"), changes or ())
        if seeds is not None:
            settings = settings.with_seeds(seeds)
        if resume is not None:
            asked = settings if recipe or changes else None
            settings, seed = RunFolder(resume).recipe(), RunFolder(resume).about()["seed"]
            if asked and not asked.same_but_seeds(settings):
                raise InvalidCheckpoint(
                    f"{resume}: was started with another recipe; leave out --recipe and --set, or "
                    "start a new run"
                )
        if settings.seeds.count > 1:
            if processes.started() > 1:
                raise ArticugenError(
                    "torchrun: seeds race in processes of their own; add --seeds 1"
                )
            at_once = (jobs or os.cpu_count() or 1) if device == "cpu" else 1
            run_training = partial(race, jobs=min(at_once, settings.seeds.count))
        with processes.joined(device) as own_device, _ProgressBar() as on_progress:
            if processes.is_first():
                _hint_of_few(data)
                if not tensorboard.is_installed():
                    _err.print(tensorboard.MISSING, soft_wrap=True, markup=False)
            run = run_training(
                settings,
                category=category,
                data=data,
                runs=runs / category,
                seed=seed,
                resume=resume,
                device=own_device,
                on_progress=on_progress,
            )
            if not run.writes:
                return
        _out.print(f"done: {run.path}", soft_wrap=True)
        _out.print(f"next: articugen evaluate {run.path} --data {data}", soft_wrap=True)


def train_depth(
    run: Annotated[Path, typer.Argument(help="A run's folder, or that of a category's runs.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="The folder of the data set.")],
    device: Annotated[str, typer.Option(help="cpu, cuda or cuda:1.")] = "cpu",
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves it to torch.")] = 0,
) -> None:
    """Train a run's encoder for depth input, or go on with it: what one camera sees, not all."""
    with _said("interrupted; what was last saved is kept, the same command goes on"):
        _prepare(device, threads)
        from articugen.learning import processes
        from articugen.learning.ppd.depth import train_depth as run_training
        from articugen.learning.runs import RunFolder

        if processes.started() > 1:
            raise ArticugenError("train-depth runs in one process; leave out torchrun")
        folder = RunFolder.existing(_newest(run))
        with _ProgressBar() as on_progress:
            path = run_training(folder, data, device=device, on_progress=on_progress)
        _out.print(f"done: {path}", soft_wrap=True)
        _out.print(f"next: articugen evaluate {folder.path} --data {data}", soft_wrap=True)


def evaluate(
    run: Annotated[Path, typer.Argument(help="A run's folder, or that of a category's runs.")],
    data: Annotated[Path, typer.Option("--data", "-d", help="The folder of the data set.")],
    protocol: Annotated[
        str, typer.Option(help="paper, or release: as the authors' code measures.")
    ] = "paper",
    resolution: Annotated[
        int | None,
        typer.Option(min=8, max=256, help="Of the meshes' grid.", show_default="32; release: 64"),
    ] = None,
    label_poses: Annotated[
        str, typer.Option(help="Whose poses vote for labels: canonical or all.")
    ] = "canonical",
    states: Annotated[
        int | None,
        typer.Option(min=1, help="Random states a test object.", show_default="all"),
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw figures as well (minutes).")] = True,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves it to torch.")] = 0,
) -> None:
    """Evaluate a run's last checkpoint on the test objects, as the paper does."""
    with _said():
        _prepare("cpu", threads)
        from articugen.learning.evaluation.evaluate import Protocol
        from articugen.learning.evaluation.evaluate import evaluate as run_evaluation
        from articugen.learning.evaluation.report import markdown
        from articugen.learning.ppd import release
        from articugen.learning.ppd.depth import DEPTH, read_depth_model, seen_by_a_camera
        from articugen.learning.ppd.reconstruct import reconstruction_from
        from articugen.learning.runs import LATEST, RunFolder, about, read_checkpoint
        from articugen.records import dequantize
        from articugen.store.files import write_atomically

        if label_poses not in ("canonical", "all"):
            raise ArticugenError(f"--label-poses {label_poses}: canonical or all")
        if protocol not in ("paper", "release"):
            raise ArticugenError(f"--protocol {protocol}: paper or release")
        meshes = None
        if protocol == "release":
            run_evaluation, meshes = release.evaluate_as_release, release.release_meshes
            resolution = resolution or release.RESOLUTION
        folder = _newest(run)
        checkpoint = read_checkpoint(folder / LATEST)
        see = reconstruction_from(checkpoint, resolution or 32, meshes)
        with _err.status("evaluating ...") as status:
            measure = partial(
                run_evaluation,
                data,
                protocol=Protocol(
                    label_poses=label_poses,
                    test_states=states,
                    occupancy=checkpoint.recipe.data.occupancy,
                ),
                category=checkpoint.category,
                on_object=lambda name: status.update(f"evaluated {name}"),
            )
            result = measure(lambda instance: see(dequantize(instance.surface_points)))
            if (folder / DEPTH).is_file():
                model = read_depth_model(folder, checkpoint)
                look = reconstruction_from(checkpoint, resolution or 32, meshes, model=model)
                result["depth_input"] = measure(lambda instance: look(seen_by_a_camera(instance)))
        asked = {"protocol": protocol, "label_poses": label_poses, "resolution": resolution or 32}
        result = {"run": about(checkpoint) | asked, **result}
        table = markdown(result)
        out = folder / ("evaluation" if protocol == "paper" else f"evaluation-{protocol}")
        out.mkdir(exist_ok=True)
        text = json.dumps(result, indent=1) + "\n"
        write_atomically(out / "evaluation.json", text.encode())
        write_atomically(out / "evaluation.md", table.encode())
        _out.print(table, soft_wrap=True, markup=False)
        _out.print(f"written: {out}/evaluation.json, evaluation.md", soft_wrap=True)
        if figures and protocol == "paper":
            from articugen.learning.evaluation.figures.draw import draw_figures

            fine = min(4 * (resolution or 32), 128)
            drawn = draw_figures(out, RunFolder(folder), data, checkpoint, result, resolution=fine)
            with _err.status("drawing ..."):
                for path in drawn:
                    _out.print(f"drawn: {path}", soft_wrap=True)


def tables(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs that were evaluated.")],
) -> None:
    """Print the paper's tables over several evaluated runs: categories, ablations, inputs."""
    with _said():
        from articugen.learning.evaluation.report import read_result
        from articugen.learning.evaluation.report import tables as written

        results = [read_result(_newest(run)) for run in runs]
        _out.print(written(results), soft_wrap=True, markup=False)


def predict(
    run: Annotated[Path, typer.Argument(help="A run's folder, or that of a category's runs.")],
    cloud: Annotated[Path, typer.Argument(help="A shard, or points as .ply, .npy, .npz or .xyz.")],
    row: Annotated[int, typer.Option(min=0, help="Which instance of the shard.")] = 0,
    depth: Annotated[
        bool, typer.Option("--depth", help="One depth camera's cloud; needs train-depth.")
    ] = False,
    camera: Annotated[int, typer.Option(min=0, help="Which of the shard's, for --depth.")] = 0,
    fit: Annotated[
        bool, typer.Option("--fit", help="Bring the cloud's box into the unit frame first.")
    ] = False,
    out: Annotated[Path, typer.Option(help="The folder for meshes and URDF.")] = Path("rig"),
    resolution: Annotated[int, typer.Option(min=8, max=256, help="Of the meshes' grid.")] = 64,
) -> None:
    """Segment and rig a shape: a mesh for each part, and a URDF with the predicted joints."""
    with _said():
        _prepare()
        from articugen.learning.clouds import cloud_of_file, cloud_of_shard
        from articugen.learning.ppd.depth import read_depth_model
        from articugen.learning.ppd.reconstruct import reconstruction_from
        from articugen.learning.predict import write_rig
        from articugen.learning.runs import LATEST, read_checkpoint

        folder = _newest(run)
        checkpoint = read_checkpoint(folder / LATEST)
        if cloud.suffix == ".h5":
            eye = camera if depth else None
            given = cloud_of_shard(cloud, row, category=checkpoint.category, camera=eye)
        else:
            given = cloud_of_file(cloud, fit=fit)
        if given.hint:
            _err.print(given.hint, soft_wrap=True)
        model = read_depth_model(folder, checkpoint) if depth else None
        found = reconstruction_from(checkpoint, resolution, model=model)(given.points)
        path = write_rig(found, out, frame=given.frame)
        for i in sorted(set(found.part.tolist())):
            kind = ("fixed", "revolute", "prismatic")[found.kind[i]]
            state = found.state[i] * (given.frame.scale if kind == "prismatic" else 1.0)
            _out.print(f"part {i}: {kind}, state {state:.3f}")
        _out.print(f"written: {path}", soft_wrap=True)


def _prepare(device: str = "cpu", threads: int = 0) -> None:
    """Raise where torch or the device is not there."""
    try:
        import torch
    except ImportError:
        raise MissingExtra("torch", "ppd") from None
    if threads:
        torch.set_num_threads(threads)
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        raise ArticugenError(
            f"--device {device}: torch sees no such device; use --device cpu"
        ) from None


def _hint_of_few(data: Path) -> None:
    """Tell where a data set is too small for a model to carry over to other objects."""
    from articugen.store.manifest import Manifest

    count = sum(o.key.split == "train" for o in Manifest.read(data).objects)
    if count < FEW_OBJECTS:
        _err.print(
            f"{data}: {count} training objects show that all works, but teach little that carries "
            "over to others; for that make the full data set, without RECIPE=quick or OBJECTS=",
            soft_wrap=True, markup=False,
        )  # fmt: skip


def _newest(run: Path) -> Path:
    """The run itself, or the newest of the numbered runs in a folder."""
    if (run / "run.json").is_file():
        return run
    numbered = sorted((p for p in run.glob("*") if p.name.isdecimal()), key=lambda p: int(p.name))
    if not numbered:
        raise InvalidCheckpoint(f"{run}: holds no run; make one with: articugen train")
    return numbered[-1]


class _ProgressBar:
    """A bar with rate and time left on a terminal; a line at each validation elsewhere."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        from articugen.learning.processes import is_first

        self.bar = Bar(
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f} iterations"),
            TextColumn("{task.fields[told]}"),
            TimeRemainingColumn(),
            console=_err,
            disable=not (_err.is_terminal and is_first()),
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
            name, value = next(iter(progress.terms.items()))
            self.bar.update(task, told=f"{who}{name} {value:.3g}, {speed:.2f}/s")
        if progress.validation:
            values = ", ".join(f"{k} {v:.4f}" for k, v in progress.validation.items())
            line = f"{who}{progress.iteration}/{progress.iterations} held-out objects: {values}"
            self.bar.console.print(line, soft_wrap=True)
