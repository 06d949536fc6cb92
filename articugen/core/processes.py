"""Worker processes that are watched: they die with their parent, and none takes another along.

A worker that is killed, or for which memory runs out, costs its task one more try, alone, when all
others are done; one that exceeds the limit is killed, and that is the task's result.

They are started by hand, not by `multiprocessing`: a script then needs no `if __name__ ==
"__main__"`, and one that is lost breaks no pool.
"""

import ctypes
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from articugen.core.errors import ArticugenError, MachineFault

T = TypeVar("T")
R = TypeVar("R")

TICK = 0.2
"""Seconds between two checks of the workers' clocks and memory."""

LONGEST_LOOK = 5.0
"""Seconds that count at most between two looks: this process was stopped (Ctrl-Z), or the machine
slept, and so did the workers."""

LONGEST_START = 600.0
"""Seconds in which a worker must be ready: with too little address space OpenBLAS, for instance,
asks for memory again and again while it is loaded, for ever."""

_READY, _SAID, _DONE, _RAISED, _NO_MEMORY = "ready", "said", "done", "raised", "no memory"
_PR_SET_PDEATHSIG = 1  # of linux/prctl.h
_STOPPING = {signal.SIGINT, signal.SIGTERM}


@dataclass(frozen=True)
class Limit:
    """Limits of one task: seconds of the clock, and resident memory of its worker."""

    seconds: float = math.inf
    megabytes: float = math.inf


@dataclass(frozen=True)
class Ended(Generic[R]):
    """End of a task: with a value, over the limit, or with its worker lost twice.

    Attributes:
        number: the task's place among the tasks.
        value: what the function returned; None where it did not.
        over: "seconds" or "megabytes", the limit it exceeded; or None.
        lost: what became of its worker, for instance "ran out of memory"; or None.
    """

    number: int
    value: R | None = None
    over: str | None = None
    lost: str | None = None


def _nothing(*_: object) -> None:
    pass


def each(
    function: Callable[[T], R],
    tasks: Sequence[T],
    *,
    workers: int,
    limit: Limit = Limit(),
    ready: Callable[[], None] = _nothing,
    help: Callable[[T], object] | None = None,
    handles: Sequence[int] = (),
    notice: Callable[[str], None] = _nothing,
    name: Callable[[T], str] = str,
) -> Generator[Ended[R], None, None]:
    """As `Crew.each`, by a crew of its own: closing this ends all tasks."""
    with Crew(
        function,
        workers=workers if help and tasks else min(workers, len(tasks)),
        limit=limit,
        ready=ready,
        help=help,
        handles=handles,
        notice=notice,
        name=name,
    ) as crew:
        yield from crew.each(tasks)


def in_order(
    function: Callable[[T], R], tasks: Sequence[T], *, workers: int, name: Callable[[T], str] = str
) -> Generator[R, None, None]:
    """As `Crew.in_order`, by a crew of its own: closing this ends all tasks."""
    with Crew(function, workers=min(workers, len(tasks)), name=name) as crew:
        yield from crew.in_order(tasks)


def report(message: object) -> None:
    """Hand a picklable message to the `on_report` of the crew whose task is calling this."""
    _report(message)


_report: Callable[[object], None] = _nothing
"""What `report` does in this process: set in every worker, and here while a task is done here."""


def die_with(parent: int) -> None:
    """End this process as soon as the process `parent`, its parent, has ended; within a second.

    Linux does it at once, whatever this process is doing. Elsewhere a thread looks, which our
    kernels let run. The signal follows the parent's *thread* that started this process.
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGKILL)


# --- in a worker


def serve(handle: int, parent: int) -> None:
    """What a worker does: the tasks that come through the pipe, until nobody is at its end."""
    global _report  # noqa: PLW0603
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then ends us
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPPING)
    die_with(parent)
    with Connection(handle) as pipe:
        _report = lambda message: pipe.send((_SAID, message))  # noqa: E731
        try:
            function, ready, help = pipe.recv()
            kind, value = _answer(lambda _: ready(), None)
            pipe.send((_READY if kind is _DONE else kind, value))
            while True:
                helps, task = pipe.recv()
                pipe.send(_answer(help if helps else function, task))
        except (EOFError, OSError, MemoryError):
            os._exit(1)  # nobody is there to be answered


def _answer(function: Callable[[Any], Any], task: Any) -> tuple[str, Any]:
    try:
        return _DONE, function(task)
    except MemoryError:
        return _NO_MEMORY, None
    except Exception as error:
        return _RAISED, _picklable(error)


def _picklable(error: Exception) -> Exception:
    """Some exceptions cannot be made again from what they say."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        kind = ArticugenError if isinstance(error, ArticugenError) else RuntimeError
        return kind(str(error))
    return error


# --- in the parent


class _Clock:
    """The seconds in which somebody checked it: see `LONGEST_LOOK`."""

    def __init__(self) -> None:
        self._seconds, self._looked = 0.0, time.monotonic()

    def __call__(self) -> float:
        now = time.monotonic()
        self._seconds += min(now - self._looked, LONGEST_LOOK)
        self._looked = now
        return self._seconds


class _Worker:
    """One process, its pipe, and the task it is at."""

    def __init__(
        self,
        does: tuple[Callable[[Any], Any], Callable[[], None], Callable[[Any], object] | None],
        handles: Sequence[int],
        clock: _Clock,
    ) -> None:
        self.number: int | None = None
        self.alone = self.helps = False
        self.since: float | None = None  # when its clock started; None while it gets ready
        self._clock, self._hired = clock, clock()
        self._ready = False
        ours, theirs = Pipe()
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from articugen.core.processes import serve; "
            f"serve({theirs.fileno()}, {os.getpid()})"
        )
        with theirs, _no_interrupts():
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), *handles),
            )
        self.pipe = ours
        self.pid = self._process.pid
        self._send(does)

    @property
    def is_stuck(self) -> bool:
        return not self._ready and self._clock() - self._hired > LONGEST_START

    def begin(self, number: int, task: object, *, alone: bool = False, helps: bool = False) -> None:
        self.number, self.alone, self.helps = number, alone, helps
        self.since = self._clock() if self._ready else None
        self._send((helps, task))

    def hear(self) -> tuple[str, Any]:
        """What it says; `EOFError` where it is gone."""
        try:
            kind, value = self.pipe.recv()
        except OSError:
            raise EOFError from None
        if kind == _READY:
            self._ready, self.since = True, self._clock()
        return kind, value

    def end(self) -> int:
        """Kill it where it still lives; its exit status."""
        self._process.kill()
        status = self._process.wait()
        self.pipe.close()
        return status

    def _send(self, what: object) -> None:
        with suppress(OSError):  # it is gone, as `hear` will find
            self.pipe.send(what)


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait, here and in what is started meanwhile: see `serve`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Crew(Generic[T, R]):
    """Workers for one function; as a context, at whose end all of them are dismissed.

    Args:
        function: picklable, by its name in a module; its tasks and results are picklable, too.
        workers: processes at most; 0 does all of it in this process, without any limit.
        limit: what one task may take.
        ready: called once in each worker before its first task, off the clock.
        help: what a worker without a task does for one that another is at, from its beginning; it
            returns where nothing is left to do there. What it returns or raises means nothing.
        handles: open files that every worker holds open as long as it lives, locks for instance.
        on_report: called here with each message that a task gives to `report`, in their order.
        notice: called with one sentence where a worker was lost.
        name: what a task is called in it.
    """

    def __init__(
        self,
        function: Callable[[T], R],
        *,
        workers: int,
        limit: Limit = Limit(),
        ready: Callable[[], None] = _nothing,
        help: Callable[[T], object] | None = None,
        handles: Sequence[int] = (),
        on_report: Callable[[Any], None] = _nothing,
        notice: Callable[[str], None] = _nothing,
        name: Callable[[T], str] = str,
    ) -> None:
        self._function = function
        self._clock = _Clock()
        self._hire = lambda: _Worker((function, ready, help), handles, self._clock)
        self._limit = limit
        self._here = workers == 0
        self._width = workers
        self._on_report = on_report
        self._notice = notice
        self._name = name
        self._hopeless = workers + 3
        self._deaths = 0
        self._any_done = False
        self._may_help = help is not None
        self._helpless: set[int] = set()  # tasks in which nothing is left for helpers
        self._busy: list[_Worker] = []
        self._helping: list[_Worker] = []
        self._idle: list[_Worker] = []
        self._waiting: deque[int] = deque()
        self._alone: deque[int] = deque()

    def __enter__(self) -> "Crew[T, R]":
        return self

    def __exit__(self, *_: object) -> None:
        self._end_helpers()
        for worker in self._busy + self._idle:
            worker.end()
        self._busy, self._idle = [], []

    def each(self, tasks: Sequence[T]) -> Iterator[Ended[R]]:
        """Yield the function of each task, as they end; raises what it raises.

        Raises:
            MachineFault: no worker can be started, or none does anything before it is lost.
        """
        if self._here:
            yield from map(self._do_here, range(len(tasks)), tasks)
            return
        self._end_helpers()
        self._helpless = set()
        self._waiting.extend(range(len(tasks)))
        while self._waiting or self._alone or self._busy:
            self._hand_out(tasks)
            self._help_out(tasks)
            spoken = wait([worker.pipe for worker in self._busy + self._helping], TICK)
            self._hear_helpers(spoken)
            for worker in [w for w in self._busy if w.pipe in spoken or w.is_stuck]:
                hear = self._heard if worker.pipe in spoken else self._given_up
                ended, lost = hear(worker)
                if ended:
                    yield ended
                if lost:
                    self._notice(self._loss(lost, self._name(tasks[worker.number or 0])))
            for worker, over in self._over_limit():
                self._dismiss(worker)
                if not worker.helps:
                    yield Ended(worker.number or 0, over=over)

    def in_order(self, tasks: Sequence[T]) -> Iterator[R]:
        """Yield the function of each task, in the order of the tasks; raises what it raises.

        Raises:
            MachineFault: as `each`; or a worker was lost twice over the same task.
        """
        early: dict[int, R] = {}
        following = 0
        for ended in self.each(tasks):
            if ended.lost:
                raise MachineFault(
                    f"{self._name(tasks[ended.number])}: its worker {ended.lost} when it was tried "
                    "alone as well; use fewer --jobs or end other programs"
                )
            early[ended.number] = cast("R", ended.value)
            while following in early:
                yield early.pop(following)
                following += 1

    def _do_here(self, number: int, task: T) -> Ended[R]:
        global _report  # noqa: PLW0603
        before, _report = _report, self._on_report
        try:
            return Ended(number, value=self._function(task))
        except MemoryError:
            return Ended(number, lost="ran out of memory")
        finally:
            _report = before

    def _hand_out(self, tasks: Sequence[T]) -> None:
        while self._waiting and len(self._busy) < self._width:
            if not self._give(self._waiting, tasks, alone=False):
                self._width = len(self._busy)
        if self._alone and not self._busy:
            self._give(self._alone, tasks, alone=True)

    def _help_out(self, tasks: Sequence[T]) -> None:
        """Have workers without a task help where one is begun, with the one of fewest helpers."""
        while self._may_help and not self._waiting and not self._alone:
            at_work = len(self._busy) + len(self._helping)
            numbers = {w.number: w.since for w in self._busy if w.number not in self._helpless}
            if not numbers or at_work >= self._width:
                break
            if not self._idle and not self._is_one_more_hired():
                break
            helped = Counter(worker.number for worker in self._helping)
            begun = [number for number, since in numbers.items() if since is not None]
            if not begun:
                break
            number = cast("int", min(begun, key=lambda n: helped[n]))
            self._helping.append(self._idle.pop())
            self._helping[-1].begin(number, tasks[number], helps=True)

    def _is_one_more_hired(self) -> bool:
        try:
            self._idle.append(self._hire())
        except OSError:
            self._may_help = False  # the tasks do without
        return self._may_help

    def _hear_helpers(self, spoken: Sequence[object]) -> None:
        for helper in [w for w in self._helping if w.pipe in spoken]:
            try:
                kind, _ = helper.hear()
            except EOFError:
                kind = None
            if kind in (_READY, _SAID):
                continue
            self._helping.remove(helper)
            self._helpless.add(cast("int", helper.number))
            if kind == _DONE:
                self._idle.append(helper)
            else:  # what is wrong there, the task will tell by itself
                helper.end()

    def _end_helpers(self) -> None:
        while self._helping:
            self._helping.pop().end()

    def _give(self, numbers: deque[int], tasks: Sequence[T], *, alone: bool) -> bool:
        """Hand the next task to a worker; whether there was one to be had."""
        try:
            worker = self._idle.pop() if self._idle else self._hire()
        except OSError as error:
            if self._busy:
                return False
            raise MachineFault(
                f"no worker process can be started: {error.strerror or error}; end other programs, "
                "raise the limits (ulimit) or use fewer --jobs"
            ) from error
        number = numbers.popleft()
        worker.begin(number, tasks[number], alone=alone)
        self._busy.append(worker)
        return True

    def _heard(self, worker: _Worker) -> tuple[Ended[Any] | None, str | None]:
        """How its task ended, if it did; what became of the worker, where its task gets a try."""
        try:
            kind, value = worker.hear()
        except EOFError:
            return self._lost(worker, _fate(self._dismiss(worker)))
        if kind == _SAID:
            self._on_report(value)
        if kind == _RAISED:
            raise value
        if kind == _NO_MEMORY:
            self._dismiss(worker)
            return self._lost(worker, "ran out of memory")
        if kind == _DONE:
            self._any_done = True
            self._busy.remove(worker)
            self._idle.append(worker)
            return Ended(worker.number or 0, value=value), None
        return None, None

    def _given_up(self, worker: _Worker) -> tuple[Ended[Any] | None, str | None]:
        self._dismiss(worker)
        return self._lost(worker, f"was not ready after {LONGEST_START:g} s")

    def _lost(self, worker: _Worker, fate: str) -> tuple[Ended[Any] | None, str | None]:
        number = worker.number or 0
        self._deaths += 1
        if self._deaths == self._hopeless and not self._any_done:
            raise MachineFault(
                f"{self._deaths} workers were lost and no task was done, the last one {fate}; end "
                "other programs or raise the limits (ulimit)"
            )
        if worker.alone:
            return Ended(number, lost=fate), None
        self._alone.append(number)
        self._width = max(1, self._width - 1)
        self._may_help = False
        self._end_helpers()
        while self._idle:  # what they hold on to may be what was missing
            self._idle.pop().end()
        return None, fate

    def _loss(self, fate: str, task: str) -> str:
        left = f"{self._width} worker{'s' if self._width > 1 else ''}"
        return f"a worker {fate} at {task}, which is tried once more at the end; {left} from now on"

    def _over_limit(self) -> list[tuple[_Worker, str]]:
        now, most = self._clock(), 1e6 * self._limit.megabytes
        every = self._busy + self._helping
        at_work = [(w, w.since) for w in every if w.since is not None]
        clocks = [w for w, since in at_work if now - since > self._limit.seconds]
        others = [w for w, _ in at_work if w not in clocks]
        held = resident_bytes([w.pid for w in others]) if math.isfinite(most) else {}
        heavy = [w for w in others if held.get(w.pid, 0) > most]
        return [(w, "seconds") for w in clocks] + [(w, "megabytes") for w in heavy]

    def _dismiss(self, worker: _Worker) -> int:
        if worker.helps:
            self._helpless.add(cast("int", worker.number))
        (self._helping if worker.helps else self._busy).remove(worker)
        return worker.end()


def _fate(status: int) -> str:
    """What an exit status tells of a worker that we did not end."""
    if status == -signal.SIGKILL:
        return "was killed (as systems do where memory runs out)"
    if status < 0:
        return f"was ended by {signal.Signals(-status).name}"
    return f"ended by itself with status {status}"


def resident_bytes(pids: Sequence[int]) -> dict[int, int]:
    """Return the memory that processes hold, by their id; without those that are gone."""
    if Path("/proc/self/statm").exists():
        return dict(filter(None, map(_resident_on_linux, pids)))
    command = ["ps", "-o", "pid=,rss=", "-p", ",".join(map(str, pids))]
    listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    numbers = list(map(int, listed))
    return {pid: 1024 * held for pid, held in zip(numbers[::2], numbers[1::2], strict=True)}


def _resident_on_linux(pid: int) -> tuple[int, int] | None:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return None
    return pid, pages * os.sysconf("SC_PAGE_SIZE")
