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
from importlib.metadata import EntryPoint, version
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np

from articugen.core import processes
from articugen.core.content import CACHE
from articugen.core.geometry import look_along
from articugen.core.records import LabelledMesh, Views

WARM_UPS = {
    "generate": (
        "fusion.warm:views", "rendering.warm:drawing", "fusion.warm:rays", "fusion.warm:solids",
        "fusion.warm:boxes",
    ),
    "inspect": (
        "pictures.warm:discs", "pictures.warm:light", "inspection.warm:skins",
        "inspection.warm:clouds", "inspection.warm:checks", "rendering.warm:drawing",
    ),
    "train": ("discovery.warm:joints", "learning.ppd.cpu.warm:networks"),
}  # fmt: skip
"""For each command the functions that call the kernels it needs; first those that take longest.

What they call is handed arrays made by hand wherever it needs none that another kernel makes, so
that several processes compile different kernels at a time. A test sees to it that after this the
real work finds every kernel compiled, for just the types that it hands over."""

_PACKAGE = Path(__file__).resolve().parents[1]


def compile_kernels(
    command: str, *, jobs: int | None = None, notice: Callable[[str], None] = lambda _: None
) -> None:
    """Compile what a command needs, unless that was done before; they are kept on the disk.

    Args:
        jobs: processes to use, None for all cores; with 0 nothing is done, and the kernels are
            compiled when first met.
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
    workers = jobs or processes.default_jobs()
    lost = [ended.lost for ended in processes.each(_warm_up, WARM_UPS[command], workers=workers)]
    if not any(lost):
        with suppress(OSError):
            stamp.touch()


def compile_all() -> None:
    """Compile what every command needs, on all cores."""
    for command in WARM_UPS:
        compile_kernels(command)


def _warm_up(name: str) -> None:
    EntryPoint("", f"articugen.{name}", "").load()()


def tetrahedron() -> LabelledMesh:
    """Return a closed mesh of four faces, one part."""
    return LabelledMesh(
        np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
        np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
        np.zeros(4, np.uint8),
    )


def two_views() -> Views:
    """Return two views of 4 x 4 pixels."""
    two, sides = np.ones(2), np.stack([look_along(way) for way in np.eye(3)[:2]])
    return Views("orthographic", sides, two, two, two, two, 4, 4)


def _stamp(command: str) -> Path:
    """Return the file that is there once a command's kernels are compiled as they are now."""
    processor = {
        "NUMBA_CPU_NAME": llvm.get_host_cpu_name(),
        "NUMBA_CPU_FEATURES": llvm.get_host_cpu_features().flatten(),
    }  # that numba compiles for, unless the environment names another
    known = [sys.version, version("numba"), *(os.environ.get(*one) for one in processor.items())]
    modules = {name.partition(".warm:")[0] for names in WARM_UPS.values() for name in names}
    rooms = (_PACKAGE.joinpath(*module.split(".")) for module in sorted(modules))
    files = (file for room in rooms for file in sorted(room.rglob("*.py")))
    for file in [_PACKAGE / "core" / "jit.py", _PACKAGE / "core" / "near.py", *files]:
        state = file.stat()  # numba, too, checks no more than that
        known.append(f"{file.relative_to(_PACKAGE)} {state.st_mtime_ns} {state.st_size}")
    digest = hashlib.sha256("\n".join(known).encode()).hexdigest()
    return _folder() / f"compiled-{command}-{digest[:16]}"


def _folder() -> Path:
    if folder := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(folder)
    beside = _PACKAGE / "__pycache__"
    writable = os.access(beside if beside.exists() else _PACKAGE, os.W_OK)
    return beside if writable else CACHE / "kernels"
