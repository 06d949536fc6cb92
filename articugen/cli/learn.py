"""The commands of learning: each calls one function of `learning.commands`, prints what it says."""

# Everything heavy is imported where it is used: --help should not wait for torch.
# ruff: noqa: PLC0415
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from articugen.cli.options import DATA, DEVICE, RUN, THREADS, argument, offered
from articugen.cli.saying import command, compile_for, loading, said, say, stderr
from articugen.pipeline.options import CHANGES, option

if TYPE_CHECKING:
    from rich.progress import TaskID

    from articugen.learning.loop import Progress


@offered(
    "articugen train --category laptop --data data/laptop",
    "articugen train --category laptop --data data/laptop --set losses.vol=500",
    "articugen train --category laptop --data data/laptop --resume runs/laptop/000",
    "articugen train --category drawer --stream procedural_varied",
)
def train(
    category: str = option(MISSING, "What the data set holds.", "-c"),
    data: Sequence[Path] = option(
        (),
        "The folder of the data set. May be given several times: all are learned from "
        "together, real objects beside bundled ones, say.",
        "-d",
        show_default="needed, or --stream",
    ),
    stream: str | None = option(
        None, "Instead of a data set: new objects of this source for ever, procedural_varied say."
    ),
    recipe: str | None = option(
        None,
        "A name under recipes/, or a YAML file.",
        "-r",
        show_default="the method's own: ppd_quick",
    ),
    method: str | None = option(None, "What learns.", "-m", show_default="the recipe's, else ppd"),
    changes: Sequence[str] = CHANGES,
    runs: Path = option(Path("runs"), "Runs go to <runs>/<category>/<number>."),
    seed: int = option(0, "Of weights and batches; the first of several."),
    seeds: int | None = option(
        None,
        "How many race; the best on held-out objects wins.",
        min=1,
        show_default="the recipe's",
    ),
    jobs: int = option(0, "Seeds at a time; 0 means one a CPU core.", "-j", min=0),
    resume: Path | None = option(None, "Go on with this run instead; its recipe and seed hold."),
    device: str = DEVICE,
    threads: int = THREADS,
) -> None:
    """Train a method on a data set, or go on with a run."""
    run_folder = resume or f"{runs / category}/<the newest number>"
    with said(f"interrupted; what was last saved is kept, go on with --resume {run_folder}"):
        from articugen.core.recipe import check_category

        check_category(category)
        if bool(data) == bool(stream):
            raise typer.BadParameter("give the folder of a data set (--data), or --stream a source")
        with loading():
            from articugen.learning import commands
            from articugen.pipeline.stream import stream as open_stream

        for hint in commands.hints(data):
            say(hint, to=stderr)
        compile_for("train")
        source = open_stream(category, "stream", stream) if stream else data
        with _progress_bar() as on_progress:
            run = commands.train(
                source, recipe, method=method, changes=changes, category=category, runs=runs,
                seed=seed, seeds=seeds, jobs=jobs, resume=resume, device=device, threads=threads,
                on_progress=on_progress,
            )  # fmt: skip
        say(f"done: {run.path}")
        of = data[0] if data else f"data/{category}"
        say(f"next: {command('evaluate', run.path, '--data', of)}")


@offered("articugen train-depth runs/laptop --data data/laptop")
def train_depth(
    run: Path = RUN,
    data: Path = DATA,
    recipe: str | None = option(
        None, "ppd_depth is longer; or a YAML file.", "-r", show_default="ppd_depth_quick"
    ),
    changes: Sequence[str] = CHANGES,
    runs: Path = option(Path("runs-depth"), "Where the new run goes, as for train."),
    seed: int = option(0, "Of weights and batches."),
    resume: Path | None = option(None, "Go on with this run instead."),
    device: str = DEVICE,
    threads: int = THREADS,
) -> None:
    """Train an encoder for what one camera sees, beside a run: train, with that run as teacher."""
    with loading():
        from articugen.learning.commands import RunFolder, newest

    teacher, recipe = newest(run), recipe or (None if resume else "ppd_depth_quick")
    train(
        category=RunFolder(teacher).about()["category"], data=[data], recipe=recipe,
        changes=[*changes, *([f"teacher={json.dumps(str(teacher))}"] if recipe else [])],
        runs=runs, seed=seed, resume=resume, device=device, threads=threads,
    )  # fmt: skip


@offered("articugen evaluate runs/laptop --data data/laptop")
def evaluate(
    run: Path = RUN,
    data: Path = DATA,
    protocol: str = option("paper", "paper, or release: as the authors' code measures."),
    resolution: int | None = option(
        None,
        "Of the meshes' grid.",
        min=8,
        max=256,
        show_default="32, labels on 64 as well; release: 64",
    ),
    label_poses: str = option(
        "canonical", "Whose poses vote for labels: canonical, or all as well."
    ),
    states: int = option(8, "Random states an object; 0 means all, as in the paper.", min=0),
    on: Sequence[Path] = option(
        (),
        "Another data set: test all its objects, of which none was trained on. May be "
        "given several times, for an evaluation each.",
        show_default="the test objects",
    ),
    figures: bool = option(True, "Draw figures as well.", "--figures/--no-figures"),
    jobs: int = option(0, "Objects at a time, a thread each; 0: one for each core.", "-j", min=0),
) -> None:
    """Evaluate a run's last checkpoint on the test objects, as the paper does."""
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
                run, data, protocol=protocol, resolution=resolution, label_poses=label_poses,
                states=states or None, jobs=jobs, on=place,
                on_object=lambda name, status=status: status.update(f"evaluated {name}"),
            )  # fmt: skip
        say(markdown(result))
        say(f"written: {out}/evaluation.json, evaluation.md")
        if figures and protocol == "paper":
            with stderr.status("drawing ..."):
                for path in commands.draw(run, data, result):
                    say(f"drawn: {path}")


@offered("articugen tables runs --figure examples.png")
def tables(
    runs: Sequence[Path] = argument("Folders with evaluated runs in them."),
    figure: Path | None = option(
        None, "Draw a test object of each run in three states into this PNG as well."
    ),
    data: Path | None = option(
        None,
        "For --figure: a data set, or a folder with one named after each category.",
        "-d",
        show_default="what each run was trained on",
    ),
) -> None:
    """Print the paper's tables over all evaluated runs in folders, seeds as mean and spread."""
    if data and not figure:
        raise typer.BadParameter("--data is what --figure draws; name that too")
    from articugen.learning import commands

    say(commands.tables(runs))
    if figure:
        with stderr.status("drawing ..."):
            commands.draw_examples(runs, figure, data)
        say(f"drawn: {figure}")


@offered(
    "articugen train-all data/laptop -l ablation --budget 60 --seeds 3",
    interrupted="interrupted; what was last saved is kept, the same command resumes",
)
def train_all(
    data: Path = argument("The folder of the data set."),
    recipes: str = option(
        "comparison", "comparison, ablation, or a YAML list of recipes.", "--list", "-l"
    ),
    budget: float = option(10.0, "CPU minutes of each training, or a GPU's.", min=0.001, max=1e6),
    seeds: int = option(1, "Seeds of each recipe.", min=1),
    states: int = option(8, "Random states an object in the evaluation; 0 means all.", min=0),
    runs: Path | None = option(None, "Where runs go.", show_default="a folder called as the list"),
    jobs: int = option(2, "Recipes at a time.", "-j", min=1, max=2),
    device: str = DEVICE,
) -> None:
    """Train several recipes for equally long, evaluate them alike, print tables, draw an object."""
    with loading():
        from articugen.learning.comparison import compare as compare_recipes

    compile_for("train")
    with _progress_bar() as on_progress:
        done = compare_recipes(
            data, recipes, minutes=budget, runs=runs, seeds=seeds, states=states or None,
            jobs=jobs, device=device, on_progress=on_progress,
            on_done=lambda text: say(text, to=stderr),
        )  # fmt: skip
    say(done.text)
    say(f"written: {done.folder}/tables.md, {done.figure.name}")


@offered(
    "articugen predict runs/laptop data/laptop/test-00000.h5 --row 3",
    "articugen predict runs/laptop cloud.ply --fit --out rig",
    "articugen predict runs-depth/laptop view.ply",
)
def predict(
    run: Path = RUN,
    cloud: Path = argument("A shard, or points as .ply, .npy, .npz or .xyz."),
    row: int = option(0, "Which instance of the shard.", min=0),
    camera: int = option(0, "Which of the shard's, for a run of train-depth.", min=0),
    fit: bool = option(False, "Bring the cloud's box into the unit frame first."),
    out: Path = option(Path("rig"), "The folder for meshes, URDF and GLB."),
    resolution: int = option(128, "Of the meshes' grid.", min=8, max=256),
) -> None:
    """Segment and rig a shape: what is reconstructed, and what was given, cut into the parts."""
    from articugen.learning import commands

    with stderr.status("looking ...") as status:
        predicted = commands.predict(
            run, cloud, row=row, camera=camera, fit=fit, out=out, resolution=resolution,
            on_progress=status.update,
        )  # fmt: skip
    if predicted.cloud.hint:
        say(predicted.cloud.hint, to=stderr)
    for line in predicted.lines():
        say(line)
    say(", ".join([f"written: {predicted.path}", *(path.name for path in predicted.cut)]))


@offered()
def watch(
    run: Path = RUN,
    folder: Path = argument(
        "A sequence of RBO or of the Articulated Object Dataset, or OP-Align's views of an object."
    ),
    images: int = option(8, "How many of the sequence.", min=2),
    out: Path = option(Path("recorded"), "The folder for picture and numbers."),
) -> None:
    """Reconstruct a laptop that a depth camera has recorded, and compare with its true poses."""
    from articugen.learning.recorded import watch as watch_recorded

    numbers = watch_recorded(run, folder, images=images, out=out)
    for name, value in numbers.items():
        say(f"{name}: {value:.3g}")
    say(f"written: {out / 'figure.png'}")


@contextmanager
def _progress_bar() -> "Iterator[Callable[[Progress], None]]":
    """A bar with rate and time left on a terminal; elsewhere a line at each validation, and the
    last that was said of each thing done before: counts come to an end, findings stay."""
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    bar = Bar(
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} iterations"),
        TextColumn("{task.fields[state]}"),
        TimeRemainingColumn(),
        console=stderr,
        disable=not stderr.is_terminal,
    )
    tasks: dict[str, TaskID] = {}
    latest: dict[str, str] = {}
    kept: set[str] = set()

    def tell(progress: "Progress") -> None:
        if progress.who not in tasks:
            tasks[progress.who] = bar.add_task("", total=None, state="")
        task = tasks[progress.who]
        who = progress.who and f"{progress.who}: "
        bar.update(task, completed=progress.iteration, total=progress.iterations)
        before, latest[progress.who] = latest.get(progress.who, ""), progress.said
        is_over = before and before.partition(":")[0] != progress.said.partition(":")[0]
        if is_over and before not in kept:  # whichever of the seeds that race say so
            kept.add(before)
            say(before, to=bar.console)
        if progress.said:
            bar.update(task, state=f"{who}{progress.said}")
        if progress.terms:
            speed = bar.tasks[task].speed or 0.0
            name, value = next(iter(progress.terms.items()))
            bar.update(task, state=f"{who}{name} {value:.3g}, {speed:.2f}/s")
        if progress.validation:
            values = ", ".join(f"{k} {v:.4f}" for k, v in progress.validation.items())
            line = f"{who}{progress.iteration}/{progress.iterations} held-out objects: {values}"
            say(line, to=bar.console)

    with bar:
        yield tell
