"""Tasks on a Dask cluster: many machines instead of this one's processes (alone in knowing Dask).

As `processes.each`, with the cluster's workers in place of our own. Each thread of theirs keeps a
process of ours, which is watched as it would be here: a task that exceeds its limit, or takes its
process along, costs nobody else's. What is sent back is small; data go to a folder that all
machines see.
"""

import pickle
import threading
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any
from uuid import uuid4

from articugen.core.errors import MachineFault, MissingExtra
from articugen.core.processes import Ended
from articugen.pipeline.executors.work import Elsewhere, Executor, Notice, Work
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task
from articugen.store.outcome import Outcome

CONNECT_SECONDS = 20.0
WIDTH_SECONDS = 2.0
"""Seconds between two counts of the workers."""
RETRIES = 2
"""Of a task that says its machine is at fault: others may do better."""

_IN_FLIGHT = 4
"""Tasks that the scheduler knows of, a thread: it need not remember a million."""


@dataclass(frozen=True)
class Dask(Executor):
    """The workers of a cluster, by its scheduler's address, tcp://host:8786."""

    address: str

    @classmethod
    def of(cls, job: Job, command: str) -> "Dask":
        return cls(job.scheduler)

    def get_ready(self, job: Job, notice: Notice) -> None:
        """Raise MissingExtra without distributed, MachineFault where no scheduler answers."""
        self.width(0)

    def width(self, tasks: int) -> int:
        with _client(self.address) as client:
            return _threads(client)

    def ends(
        self, work: Work, tasks: Sequence[Task], notice: Notice
    ) -> Generator[Ended[Outcome | None], None, None]:
        """Raise MissingExtra without distributed, MachineFault where no scheduler answers or it has
        gone, ArticugenError where a worker has other code or does not see the folder."""
        elsewhere = Elsewhere.of(work)
        with _client(self.address) as client:
            if not _threads(client):
                start = f"start some with: dask worker {self.address}"
                notice(f"{self.address} has no workers yet; {start}")
            of = f"make-{uuid4().hex[:8]}"
            numbers, running = iter(range(len(tasks))), dict[Any, int]()
            queue = _distributed().as_completed(loop=client.loop)

            # of the present while: workers come and go, but asking takes time
            width = lru_cache(1)(lambda _: max(_threads(client), _IN_FLIGHT))

            def hand_out() -> None:
                while len(running) < _IN_FLIGHT * width(time.monotonic() // WIDTH_SECONDS):
                    number = next(numbers, None)
                    if number is None:
                        return
                    future = client.submit(
                        _do, elsewhere, tasks[number], key=(of, number), pure=False, retries=RETRIES
                    )
                    running[future] = number
                    queue.add(future)

            try:
                hand_out()
                for future in queue:
                    number = running.pop(future)
                    yield _ended(future, number, self.address)
                    hand_out()
            finally:
                with suppress(Exception):  # the scheduler may be gone, and with it the tasks
                    client.cancel(list(running), force=True)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        client = _distributed().Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise MachineFault(
            f"{address}: no scheduler answers ({error}); start one with: dask scheduler"
        ) from None
    with client:
        yield client


def _distributed() -> Any:
    try:
        import distributed  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtra("distributed", "cluster") from None
    return distributed


def _threads(client: Any) -> int:
    return sum(client.nthreads().values())


def _ended(future: Any, number: int, address: str) -> Ended[Any]:
    """Return how a task has ended."""
    distributed = _distributed()
    try:
        return replace(future.result(), number=number)
    except distributed.KilledWorker as error:
        times = getattr(error, "allowed_failures", 0) + 1
        return Ended(number, lost=f"was lost with its machine {times} times over")
    except (distributed.client.FutureCancelledError, OSError) as error:
        raise MachineFault(f"{address}: the scheduler has gone ({error}); start it again") from None


# --- in a worker of the cluster


_mine = threading.local()


def _do(work: Elsewhere, task: Task) -> Ended[Outcome | None]:
    """Do one task in this thread's own process, which it keeps for the next one."""
    try:
        if getattr(_mine, "work", None) != (what := pickle.dumps(work)):
            _dismiss()
            _mine.crew, _mine.work = work.worker(), what
        (ended,) = _mine.crew.each([task])
    except BaseException:
        _dismiss()
        raise
    return ended


def _dismiss() -> None:
    crew, _mine.crew, _mine.work = getattr(_mine, "crew", None), None, None
    if crew is not None:
        crew.__exit__()
