"""The snippets of docs/extending.md do what the page says: each section in a folder of its own.

A block with a title, ```python title="name.py", is that file; ```diff title="articugen/name.py"
changes that file of a copy of the package; any other ```python block is executed, in order, all
blocks of a section in one process.
"""

import os
import re
import sys
from pathlib import Path

import pytest
from python_process import printed

import articugen

PACKAGE = Path(articugen.__file__).parent
PAGE = PACKAGE.parent / "docs" / "extending.md"

_BLOCK = re.compile(
    r'^```(python|diff|yaml)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL
)


def sections() -> dict[str, str]:
    _, *parts = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {title: text for title, _, text in (part.partition("\n") for part in parts)}


def package_in(folder: Path) -> None:
    """The package, as links: kernels that are compiled already serve it as well."""
    (folder / "articugen").mkdir(exist_ok=True)
    for path in PACKAGE.iterdir():
        link = folder / "articugen" / path.name
        if path.name in ("core", "instance"):  # their files may be changed, too
            (link / "__pycache__").mkdir(parents=True)
            for inner in (*path.glob("*.py"), *path.glob("__pycache__/*")):
                (link / inner.relative_to(path)).symlink_to(inner)
        else:
            link.symlink_to(path)


def change(path: Path, hunk: str) -> None:
    """Apply one block of a diff: its lines lie together in the file, once."""
    lines = [line for line in hunk.splitlines() if not line.startswith("@@")]
    before, after = (
        "".join(line[1:] + "\n" for line in lines if line[:1] in (" ", sign)) for sign in "-+"
    )
    text = path.read_text(encoding="utf-8")
    assert text.count(before) == 1, f"{path.name} has not, or not once:\n{before}"
    assert path.parent.resolve() == path.parent, f"{path} lies behind a link: nothing there is ours"
    path.unlink()  # which may be a link
    path.write_text(text.replace(before, after), encoding="utf-8")


@pytest.mark.parametrize("title", sections())
def test_the_snippets_of_a_section_run(title: str, tmp_path: Path) -> None:
    if title == "A learner":
        pytest.importorskip("torch", reason="learners need torch")
    blocks = _BLOCK.findall(sections()[title])
    assert blocks, "a section without a snippet shows nothing"
    if any(kind == "diff" for kind, *_ in blocks):
        package_in(tmp_path)
    for kind, name, code in blocks:
        if kind == "diff":
            change(tmp_path / name, code)
        elif name:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(code, encoding="utf-8")
    script = tmp_path / "page.py"
    run = [code for kind, name, code in blocks if kind == "python" and not name]
    script.write_text("\n".join(run), encoding="utf-8")
    own = {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(PACKAGE.parent), *sys.path])}
    printed("-B", "-W", "error", script.name, folder=tmp_path, **own)
