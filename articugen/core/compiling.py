"""Kernels compiled before they are needed: each once, by several processes at a time.

Left alone, each worker compiles every kernel when it first meets it, all of them the same. A stamp
beside what numba keeps says that there is nothing left to do; without it nothing goes wrong, it
only takes a few seconds to find out.

Commands call `compile_kernels` for what they need; `make test` calls `compile_all` when it sets up.
"""

import hashlib
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm

from articugen.core import processes
from articugen.core.bundled import CACHE

PARTS = {
    "generate": ("views", "drawing", "rays", "solids", "boxes", "files"),
    "inspect": ("discs", "light", "skins", "drawing"),
    "train": ("networks",),
}
"""For each command the parts of `rehearsal` that it needs; first those that take longest."""

_PACKAGE = Path(__file__).resolve().parents[1]
_KERNELS = (
    "fusion", "inspection", "jit.py", "learning/ppd/greatest.py", "learning/ppd/patches.py",
    "learning/ppd/sine_kernels.py", "rehearsal.py", "rendering", "report/skin.py",
    "sources/obj_kernel.py", "swept.py",
)  # fmt: skip


def compile_kernels(
    command: str, *, jobs: int, notice: Callable[[str], None] = lambda _: None
) -> None:
    """Compile what a command needs, unless that was done before; they are kept on the disk.

    Args:
        jobs: processes to use; with 0 nothing is done, and the kernels are compiled when first met.
        notice: called with one sentence where it takes a while.
    """
    stamp = _stamp(command)
    if jobs == 0 or stamp.exists():
        return
    try:
        stamp.parent.mkdir(parents=True, exist_ok=True)
    except OSError:  # nothing can be kept here
        return
    notice("compiling the kernels, once after an installation or an update ...")
    lost = [ended.lost for ended in processes.each(_rehearse, PARTS[command], workers=jobs)]
    if not any(lost):
        with suppress(OSError):
            stamp.touch()


def compile_all() -> None:
    """What every command needs, on all cores."""
    for command in PARTS:
        compile_kernels(command, jobs=os.cpu_count() or 1)


def _rehearse(part: str) -> None:
    from articugen import rehearsal  # noqa: PLC0415 - imports numba

    getattr(rehearsal, part)()


def _stamp(command: str) -> Path:
    """The file that is there once a command's kernels are compiled as they are now, for this
    processor; in the same folder as they, or where that cannot be written to in the user's cache.
    """
    known = [sys.version, version("numba"), *_processor()]
    for name in _KERNELS:
        path = _PACKAGE / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            state = file.stat()  # numba, too, looks at no more than that
            known.append(f"{file.relative_to(_PACKAGE)} {state.st_mtime_ns} {state.st_size}")
    digest = hashlib.sha256("\n".join(known).encode()).hexdigest()
    return _folder() / f"compiled-{command}-{digest[:16]}"


def _folder() -> Path:
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(asked)
    beside = _PACKAGE / "__pycache__"
    writable = os.access(beside if beside.exists() else _PACKAGE, os.W_OK)
    return beside if writable else CACHE.parent / "kernels"


def _processor() -> tuple[str, str]:
    """For which numba compiles."""
    asked = os.environ.get("NUMBA_CPU_NAME"), os.environ.get("NUMBA_CPU_FEATURES")
    if None not in asked:
        return str(asked[0]), str(asked[1])
    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
