"""The commands that look at data sets that are there: `inspect`, `verify`, `clean`, `mesh`."""

# Everything else is imported where it is used: --help should not wait for numba, h5py and trimesh.
# ruff: noqa: PLC0415
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from articugen.cli.app import app
from articugen.cli.options import DataSets
from articugen.cli.saying import FAILED, command, counting_bar, said, stderr, stdout
from articugen.core.tables import DIM, quiet_table

if TYPE_CHECKING:
    from articugen.verify.dataset import Repair


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
    beside: Annotated[
        Path | None,
        typer.Option(help="Another set or shard: the report says how alike they are, as compare."),
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
    if beside and not html:
        raise typer.BadParameter("--beside is a section of the report; name that with --html")
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
                written = write_report(path, shards, html, beside=beside, **asked)
            stdout.print(escape(f"report: {html}, {size(written)}"), soft_wrap=True)


@app.command(epilog="Example: articugen compare data/oven real/oven --image farthest.png")
def compare(
    first: Annotated[Path, typer.Argument(help="A set, or a shard: what is at hand.")],
    second: Annotated[Path, typer.Argument(help="Another: what it is to be like.")],
    image: Annotated[
        Path | None,
        typer.Option("--image", "-i", help="Draw the second set's farthest into this PNG."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print numbers for other programs.")] = False,
) -> None:
    """Say how alike two sets of objects are: neighbours, proportions, parts, joints."""
    with said():
        from articugen.core.compiling import compile_kernels
        from articugen.inspection import likeness
        from articugen.pictures.layout import check_picture, save
        from articugen.pipeline.run import default_jobs

        if image is not None:
            check_picture(image)
        compile_kernels("inspect", jobs=default_jobs(), notice=stderr.print)
        with stderr.status("comparing all objects ..."):
            found = likeness.likeness(first, second)
            if image is not None:
                save(likeness.farthest(found), image)
        if json:
            stdout.print_json(data=found.numbers)
            return
        table = quiet_table("", ">first", ">second")
        for line in likeness.rows(found):
            table.add_row(*line)
        stdout.print(table)
        stdout.print(
            "Distances: Chamfer, canonical pose, a longest edge is 1. Others: median (10 %, 90 %).",
            style=DIM,
        )
        if image is not None:
            stdout.print(escape(f"drawn: {image}"), soft_wrap=True)


@app.command(
    epilog="Examples:\n\narticugen verify data/laptop\n\n"
    "articugen verify data/laptop --replay 5\n\narticugen verify data/laptop --repair",
)
def verify(
    path: DataSets,
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
    path: DataSets,
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
