"""Real runs with real workers, struck at moments that a seed draws; the same command goes on."""

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from pathlib import Path

from tests.chaos.commands import PYTHON, Command, Result, prepare
from tests.chaos.disk import ROOT
from tests.chaos.tally import Tally

GONE_AFTER = 2.0
"""Seconds in which the workers of a run that was ended are to be gone."""


class Strike(Enum):
    """Who is struck, and how."""

    GROUP = "SIGKILL of the whole group"
    PARENT = "SIGKILL of the parent"
    WORKER = "SIGKILL of one worker"
    TERM = "SIGTERM"


class Kills:
    """A command that is struck, beside what it leaves undisturbed in so many seconds."""

    def __init__(self, command: Command, work: Path, whole: Result, seconds: float) -> None:
        self.command, self._work, self.whole, self.seconds = command, work, whole, seconds

    @staticmethod
    def of(command: Command, work: Path) -> "Kills":
        """Beside a run that nothing disturbs now."""
        kills = Kills(command, work, {}, 0.0)
        kills._fresh()
        began = time.monotonic()
        assert kills._finished(command.begin) == ""
        return Kills(command, work, command.result(), time.monotonic() - began)

    def tried(
        self, strike: Strike, moments: list[float], told: Callable[[str], None], name: str = ""
    ) -> Tally:
        """A run struck at each moment, a share of the time that a run takes; and gone on with."""
        row = Tally(f"`{self.command.name}`{name}: {strike.value}")
        for moment in moments:
            self._fresh()
            wrong = self._struck(strike, moment * self.seconds)
            said = self._finished(self.command.resumed())
            result = {} if said else self.command.result()
            equal = result == self.whole
            if not equal and not wrong:
                wrong = said or str(set(result.items()) ^ set(self.whole.items()))
            where = f"{strike.value} after {moment:.3f} of {self.seconds:.1f} s: "
            row.note(survived=not said, equal=equal, wrong=wrong and where + wrong)
            told(f"{row.fault}: {row.tried}")
        return row

    def _struck(self, strike: Strike, after: float) -> str:
        """What went otherwise than promised, or nothing."""
        process = self._started(self.command.begin)
        try:
            process.wait(after)
        except subprocess.TimeoutExpired:
            _strike(process, strike)
        if strike == Strike.WORKER:
            said = process.communicate()[0]
            return "" if process.returncode == 0 else f"status {process.returncode}: {said}"
        struck = time.monotonic()
        while _lives(process.pid):
            process.poll()
            if time.monotonic() - struck > GONE_AFTER:
                os.killpg(process.pid, signal.SIGKILL)
                return f"a process lives {GONE_AFTER} s later"
            time.sleep(0.01)
        said = process.communicate()[0]
        ends = (0, 143, -15) if strike == Strike.TERM else (0, -9)
        if process.returncode not in ends or "Traceback" in said:
            return f"status {process.returncode}: {said}"
        return ""

    def _fresh(self) -> None:
        shutil.rmtree(self._work, ignore_errors=True)
        prepare(self._work)

    def _started(self, arguments: tuple[str, ...]) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [*PYTHON, *arguments],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def _finished(self, arguments: tuple[str, ...]) -> str:
        """Run it to its end; what it said where that is none."""
        process = self._started(arguments)
        said = process.communicate()[0]
        return "" if process.returncode == 0 else f"status {process.returncode}: {said}"


def moments(seed: int, count: int) -> list[float]:
    """When to strike, in shares of the time that a run takes."""
    return [random.Random(f"{seed} {number}").random() for number in range(count)]


def _strike(process: "subprocess.Popen[str]", strike: Strike) -> None:
    if strike == Strike.GROUP:
        os.killpg(process.pid, signal.SIGKILL)
    elif strike == Strike.PARENT:
        process.kill()
    elif strike == Strike.TERM:
        process.terminate()
    elif workers := _children(process.pid):
        with suppress(ProcessLookupError):  # it was done just now
            os.kill(workers[0], signal.SIGKILL)


def _children(parent: int) -> list[int]:
    try:
        listed = Path(f"/proc/{parent}/task/{parent}/children").read_text()
    except OSError:
        return []
    return [int(word) for word in listed.split()]


def _lives(group: int) -> bool:
    """Whether a process of the group is alive, zombies aside."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                told = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(told[2]) == group and told[0] != "Z":
                return True
    return False
