"""What a report says of itself: command, commit, machine, versions."""

import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from articugen.core import processes
from articugen.store.provenance import this_machine

LIBRARIES = ("numpy", "numba", "h5py", "trimesh")


def about(quick: bool, versions: Iterable[Mapping[str, str]] = ()) -> dict[str, Any]:
    """The record of this run; call it first, for it reads how busy the machine is.

    Args:
        versions: of further distributions, "" where one is absent.
    """
    found = {name: metadata.version(name) for name in LIBRARIES}
    for more in versions:
        found |= more
    module = Path(sys.argv[0]).stem
    name = "tests.benchmarks" + ("" if module == "__main__" else f".{module}")
    return {
        "command": " ".join(["python -m", name, *_without_folder(sys.argv[1:])]),
        "commit": _git("describe", "--always", "--dirty", "--abbrev=12"),
        "date": time.strftime("%Y-%m-%d"),
        "machine": f"{this_machine()['processor']}, {processes.default_jobs()} cores, "
        f"{platform.system()}, Python {platform.python_version()}",
        "load_before": os.getloadavg()[0],
        "quick": quick,
        "versions": found,
    }


def head(record: Mapping[str, Any]) -> str:
    """The record as a paragraph of Markdown."""
    versions = ", ".join(f"{name} {v or 'absent'}" for name, v in record["versions"].items())
    lines = [
        f"`{record['command']}` at commit {record['commit']}, {record['date']}, "
        f"{record['minutes']:.1f} minutes. {record['machine']}; load before the run "
        f"{record['load_before']:.1f}. {versions}.",
        "",
    ]
    if record["quick"]:
        lines += ["**A quick run: it shows that this works; its figures mean little.**", ""]
    return "\n".join(lines)


def _without_folder(arguments: list[str]) -> list[str]:
    """All but `--out FOLDER`: where it was written is nobody else's business."""
    before = [None, *arguments]
    return [a for b, a in zip(before, arguments, strict=False)
            if b != "--out" and a.split("=")[0] != "--out"]  # fmt: skip


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"
