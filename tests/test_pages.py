"""Pages for people: short enough, linked, and naming the commands that there are."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.main import get_command

from articugen.cli import app

CHECKOUT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    {
        *CHECKOUT.glob("*.md"),
        *(CHECKOUT / "docs").rglob("*.md"),
        *(CHECKOUT / "urdf_sources").rglob("README.md"),
        *(CHECKOUT / "examples").glob("*.md"),
    }
)


def prose(path: Path) -> str:
    """The text of a page without its blocks of code."""
    return re.sub(r"^```.*?^```$", "", path.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def anchors(path: Path) -> Iterator[str]:
    """The anchors of a page's headings, as code-hosting sites write them."""
    for heading in re.findall(r"^#+ (.+)$", prose(path), re.MULTILINE):
        yield re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_the_readme_is_read_in_five_minutes() -> None:
    text = (CHECKOUT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 110
    assert len(text.split()) <= 900
    assert max(map(len, text.splitlines())) <= 112


def test_the_page_on_what_articugen_is_for_is_one_page() -> None:
    assert len((CHECKOUT / "docs" / "why.md").read_text("utf-8").split()) <= 400


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_links_lead_to_a_file_and_a_heading(path: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)\s#:]*)(?:#([^)\s]*))?\)", prose(path)):
        page = (path.parent / target).resolve() if target else path
        assert page.exists(), target
        assert not anchor or anchor in anchors(page), f"{target}#{anchor}"


def test_files_of_ours_that_pages_name_are_there() -> None:
    """All but the chest's that docs/extending.md has its reader write."""
    there = [path.as_posix() for path in CHECKOUT.glob("*/**/*.py")]
    named = {
        name
        for path in PAGES
        if path.name != "CHANGELOG.md"
        for name in re.findall(r"`(\w+(?:/\w+)+\.py)`", prose(path))
    }
    assert len(named) >= 40
    lost = {name for name in named if not any(path.endswith(f"/{name}") for path in there)}
    assert lost == {"articugen/procedural/chest.py"}


def test_every_page_of_docs_is_in_the_site() -> None:
    nav = (CHECKOUT / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
    pages = (path.relative_to(CHECKOUT / "docs") for path in (CHECKOUT / "docs").rglob("*.md"))
    assert [page for page in pages if not re.search(rf" {page}$", nav, re.MULTILINE)] == []


def test_the_page_of_commands_has_all_of_them_with_options_that_they_take() -> None:
    page = (CHECKOUT / "docs" / "commands.md").read_text("utf-8")
    group = get_command(app)
    commands = group.commands
    named = set()
    for line in re.findall(r"^\| `articugen (.*)$", page, re.MULTILINE):
        command, _, purpose = line.partition("`")
        name = command.split()[0]
        named.add(name)
        options = {option for p in commands[name].params for option in p.opts}
        used = re.findall(r"(?<= )--?[a-z][a-z-]*", command)
        used += re.findall(r"`(--[a-z-]+)", purpose)
        assert set(used) <= options, name
    assert named == set(commands)
    makefile = (CHECKOUT / "Makefile").read_text("utf-8")
    for target in re.findall(r"`make ([a-z-]+)", page):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    options = {option for p in commands["generate"].params for option in p.opts} - {"--help"}
    passed = dict(re.findall(r"\b([A-Z_]+):([a-z-]+)", makefile))
    said = {"--category", "--source", "--out", "--set", "--replace"}
    elsewhere = {"--dry-run", "--scheduler", "--shard"}
    assert {f"--{name}" for name in passed.values()} | said | elsewhere == {
        option for option in options if option.startswith("--")
    }
    listed = (page + makefile.partition("help:")[2].partition("dataset:")[0]).split()
    assert {f"{name}=" for name in passed} <= {word.strip('[]`"') for word in listed}
    statuses = set(re.findall(r"(?:^|, )(\d+) ", (group.epilog or "").partition("status: ")[2]))
    assert statuses
    assert statuses <= set(re.findall(r"^\| (\d+) \|", page, re.MULTILINE))
