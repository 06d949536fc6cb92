"""Trouble for tests: small disks, folders that another run holds, what is no file to read."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

_HOLD = """
import sys, time
from pathlib import Path
from articugen.core.place import Folder
from articugen.pipeline.records import Records
records = Records(Folder(Path(sys.argv[1])))
print("held", flush=True)
time.sleep(60)
"""


@contextmanager
def small_disk(path: Path, size: str) -> Iterator[Path]:
    """A file system of so much memory, for instance "64k", at a folder that does not exist yet."""
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(path)]
    if (
        sys.platform != "linux"
        or os.geteuid() != 0
        or subprocess.run(mount, capture_output=True, check=False).returncode
    ):
        pytest.skip("only root can mount a small disk to fill")
    try:
        yield path
    finally:
        subprocess.run(["umount", str(path)], check=True)


def obeying_permissions() -> list[str]:
    """How the command begins of a process that may not write everywhere, as root may."""
    if os.geteuid() != 0:
        return []
    no_override = ["--bounding-set", "-dac_override", "--inh-caps", "-dac_override"]
    command = ["setpriv", *no_override]
    if not shutil.which("setpriv") or subprocess.run([*command, "true"], check=False).returncode:
        pytest.skip("root may write everywhere, and there is no setpriv")
    return command


@contextmanager
def held_by_another_run(folder: Path) -> Iterator[None]:
    """A process that is at work in the folder, and is then killed."""
    command = [sys.executable, "-c", _HOLD, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        yield
        process.send_signal(signal.SIGKILL)


def unfit(path: Path, kind: str, most_bytes: int) -> None:
    """Put at `path` what is no file to read: a FIFO, a folder, a file of more than `most_bytes`,
    or a link to a device or to itself; or nothing, where it is absent."""
    if kind == "FIFO":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "too large":
        path.touch()
        os.truncate(path, most_bytes + 1)
    elif kind != "absent":
        path.symlink_to({"device": "/dev/zero", "round link": path}[kind])
