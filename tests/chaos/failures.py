"""Every change on the disk fails once, or from there on, or is the last thing that is done."""

import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from tests.chaos.commands import Command, Result, prepare
from tests.chaos.disk import Disk, Ended, Mode
from tests.chaos.tally import Tally

FAULTS = {
    Mode.FAIL_ONCE: "fails once",
    Mode.FAIL_FOR_GOOD: "fails, and all after it",
    Mode.TEAR_AND_KILL: "is torn by a SIGKILL",
}


class Failures:
    """A command on a failing disk, beside what it leaves on a sound one."""

    def __init__(self, command: Command, disk: Disk, work: Path) -> None:
        self.command, self._disk, self._work = command, disk, work
        disk.warm(self._fresh())
        log = work.with_name(f"{command.name}.log")
        self._fresh()
        sound = self._run(command.begin, log=log)
        assert sound.status == 0, sound.said
        self.whole: Result = command.result()
        self.changes = [tuple(line.split("\t")) for line in log.read_text().splitlines()]

    def tried(self, mode: Mode, points: Iterable[int], told: Callable[[str], None]) -> Tally:
        """The command with the fault at each of the points, and again without."""
        row = Tally(f"`{self.command.name}`: a change on the disk {FAULTS[mode]}")
        for at in points:
            self._fresh()
            ended = self._run(self.command.begin, at=at, mode=mode)
            wrong = self._wrong(ended, mode)
            again = self._run(self.command.resumed())
            result = self.command.result() if again.status == 0 else {}
            equal = result == self.whole
            if not wrong and not equal:
                other = str(set(result.items()) ^ set(self.whole.items()))
                wrong = other if again.status == 0 else again.said
            where = f"{mode.name} at {at} of {len(self.changes)} ({self.changes[at - 1]}): "
            row.note(survived=again.status == 0, equal=equal, wrong=wrong and where + wrong)
            told(f"{row.fault}: {row.tried}")
        return row

    def every(self) -> list[int]:
        """All changes, counted from 1."""
        return list(range(1, len(self.changes) + 1))

    def telling(self) -> list[int]:
        """All but the inner ones of a stretch of writes into one file, of which the middle one."""
        points, stretch = list[int](), list[int]()
        for number, change in enumerate(self.changes, 1):
            if stretch and change != self.changes[stretch[0] - 1]:
                points += _ends(stretch)
                stretch = []
            if change[0] == "write":
                stretch.append(number)
            else:
                points.append(number)
        return sorted({*points, *_ends(stretch)})

    def _fresh(self) -> Sequence[str]:
        shutil.rmtree(self._work, ignore_errors=True)
        prepare(self._work)
        return self.command.begin

    def _run(self, arguments: Sequence[str], **fault: object) -> Ended:
        return self._disk.run(arguments, self._work, **fault)  # type: ignore[arg-type]

    def _wrong(self, ended: Ended, mode: Mode) -> str:
        """What such an end should not be."""
        if mode == Mode.TEAR_AND_KILL:
            return "" if ended.status == -9 else f"status {ended.status}, not killed: {ended.said}"
        if "Traceback" in ended.said:
            return ended.said
        if ended.status == 0:  # it did without
            return "" if self.command.result() == self.whole else "done, and is another"
        if ended.status != 1 or "error: " not in ended.said:
            return f"status {ended.status}, no sentence: {ended.said}"
        return ""


def _ends(stretch: Sequence[int]) -> set[int]:
    return {stretch[0], stretch[len(stretch) // 2], stretch[-1]} if stretch else set()
