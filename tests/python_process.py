"""Another Python, as a user would start one."""

import os
import subprocess
import sys
from pathlib import Path


def printed(*arguments: str, folder: Path | None = None, seconds: float = 300, **env: str) -> str:
    """What `python *arguments` prints, in a folder and with more in its environment.

    It must end well: else what it says is what the test says.
    """
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        check=False,
        timeout=seconds,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
