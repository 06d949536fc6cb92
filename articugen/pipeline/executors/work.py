"""What an executor does: a piece of work for each of many tasks."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from articugen.core.ledger import Ledger
from articugen.core.processes import Ended
from articugen.pipeline.common import key_of, record_in, recorded
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task, make_object
from articugen.store.bucket import Bucket
from articugen.store.manifest import Outcome
from articugen.store.writer import Check

Notice = Callable[[str], None]


@dataclass(frozen=True)
class Work:
    """What is to be done with each task of a run; it can be sent to other processes.

    Attributes:
        job: what the tasks are of.
        objects: of the whole data set.
        check: looks at each shard before it gets its name.
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

    def done(self, task: Task, common: Path | None = None) -> Outcome | None:
        """Make one object; None where another process is at it. As `make_object`.

        Args:
            common: a folder where other workers help.
        """
        if self.claim is None:
            return make_object(self.job, self.job.folder, task, self.check, common)
        bucket, aside = self.job.place, self.aside
        assert isinstance(bucket, Bucket)
        assert aside is not None
        ledger = Ledger(bucket, who=self.claim[0], lease=self.claim[1])
        name = key_of((task.key.split, task.key.object_id))
        if not ledger.claim(name):
            return None
        try:
            outcome = recorded(ledger, bucket, task.key)  # another was at it until now
            if outcome is None:
                outcome = task.known or make_object(self.job, aside, task, self.check, common)
                if outcome.shard:
                    bucket.write(task.shard, aside / task.shard)
                record_in(ledger, outcome)
        finally:
            (aside / task.shard).unlink(missing_ok=True)
            ledger.free(name)
        return outcome

    def at(self, aside: Path) -> "Work":
        """Return the same, with shards that are not in the store yet in this folder."""
        return replace(self, aside=aside)


class Executor(Protocol):
    """Who makes objects: it yields how each task ended, as they do.

    Attributes:
        is_here: whether its workers end with this process.
        records: whether what it yields is in the ledger already.
    """

    is_here: bool
    records: bool

    def get_ready(self, job: Job, notice: Notice) -> None:
        """Do what is not the data's time: compile kernels, find a cluster."""
        ...

    def width(self, tasks: int) -> int:
        """Return how many of so many tasks are worked on at the same time."""
        ...

    def ends(
        self, work: Work, tasks: Sequence[Task], notice: Notice
    ) -> Generator[Ended[Outcome | None], None, None]:
        """How each task ends; closing this ends all of them. A value of None stands for an object
        that another process is at."""
        ...
