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
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import KW_ONLY, dataclass
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any, Generic, TypeVar, cast

from articugen.core.errors import ArticugenError, InvalidArgument, MachineFault
from articugen.core.memory import resident_bytes

T = TypeVar("T")
R = TypeVar("R")

TICK = 0.2  # seconds between two checks of the workers' clocks and memory
LONGEST_LOOK = 5.0  # seconds that count between two checks: after Ctrl-Z workers stood still too
LONGEST_START = 600.0  # seconds to get ready in: short of memory, OpenBLAS asks again for ever

_READY, _SAID, _DONE, _RAISED = "ready", "said", "done", "raised"
_NO_MEMORY, _GONE = "ran out of memory", "gone"
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
    function: Callable[[T], R], tasks: Sequence[T], *, workers: int, **options: Any
) -> Generator[Ended[R], None, None]:
    """Do as `Crew.each`, by a crew of its own with these `options`: closing this ends all tasks."""
    with Crew(function, workers=min(workers, len(tasks)), **options) as crew:
        yield from crew.each(tasks)


def in_order(
    function: Callable[[T], R], tasks: Sequence[T], *, workers: int, **options: Any
) -> Generator[R, None, None]:
    """Do as `Crew.in_order`, likewise."""
    with Crew(function, workers=min(workers, len(tasks)), **options) as crew:
        yield from crew.in_order(tasks)


def report(message: object) -> None:
    """Hand a picklable message to the `on_report` of the crew whose task is calling this."""
    _report(message)


_report: Callable[[object], None] = _nothing
"""What `report` does in this process: set in every worker, and here while a task is done here."""


def default_jobs() -> int:
    """Return the cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def die_with(parent: int) -> None:
    """End this process as soon as the process `parent`, its parent, has ended; within a second.

    Linux does it at once, whatever this process is doing. Elsewhere a thread looks, which our
    kernels let run. The signal follows the parent's *thread* that started this process.
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def serve(handle: int, parent: int) -> None:
    """Do, in a worker, the tasks that come through the pipe, until nobody is at its end."""
    global _report  # noqa: PLW0603
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then ends us
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPPING)
    die_with(parent)
    with Connection(handle) as pipe:
        _report = lambda message: pipe.send((_SAID, message))  # noqa: E731
        try:
            function, ready = pipe.recv()
            kind, value = _answer(lambda _: ready(), None)
            pipe.send((_READY if kind is _DONE else kind, value))
            while True:
                pipe.send(_answer(function, pipe.recv()))
        except (EOFError, OSError, MemoryError):
            os._exit(1)  # nobody is there to be answered


def _answer(function: Callable[[Any], Any], task: Any) -> tuple[str, Any]:
    try:
        return _DONE, function(task)
    except MemoryError:
        return _NO_MEMORY, None
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # some cannot be made again from what they say
            kind = ArticugenError if isinstance(error, ArticugenError) else RuntimeError
            return _RAISED, kind(str(error))
        return _RAISED, error


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
        does: tuple[Callable[[Any], Any], Callable[[], None]],
        handles: Sequence[int],
        clock: _Clock,
    ) -> None:
        self.number = -1
        self.alone = False
        self.since: float | None = None  # when its clock started; None while it gets ready
        self._clock, self._hired = clock, clock()
        self._ready = False
        ours, theirs = Pipe()
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from articugen.core.processes import serve; "
            f"serve({theirs.fileno()}, {os.getpid()})"
        )
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPING)  # they wait, there too
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    stdin=subprocess.DEVNULL,
                    pass_fds=(theirs.fileno(), *handles),
                )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self.pipe = ours
        self.pid = self._process.pid
        self._send(does)

    @property
    def is_stuck(self) -> bool:
        return not self._ready and self._clock() - self._hired > LONGEST_START

    def begin(self, number: int, task: object, *, alone: bool) -> None:
        self.number, self.alone = number, alone
        self.since = self._clock() if self._ready else None
        self._send(task)

    def hear(self) -> tuple[str, Any]:
        """Return the kind of what it says, and the value."""
        try:
            kind, value = self.pipe.recv()
        except (OSError, EOFError):
            return _GONE, None
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


@dataclass(eq=False)
class Crew(AbstractContextManager["Crew[T, R]"], Generic[T, R]):
    """Workers for one function; as a context, at whose end all of them are dismissed.

    Attributes:
        function: picklable, by its name in a module; its tasks and results are picklable, too.
        workers: processes at most; 0 does all of it in this process, without any limit.
        limit: what one task may take.
        ready: called once in each worker before its first task, off the clock.
        handles: open files that every worker holds open as long as it lives, locks for instance.
        on_report: called here with each message that a task gives to `report`, in their order.
        notice: called with one sentence where a worker was lost.
        name: what a task is called in it.
    """

    function: Callable[[T], R]
    _: KW_ONLY
    workers: int
    limit: Limit = Limit()
    ready: Callable[[], None] = _nothing
    handles: Sequence[int] = ()
    on_report: Callable[[Any], None] = _nothing
    notice: Callable[[str], None] = _nothing
    name: Callable[[T], str] = str

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise InvalidArgument(f"{self.workers} worker processes; give 0 or more")
        self._clock = _Clock()
        self._width = self.workers
        self._deaths = 0
        self._any_done = False
        self._at_work: list[_Worker] = []
        self._idle: list[_Worker] = []
        self._waiting: deque[int] = deque()
        self._alone: deque[int] = deque()

    def __exit__(self, *_: object) -> None:
        for worker in self._at_work + self._idle:
            worker.end()
        self._at_work, self._idle = [], []

    def each(self, tasks: Sequence[T]) -> Iterator[Ended[R]]:
        """Yield the function of each task, as they end; raises what it raises, or MachineFault."""
        if not self.workers:
            yield from map(self._do_here, range(len(tasks)), tasks)
            return
        self._waiting.extend(range(len(tasks)))
        while self._waiting or self._alone or self._at_work:
            self._hand_out(tasks)
            spoken = wait([worker.pipe for worker in self._at_work], TICK)
            for worker in [w for w in self._at_work if w.pipe in spoken or w.is_stuck]:
                kind, value = f"was not ready after {LONGEST_START:g} s", None
                if worker.pipe in spoken:
                    kind, value = worker.hear()
                if ended := self._heard(worker, kind, value, tasks):
                    yield ended
            for worker, over in self._over_limit():
                self._dismiss(worker)
                yield Ended(worker.number, over=over)

    def in_order(self, tasks: Sequence[T]) -> Iterator[R]:
        """Yield the same in the tasks' order; MachineFault too where one loses two workers."""
        early: dict[int, R] = {}
        following = 0
        for ended in self.each(tasks):
            if ended.lost:
                raise MachineFault(
                    f"{self.name(tasks[ended.number])}: its worker {ended.lost} when it was tried "
                    "alone as well; use fewer --jobs or end other programs"
                )
            early[ended.number] = cast("R", ended.value)
            while following in early:
                yield early.pop(following)
                following += 1

    def _do_here(self, number: int, task: T) -> Ended[R]:
        global _report  # noqa: PLW0603
        before, _report = _report, self.on_report
        try:
            return Ended(number, value=self.function(task))
        except MemoryError:
            return Ended(number, lost="ran out of memory")
        finally:
            _report = before

    def _hand_out(self, tasks: Sequence[T]) -> None:
        while self._waiting and len(self._at_work) < self._width:
            if not self._give(self._waiting, tasks, alone=False):
                self._width = len(self._at_work)
        if self._alone and not self._at_work:
            self._give(self._alone, tasks, alone=True)

    def _give(self, numbers: deque[int], tasks: Sequence[T], *, alone: bool) -> bool:
        """Hand the next task to a worker; whether there was one to be had."""
        try:
            does = (self.function, self.ready)
            worker = self._idle.pop() if self._idle else _Worker(does, self.handles, self._clock)
        except OSError as error:
            if self._at_work:
                return False
            raise MachineFault(
                f"no worker process can be started: {error.strerror or error}; end other programs, "
                "raise the limits (ulimit) or use fewer --jobs"
            ) from error
        number = numbers.popleft()
        worker.begin(number, tasks[number], alone=alone)
        self._at_work.append(worker)
        return True

    def _heard(self, worker: _Worker, kind: str, value: Any, tasks: Sequence[T]) -> Ended[R] | None:
        """Return how its task ended, if it did; say what became of it if its task gets a try."""
        if kind == _SAID:
            self.on_report(value)
        if kind in (_READY, _SAID):
            return None
        if kind == _RAISED:
            raise value
        if kind == _DONE:
            self._at_work.remove(worker)
            self._idle.append(worker)
            self._any_done = True
            return Ended(worker.number, value=value)
        status = self._dismiss(worker)
        fate = _fate(status) if kind == _GONE else kind
        self._deaths += 1
        if self._deaths == self.workers + 3 and not self._any_done:
            raise MachineFault(
                f"{self._deaths} workers were lost and no task was done, the last one {fate}; end "
                "other programs or raise the limits (ulimit)"
            )
        if worker.alone:
            return Ended(worker.number, lost=fate)
        self._alone.append(worker.number)
        self._width = max(1, self._width - 1)
        while self._idle:  # what they hold on to may be what was missing
            self._idle.pop().end()
        left = f"{self._width} worker{'s' if self._width > 1 else ''}"
        self.notice(
            f"a worker {fate} at {self.name(tasks[worker.number])}, which is tried once more at "
            f"the end; {left} from now on"
        )
        return None

    def _over_limit(self) -> list[tuple[_Worker, str]]:
        now, most = self._clock(), 1e6 * self.limit.megabytes
        waited = [w for w in self._at_work if not w.pipe.poll()]  # the others have ended in time
        at_work = [(w, w.since) for w in waited if w.since is not None]
        clocks = [w for w, since in at_work if now - since > self.limit.seconds]
        others = [w for w, _ in at_work if w not in clocks]
        resident = resident_bytes([w.pid for w in others]) if math.isfinite(most) else {}
        heavy = [w for w in others if resident.get(w.pid, 0) > most]
        return [(w, "seconds") for w in clocks] + [(w, "megabytes") for w in heavy]

    def _dismiss(self, worker: _Worker) -> int:
        self._at_work.remove(worker)
        return worker.end()


def _fate(status: int) -> str:
    """Return a sentence on a worker that we did not end, by its exit status."""
    if status == -signal.SIGKILL:
        return "was killed (as systems do where memory runs out)"
    if status < 0:
        return f"was ended by {signal.Signals(-status).name}"
    return f"ended by itself with status {status}"
