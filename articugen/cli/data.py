"""The commands that examine models and data sets: `inspect`, `check`, `verify` and others."""

# Everything else is imported where it is used: --help should not wait for numba, h5py and trimesh.
# ruff: noqa: PLC0415
from collections.abc import Callable
from dataclasses import MISSING
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from articugen.cli.options import DATA_SETS, JOBS, argument, offered
from articugen.cli.saying import (
    FAILED,
    REJECTED,
    command,
    compile_for,
    counting_bar,
    say,
    stderr,
    stdout,
)
from articugen.core.tables import DIM, counted, quiet_table, size
from articugen.pipeline.options import option

if TYPE_CHECKING:
    from articugen.inspection.check.model import Checked


@offered(
    "articugen inspect data/laptop",
    "articugen inspect data/laptop/test-00000.h5 --image sheet.png",
    "articugen inspect data/laptop --html report.html",
)
def inspect(
    path: Path = argument("A shard, or the folder of a data set."),
    image: Path | None = option(None, "Draw a contact sheet into this PNG.", "-i"),
    html: Path | None = option(None, "Write a report of all of it into this one HTML file."),
    beside: Path | None = option(
        None, "Another set or shard: the report says how alike they are, as compare."
    ),
    objects: int | None = option(
        None, "Rows of the sheet.", min=1, max=64, show_default="4; report 12"
    ),
    states: int | None = option(
        None, "Columns of the sheet.", min=1, max=64, show_default="6; report 3"
    ),
) -> None:
    """Print what a shard or a data set holds, draw it, and report on it."""
    from articugen.cli.console import left_out
    from articugen.inspection.summary import summary
    from articugen.store.shelf import shards_of

    if beside and not html:
        raise typer.BadParameter("--beside is a section of the report; name that with --html")
    chosen = {n: count for n, count in (("objects", objects), ("states", states)) if count}
    if chosen and not (image or html):
        raise typer.BadParameter("--objects and --states are of a picture; name --image or --html")
    shards = shards_of(path)
    stdout.print(summary(shards))
    stdout.print(left_out(path))
    if image or html:
        compile_for("inspect")
    if image:
        from articugen.pictures.contact_sheet import contact_sheet

        with stderr.status("drawing ..."):
            contact_sheet(shards, image, **chosen)
        say(f"drawn: {image}")
    if html:
        from articugen.inspection.report.page import write_report

        with stderr.status("reading all of it ..."):
            written = write_report(path, shards, html, beside=beside, **chosen)
        say(f"report: {html}, {size(written)}")


@offered("articugen site data/laptop --out site/laptop")
def site(
    data: Path = argument("The folder of a data set, or a shard."),
    out: Path = option(MISSING, "A new folder, an empty one, or a former site.", "-o"),
    jobs: int | None = JOBS,
) -> None:
    """Write a folder of static pages that show all objects of a set, on any host or offline."""
    from articugen.core.processes import default_jobs
    from articugen.inspection.report.site import site as write

    compile_for("generate", "inspect")  # models are made again to measure the truth
    with counting_bar() as count_shard:
        done = write(data, out, jobs=jobs or default_jobs(), on_shard=count_shard)
    say(f"{out / 'index.html'}: {counted(done.objects, 'object')}, {size(done.bytes)}")


@offered("articugen compare data/oven real/oven --image farthest.png")
def compare(
    first: Path = argument("A set, or a shard."),
    second: Path = argument("Another: what it is to be like."),
    image: Path | None = option(None, "Draw the second set's farthest into this PNG.", "-i"),
    json: bool = option(False, "Print numbers for other programs."),
) -> None:
    """Say how alike two sets of objects are: neighbours, proportions, parts, joints."""
    from articugen.inspection import likeness
    from articugen.pictures.layout import check_picture, save

    if image is not None:
        check_picture(image)
    compile_for("inspect")
    with stderr.status("comparing all objects ..."):
        alike = likeness.likeness(first, second)
        if image is not None:
            save(likeness.farthest(alike), image)
    if json:
        stdout.print_json(data=alike.numbers)
        return
    table = quiet_table("", ">first", ">second")
    for line in likeness.rows(alike):
        table.add_row(*line)
    stdout.print(table)
    stdout.print(
        "Distances: Chamfer, canonical pose, a longest edge is 1. Others: median (10 %, 90 %).",
        style=DIM,
    )
    if image is not None:
        say(f"drawn: {image}")


@offered(
    "articugen check cabinet.urdf",
    "articugen check models/ --json checks.json --html checks.html",
    "Exit status: 0 all sound, 3 findings, 1 a model cannot be read.",
)
def check(
    path: Path = argument("A mesh, URDF, MJCF or USD file, or a folder of them."),
    json: Path | None = option(None, "Write all numbers into this file."),
    html: Path | None = option(None, "Write a page with pictures."),
    jobs: int | None = JOBS,
) -> int:
    """Check models of others before use: closed, solid, joints, collisions."""
    from articugen.core.files import check_place, write_atomically
    from articugen.core.processes import default_jobs
    from articugen.inspection.check import door
    from articugen.inspection.check.model import FINDINGS, VERDICTS
    from articugen.inspection.check.page import page
    from articugen.inspection.report.page import check_html

    if json:
        check_place(json)
    if html:
        check_html(html)
    compile_for("generate", "inspect")
    with counting_bar() as count_model:
        done = count(1)

        def note(model: "Checked", of: int) -> None:
            _say_checked(model)
            count_model(next(done), of, model.name)

        checks = door.check(path, jobs=jobs or default_jobs(), pictures=bool(html), on_model=note)
    number = checks.counts()
    counts = [f"{number[word]:,} {word}" for word in (*VERDICTS, *FINDINGS) if number[word]]
    if len(checks.models) > 1:
        say(f"{len(checks.models):,} models: {', '.join(counts)}")
    if json:
        write_atomically(json, checks.json().encode())
    if html:
        write_atomically(html, page(checks, path.resolve().name).encode())
    return 0 if checks.ok else FAILED if number["unreadable"] else REJECTED


def _say_checked(model: "Checked") -> None:
    mark = {"sound": ("✓", "green"), "findings": ("✗", "yellow")}.get(model.verdict, ("✗", "red"))
    amiss: list[str | tuple[str, str]] = []
    for finding in model.findings:
        amiss += ["; " if amiss else "", (finding.kind, "bold"), f" {finding.text}"]
    say(mark, f" {model.name}: ", *(amiss or [model.problem or "sound"]))


@offered(
    "articugen verify data/laptop",
    "articugen verify data/laptop --replay 5",
    "articugen verify data/laptop --repair",
)
def verify(
    path: Path = DATA_SETS,
    jobs: int | None = JOBS,
    replay: int = option(
        0,
        "Make this many instances again from their source: each must come out the same to "
        "the byte, with its surface points on the field's zero level.",
        min=0,
    ),
    repair: bool = option(
        False,
        "Make damaged shards again from recipe and sources, each to the same content, and "
        "a damaged manifest from whole shards; what cannot be proven right is left as it is.",
    ),
    drop_user: bool = option(
        False, "While repairing, give up a group 'user' that cannot be read; others are kept."
    ),
) -> int:
    """Check checksums, schema, value ranges and geometry of data sets, and mend them."""
    from articugen.pipeline.folder import data_sets
    from articugen.verify.check import check

    status = 0
    for folder in data_sets(path, follow=not repair):
        with counting_bar() as count_shard:
            report = check(
                folder, replay=replay, repair=repair, drop_user=drop_user, jobs=jobs,
                on_shard=_counter(folder, count_shard),
                on_repair=lambda done, folder=folder: say(
                    ("+", "green") if done.ok else ("-", "yellow"), f" {folder}: {done}"
                ),
                on_notice=stderr.print,
            )  # fmt: skip
        for finding in report.findings:
            say(("✗", "red"), f" {folder}: {finding}")
        if report.ok:
            again, more = min(replay, report.instances), len(report.extended)
            replayed = f"; {again} came out the same, made again" if replay else ""
            theirs = f"; {more} with a group 'user', which was not checked" if more else ""
            say(
                ("✓", "green"),
                f" {folder}: {counted(report.shards, 'shard')}, "
                f"{counted(report.instances, 'instance')} as they were made{theirs}{replayed}",
            )
        else:
            status = FAILED
            if report.mendable and not repair:
                hint = command("verify", folder, "--repair")
                say(f"mend what can be made again with: {hint}", to=stderr)
    return status


def _counter(folder: Path, count_shard: Callable[[int, int, str], None]) -> Callable[[str], None]:
    """Return a function to be called with the name of each shard that has been checked."""
    shards, done = sum(1 for _ in folder.glob("*.h5")), count()  # a repair looks at them again
    return lambda name: count_shard(
        next(done) % max(shards, 1) + 1, shards, f"{folder.name}: {name}"
    )


@offered("articugen clean data/laptop --dry-run")
def clean(
    path: Path = DATA_SETS,
    dry_run: bool = option(False, "Say what would be removed; remove nothing."),
) -> None:
    """Remove what killed runs left; what is finished or can be resumed stays."""
    from articugen.pipeline.clean import clean as tidy

    leftovers = tidy(path, dry_run=dry_run)
    done = "would remove" if dry_run else "removed"
    for left in leftovers:
        say(f"{done} {left.path}: {left.why}, {size(left.bytes)}")
    if not leftovers:
        say(f"{path}: no killed run has left anything here")


@offered("articugen mesh data/laptop laptop_0003 --state 7 --resolution 256 -o lid.ply")
def mesh(
    folder: Path = argument("The folder of a data set."),
    object_id: str = argument("One of its objects."),
    output: Path = option(MISSING, "A .ply, .obj, .stl or .glb file to write.", "-o"),
    state: int = option(0, "Which instance; 0 is the canonical pose.", min=0),
    resolution: int = option(128, "Voxels along an edge.", min=8, max=1024),
    of: str = option(
        "material",
        "material of the parts; visible: with the space that no view sees; or part: a file "
        "<output>_<k> for each part k.",
    ),
) -> None:
    """Write a watertight mesh of one instance, made again from its source."""
    from articugen.instance.again import write_meshes

    with stderr.status("fusing ..."):
        written = write_meshes(folder, object_id, state, resolution, output, of)
    for path, faces in written.items():
        say(f"{path}: {faces:,} faces, unit frame")
