"""Tasks on a Dask cluster: many machines instead of this one's processes (alone in knowing Dask).

As `processes.each`, with the cluster's workers in place of our own. Each thread of theirs keeps a
process of ours, which is watched as it would be here: a task that exceeds its limit, or takes its
process along, costs nobody else's. What is sent back is small; data go to a folder that all
machines see.
"""

import math
import pickle
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from articugen.core.errors import ArticugenError, MachineFault, MissingExtra
from articugen.core.ledger import LEDGER
from articugen.core.processes import Crew, Ended, Limit
from articugen.pipeline.executors.work import Notice, Work
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task, import_stages, limit_of, name_of
from articugen.store.manifest import Outcome, code_version

T = TypeVar("T")
R = TypeVar("R")

CONNECT_SECONDS = 20.0
WIDTH_SECONDS = 2.0
"""Between two looks at how many workers there are."""
RETRIES = 2
"""Of a task that says its machine is at fault: others may do better."""

_IN_FLIGHT = 4
"""Tasks that the scheduler has been told of, a thread: it need not remember a million."""


@dataclass(frozen=True)
class Dask:
    """The workers of a cluster, by its scheduler's address, tcp://host:8786."""

    address: str
    is_here = False
    records = False

    def get_ready(self, job: Job, notice: Notice) -> None:
        """
        Raises:
            MissingExtra, MachineFault: as `each`.
        """
        threads(self.address)

    def width(self, tasks: int) -> int:
        return threads(self.address)

    def ends(
        self, work: Work, tasks: Sequence[Task], notice: Notice
    ) -> Generator[Ended[Outcome | None], None, None]:
        folder = work.job.folder.resolve()
        duty = Duty(
            partial(Work.done, replace(work, job=replace(work.job, out=folder), handles=())),
            limit_of(work.job.recipe),
            import_stages,
            name_of,
            code_version(),
            folder / LEDGER,
        )
        return each(duty, tasks, address=self.address, notice=notice)


@dataclass(frozen=True)
class Duty:
    """What workers of the cluster are to do with every task.

    Attributes:
        function, limit, ready, name: as of `processes.each`.
        code: whoever has other code must not take part.
        sees: a file that must be there: it tells whether the folder is a common one.
        patience: seconds after which a network's file system shows a new file everywhere.
    """

    function: Callable[[Any], Any]
    limit: Limit
    ready: Callable[[], None]
    name: Callable[[Any], str]
    code: str
    sees: Path
    patience: float = 10.0


def each(
    duty: Duty, tasks: Sequence[T], *, address: str, notice: Callable[[str], None]
) -> Generator[Ended[Any], None, None]:
    """The function of each task, as they end; raises what it raises. Closing this ends all tasks.

    Args:
        duty: what to do.
        tasks: picklable.
        address: of the scheduler, tcp://host:8786.
        notice: called with one sentence where nobody is there to work.

    Raises:
        MissingExtra: distributed is not installed.
        MachineFault: no scheduler answers, or it has gone.
        ArticugenError: a worker has other code, or does not see the folder.
    """
    with _client(address) as client:
        if not _threads(client):
            notice(f"{address} has no workers yet; start some with: dask worker {address}")
        of = f"make-{uuid4().hex[:8]}"
        numbers, running = iter(range(len(tasks))), dict[Any, int]()
        queue = _distributed().as_completed(loop=client.loop)

        width = _Width(client)

        def hand_out() -> None:
            while len(running) < _IN_FLIGHT * max(width.now(), _IN_FLIGHT):
                number = next(numbers, None)
                if number is None:
                    return
                future = client.submit(
                    _do, duty, tasks[number], key=(of, number), pure=False, retries=RETRIES
                )
                running[future] = number
                queue.add(future)

        try:
            hand_out()
            for future in queue:
                number = running.pop(future)
                yield _ended(future, number, address)
                hand_out()
        finally:
            with suppress(Exception):  # the scheduler may be gone, and with it the tasks
                client.cancel(list(running), force=True)


class _Width:
    """How many tasks the cluster does at once: workers come and go, but asking takes time."""

    def __init__(self, client: Any) -> None:
        self._client, self._found, self._asked = client, 0, -math.inf

    def now(self) -> int:
        if time.monotonic() - self._asked > WIDTH_SECONDS:
            self._found, self._asked = _threads(self._client), time.monotonic()
        return self._found


def threads(address: str) -> int:
    """Return how many tasks the cluster does at once.

    Raises:
        MissingExtra, MachineFault: as `each`.
    """
    with _client(address) as client:
        return _threads(client)


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


def _do(duty: Duty, task: Any) -> Ended[Any]:
    """Return one task in this thread's own process."""
    crew = _crew(duty)
    try:
        (ended,) = crew.each([task])
    except BaseException:
        _dismiss()
        raise
    return ended


def _crew(duty: Duty) -> Crew[Any, Any]:
    """Return the process that this thread keeps for a duty, which is looked at once."""
    what = pickle.dumps(duty)
    if getattr(_mine, "duty", None) != what:
        _dismiss()
        _check(duty)
        _mine.crew = Crew(
            duty.function, workers=1, limit=duty.limit, ready=duty.ready, name=duty.name
        )
        _mine.duty = what
    return _mine.crew


def _dismiss() -> None:
    crew, _mine.crew, _mine.duty = getattr(_mine, "crew", None), None, None
    if crew is not None:
        crew.__exit__()


def _check(duty: Duty) -> None:
    """
    Raises:
        ArticugenError: this worker would make other data, or put them elsewhere.
    """
    here = socket.gethostname()
    if code_version() != duty.code:
        raise ArticugenError(
            f"the worker on {here} has articugen {code_version()}, this is {duty.code}; install "
            "the same there"
        )
    patience = time.monotonic() + duty.patience
    while not duty.sees.exists():
        if time.monotonic() > patience:
            raise ArticugenError(
                f"the worker on {here} does not see {duty.sees.parent}; --out must be on a file "
                "system that all machines have under the same path"
            )
        time.sleep(0.1)
