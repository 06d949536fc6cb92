"""The documentation site: built strictly, opened in a real browser from the disk, offline."""

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from browser import LAPTOP, PHONE, alone
from python_process import ended

import articugen as ag

CHECKOUT = Path(__file__).resolve().parents[1]
HERE = CHECKOUT / "docs" / "site"
LITTLE = """\
extends: quick
objects: 1
articulation: {states: 1}
views: {count: 8, resolution: 64}
sampling: {surface_points: 2048, uniform_points: 64, near_points: 64, partial_views: 0, grids: [8]}
max_rejected_fraction: 1.0
"""
LOOKED_AT = (
    "index.html", "gallery/laptop.html", "exports.html", "exports/ppd.html", "format.html",
    "reference/commands.html", "extending.html",
)  # fmt: skip
"""Pages with what may be wide: tables, code, pictures, a frame, signatures."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (importlib.util.find_spec("mkdocs") and importlib.util.find_spec("mkdocstrings")),
        reason="mkdocs is not installed: make site-tools",
    ),
]


def called(*arguments: object, **env: str) -> subprocess.CompletedProcess[str]:
    env |= {"PYTHONPATH": str(CHECKOUT), "NO_MKDOCS_2_WARNING": "1"}
    return ended(*arguments, folder=CHECKOUT, seconds=900, **env)


@pytest.fixture(scope="module")
def hooks() -> Any:
    """docs/site/hooks.py, which mkdocs loads by its path."""
    pytest.importorskip("mkdocs", reason="make site-tools installs it")
    sys.path.insert(0, str(HERE))
    return importlib.import_module("hooks")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site with a gallery of one object a category, in a folder of no simple name."""
    root = tmp_path_factory.mktemp("a site, ünusual")
    (root / "little.yaml").write_text(LITTLE)
    little = ("--recipe", root / "little.yaml", "--jobs", 0, "--many", 1)
    made = called(HERE / "gallery.py", root / "gallery", *little)
    assert made.returncode == 0, made.stderr
    assert "gallery: oven, 4 of 5 ..." in made.stdout
    out = root / "site"
    built = called(
        "-m", "mkdocs", "build", "--site-dir", out, ARTICUGEN_GALLERY=str(root / "gallery")
    )
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return out


def test_without_a_gallery_the_build_says_what_makes_it(tmp_path: Path) -> None:
    built = called(
        "-m", "mkdocs", "build", "--site-dir", tmp_path / "s", ARTICUGEN_GALLERY=str(tmp_path)
    )
    assert built.returncode != 0
    assert "manifest.json: is not there; `make docs` makes it first" in built.stderr


def test_links_of_the_repository_become_those_of_the_site(hooks: Any) -> None:
    def turned(text: str, path: str, uri: str) -> str:
        return hooks.with_links_of_site(text, path, uri)

    readme = (
        "[a](docs/python.md#rows) ![b](docs/images/x.png) [c](CHANGELOG.md) [d](https://e.org/f)"
    )
    assert turned(readme, "README.md", "index.md") == (
        "[a](python.md#rows) ![b](docs/images/x.png) [c](changelog.md) [d](https://e.org/f)"
    )  # there is no such image: mkdocs shall say so
    source = "[a](../../docs/sources.md) [b](#here) [c](../README.md#known)"
    assert turned(source, "urdf_sources/shape2motion/README.md", "models/shape2motion.md") == (
        "[a](../sources.md) [b](#here) [c](index.md#known)"
    )
    page = "[a](../exports.md#part-meshes) [b](urdf.md) and `f[x](y)`"
    assert turned(page, "docs/exports/glb.md", "exports/glb.md") == page


class _Fetched(HTMLParser):
    """What a page fetches by itself, as it is opened."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.urls: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        about = dict(attrs)
        if tag in ("script", "img", "iframe", "source", "video"):
            self.urls.append(about.get("src") or "")
        if tag == "link" and about.get("rel") not in ("canonical", "prev", "next"):
            self.urls.append(about.get("href") or "")


def test_pages_fetch_nothing_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 40
    for path in pages:
        for url in _Fetched(path.read_text(encoding="utf-8")).urls:
            assert url.startswith("data:") or not re.match(r"(\w+:)?//", url), f"{path}: {url}"
    for path in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?https?:|@import", path.read_text("utf-8")), path


def test_the_home_page_is_the_readme_and_its_links_lead_somewhere(site: Path) -> None:
    home = (site / "index.html").read_text(encoding="utf-8")
    for word in ("Your own models", 'href="format.html"', 'src="images/five.png"',
                 'href="models/partnet_mobility.html"', 'href="LICENSE.txt"',
                 'href="gallery/index.html">The gallery</a>'):  # fmt: skip
        assert word in home
    assert (site / "LICENSE.txt").read_text() == (CHECKOUT / "LICENSE").read_text()


def test_the_reference_has_every_name_with_its_arguments(site: Path, hooks: Any) -> None:
    assert hooks.reference.HOMES.keys() == set(ag.__all__)
    pages = "".join(p.read_text("utf-8") for p in (site / "reference").glob("*.html"))
    headings = "".join(re.findall(r"<h2 .*?</h2>", pages, re.DOTALL))
    for name in ag.__all__:
        assert re.search(rf"\bag\.{name}\b", headings), name
    commands = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    for said in ("recipe", "objects", "ids", "max_rejected", "on_object"):
        assert re.search(rf"<b><code>{said}</code></b>", commands), said


def test_what_stands_in_angle_brackets_stays_in_the_reference(hooks: Any, site: Path) -> None:
    escaped = importlib.import_module("docstrings").escaped
    assert escaped("to <out>/<category>, `<code>`, a < b") == (
        "to &lt;out>/&lt;category>, `<code>`, a < b"
    )
    commands = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "a folder &lt;category&gt; in here" in commands


def opened(chromium: Any, page: Path, screen: dict[str, int], **context: Any) -> tuple[Any, list]:
    """The page, and what the console says against it or what it asked of the net."""
    tab, faults = alone(chromium, screen, offline=True, **context)
    tab.goto(page.as_uri())
    return tab, faults


@pytest.mark.parametrize("screen", [LAPTOP, PHONE], ids=["laptop", "phone"])
def test_pages_open_offline_and_none_is_wider_than_the_screen(chromium, site, screen):
    for name in LOOKED_AT:
        tab, faults = opened(chromium, site / name, screen)
        assert tab.locator("article h1").count() == 1, name
        wide = tab.evaluate("document.documentElement.scrollWidth")
        assert wide <= screen["width"], f"{name}: {wide}"
        assert faults == [], name
        if folder := os.environ.get("ARTICUGEN_SCREENSHOTS"):
            shot = Path(folder) / f"{name.replace('/', '-')}-{screen['width']}.png"
            tab.screenshot(path=shot, full_page=name == "index.html")
        tab.context.close()


def test_the_report_of_a_category_is_in_its_page(chromium: Any, site: Path) -> None:
    tab, faults = opened(chromium, site / "gallery" / "laptop.html", LAPTOP)
    report = tab.frame_locator("iframe.report")
    report.locator("#viewer[data-ready]").wait_for(state="attached")
    assert report.locator("#viewer .joint [step=any]").count() == 1
    assert faults == []


def test_the_search_finds_a_page_without_a_server(chromium: Any, site: Path) -> None:
    tab, faults = opened(chromium, site / "index.html", LAPTOP)
    tab.locator("input.md-search__input").click()
    tab.keyboard.type("gt_coords")
    found = tab.locator(".md-search-result__link").first
    found.wait_for()
    assert "exports/npcs.html" in found.get_attribute("href")
    assert faults == []
