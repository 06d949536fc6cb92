"""The commands `generate` and `merge`: they make data sets and show how far that is."""

# Everything else is imported where it is used: --help should not wait for numba, h5py and trimesh.
# ruff: noqa: PLC0415
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from articugen.cli.app import app
from articugen.cli.options import with_options_of
from articugen.cli.saying import (
    FAILED,
    KEPT,
    STOPPED,
    called_by_make,
    command,
    counting_bar,
    said,
    stderr,
    stdout,
    whole_command,
)
from articugen.pipeline.options import Options

if TYPE_CHECKING:
    from articugen.pipeline.job import Job


@app.command(
    epilog="Examples:\n\n"
    "articugen generate --category laptop --recipe quick\n\n"
    "articugen generate -c laptop,oven --objects 6 --states 10 --out /tmp/data\n\n"
    "articugen generate -c storage_furniture -s partnet_mobility --movable 'drawer*'\n\n"
    "articugen generate -c table -s path/to/partnet_mobility --joints prismatic\n\n"
    "articugen generate -c oven -r quick --set views.count=50 --set 'sampling.grids=[16, 32]'\n\n"
    "articugen generate --category cabinet --source path/to/urdfs --dry-run\n\n"
    "On many machines that share a folder, the same line on each, here as a SLURM array "
    "(docs/scale.md has other launchers):\n\n"
    "sbatch --array=0-99 --cpus-per-task=4 --wrap 'articugen generate -c laptop -o /shared/data "
    "--shard $SLURM_ARRAY_TASK_ID/100'\n\n"
    "articugen merge /shared/data/laptop\n\n"
    "Into an object store, on as many machines as there are: "
    "articugen generate -c laptop -o s3://bucket/data\n\n"
    "On a Dask cluster: articugen generate -c laptop -o /shared/data --scheduler tcp://host:8786\n\n"
    "On SLURM, submitted, followed and merged by one command: articugen generate -c laptop "
    "-o /shared/data --scheduler 'slurm://partition?tasks=100&cpus=4&time=60'",
)
@with_options_of(Options)
def generate(
    options: Options,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be made and why; make nothing.")
    ] = False,
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Make only every N-th object, from the I-th on, counted from 0: one of N "
            "processes that fill one folder, on any machines. N may change between runs; when all "
            "have ended, `articugen merge` writes the manifest.",
            show_default="all objects",
        ),
    ] = None,
) -> None:
    """Make a data set, or what is missing of it: run it again to resume."""
    with said(KEPT):
        from articugen.pipeline.door import jobs_of
        from articugen.pipeline.job import Share

        todo = jobs_of(options, None if shard is None else Share.of_text(shard))
    make = _made if len(todo) == 1 else _made_each
    status = make(*todo, dry_run=dry_run, replace=options.replace)
    if status:
        raise typer.Exit(status)


def _made(job: "Job", *, dry_run: bool, replace: bool) -> int:
    """Make one data set, or a share of it, and tell of it; the exit status."""
    with said(KEPT):
        from articugen.cli import console
        from articugen.pipeline.run import started

        whole = whole_command(sys.argv)
        executor = job.executor.of(job, whole)
        with started(job, command=whole) as run:
            if job.share:
                count = f"{len(run.plan.keys)} of {run.objects} objects"
                stdout.print(f"shard {job.share}: {count}", soft_wrap=True)
            if dry_run:
                stdout.print(console.plan_table(job, run.plan))
                return 0
            cure = "REPLACE=1" if called_by_make() else "--replace"
            run.check_replaces(replace=replace, cure=f"add {cure}")
            with console.progress(stderr, run.plan) as callbacks:
                finished = run.finish(executor, *callbacks)
        if finished.manifest is None:
            return console.tell_share(finished.outcomes, job)
        if not run.plan.tasks:
            stdout.print("nothing to do, all of it was there already")
        status = console.tell(finished.manifest, job.out)
        if isinstance(job.out, Path):
            stdout.print(f"next: {escape(_looking(job.out))}", soft_wrap=True)
    return status


def _looking(folder: Path) -> str:
    """The command that shows what a data set holds."""
    if not called_by_make():
        return command("inspect", folder, "--image", folder / "sheet.png")
    where = [] if str(folder.parent) == "data" else [f"OUT={folder.parent}"]
    return shlex.join(["make", "inspect", f"CATEGORY={folder.name}", *where])


def _made_each(*todo: "Job", dry_run: bool, replace: bool) -> int:
    """Make several data sets: one that fails does not stop the others; the worst exit status."""
    ended: dict[str, int] = {}
    for job in todo:
        try:
            ended[job.category] = _made(job, dry_run=dry_run, replace=replace)
        except typer.Exit as left:
            if left.exit_code in STOPPED.values():
                raise
            ended[job.category] = left.exit_code
    failed = [name for name, status in ended.items() if status == FAILED]
    stdout.print(
        f"{len(ended) - len(failed)} of {len(ended)} categories are done"
        + (f"; not: {', '.join(failed)}" if failed else ""),
        soft_wrap=True,
    )
    return FAILED if failed else max(ended.values(), default=0)


@app.command(epilog="Example: articugen merge /shared/data/laptop")
def merge(
    path: Annotated[
        Path, typer.Argument(help="The folder that ranks have filled, or one of such folders.")
    ],
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=1, help="Shards read at once.", show_default="all cores"),
    ] = None,
    sizes_only: Annotated[
        bool,
        typer.Option(
            "--sizes-only", help="Compare sizes alone; `articugen verify` looks at every byte."
        ),
    ] = False,
) -> None:
    """Check what `generate --shard` has made, and write the manifest."""
    status = 0
    with said():
        from articugen.cli import console
        from articugen.pipeline.folder import data_sets
        from articugen.pipeline.merge import merge as merge_shares
        from articugen.pipeline.run import default_jobs

        for folder in data_sets(path, follow=False):
            with counting_bar() as told:
                manifest = merge_shares(
                    folder, jobs=jobs or default_jobs(), sizes_only=sizes_only, on_object=told,
                    on_notice=stdout.print,
                )  # fmt: skip
            status = max(status, console.tell(manifest, folder))
    if status:
        raise typer.Exit(status)
