"""A model, read in a process of its own.

OpenUSD puts a whole stage together before anything of it can be counted: a few lines of references
that name each other make billions of prims, and a damaged binary file is read by compiled code. So
it runs where limits of time and memory hold for it alone, and where its end is a sentence about the
model.
"""

import io
import json
import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.errors import InvalidSource, MachineFault, installing, printable
from articugen.core.records import Joint, JointKind, Mesh
from articugen.sources.usd.model import Model

SECONDS = 120  # of one core, for one model
MEMORY = 6 * 2**30  # bytes of address space, half a GiB of which OpenUSD takes by itself

_PACKAGES = Path(__file__).resolve().parents[3]

_START = (
    "import sys; sys.path[:] = [sys.argv[1], *filter(None, sys.path)]; "
    "from articugen.sources.usd.child import main; main()"
)
"""The folder that the command is called in is no place for modules: models may lie there."""

_OURS = ("PXR_", "USD_", "SDF_", "PCP_", "TF_", "USDC_")
"""Variables by which OpenUSD is told of plugins and folders of the user's."""

_MOST_SECONDS = 900  # by the clock, for a machine that has other things to do


def read_apart(path: Path, root: Path, *, with_meshes: bool = True) -> Model:
    """As `model.read_model`; also refused: what takes too long or too much memory.

    Raises:
        InvalidSource: also where OpenUSD is not installed.
        MachineFault, MemoryError: as there; or the system ended it.
    """
    line, data = _asked(path, root, {"with_meshes": with_meshes, "only_hashed": False})
    with np.load(io.BytesIO(data)) as arrays:
        links = tuple(
            (name, Mesh(arrays[f"vertices_{k}"], arrays[f"faces_{k}"]) if there else None)
            for k, (name, there) in enumerate(line["links"])
        )
    joints = tuple(
        Joint(
            **{
                **j,
                "kind": JointKind.named(j["kind"]),
                "axis": np.array(j["axis"]),
                "T_parent_joint": np.array(j["T_parent_joint"]),
            }
        )
        for j in line["joints"]
    )
    return Model(links, joints, line["sha256"], tuple(line["notes"]))


def digest_apart(path: Path, root: Path) -> str:
    """As `model.digest`.

    Raises:
        InvalidSource, MachineFault, MemoryError: as `read_apart`.
    """
    return _asked(path, root, {"with_meshes": False, "only_hashed": True})[0]["sha256"]


def _asked(path: Path, root: Path, how: dict[str, bool]) -> tuple[dict[str, Any], bytes]:
    """What the process answers: a line, and what comes behind it."""
    # a package that somebody has put None in the place of has no spec either
    if sys.modules.get("pxr", sys) is None or find_spec("pxr") is None:
        raise InvalidSource(
            f"{path}: is USD, and usd-core, which reads it, is not installed; run: "
            f"{installing('usd')}"
        )
    limits = {"seconds": SECONDS, "memory": MEMORY, "parent": os.getpid()}
    request = {"path": str(path), "root": str(root), **limits, **how}
    # the user's, without what leads OpenUSD elsewhere; one thread, for workers are many
    environment = {k: v for k, v in os.environ.items() if not k.startswith(_OURS)}
    environment |= {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _START, str(_PACKAGES)],
            input=json.dumps(request).encode(),
            capture_output=True,
            env=environment,
            timeout=_MOST_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise _too_long(path) from None
    except OSError as error:
        raise MachineFault(f"{sys.executable}: cannot be started: {error}; see to it") from error
    if done.returncode:
        raise _ended(path, done)
    line, _, data = done.stdout.partition(b"\n")
    said = json.loads(line)
    if "refused" in said:
        raise InvalidSource(said["refused"])
    if "too_large" in said:
        raise _too_large(path)
    if "fault" in said:
        raise MachineFault(said["fault"])
    return said, data


def _ended(path: Path, done: subprocess.CompletedProcess[bytes]) -> Exception:
    """What to raise where the process has ended without an answer."""
    if -done.returncode == signal.SIGXCPU:
        return _too_long(path)
    if -done.returncode == signal.SIGKILL:  # by the system, for want of memory
        return MemoryError(f"{path}: the process that read it was ended by the system")
    said = done.stderr.decode(errors="replace")
    if "bad_alloc" in said or "MemoryError" in said:
        return _too_large(path)
    how = f"signal {-done.returncode}" if done.returncode < 0 else f"status {done.returncode}"
    last = printable(said.strip().rpartition("\n")[2])[:200] if done.returncode > 0 else ""
    return InvalidSource(
        f"{path}: OpenUSD fails at it ({how}{': ' if last else ''}{last}); export it again"
    )


def _too_long(path: Path) -> InvalidSource:
    return InvalidSource(f"{path}: takes OpenUSD more than {SECONDS} s; simplify it")


def _too_large(path: Path) -> InvalidSource:
    return InvalidSource(f"{path}: takes OpenUSD more than {MEMORY / 2**30:g} GiB; simplify it")
