"""The command `view`: it serves what `articugen.inspection.viewer` shows, until it is stopped."""

# Everything heavy is imported where it is used: --help should not wait for numba.
# ruff: noqa: PLC0415
from contextlib import suppress

from articugen.cli.options import argument, offered
from articugen.cli.saying import compile_for, say
from articugen.pipeline.options import option


@offered(
    "articugen view data/laptop",
    "articugen view cabinet.urdf --open",
    "articugen view urdfs --category drawer --recipe quick",
)
def view(
    path: str = argument(
        "A shard, a data set's folder, a URDF, a folder of models, or a source's name."
    ),
    category: str | None = option(
        None, "Of models: what they are.", "-c", show_default="as they say"
    ),
    recipe: str | None = option(
        None, "Of models: how instances are made.", "-r", show_default="category's"
    ),
    seed: int = option(0, "Of models: the master seed."),
    host: str = option("127.0.0.1", "Where to listen; 0.0.0.0 lets other machines in."),
    port: int | None = option(
        None, "On which port.", min=1, max=65535, show_default="8080, or the next free"
    ),
    open_browser: bool = option(False, "Open it in this machine's browser.", "--open"),
) -> None:
    """Examine objects in the browser: turn them, move their joints, see all that is sampled."""
    import time
    import webbrowser

    from articugen.inspection.viewer.serve import served
    from articugen.inspection.viewer.sources import source_of

    compile_for("generate", "inspect")
    source = source_of(path, category=category, recipe=recipe, seed=seed)
    with served(source, host=host, port=port) as shown:
        say(f"{path} is shown at {shown.url}; Ctrl-C ends it")
        if open_browser:
            webbrowser.open(shown.url)
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(3600)
