"""The commands of learning: each calls one function of `learning.commands`, prints what it says."""

# Everything heavy is imported where it is used: --help should not wait for torch.
# ruff: noqa: PLC0415
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from articugen.cli.app import app
from articugen.cli.options import Changes, Data, Device, Run, Threads
from articugen.cli.saying import command, loading, said, stderr, stdout

if TYPE_CHECKING:
    from rich.progress import TaskID

    from articugen.learning.loop import Progress


@app.command(
    epilog="Examples:\n\narticugen train --category laptop --data data/laptop\n\n"
    "articugen train --category laptop --data data/laptop --set losses.vol=500\n\n"
    "articugen train --category laptop --data data/laptop --resume runs/laptop/000"
)
def train(
    category: Annotated[str, typer.Option("--category", "-c", help="What the data set holds.")],
    data: Annotated[
        list[Path],
        typer.Option(
            "--data",
            "-d",
            help="The folder of the data set. May be given several times: all are learned from "
            "together, real objects beside bundled ones, say.",
        ),
    ],
    recipe: Annotated[
        str | None,
        typer.Option(
            "--recipe",
            "-r",
            help="A name under recipes/, or a YAML file.",
            show_default="the method's own: ppd_quick",
        ),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option("--method", "-m", help="What learns.", show_default="the recipe's, else ppd"),
    ] = None,
    changes: Changes = None,
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
    device: Device = "cpu",
    threads: Threads = 0,
) -> None:
    """Train a method on a data set, or go on with a run."""
    run_folder = resume or f"{runs / category}/<the newest number>"
    with said(f"interrupted; what was last saved is kept, go on with --resume {run_folder}"):
        from articugen.core.recipe import check_category

        check_category(category)
        with loading():
            from articugen.core.compiling import compile_kernels
            from articugen.learning import commands
            from articugen.pipeline.run import default_jobs

        for hint in commands.hints(data):
            stderr.print(hint, soft_wrap=True, markup=False)
        compile_kernels("train", jobs=default_jobs(), notice=stderr.print)
        with _ProgressBar() as on_progress:
            run = commands.train(
                data,
                recipe,
                method=method,
                changes=changes or (),
                category=category,
                runs=runs,
                seed=seed,
                seeds=seeds,
                jobs=jobs,
                resume=resume,
                device=device,
                threads=threads,
                on_progress=on_progress,
            )
        stdout.print(f"done: {run.path}", soft_wrap=True)
        then = command("evaluate", run.path, "--data", data[0])
        stdout.print(f"next: {escape(then)}", soft_wrap=True)


@app.command(epilog="Example: articugen train-depth runs/laptop --data data/laptop")
def train_depth(
    run: Run,
    data: Data,
    recipe: Annotated[
        str, typer.Option("--recipe", "-r", help="ppd_depth is longer; or a YAML file.")
    ] = "ppd_depth_quick",
    changes: Changes = None,
    runs: Annotated[Path, typer.Option(help="Where the new run goes, as for train.")] = Path(
        "runs-depth"
    ),
    resume: Annotated[Path | None, typer.Option(help="Go on with this run instead.")] = None,
    device: Device = "cpu",
    threads: Threads = 0,
) -> None:
    """Train an encoder for what one camera sees, beside a run: train, with that run as teacher."""
    with said():
        with loading():
            from articugen.learning.commands import RunFolder, newest

        teacher = newest(run)
        category = RunFolder(teacher).about()["category"]
    settings = [*(changes or ()), f"teacher={json.dumps(str(teacher))}"]
    train(
        category, [data], recipe, changes=settings, runs=runs, resume=resume, device=device,
        threads=threads,
    )  # fmt: skip


@app.command(epilog="Example: articugen evaluate runs/laptop --data data/laptop")
def evaluate(
    run: Run,
    data: Data,
    protocol: Annotated[
        str, typer.Option(help="paper, or release: as the authors' code measures.")
    ] = "paper",
    resolution: Annotated[
        int | None,
        typer.Option(
            min=8,
            max=256,
            help="Of the meshes' grid.",
            show_default="32, labels on 64 as well; release: 64",
        ),
    ] = None,
    label_poses: Annotated[
        str, typer.Option(help="Whose poses vote for labels: canonical, or all as well.")
    ] = "canonical",
    states: Annotated[
        int, typer.Option(min=0, help="Random states an object; 0 means all, as in the paper.")
    ] = 8,
    on: Annotated[
        list[Path] | None,
        typer.Option(
            help="Another data set: test all its objects, of which none was trained on. May be "
            "given several times, for an evaluation each.",
            show_default="the test objects",
        ),
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw figures as well.")] = True,
    threads: Annotated[
        int, typer.Option(min=0, help="CPU threads, of which more hardly help; 0: torch's.")
    ] = 1,
) -> None:
    """Evaluate a run's last checkpoint on the test objects, as the paper does."""
    with said():
        from articugen.evaluation.report import markdown
        from articugen.learning import commands
        from articugen.store.manifest import Manifest

        folders = [commands.evaluation_folder(run, protocol, place) for place in on or [None]]
        if len(set(folders)) < len(folders):
            raise typer.BadParameter("--on: two of the data sets have one name; rename a folder")
        for place in on or ():
            commands.check_splits(data, Manifest.read(data).category, place)
        for place, out in zip(on or [None], folders, strict=True):
            with stderr.status("evaluating ...") as status:
                result = commands.evaluate(
                    run,
                    data,
                    protocol=protocol,
                    resolution=resolution,
                    label_poses=label_poses,
                    states=states or None,
                    threads=threads,
                    on=place,
                    on_object=lambda name, status=status: status.update(f"evaluated {name}"),
                )
            stdout.print(markdown(result), soft_wrap=True, markup=False)
            stdout.print(f"written: {out}/evaluation.json, evaluation.md", soft_wrap=True)
            if figures and protocol == "paper":
                with stderr.status("drawing ..."):
                    for path in commands.draw(run, data, result):
                        stdout.print(f"drawn: {path}", soft_wrap=True)


@app.command(epilog="Example: articugen tables runs --figure examples.png")
def tables(
    runs: Annotated[list[Path], typer.Argument(help="Folders with evaluated runs in them.")],
    figure: Annotated[
        Path | None,
        typer.Option(help="Draw a test object of each run in three states into this PNG as well."),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            "-d",
            help="For --figure: a data set, or a folder with one named after each category.",
            show_default="what each run was trained on",
        ),
    ] = None,
) -> None:
    """Print the paper's tables over all evaluated runs in folders, seeds as mean and spread."""
    if data and not figure:
        raise typer.BadParameter("--data is what --figure draws; name that too")
    with said():
        from articugen.learning import commands

        stdout.print(commands.tables(runs), soft_wrap=True, markup=False)
        if figure:
            with stderr.status("drawing ..."):
                commands.draw_examples(runs, figure, data)
            stdout.print(f"drawn: {figure}", soft_wrap=True)


@app.command(epilog="Example: articugen train-all data/laptop -l ablation --budget 60 --seeds 3")
def train_all(
    data: Annotated[Path, typer.Argument(help="The folder of the data set.")],
    recipes: Annotated[
        str, typer.Option("--list", "-l", help="comparison, ablation, or a YAML list of recipes.")
    ] = "comparison",
    budget: Annotated[
        float, typer.Option(min=0.001, help="CPU minutes of each training; on a GPU, the clock's.")
    ] = 10.0,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds of each recipe.")] = 1,
    states: Annotated[
        int, typer.Option(min=0, help="Random states an object in the evaluation; 0 means all.")
    ] = 8,
    runs: Annotated[
        Path | None, typer.Option(help="Where runs go.", show_default="a folder called as the list")
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, max=2, help="Recipes at a time.")] = 2,
    device: Device = "cpu",
) -> None:
    """Train several recipes for equally long, evaluate them alike, print tables, draw an object."""
    with said("interrupted; what was last saved is kept, the same command resumes"):
        with loading():
            from articugen.core.compiling import compile_kernels
            from articugen.learning.comparison import compare as compare_recipes
            from articugen.pipeline.run import default_jobs

        compile_kernels("train", jobs=default_jobs(), notice=stderr.print)
        with _ProgressBar() as on_progress:
            done = compare_recipes(
                data, recipes, minutes=budget, runs=runs, seeds=seeds, states=states or None,
                jobs=jobs, device=device, on_progress=on_progress,
                on_done=lambda text: stderr.print(escape(text), soft_wrap=True),
            )  # fmt: skip
        stdout.print(done.text, soft_wrap=True, markup=False)
        stdout.print(f"written: {done.folder}/tables.md, {done.figure.name}", soft_wrap=True)


@app.command(
    epilog="Examples:\n\narticugen predict runs/laptop data/laptop/test-00000.h5 --row 3\n\n"
    "articugen predict runs/laptop cloud.ply --fit --out rig\n\n"
    "articugen predict runs-depth/laptop view.ply"
)
def predict(
    run: Run,
    cloud: Annotated[Path, typer.Argument(help="A shard, or points as .ply, .npy, .npz or .xyz.")],
    row: Annotated[int, typer.Option(min=0, help="Which instance of the shard.")] = 0,
    camera: Annotated[
        int, typer.Option(min=0, help="Which of the shard's, for a run of train-depth.")
    ] = 0,
    fit: Annotated[
        bool, typer.Option("--fit", help="Bring the cloud's box into the unit frame first.")
    ] = False,
    out: Annotated[Path, typer.Option(help="The folder for meshes, URDF and GLB.")] = Path("rig"),
    resolution: Annotated[int, typer.Option(min=8, max=256, help="Of the meshes' grid.")] = 64,
) -> None:
    """Segment and rig a shape: what is reconstructed, and what was given, cut into the parts."""
    with said():
        from articugen.learning import commands

        with stderr.status("looking, cutting, drawing ..."):
            made = commands.predict(
                run, cloud, row=row, camera=camera, fit=fit, out=out, resolution=resolution
            )
        if made.cloud.hint:
            stderr.print(made.cloud.hint, soft_wrap=True)
        for line in made.lines():
            stdout.print(line)
        cut = "".join(f", {path.name}" for path in made.cut)
        stdout.print(f"written: {made.path}{cut}", soft_wrap=True)


@app.command()
def watch(
    run: Run,
    folder: Annotated[
        Path, typer.Argument(help="A sequence of RBO or of the Articulated Object Dataset.")
    ],
    images: Annotated[int, typer.Option(min=2, help="How many of the sequence.")] = 8,
    out: Annotated[Path, typer.Option(help="The folder for picture and numbers.")] = Path(
        "recorded"
    ),
) -> None:
    """Reconstruct a laptop that a depth camera has recorded, and compare with its true poses."""
    with said():
        from articugen.learning.recorded import watch as watch_recorded

        outcome = watch_recorded(run, folder, images=images, out=out)
        for name, value in outcome.numbers.items():
            stdout.print(f"{name}: {value:.3g}")
        stdout.print(f"written: {outcome.figure}", soft_wrap=True)


class _ProgressBar:
    """A bar with rate and time left on a terminal; elsewhere a line at each validation, and the
    last that was said of each thing done before: counts come to an end, findings stay."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        self.bar = Bar(
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f} iterations"),
            TextColumn("{task.fields[state]}"),
            TimeRemainingColumn(),
            console=stderr,
            disable=not stderr.is_terminal,
        )
        self.tasks: dict[str, TaskID] = {}
        self.latest: dict[str, str] = {}
        self.kept: set[str] = set()

    def __enter__(self) -> "Callable[[Progress], None]":
        self.bar.start()
        return self._tell

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def _tell(self, progress: "Progress") -> None:
        if progress.who not in self.tasks:
            self.tasks[progress.who] = self.bar.add_task("", total=None, state="")
        task = self.tasks[progress.who]
        who = progress.who and f"{progress.who}: "
        self.bar.update(task, completed=progress.iteration, total=progress.iterations)
        before, self.latest[progress.who] = self.latest.get(progress.who, ""), progress.said
        is_over = before and before.partition(":")[0] != progress.said.partition(":")[0]
        if is_over and before not in self.kept:  # whichever of the seeds that race say so
            self.kept.add(before)
            self.bar.console.print(before, soft_wrap=True)
        if progress.said:
            self.bar.update(task, state=f"{who}{progress.said}")
        if progress.terms:
            speed = self.bar.tasks[task].speed or 0.0
            name, value = next(iter(progress.terms.items()))
            self.bar.update(task, state=f"{who}{name} {value:.3g}, {speed:.2f}/s")
        if progress.validation:
            values = ", ".join(f"{k} {v:.4f}" for k, v in progress.validation.items())
            line = f"{who}{progress.iteration}/{progress.iterations} held-out objects: {values}"
            self.bar.console.print(line, soft_wrap=True)
