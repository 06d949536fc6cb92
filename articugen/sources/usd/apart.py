"""A model, read in a process of its own.

OpenUSD puts a whole stage together before anything of it can be counted: a few lines of references
that name each other make billions of prims, and a damaged binary file is read by compiled code. So
it runs where limits of time and memory hold for it alone, and where its end is a sentence about the
model.
"""

import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

from articugen.core import processes
from articugen.core.errors import InvalidSource, installing

T = TypeVar("T")

SECONDS = 300  # by the clock, for one model
MEGABYTES = 6_000  # half a thousand of which OpenUSD takes by itself

_OURS = ("PXR_", "USD_", "SDF_", "PCP_", "TF_", "USDC_")
"""Variables by which OpenUSD finds plugins and folders of the user's."""


def apart(function: Callable[[Path], T], path: Path) -> T:
    """Return what a function of `model` makes of a file, and raise as that does; InvalidSource also
    where it takes too long or too much memory, or OpenUSD is not installed, MemoryError where the
    system ended it."""
    # a package that somebody has replaced by None has no spec either
    if sys.modules.get("pxr", sys) is None or find_spec("pxr") is None:
        raise InvalidSource(
            f"{path}: is USD, and usd-core, which reads it, is not installed; run: "
            f"{installing('usd')}"
        )
    limit = processes.Limit(SECONDS, MEGABYTES)
    (ended,) = processes.each(function, [path], workers=1, limit=limit, ready=_get_ready)
    if ended.over:
        most = f"{SECONDS} s" if ended.over == "seconds" else f"{MEGABYTES:,} MB"
        raise InvalidSource(f"{path}: takes OpenUSD more than {most}; simplify it")
    if ended.lost and "memory" in ended.lost:
        raise MemoryError(f"{path}: the process that read it {ended.lost}")
    if ended.value is None:
        raise InvalidSource(f"{path}: OpenUSD fails at it ({ended.lost}); export it again")
    return ended.value


def _get_ready() -> None:
    """Have OpenUSD find nothing of the user's, use one thread, and print to nobody."""
    for name in [name for name in os.environ if name.startswith(_OURS)]:
        del os.environ[name]
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"  # workers are many
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
