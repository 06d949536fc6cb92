"""The commands `sources` and `fetch`: they list models, write the bundled ones, bring others."""

# Everything heavy is imported where it is used: --help should not wait for yourdfpy.
# ruff: noqa: PLC0415
from collections.abc import Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import TYPE_CHECKING

from articugen.cli.options import argument, offered
from articugen.cli.saying import REJECTED, command, counting_bar, say, stderr, stdout
from articugen.core.errors import printable
from articugen.pipeline.options import option

if TYPE_CHECKING:
    from articugen.sources.fetch.target import Fetched


@offered("articugen sources", "articugen sources --write models")
def sources(
    write: Path | None = option(
        None, "Write the bundled models below this folder as URDFs.", show_default=False
    ),
) -> None:
    """List the sources of models, their categories and how many objects there are."""
    from articugen.cli.console import sources_table
    from articugen.sources.source import named_sources, write_bundled

    if write is None:
        stdout.print(sources_table(named_sources()))
        return
    for folder, count in write_bundled(write):
        say(f"{folder}: {count} models")


@offered(
    "articugen fetch partnet-mobility --category Laptop --out models/partnet",
    "articugen fetch partnet-mobility --ids 10040,10101 --via sapien --out models/partnet",
    "articugen fetch shape2motion --from Shape2Motion.zip --out models/shape2motion",
    interrupted="interrupted; the same command goes on",
)
def fetch(
    source: str = argument(
        "partnet-mobility; with --from also shape2motion, articraft, artiverse, "
        "artiatlas, artvip or sketchmobility."
    ),
    out: Path = option(MISSING, "A new folder, or one to go on in.", "-o", show_default=False),
    category: Sequence[str] = option((), "These categories, or `all`.", "-c", show_default="none"),
    ids: Sequence[str] = option((), "These models: 10040,10101.", show_default="all"),
    token: str | None = option(
        None,
        "Of your account at the publisher's. Others on this machine may see what is on a "
        "command line: the variables HF_TOKEN and SAPIEN_ACCESS_TOKEN they do not.",
        show_default="HF_TOKEN or SAPIEN_ACCESS_TOKEN",
    ),
    via: str | None = option(
        None,
        "hub (Hugging Face) or sapien (SAPIEN's own site, by --ids).",
        show_default="hub, else sapien",
    ),
    archives: Sequence[Path] = option(
        (), "Unpack this .zip or .tar.gz instead.", "--from", show_default="none"
    ),
) -> int:
    """Get models of others, check them and list them; called again it goes on."""
    from articugen.sources.fetch.door import fetch as bring
    from articugen.sources.fetch.terms import terms_of

    terms = terms_of(source)
    say(f"{terms.origin}\n", ("terms:", "bold"), f" {terms.licence}")
    with counting_bar() as count_file:
        done = bring(
            source, out, category=category, ids=ids, token=token, via=via, archives=archives,
            on_progress=count_file, on_notice=lambda text: say(printable(text), to=stderr),
        )  # fmt: skip
    _print(done)
    return REJECTED if done.refused or done.failed else 0


def _print(done: "Fetched") -> None:
    from articugen.sources.fetch.target import LIST_NAME

    for word, reasons in (("refused", done.refused), ("not fetched", done.failed)):
        for name, why in reasons.items():
            say((word, "yellow"), f" {printable(f'{name}: {why}')}")
    sound = done.models - len(done.refused)
    say(
        f"{done.folder}: {done.models} models, {done.new} of them new, {sound} sound; "
        f"listed with their terms in {LIST_NAME}"
    )
    category = "object" if done.terms.source == "articraft" else "all"  # which has no categories
    say(f"next: {command('generate', '--source', done.folder, '--category', category)}")
