"""A process whose disk fails, or that dies, at the n-th thing it changes on it.

After SQLite's tests: n is raised until a run comes to its end, so that every write, fsync, rename,
unlink, mkdir and creation of a file has been the one that fails.

A server has imported all that commands need and is forked for each run: nothing else is shared.
"""

import ctypes
import errno
import json
import os
import shutil
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


class Mode(IntEnum):
    """What happens at the n-th change; as in disk.c."""

    ONLY_COUNT = 0
    FAIL_ONCE = 1
    FAIL_FOR_GOOD = 2
    KILL = 3
    TEAR_AND_KILL = 4


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit status, or minus the signal; what it said; changes it made."""

    status: int
    said: str
    changes: int


class Disk:
    """The server: `run` calls a command on a disk that fails."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process

    def warm(self, arguments: Sequence[str]) -> None:
        """Call articugen in the server itself: what is loaded then is there in all runs."""
        told = self._ask({"warm": True, "arguments": list(arguments)})
        assert told["status"] == 0, told["said"]

    def run(
        self,
        arguments: Sequence[str],
        below: Path,
        *,
        at: int = 0,
        mode: Mode = Mode.ONLY_COUNT,
        log: Path | None = None,
    ) -> Ended:
        """Call articugen; changes below a folder are counted, and logged where `log` is named."""
        asked = {
            "arguments": list(arguments),
            "below": str(below),
            "at": at,
            "mode": int(mode),
            "log": str(log) if log else None,
        }
        return Ended(**self._ask(asked))

    def _ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


@contextmanager
def failing_disk(folder: Path) -> Iterator[Disk]:
    """The server, built in a folder; skipped where there is no C compiler, or no Linux."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if sys.platform != "linux" or compiler is None:
        pytest.skip("a disk that fails needs Linux and a C compiler")
    library = folder / "disk.so"
    flags = ["-O2", "-shared", "-fPIC", "-o", str(library)]
    source = str(Path(__file__).with_name("disk.c"))
    subprocess.run([compiler, *flags, source, "-ldl"], check=True)
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with subprocess.Popen(
        [sys.executable, "-m", "tests.chaos.disk", str(library)],
        cwd=ROOT,
        env=os.environ | single | {"LD_PRELOAD": str(library), "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield Disk(process)
        assert process.stdin is not None
        process.stdin.close()


# --- in the server


def _serve(library: ctypes.CDLL) -> None:
    from articugen.cli import main  # noqa: PLC0415 - its modules come with `warm`

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the commands say is none
    for line in sys.stdin:
        asked = json.loads(line)
        library.disk_disarm()
        if asked.pop("warm", False):
            told = {"status": _called(main, asked), "said": ""}
        else:
            told = _forked(library, lambda asked=asked: _called(main, asked), asked)
        answers.write(json.dumps(told) + "\n")
        answers.flush()


def _called(main: Callable[[], None], asked: dict[str, Any]) -> int:
    sys.argv = ["articugen", *asked["arguments"]]
    try:
        main()
    except SystemExit as left:
        return int(left.code or 0)
    return 0


def _forked(library: ctypes.CDLL, call: Callable[[], int], asked: dict[str, Any]) -> dict[str, Any]:
    reader, writer = os.pipe()
    if not (child := os.fork()):
        os.close(reader)
        for stream in (1, 2):
            os.dup2(writer, stream)
        log = -1
        if asked["log"]:
            log = os.open(asked["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
        failing = errno.ENOSPC if asked["at"] % 2 else errno.EIO
        below, at = asked["below"].encode(), ctypes.c_long(asked["at"])
        library.disk_arm(below, at, asked["mode"], failing, log)
        status = 1
        try:
            status = call()
        except BaseException:
            traceback.print_exc()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status)
    os.close(writer)
    with os.fdopen(reader, "rb") as said:
        text = said.read().decode(errors="replace")
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return {"status": status, "said": text, "changes": library.disk_count()}


if __name__ == "__main__":
    loaded = ctypes.CDLL(sys.argv[1])
    loaded.disk_count.restype = ctypes.c_long
    _serve(loaded)
