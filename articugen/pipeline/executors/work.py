"""What an executor does: a piece of work for each of many tasks."""

import socket
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from articugen.core.errors import ArticugenError
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.processes import Crew, Ended
from articugen.pipeline.common import key_of, record_in, recorded
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task, import_stages, limit_of, make_object
from articugen.store.bucket import Bucket
from articugen.store.outcome import Outcome
from articugen.store.provenance import code_version
from articugen.store.writer import Check

Notice = Callable[[str], None]


@dataclass(frozen=True)
class Work:
    """Work to be done for each task of a run; it can be sent to other processes.

    Attributes:
        job: what the tasks are of.
        objects: of the whole data set.
        check: examines each shard before it gets its name.
        handles: open files that keep other runs out as long as anybody holds them.
        claim: the run's name and the seconds that its claims hold, where objects are claimed: in a
            store.
        aside: a folder of this machine for shards that are not in the store yet.
    """

    job: Job
    objects: int
    check: Check | None = None
    handles: tuple[int, ...] = ()
    claim: tuple[str, float] | None = None
    aside: Path | None = None

    def done(self, task: Task) -> Outcome | None:
        """Make one object; None where another process is at it. As `make_object`."""
        if self.claim is None:
            return make_object(self.job, self.job.folder, task, self.check)
        bucket, aside = self.job.place, self.aside
        assert isinstance(bucket, Bucket)
        assert aside is not None
        ledger = Ledger(bucket, who=self.claim[0], lease=self.claim[1])
        name = key_of(task.key.name)
        if not ledger.claim(name):
            return None
        try:
            outcome = recorded(ledger, task.key)  # another was at it until now
            if outcome is None:
                outcome = task.known or make_object(self.job, aside, task, self.check)
                if outcome.shard:
                    bucket.write(task.shard, aside / task.shard)
                record_in(ledger, outcome)
        finally:
            (aside / task.shard).unlink(missing_ok=True)
            ledger.free(name)
        return outcome

    def crew(self, workers: int, notice: Notice = lambda _: None) -> Crew[Task, Outcome | None]:
        """Return processes of this machine that do it, watched by the recipe's limits."""
        return Crew(
            self.done,
            workers=workers,
            limit=limit_of(self.job.recipe),
            ready=import_stages,
            handles=self.handles,
            notice=notice,
            name=lambda task: task.key.object_id,
        )


@dataclass(frozen=True)
class Elsewhere:
    """Work as it is sent to other machines, which see the data set's folder under the same path.

    Attributes:
        work: without this process's files; a relative source needs the same working folder there.
        code: the version of articugen here.
        patience: seconds after which a network's file system shows a new file everywhere.
    """

    work: Work
    code: str
    patience: float = 10.0

    @staticmethod
    def of(work: Work) -> "Elsewhere":
        job = replace(work.job, out=work.job.folder.resolve(), scheduler="")
        return Elsewhere(replace(work, job=job, handles=()), code_version())

    def worker(self) -> Crew[Task, Outcome | None]:
        """Return a process on this machine that does tasks, by `worker.each([task])`.

        It is watched as it would be in a run here: a task that exceeds the recipe's limits, or
        takes its process along, costs no other. Leaving it as a context ends it.

        Raises:
            ArticugenError: this machine would make other data, or put them elsewhere.
        """
        here, folder = socket.gethostname(), self.work.job.folder
        if code_version() != self.code:
            raise ArticugenError(
                f"the worker on {here} has articugen {code_version()}, this is {self.code}; "
                "install the same there"
            )
        end = time.monotonic() + self.patience
        while not (folder / LEDGER).exists():
            if time.monotonic() > end:
                raise ArticugenError(
                    f"the worker on {here} does not see {folder}; --out must be on a file system "
                    "that all machines have under the same path"
                )
            time.sleep(0.1)
        return self.work.crew(1)


class Executor(Protocol):
    """Executor of tasks: it says where objects are made. Inherit from this: what has a body need
    not be given.

    Attributes:
        is_here: whether its workers end with this process. If so, an interrupted run tidies up.
        records: whether its workers are runs of a share of their own (`generate --shard`): what
            `ends` yields is in the ledger already, and the folder is open to other processes.
    """

    is_here: bool = False
    records: bool = False

    @classmethod
    def of(cls, job: Job, command: str) -> "Executor":
        """Return the executor that `job.scheduler` names, whose address may make no sense:
        InvalidArgument. `command` makes the whole data set, as people write it."""
        ...

    def get_ready(self, job: Job, notice: Notice) -> None:
        """Do what is not the data's time: compile kernels, find a cluster.

        Raises:
            ArticugenError: it cannot work.
        """

    def width(self, tasks: int) -> int:
        """Return how many of `tasks` tasks are worked on at the same time."""
        ...

    def ends(
        self, work: Work, tasks: Sequence[Task], notice: Notice
    ) -> Generator[Ended[Outcome | None], None, None]:
        """Yield how each task ends, in any order; closing the generator ends all of them.

        An `Ended` has the task's index in `tasks`. A value of None stands for an object that
        another process is at. A worker that died is given its task again, as often as makes sense,
        and then yielded as `lost`. The folder's ledger is there already.

        Args:
            notice: called with one sentence where a worker was lost, and the like.

        Raises:
            MachineFault: nobody can go on; what was yielded is kept.
        """
        ...
