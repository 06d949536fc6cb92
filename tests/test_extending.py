"""The snippets of docs/extending.md do what the page says: each section in a folder of its own.

A block ```python title="name.py" is written to that file; any other ```python block is executed, in
order, all blocks of a section in one process.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parent.parent / "docs" / "extending.md"

_BLOCK = re.compile(r'^```python(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)


def sections() -> dict[str, str]:
    _, *parts = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {title: text for title, _, text in (part.partition("\n") for part in parts)}


@pytest.mark.parametrize("title", sections())
def test_the_snippets_of_a_section_run(title: str, tmp_path: Path) -> None:
    blocks = _BLOCK.findall(sections()[title])
    assert blocks, "a section without a snippet shows nothing"
    for name, code in blocks:
        if name:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(code, encoding="utf-8")
    script = tmp_path / "page.py"
    script.write_text("\n".join(code for name, code in blocks if not name), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "error", script.name],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
