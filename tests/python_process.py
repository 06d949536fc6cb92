"""Another Python, as a user would start one."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}
"""For a Python whose files may not grow: it would keep modules cut short, and all that import them
later would fail."""


def ended(
    *arguments: object,
    folder: Path | None = None,
    seconds: float = 300,
    begin: Sequence[str] = (),
    **env: str,
) -> subprocess.CompletedProcess[str]:
    """How `python *arguments` ends, in a folder and with more in its environment; `begin` is what
    stands before it, such as setpriv."""
    return subprocess.run(
        [*begin, sys.executable, *map(str, arguments)],
        cwd=folder,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        check=False,
        timeout=seconds,
    )


def printed(*arguments: object, **settings: Any) -> str:
    """What it prints, with the settings of `ended`. It must end well: else what it says is what
    the test says."""
    done = ended(*arguments, **settings)
    assert done.returncode == 0, done.stderr
    return done.stdout
