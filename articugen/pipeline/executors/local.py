"""The processes of this machine."""

import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from articugen.core import processes
from articugen.core.compiling import compile_kernels
from articugen.pipeline.executors.work import Executor, Notice, Work
from articugen.pipeline.job import Job
from articugen.pipeline.making import (
    Task,
    help_make,
    import_stages,
    instances_each,
    limit_of,
    name_of,
)
from articugen.store.outcome import Outcome

_FEWEST_SHARED = 8
"""Instances of an object that others may help with: fewer are made before they are ready."""


@dataclass(frozen=True)
class Local(Executor):
    """So many worker processes; with 0, this one."""

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
    ) -> Generator[processes.Ended[Outcome | None], None, None]:
        with ExitStack() as stack:
            if work.claim is not None:
                temporary = tempfile.TemporaryDirectory(prefix="articugen-")
                work = work.at(Path(stack.enter_context(temporary)))
            common = stack.enter_context(self._common_folder(work.job))
            each = processes.each(
                partial(Work.done, work, common=common),
                tasks,
                workers=self.jobs,
                limit=limit_of(work.job.recipe),
                ready=import_stages,
                help=common and partial(help_make, work.job, common),
                handles=work.handles,
                notice=notice,
                name=name_of,
            )
            yield from stack.enter_context(closing(each))

    @contextmanager
    def _common_folder(self, job: Job) -> Iterator[Path | None]:
        """Where workers that have no object left help others with theirs; None if they do not."""
        with ExitStack() as stack:
            folder = None
            if self.jobs >= 2 and instances_each(job.recipe) >= _FEWEST_SHARED:
                with suppress(OSError):  # no room, no right: everyone works alone
                    temporary = tempfile.TemporaryDirectory(
                        prefix="articugen-", ignore_cleanup_errors=True
                    )
                    folder = Path(stack.enter_context(temporary))
            yield folder
