"""The command `export`: it calls `articugen.export` and shows how far that is."""

# Everything heavy is imported where it is used: --help should not wait for h5py.
# ruff: noqa: PLC0415
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperCommand

from articugen.cli.app import app
from articugen.cli.saying import REJECTED, counting_bar, said, say_error, stdout

if TYPE_CHECKING:
    from articugen.export.run import Exported


class _ListsFormats(TyperCommand):
    """`--to` without a name asks what names there are."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        for place, word in enumerate(args):
            if word == "--to" and (args[place + 1 :] or ["-"])[0].startswith("-"):
                return super().parse_args(ctx, args[:place] + args[place + 1 :])
        return super().parse_args(ctx, args)


@app.command(
    cls=_ListsFormats,
    epilog="Examples:\n\narticugen export --to\n\n"
    "articugen export data/laptop --to onet --out onet/laptop --split train\n\n"
    "articugen export data/laptop --to mjcf --out mjcf/laptop --collision",
)
def export(
    data: Annotated[
        Path | None,
        typer.Argument(help="The folder of a data set, or a shard.", show_default=False),
    ] = None,
    to: Annotated[
        str | None, typer.Option(help="The format; --to alone lists them.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="A new folder, or one to go on in.", show_default=False),
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="The instances of this split alone.", show_default="all")
    ] = None,
    resolution: Annotated[
        int | None,
        typer.Option(
            min=8, max=1024, help="Of part meshes: voxels along an edge.", show_default="256"
        ),
    ] = None,
    from_grids: Annotated[
        bool, typer.Option("--from-grids", help="Part meshes from stored grids: no models needed.")
    ] = False,
    collision: Annotated[
        bool, typer.Option("--collision", help="Add convex parts to collide with (CoACD).")
    ] = False,
    occupancy: Annotated[
        str | None,
        typer.Option(help="Inside is what is: visible or material.", show_default="visible"),
    ] = None,
) -> None:
    """Write a data set in a format that others read; called again it goes on."""
    with said("interrupted; the same command goes on"):
        from articugen.export.formats import names
        from articugen.export.run import export as run

        if data is None or out is None or to not in names():
            _list_formats(data, to, out)
        assert data is not None
        assert to is not None
        assert out is not None
        with counting_bar() as told:
            done = run(
                data,
                to,
                out,
                split=split,
                resolution=resolution,
                from_grids=from_grids or None,
                collision=collision or None,
                occupancy=occupancy,
                on_item=lambda count, items, item: told(count, items, item.key),
            )
        _print(done)
    if done.left_out:
        raise typer.Exit(REJECTED)


def _list_formats(data: Path | None, to: str | None, out: Path | None) -> None:
    """Say what is missing, or which formats there are where nothing is named; and leave."""
    from articugen.core.tables import quiet_table
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


def _print(done: "Exported") -> None:
    from articugen.core.tables import size

    for sentence in done.left_out:
        stdout.print(f"[yellow]left out[/] {escape(sentence)}", soft_wrap=True)
    stdout.print(f"{done.folder}: {done.files:,} files, {size(done.bytes)}", soft_wrap=True)
