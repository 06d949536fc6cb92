"""What decides a data set besides its recipe and models: libraries, code, machine."""

import hashlib
import os
import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

from articugen.core.content import VERSION


def library_versions() -> dict[str, str]:
    """Return versions of Python and of the libraries that decide a data set's numbers or bytes."""
    names = ("numpy", "numba", "h5py", "trimesh", "yourdfpy")
    return {"python": platform.python_version()} | {n: metadata.version(n) for n in names}


@cache
def code_version() -> str:
    """Return the package's version and a digest of all its code."""
    package = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes())
    return f"{VERSION}+{digest.hexdigest()[:12]}"


def this_machine() -> dict[str, str | int]:
    """Return facts of this machine: system, architecture, processor, number of cores."""
    processor = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.is_file():
        lines = information.read_text(errors="replace").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        processor = names[0] if names else processor
    return {
        "system": f"{platform.system()} {platform.release()}",
        "architecture": platform.machine(),
        "processor": processor,
        "cores": os.cpu_count() or 1,
    }


def this_commit() -> str | None:
    """Return the git commit of the checkout that this package is tracked in; None for an installed
    one."""
    package = Path(__file__).resolve().parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(package), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20)
        return done.stdout

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        changes = git("status", "--porcelain", "--untracked-files=no", "--", ".")
        return git("rev-parse", "HEAD").strip() + ("+changes" if changes else "")
    except (OSError, subprocess.SubprocessError):
        return None
