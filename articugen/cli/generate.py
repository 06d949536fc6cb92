"""The commands `generate`, `merge` and `demo`: they make data sets and show how far that is."""

# Everything else is imported where it is used: --help should not wait for numba, h5py and trimesh.
# ruff: noqa: PLC0415
import shlex
import sys
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from articugen.cli.options import argument, offered
from articugen.cli.saying import (
    FAILED,
    KEPT,
    STOPPED,
    called_by_make,
    command,
    compile_for,
    counting_bar,
    said,
    say,
    stderr,
    stdout,
    whole_command,
)
from articugen.pipeline.options import Options, option

if TYPE_CHECKING:
    from articugen.pipeline.job import Job

DEMO, DEMO_RECIPE = 3, "quick"
"""Objects of a demo, and how they are made."""


@offered(
    "articugen generate --category laptop --recipe quick",
    "articugen generate -c laptop,oven --objects 6 --states 10 --out /tmp/data",
    "articugen generate -c storage_furniture -s partnet_mobility --movable 'drawer*'",
    "articugen generate -c table -s path/to/partnet_mobility --joints prismatic",
    "articugen generate -c oven -r quick --set views.count=50 --set 'sampling.grids=[16, 32]'",
    "articugen generate --category cabinet --source path/to/urdfs --dry-run",
    "On many machines that share a folder, the same line on each, here as a SLURM array "
    "(docs/scale.md has other launchers):",
    "sbatch --array=0-99 --cpus-per-task=4 --wrap 'articugen generate -c laptop -o /shared/data "
    "--shard $SLURM_ARRAY_TASK_ID/100'",
    "articugen merge /shared/data/laptop",
    "Into an object store, on as many machines as there are: "
    "articugen generate -c laptop -o s3://bucket/data",
    "On a Dask cluster: articugen generate -c laptop -o /shared/data --scheduler tcp://host:8786",
    "On SLURM, submitted, followed and merged by one command: articugen generate -c laptop "
    "-o /shared/data --scheduler 'slurm://partition?tasks=100&cpus=4&time=60'",
    interrupted=KEPT,
)
def generate(
    options: Options,
    dry_run: bool = option(False, "Print what would be made and why; make nothing."),
    shard: str | None = option(
        None,
        "Make only every N-th object, from the I-th on, counted from 0: one of N "
        "processes that fill one folder, on any machines. N may change between runs; when all "
        "have ended, `articugen merge` writes the manifest.",
        metavar="I/N",
        show_default="all objects",
    ),
) -> int:
    """Make a data set, or what is missing of it: run it again to resume."""
    from articugen.pipeline.door import jobs_of
    from articugen.pipeline.job import Share

    todo = jobs_of(options, None if shard is None else Share.of_text(shard))
    make = _made if len(todo) == 1 else _made_each
    return make(*todo, dry_run=dry_run, replace=options.replace)


def _made(job: "Job", *, dry_run: bool, replace: bool) -> int:
    """Make one data set, or a share of it, and report on it; the exit status."""
    from articugen.cli import console
    from articugen.pipeline.run import started

    whole = whole_command(sys.argv)
    executor = job.executor.of(job, whole)
    with started(job, command=whole) as run:
        if job.share:
            say(f"shard {job.share}: {len(run.plan.keys)} of {run.objects} objects")
        if dry_run:
            stdout.print(console.plan_table(job, run.plan))
            return 0
        cure = "REPLACE=1" if called_by_make() else "--replace"
        run.check_replaces(replace=replace, cure=f"add {cure}")
        with console.progress(run.plan) as callbacks:
            finished = run.finish(executor, *callbacks)
    if finished.manifest is None:
        return console.tell_share(finished.outcomes, job)
    if not run.plan.tasks:
        say("nothing to do, all of it was there already")
    status = console.tell(finished.manifest, job.out)
    if isinstance(job.out, Path):
        say(f"next: {_looking(job.out)}")
    return status


def _looking(folder: Path) -> str:
    """Return the command that shows what a data set holds."""
    if not called_by_make():
        return command("inspect", folder, "--image", folder / "sheet.png")
    where = [] if str(folder.parent) == "data" else [f"OUT={folder.parent}"]
    return shlex.join(["make", "inspect", f"CATEGORY={folder.name}", *where])


def _made_each(*todo: "Job", dry_run: bool, replace: bool) -> int:
    """Make several data sets: one that fails does not stop the others; the worst exit status."""
    ended: dict[str, int] = {}
    for job in todo:
        try:
            with said(KEPT):
                ended[job.category] = _made(job, dry_run=dry_run, replace=replace)
        except typer.Exit as left:
            if left.exit_code in STOPPED.values():
                raise
            ended[job.category] = left.exit_code
    failed = [name for name, status in ended.items() if status == FAILED]
    but = f"; not: {', '.join(failed)}" if failed else ""
    say(f"{len(ended) - len(failed)} of {len(ended)} categories are done{but}")
    return FAILED if failed else max(ended.values(), default=0)


@offered("articugen merge /shared/data/laptop")
def merge(
    path: Path = argument("The folder that ranks have filled, or one of such folders."),
    jobs: int | None = option(None, "Shards read at once.", "-j", min=1, show_default="all cores"),
    sizes_only: bool = option(False, "Compare sizes alone; `articugen verify` checks every byte."),
) -> int:
    """Check what `generate --shard` has made, and write the manifest."""
    from articugen.cli import console
    from articugen.pipeline.folder import data_sets
    from articugen.pipeline.merge import merge as merge_shares

    status = 0
    for folder in data_sets(path, follow=False):
        with counting_bar() as count_object:
            manifest = merge_shares(
                folder,
                jobs=jobs,
                sizes_only=sizes_only,
                on_object=count_object,
                on_notice=stdout.print,
            )
        status = max(status, console.tell(manifest, folder))
    return status


@offered(
    "articugen demo",
    "Without installing it: uvx --from articugen-*.whl articugen demo",
    interrupted=KEPT,
)
def demo(
    category: str = argument("What to make.", "laptop"),
    out: Path = option(Path("demo"), "The folder to write into.", "-o"),
) -> None:
    """Make a few objects, a picture and a page of them, within a minute."""
    from articugen.inspection.report.page import write_report
    from articugen.pictures.contact_sheet import contact_sheet
    from articugen.pipeline.door import generate as make

    done = count(1)
    with counting_bar() as count_object:
        data = make(
            category, out=out, recipe=DEMO_RECIPE, objects=DEMO,
            on_object=lambda one: count_object(next(done), DEMO, one.object_id),
        )  # fmt: skip
    compile_for("inspect")
    sheet, page, folder = (out / f"{category}{ending}" for ending in (".png", ".html", ""))
    with stderr.status("drawing ..."):
        contact_sheet(data.shards, sheet, states=4)
        write_report(folder, data.shards, page)
    say(f"{folder}: {len(data)} instances of {DEMO} objects, each a row with points and labels")
    say(f"{sheet}: all of them, a colour a part")
    say(f"{page}: an object to turn, and what was measured; open it in a browser")
    say("next:")
    for words in (
        ("inspect", folder),
        ("export", folder, "--to", "glb", "--out", out / "glb"),
        ("generate", "-c", "mine", "-s", "path/to/your/urdfs"),
    ):
        say(f"  {command(*words)}")
