"""The command line: a thin face, each command calls one function.

Exit status: 0 done; 1 an error, said in one sentence on stderr, or a data set that is not what its
recipe asks for, as its manifest says; 2 wrong usage; 3 the data set is complete, but for objects
that were rejected (within the recipe's limit); 130 interrupted; 143 ended by SIGTERM.
"""

# Everything else is imported where it is used: --help should not wait for numba, h5py and trimesh.
# ruff: noqa: PLC0415
import os
import shlex
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.markup import escape

from articugen.cli.discover import register as register_discover
from articugen.cli.export import register as register_export
from articugen.cli.fetch import register as register_fetch
from articugen.cli.learn import Changes
from articugen.cli.learn import register as register_learning
from articugen.cli.listed import listed
from articugen.cli.merge import register as register_merge
from articugen.cli.saying import (
    FAILED,
    KEPT,
    STOPPED,
    UNHEARD,
    Stopped,
    called_by_make,
    command,
    counting_bar,
    said,
    say_error,
    stderr,
    stdout,
    whole_command,
)
from articugen.cli.view import register as register_view
from articugen.core.content import VERSION

if TYPE_CHECKING:
    from articugen.pipeline.job import Job
    from articugen.verify.dataset import Repair

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Articulated URDF models in, labelled HDF5 training data out.",
    epilog="Exit status: 0 done, 1 error, 2 wrong usage, 3 done but some objects were rejected, "
    "130 interrupted, 143 ended by SIGTERM.",
)


def main() -> None:
    """Run the command line and exit."""
    stopped: list[int] = []
    for number in STOPPED:
        signal.signal(number, partial(_stop_once, stopped))
    try:
        app(prog_name="articugen")
    except OSError as error:  # what is meant for the terminal went to a full disk, say
        with suppress(OSError):
            say_error(f"{error.filename or 'output'}: {error.strerror}")
        _drop_output()
        sys.exit(FAILED)
    except SystemExit as left:
        if stopped and left.code:
            _leave_at_once(STOPPED[stopped[0]])
        if isinstance(left.__context__, BrokenPipeError):  # rich and click call that 1
            _drop_output()
            sys.exit(UNHEARD)
        raise


def _stop_once(stopped: list[int], number: int, _: object) -> None:
    """The first Ctrl-C or SIGTERM stops the work; what is then put in order takes no second one."""
    for each in STOPPED:
        signal.signal(each, signal.SIG_IGN)
    stopped.append(number)
    raise Stopped(number)


def _leave_at_once(status: int) -> NoReturn:
    """Without waiting for threads that wait for a server: what is to be kept is kept."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def _drop_output() -> None:
    """Have Python not try again, at its end, to write what could not be written."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)


def _version(wanted: bool) -> None:
    if wanted:
        stdout.print(f"articugen {VERSION}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Say which and exit."),
    ] = False,
) -> None:
    pass


@app.command(
    epilog="Examples:\n\n"
    "articugen generate --category laptop --recipe quick\n\n"
    "articugen generate -c laptop,oven --objects 6 --states 10 --out /tmp/data\n\n"
    "articugen generate -c storage_furniture -s partnet_mobility --movable 'drawer*'\n\n"
    "articugen generate -c table -s path/to/partnet_mobility --joints prismatic\n\n"
    "articugen generate -c oven -r quick --set views.count=50 --set 'sampling.grids=[16, 32]'\n\n"
    "articugen generate --category cabinet --source path/to/urdfs --dry-run\n\n"
    "On many machines that share a folder, the same line on each, here as a SLURM array "
    "(docs/scale.md has Kubernetes, HTCondor and GNU parallel):\n\n"
    "sbatch --array=0-99 --cpus-per-task=4 --wrap 'articugen generate -c laptop -o /shared/data "
    "--shard $SLURM_ARRAY_TASK_ID/100'\n\n"
    "articugen merge /shared/data/laptop\n\n"
    "Into an object store, on as many machines as there are: "
    "articugen generate -c laptop -o s3://bucket/data\n\n"
    "On a Dask cluster: articugen generate -c laptop -o /shared/data --scheduler tcp://host:8786\n\n"
    "On SLURM, submitted, followed and merged by one command: articugen generate -c laptop "
    "-o /shared/data --scheduler 'slurm://partition?tasks=100&cpus=4&time=60'",
)
def generate(
    category: Annotated[
        list[str],
        typer.Option(
            "--category",
            "-c",
            help="What to make, as `articugen sources` lists it; several, or `all`: each into its "
            "own folder.",
        ),
    ],
    source: Annotated[
        str, typer.Option("--source", "-s", help="A source's name, or a folder of URDFs.")
    ] = "procedural",
    recipe: Annotated[
        str | None,
        typer.Option(
            "--recipe", "-r", help="A name under recipes/ or a file.", show_default="category's"
        ),
    ] = None,
    changes: Changes = None,
    objects: Annotated[
        int | None,
        typer.Option(
            "--objects",
            "-n",
            min=1,
            help="So many objects, in the splits' ratio.",
            show_default="all",
        ),
    ] = None,
    ids: Annotated[
        list[str] | None, typer.Option(help="These objects alone: 10040,10101.", show_default="all")
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option(help="But not these.", show_default="none")
    ] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option(
            help="Only objects all of whose joints that move, as the model has them, are of these "
            "kinds: revolute, continuous, prismatic.",
            show_default="any",
        ),
    ] = None,
    movable: Annotated[
        list[str] | None,
        typer.Option(
            help="Joints or parts that move, as patterns: 'drawer*,*door'.",
            show_default="recipe's, else source's",
        ),
    ] = None,
    canonical: Annotated[
        str | None,
        typer.Option(
            help="The joint value that is state 0: zero, lower or upper (limit).",
            show_default="recipe's, else source's",
        ),
    ] = None,
    states: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Random joint states an object, besides the canonical pose.",
            show_default="recipe's",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            "-j",
            min=0,
            help="Worker processes; 0 works in this one, without limits, for debugging.",
            show_default="all cores",
        ),
    ] = None,
    max_rejected: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            metavar="FRACTION",
            help="Of the objects, so many may be rejected before the run counts as failed.",
            show_default="recipe's",
        ),
    ] = None,
    folder: Annotated[
        str,
        typer.Option(
            "--out",
            "-o",
            help="The data set goes to a folder <category> in here; also s3://bucket/prefix, where "
            "any number of processes share out the objects.",
        ),
    ] = "data",
    seed: Annotated[int, typer.Option(help="The master seed; 0 is one like any other.")] = 0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be made and why; make nothing.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace data that was made in another way.")
    ] = False,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Of a Dask cluster, tcp://host:8786, whose workers make the objects; or slurm, "
            "slurm://partition?tasks=100, for an array of jobs. --out must be a folder that all "
            "of them see.",
            show_default="this machine",
        ),
    ] = None,
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
        from articugen.pipeline.door import check_replaces, jobs_of
        from articugen.pipeline.job import Share

        todo = jobs_of(
            category, source, folder, recipe,
            changes=changes or (), seed=seed, objects=objects, ids=listed(ids),
            exclude=listed(exclude), joints=listed(joints), states=states,
            movable=listed(movable), canonical=canonical, max_rejected=max_rejected, jobs=jobs,
            scheduler=scheduler, share=None if shard is None else Share.of_text(shard),
        )  # fmt: skip
        check_replaces(todo[0], replace=replace)
    make = _made if len(todo) == 1 else _made_each
    status = make(*todo, dry_run=dry_run, replace=replace)
    if status:
        raise typer.Exit(status)


def _made(job: "Job", *, dry_run: bool, replace: bool) -> int:
    """Make one data set, or a share of it, and tell of it; the exit status."""
    with said(KEPT):
        from articugen.cli import console
        from articugen.pipeline.door import executor_of
        from articugen.pipeline.run import started

        whole = whole_command(sys.argv)
        executor = executor_of(job, whole)
        with started(job, command=whole) as run:
            if job.share:
                count = f"{len(run.plan.keys)} of {run.objects} objects"
                stdout.print(f"shard {job.share}: {count}", soft_wrap=True)
            if dry_run:
                stdout.print(console.plan_table(job, run.plan))
                return 0
            cure = "REPLACE=1" if called_by_make() else "--replace"
            run.check_replaces(replace=replace, cure=f"add {cure}")
            with console.progress(stderr, run.plan) as bar:
                finished = run.finish(executor, bar.of_object, bar.of_notice)
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


@app.command(
    epilog="Examples:\n\n"
    "articugen inspect data/laptop\n\n"
    "articugen inspect data/laptop/test-00000.h5 --image sheet.png\n\n"
    "articugen inspect data/laptop --html report.html",
)
def inspect(
    path: Annotated[Path, typer.Argument(help="A shard, or the folder of a data set.")],
    image: Annotated[
        Path | None, typer.Option("--image", "-i", help="Draw a contact sheet into this PNG.")
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option("--html", help="Write a report of all of it into this one HTML file."),
    ] = None,
    objects: Annotated[
        int | None,
        typer.Option(min=1, max=64, help="Rows of the sheet.", show_default="4; report 12"),
    ] = None,
    states: Annotated[
        int | None,
        typer.Option(min=1, max=64, help="Columns of the sheet.", show_default="6; report 3"),
    ] = None,
) -> None:
    """Print what a shard or a data set holds, draw it, and report on it."""
    with said():
        from articugen.cli.console import left_out
        from articugen.inspection.summary import shards_of, summary

        shards = shards_of(path)
        stdout.print(summary(shards))
        stdout.print(left_out(path))
        if image is None and html is None:
            return
        from articugen.core.compiling import compile_kernels
        from articugen.pipeline.run import default_jobs

        compile_kernels("inspect", jobs=default_jobs(), notice=stderr.print)
        counts = {"objects": objects, "states": states}
        asked = {name: count for name, count in counts.items() if count is not None}
        if image is not None:
            from articugen.pictures.contact_sheet import contact_sheet

            with stderr.status("drawing ..."):
                contact_sheet(shards, image, **asked)
            stdout.print(escape(f"drawn: {image}"), soft_wrap=True)
        if html is not None:
            from articugen.core.tables import size
            from articugen.inspection.report.page import write_report

            with stderr.status("looking at all of it ..."):
                written = write_report(path, shards, html, **asked)
            stdout.print(escape(f"report: {html}, {size(written)}"), soft_wrap=True)


@app.command(
    epilog="Examples:\n\narticugen verify data/laptop\n\n"
    "articugen verify data/laptop --replay 5\n\narticugen verify data/laptop --repair",
)
def verify(
    path: Annotated[Path, typer.Argument(help="The folder of a data set, or one of such folders.")],
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=1, help="Worker processes.", show_default="all cores"),
    ] = None,
    again: Annotated[
        int,
        typer.Option(
            "--replay",
            min=0,
            help="Make so many instances again from their source: each must come out the same to "
            "the byte, with its surface points on the field's zero level.",
        ),
    ] = 0,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            help="Make damaged shards again from recipe and sources, each to the same content, and "
            "a damaged manifest from whole shards; what cannot be proven right is left as it is.",
        ),
    ] = False,
    drop_user: Annotated[
        bool,
        typer.Option(
            "--drop-user",
            help="While repairing, give up a group 'user' that cannot be read; others are kept.",
        ),
    ] = False,
) -> None:
    """Check checksums, schema, value ranges and geometry of data sets, and mend them."""
    sound = True
    with said():
        from articugen.pipeline.folder import data_sets
        from articugen.verify.check import check

        for folder in data_sets(path, follow=not repair):
            with counting_bar() as told:
                report = check(
                    folder, replay=again, repair=repair, drop_user=drop_user, jobs=jobs,
                    on_shard=_counter(folder, told), on_repair=partial(_say_repair, folder),
                    on_notice=stderr.print,
                )  # fmt: skip
            for finding in report.findings:
                stdout.print(f"[red]✗[/] {escape(f'{folder}: {finding}')}", soft_wrap=True)
            if report.ok:
                replayed = f"; {again} came out the same, made again" if again else ""
                more = len(report.extended)
                theirs = f"; {more} with a group 'user', which was not looked at" if more else ""
                stdout.print(
                    f"[green]✓[/] {escape(str(folder))}: {report.shards} shards, "
                    f"{report.instances:,} instances are as they were made{theirs}{replayed}",
                    soft_wrap=True,
                )
            elif report.mendable and not repair:
                hint = "mend what can be made again with: "
                hint += command("verify", folder, "--repair")
                stderr.print(escape(hint), soft_wrap=True)
            sound = sound and report.ok
    if not sound:
        raise typer.Exit(FAILED)


def _counter(folder: Path, told: Callable[[int, int, str], None]) -> Callable[[str], None]:
    """To be called with the name of each shard that has been looked at."""
    shards, done = sum(1 for _ in folder.glob("*.h5")), count()  # a repair looks at them again
    return lambda name: told(next(done) % max(shards, 1) + 1, shards, f"{folder.name}: {name}")


def _say_repair(folder: Path, repair: "Repair") -> None:
    mark = "[green]+[/]" if repair.ok else "[yellow]-[/]"
    stdout.print(f"{mark} {escape(f'{folder}: {repair}')}", soft_wrap=True)


@app.command(epilog="Example: articugen clean data/laptop --dry-run")
def clean(
    path: Annotated[Path, typer.Argument(help="The folder of a data set, or one of such folders.")],
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be removed; remove nothing.")
    ] = False,
) -> None:
    """Remove what killed runs left; what is finished or can be resumed stays."""
    with said():
        from articugen.core.tables import size
        from articugen.pipeline.clean import clean as tidy

        leftovers = tidy(path, dry_run=dry_run)
        for left in leftovers:
            what = f"{left.path}: {left.why}, {size(left.bytes)}"
            stdout.print(
                escape(f"{'would remove' if dry_run else 'removed'} {what}"), soft_wrap=True
            )
        if not leftovers:
            stdout.print(escape(f"{path}: no killed run has left anything here"), soft_wrap=True)


@app.command(
    epilog="Example: articugen mesh data/laptop laptop_0003 --state 7 --resolution 256 -o lid.ply",
)
def mesh(
    folder: Annotated[Path, typer.Argument(help="The folder of a data set.")],
    object_id: Annotated[str, typer.Argument(help="One of its objects.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="A .ply, .obj, .stl or .glb file to write.")
    ],
    state: Annotated[int, typer.Option(min=0, help="Which instance; 0 is the canonical pose.")] = 0,
    resolution: Annotated[int, typer.Option(min=8, max=1024, help="Voxels along an edge.")] = 128,
) -> None:
    """Write a watertight mesh of one instance's field, made again from its source."""
    with said():
        from articugen.instance.again import write_mesh

        with stderr.status("fusing ..."):
            faces = write_mesh(folder, object_id, state, resolution, output)
        stdout.print(escape(f"{output}: {faces:,} faces, unit frame"), soft_wrap=True)


register_merge(app)
register_fetch(app)
register_view(app)
register_export(app)
register_discover(app)
register_learning(app)
