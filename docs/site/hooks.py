"""What mkdocs builds besides docs/*.md: pages of the repository, examples, gallery, reference.

Links in all of them are those of the repository, so that a page reads as well on a code-hosting
site; here they are turned to where the site has what they point to.
"""

import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).parent))  # mkdocs loads this file alone

import gallery  # noqa: E402
import reference  # noqa: E402

_SOURCES = (
    "procedural",
    "procedural_messy",
    "procedural_rough",
    "procedural_varied",
    "partnet_mobility",
    "shape2motion",
)

PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "LICENSE": "LICENSE.txt",
    "examples/README.md": "examples/index.md",
    "examples/models/cabinet.urdf": "examples/models/cabinet.urdf",
    "examples/own_urdf.ipynb": "examples/own_urdf.ipynb",
    "urdf_sources/README.md": "models/index.md",
    **{f"urdf_sources/{name}/README.md": f"models/{name}.md" for name in _SOURCES},
}
"""Where files of the repository that are not in docs/ are on the site."""

ASSETS = ("site.css", "iframe-worker.js")

EXAMPLES = {
    path.relative_to(ROOT).as_posix(): f"examples/{path.stem}.md"
    for path in sorted((ROOT / "examples").glob("*.py"))
}

_LINK = re.compile(r"\]\((?P<path>[^)\s#:]+)(?P<anchor>#[^)\s]*)?\)")

_FIRST_PICTURE = re.compile(r"^!\[.*$", re.MULTILINE)
_TO_GALLERY = "\\g<0>\n\n[The gallery](gallery/index.md) has all five, with a report of each."
"""Below the picture of the home page: what only the site has."""


def on_files(files: Files, config: Any) -> Files:
    """Add what is not in docs/."""
    for path, uri in PAGES.items():
        _add(files, config, uri, ROOT / path)
    for name in ASSETS:
        _add(files, config, f"site-assets/{name}", ROOT / "docs" / "site" / name)
    for path, uri in EXAMPLES.items():
        _write(files, config, uri, _shown(path))
    for uri, text in reference.pages().items():
        _write(files, config, uri, text)
    folder = ROOT / config.extra["gallery"]
    try:
        made = gallery.pages(folder)
    except OSError as error:
        raise PluginError(f"{error.filename}: is not there; `make docs` makes it first") from None
    for uri, content in made.items():
        if isinstance(content, Path):
            _add(files, config, uri, content)
        else:
            _write(files, config, uri, content)
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Turn the repository's links to the site's."""
    uri = page.file.src_uri
    here = {place: path for path, place in PAGES.items()}.get(uri, f"docs/{uri}")
    turned = with_links_of_site(markdown, here, uri)
    return _FIRST_PICTURE.sub(_TO_GALLERY, turned, count=1) if uri == "index.md" else turned


def with_links_of_site(markdown: str, path: str, uri: str) -> str:
    """The text of the file at `path` in the repository as the site has it at `uri`.

    What points to no file of the repository stays, so that mkdocs sees it if it is a broken link.
    """
    start = posixpath.dirname(uri)

    def turned(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), match["path"]))
        there = site_uri(target)
        if there is None:
            return match[0]
        return f"]({posixpath.relpath(there, start or '.')}{match['anchor'] or ''})"

    return _LINK.sub(turned, markdown)


def site_uri(path: str) -> str | None:
    """Where the site has a file of the repository; None where it has not."""
    if path in PAGES or path in EXAMPLES:
        return PAGES.get(path) or EXAMPLES[path]
    inside = path.removeprefix("docs/")
    return inside if inside != path and (ROOT / path).is_file() else None


def _shown(path: str) -> str:
    """A page with the source of an example."""
    source = (ROOT / path).read_text(encoding="utf-8")
    title = Path(path).stem.replace("_", " ").capitalize()
    return f'# {title}\n\n```python title="{path}"\n{source}```\n'


def _add(files: Files, config: Any, uri: str, path: Path) -> None:
    files.append(File.generated(config, uri, abs_src_path=str(path)))


def _write(files: Files, config: Any, uri: str, text: str) -> None:
    files.append(File.generated(config, uri, content=text))
