"""The command `export`: it calls `articugen.export` and shows how far that is."""

# Everything heavy is imported where it is used: --help should not wait for h5py.
# ruff: noqa: PLC0415
from pathlib import Path
from typing import Any, NoReturn

import typer
from typer.core import TyperCommand

from articugen.cli.options import JOBS, argument, offered
from articugen.cli.saying import REJECTED, counting_bar, say, say_error, stdout
from articugen.core.tables import quiet_table, size
from articugen.pipeline.options import option


class _ListsFormats(TyperCommand):
    """`--to` without a name asks what names there are."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        for place, word in enumerate(args):
            if word == "--to" and (args[place + 1 :] or ["-"])[0].startswith("-"):
                return super().parse_args(ctx, args[:place] + args[place + 1 :])
        return super().parse_args(ctx, args)


@offered(
    "articugen export --to",
    "articugen export data/laptop --to onet --out onet/laptop --split train",
    "articugen export data/laptop --to mjcf --out mjcf/laptop --collision",
    interrupted="interrupted; the same command goes on",
    cls=_ListsFormats,
)
def export(
    data: Path | None = argument("The folder of a data set, or a shard.", None, show_default=False),
    to: str | None = option(None, "The format; --to alone lists them.", show_default=False),
    out: Path | None = option(None, "A new folder, or one to go on in.", "-o", show_default=False),
    split: str | None = option(None, "The instances of this split alone.", show_default="all"),
    resolution: int | None = option(
        None, "Of part meshes: voxels along an edge.", min=8, max=1024, show_default="256"
    ),
    from_grids: bool = option(False, "Part meshes from stored grids: no models needed."),
    collision: bool = option(False, "Add convex parts to collide with."),
    occupancy: str | None = option(
        None, "Inside is what is: visible or material.", show_default="visible"
    ),
    jobs: int | None = JOBS,
) -> int:
    """Write a data set in a format that others read; called again it goes on."""
    from articugen.export.formats import names
    from articugen.export.run import export as run

    if data is None or out is None or to not in names():
        _list_formats(data, to, out)
    with counting_bar() as count_item:
        done = run(
            data, to, out, split=split, resolution=resolution, from_grids=from_grids or None,
            collision=collision or None, occupancy=occupancy, jobs=jobs,
            on_item=lambda count, items, item: count_item(count, items, item.key),
        )  # fmt: skip
    for sentence in done.left_out:
        say(("left out", "yellow"), f" {sentence}")
    say(f"{done.folder}: {done.files:,} files, {size(done.bytes)}")
    return REJECTED if done.left_out else 0


def _list_formats(data: Path | None, to: str | None, out: Path | None) -> NoReturn:
    """Say what is missing, or which formats there are where nothing is named; and leave."""
    from articugen.export.formats import format_named, names

    if to is not None:
        format_named(to)  # or says what there is
        say_error(f"name {'a data set' if data is None else 'a folder with --out'} as well")
        raise typer.Exit(2)
    if data or out:
        say_error("name a format with --to; --to alone lists them")
        raise typer.Exit(2)
    table = quiet_table("format", "what it is")
    for name in names():
        table.add_row(name, format_named(name).what)
    stdout.print(table)
    raise typer.Exit
