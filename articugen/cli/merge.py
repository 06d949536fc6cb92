"""The command that ends what several processes have shared out."""

# Everything else is imported where it is used: --help should not wait for numba, h5py and trimesh.
# ruff: noqa: PLC0415
from pathlib import Path
from typing import Annotated

import typer

from articugen.cli.saying import counting_bar, said, stdout


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(epilog="Example: articugen merge /shared/data/laptop")(merge)


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
