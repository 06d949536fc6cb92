"""The command `view`: it serves what `articugen.inspection.viewer` shows, until it is stopped."""

# Everything heavy is imported where it is used: --help should not wait for numba.
# ruff: noqa: PLC0415
from contextlib import suppress
from typing import Annotated

import typer
from rich.markup import escape

from articugen.cli.app import app
from articugen.cli.saying import said, stderr, stdout


@app.command(
    epilog="Examples:\n\narticugen view data/laptop\n\narticugen view cabinet.urdf --open\n\n"
    "articugen view urdfs --category drawer --recipe quick"
)
def view(
    path: Annotated[
        str,
        typer.Argument(
            help="A shard, a data set's folder, a URDF, a folder of models, or a source's name."
        ),
    ],
    category: Annotated[
        str | None,
        typer.Option(
            "--category", "-c", help="Of models: what they are.", show_default="as they say"
        ),
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            "--recipe", "-r", help="Of models: how instances are made.", show_default="category's"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of models: the master seed.")] = 0,
    host: Annotated[
        str, typer.Option(help="Where to listen; 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(
            min=1, max=65535, help="On which port.", show_default="8080, or the next free"
        ),
    ] = None,
    open_browser: Annotated[
        bool, typer.Option("--open", help="Open it in this machine's browser.")
    ] = False,
) -> None:
    """Examine objects in the browser: turn them, move their joints, see all that is sampled."""
    with said():
        import time
        import webbrowser

        from articugen.core.compiling import compile_kernels
        from articugen.inspection.viewer.serve import served
        from articugen.inspection.viewer.sources import source_of
        from articugen.pipeline.run import default_jobs

        for command in ("generate", "inspect"):
            compile_kernels(command, jobs=default_jobs(), notice=stderr.print)
        source = source_of(path, category=category, recipe=recipe, seed=seed)
        with served(source, host=host, port=port) as shown:
            stdout.print(f"{escape(path)} is shown at {shown.url}; Ctrl-C ends it", soft_wrap=True)
            if open_browser:
                webbrowser.open(shown.url)
            with suppress(KeyboardInterrupt):
                while True:
                    time.sleep(3600)
