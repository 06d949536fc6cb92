"""Another Python, as a user would start one."""

import os
import subprocess
import sys
from pathlib import Path

NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}
"""For a Python whose files may not grow: it would keep modules cut short, and all that import them
later would fail."""


def ended(
    *arguments: str, folder: Path | None = None, seconds: float = 300, **env: str
) -> subprocess.CompletedProcess[str]:
    """How `python *arguments` ends, in a folder and with more in its environment."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        check=False,
        timeout=seconds,
    )


def printed(*arguments: str, folder: Path | None = None, seconds: float = 300, **env: str) -> str:
    """What it prints. It must end well: else what it says is what the test says."""
    done = ended(*arguments, folder=folder, seconds=seconds, **env)
    assert done.returncode == 0, done.stderr
    return done.stdout
