"""The processes of this machine."""

import tempfile
from collections.abc import Generator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from articugen.core.compiling import compile_kernels
from articugen.core.processes import Ended
from articugen.pipeline.executors.work import Executor, Notice, Work
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task
from articugen.store.outcome import Outcome


@dataclass(frozen=True)
class Local(Executor):
    """Worker processes; with 0, this one."""

    jobs: int
    is_here = True

    @classmethod
    def of(cls, job: Job, command: str) -> "Local":
        return cls(job.jobs)

    def get_ready(self, job: Job, notice: Notice) -> None:
        compile_kernels("generate", jobs=self.jobs, notice=notice)

    def width(self, tasks: int) -> int:
        return self.jobs

    def ends(
        self, work: Work, tasks: Sequence[Task], notice: Notice
    ) -> Generator[Ended[Outcome | None], None, None]:
        with ExitStack() as stack:
            if work.claim is not None:
                aside = stack.enter_context(tempfile.TemporaryDirectory(prefix="articugen-"))
                work = replace(work, aside=Path(aside))
            crew = stack.enter_context(work.crew(min(self.jobs, len(tasks)), notice))
            yield from crew.each(tasks)
