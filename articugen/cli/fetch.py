"""The commands `sources` and `fetch`: they list models, write the bundled ones, bring others."""

# Everything heavy is imported where it is used: --help should not wait for yourdfpy.
# ruff: noqa: PLC0415
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from articugen.cli.app import app
from articugen.cli.options import listed
from articugen.cli.saying import REJECTED, command, counting_bar, said, stderr, stdout
from articugen.core.errors import printable

if TYPE_CHECKING:
    from articugen.sources.fetch.target import Fetched


@app.command(
    "sources",
    epilog="Examples:\n\narticugen sources\n\narticugen sources --write models",
)
def list_sources(
    write: Annotated[
        Path | None,
        typer.Option(
            help="Write the bundled models below this folder as URDFs.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """List the sources of models, their categories and how many objects there are."""
    with said():
        from articugen.cli.console import sources_table
        from articugen.sources.source import named_sources, write_bundled

        if write is None:
            stdout.print(sources_table(named_sources()))
            return
        for folder, count in write_bundled(write):
            stdout.print(f"{folder}: {count} models", soft_wrap=True, markup=False)


@app.command(
    "fetch",
    epilog="Examples:\n\n"
    "articugen fetch partnet-mobility --category Laptop --out models/partnet\n\n"
    "articugen fetch partnet-mobility --ids 10040,10101 --via sapien --out models/partnet\n\n"
    "articugen fetch shape2motion --from Shape2Motion.zip --out models/shape2motion",
)
def fetch_models(
    source: Annotated[
        str,
        typer.Argument(
            help="partnet-mobility; with --from also shape2motion, articraft, artiverse, "
            "artiatlas, artvip or sketchmobility."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="A new folder, or one to go on in.", show_default=False),
    ],
    category: Annotated[
        list[str] | None,
        typer.Option("--category", "-c", help="These categories, or `all`.", show_default="none"),
    ] = None,
    ids: Annotated[
        list[str] | None, typer.Option(help="These models: 10040,10101.", show_default="all")
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(
            help="Of your account at the publisher's. Others on this machine may see what is on a "
            "command line: the variables HF_TOKEN and SAPIEN_ACCESS_TOKEN they do not.",
            show_default="HF_TOKEN or SAPIEN_ACCESS_TOKEN",
        ),
    ] = None,
    via: Annotated[
        str | None,
        typer.Option(
            help="hub (Hugging Face) or sapien (SAPIEN's own site, by --ids).",
            show_default="hub, else sapien",
        ),
    ] = None,
    archives: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Unpack this .zip or .tar.gz instead.", show_default="none"),
    ] = None,
) -> None:
    """Get models of others, check them and list them; called again it goes on."""
    with said("interrupted; the same command goes on"):
        from articugen.sources.fetch.door import fetch
        from articugen.sources.fetch.terms import terms_of

        terms = terms_of(source)
        stdout.print(
            f"{escape(terms.origin)}\n[bold]terms:[/] {escape(terms.licence)}", soft_wrap=True
        )
        with counting_bar() as told:
            done = fetch(
                source,
                out,
                category=listed(category),
                ids=listed(ids),
                token=token,
                via=via,
                archives=archives or (),
                on_progress=told,
                on_notice=lambda text: stderr.print(escape(printable(text)), soft_wrap=True),
            )
        _print(done)
    if done.refused or done.failed:
        raise typer.Exit(REJECTED)


def _print(done: "Fetched") -> None:
    from articugen.sources.fetch.target import LIST_NAME

    for word, reasons in (("refused", done.refused), ("not fetched", done.failed)):
        for name, why in reasons.items():
            line = escape(printable(f"{name}: {why}"))
            stdout.print(f"[yellow]{word}[/] {line}", soft_wrap=True)
    sound = done.models - len(done.refused)
    stdout.print(
        f"{escape(str(done.folder))}: {done.models} models, {done.new} of them new, {sound} sound; "
        f"listed with their terms in {LIST_NAME}",
        soft_wrap=True,
    )
    category = "object" if done.terms.source == "articraft" else "all"  # which tells no categories
    stdout.print(
        f"next: {escape(command('generate', '--source', done.folder, '--category', category))}",
        soft_wrap=True,
    )
