"""A data set by an array of SLURM jobs, from one command (alone in knowing submitit).

The array's tasks are runs of a share each, and know nothing of the process that submits them. That
one follows the ledger, submits again what was lost, and writes the manifest at the end. Where it is
killed they go on, and the same command follows them.
"""

import hashlib
import io
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, redirect_stderr
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from articugen.core.compiling import compile_kernels
from articugen.core.errors import (
    ArticugenError,
    InvalidArgument,
    MachineFault,
    MissingExtra,
    printable,
)
from articugen.core.ledger import Ledger
from articugen.core.place import Folder
from articugen.core.processes import Ended
from articugen.pipeline.executors.local import Local
from articugen.pipeline.executors.work import Executor, Notice, Work
from articugen.pipeline.job import Job, Share
from articugen.pipeline.making import Task
from articugen.pipeline.run import started
from articugen.store.outcome import Outcome

POLL_SECONDS = 5.0
IN_VAIN = 3
"""Arrays one after the other in which nothing is made, before the run ends."""

_REQUEUES = 100
"""Of one task at its limit of time."""
_NOTICE_SECONDS = 30
"""Before the limit of time a task gets a signal, and queues again; SLURM may be a minute early."""
_LEAST_MINUTES = 5
_LOGS = ".articugen-slurm"

_LIKE = "give slurm, or slurm://partition?tasks=100&cpus=4&time=60, and other options of sbatch"


@dataclass(frozen=True)
class Array:
    """Array of SLURM jobs.

    Attributes:
        partition: "" for the default one.
        tasks: the most at a time.
        cpus: cores of each.
        time: minutes after which a task is queued again.
        others: further options of sbatch: account, qos, mem.
    """

    partition: str = ""
    tasks: int = 100
    cpus: int = 4
    time: int = 60
    others: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def of_address(address: str) -> "Array":
        """Return what an address asks for; InvalidArgument if it is not like
        slurm://partition?tasks=100&cpus=4&time=60."""
        parts = urlsplit(address if "://" in address else f"{address}://")
        try:
            values = dict(parse_qsl(parts.query, True, bool(parts.query)))  # 3.10 refuses none
            numbers = {n: int(values.pop(n)) for n in ("tasks", "cpus", "time") if n in values}
        except ValueError:
            numbers, values = {"tasks": 0}, {}
        array = Array(parts.netloc, **numbers, others=values)
        if parts.path or min(array.tasks, array.cpus) < 1 or array.time < _LEAST_MINUTES:
            raise InvalidArgument(
                f"{address}: {_LIKE}; time is in minutes, {_LEAST_MINUTES} or more"
            )
        return array


@dataclass(frozen=True)
class Slurm(Executor):
    """An array of SLURM for a data set in a folder that all of its nodes see.

    Attributes:
        command: that makes the data set, as people write it.
        ledger: in which the array's tasks record what they have made.
    """

    array: Array
    command: str
    ledger: Ledger
    records = True

    @classmethod
    def of(cls, job: Job, command: str) -> "Slurm":
        array, ledger = Array.of_address(job.scheduler), Ledger(Folder(job.folder.resolve()))
        ledger.mark()  # before the run plans: what is recorded from now on, it may not know
        return cls(array, command, ledger)

    def get_ready(self, job: Job, notice: Notice) -> None:
        """Raise MissingExtra without submitit, ArticugenError where SLURM is not here."""
        _submitit()
        if not all(map(shutil.which, ("sbatch", "squeue", "srun"))):
            raise ArticugenError(
                "there is no sbatch here; run this where jobs of SLURM are submitted, or give each "
                "machine a --shard"
            )
        compile_kernels("generate", jobs=job.jobs, notice=notice)

    def width(self, tasks: int) -> int:
        return self.array.cpus * min(self.array.tasks, tasks)

    def ends(
        self, work: Work, tasks: Sequence[Task], notice: Notice
    ) -> Generator[Ended[Outcome | None], None, None]:
        """Have objects made until all are recorded.

        Raises:
            ArticugenError: SLURM refuses the array; no object can be made.
            MachineFault: what was submitted again and again made nothing.
            KeyboardInterrupt: the array is cancelled; finished objects are kept.
        """
        job = replace(work.job, out=work.job.folder.resolve(), scheduler="", jobs=self.array.cpus)
        missing = {task.key.name: n for n, task in enumerate(tasks)}
        in_vain = 0
        with _Queue(job, self.array, notice) as queue:
            while missing:
                before, submitted = len(missing), list[Any]()
                if not queue.listed():
                    of = min(self.array.tasks, work.objects)
                    numbers = sorted({tasks[number].place % of for number in missing.values()})
                    shares = [replace(job, share=Share(number, of)) for number in numbers]
                    submitted = list(queue.submit([_Rank(one, self.command) for one in shares]))
                is_over = False
                while not is_over:  # until SLURM lists none of them, and then once more
                    is_over = not queue.listed()
                    for outcome in map(Outcome.model_validate_json, self.ledger.news().values()):
                        number = missing.pop(outcome.key.name, None)
                        if number is not None:
                            yield Ended(number, outcome)
                    time.sleep(0.0 if is_over else POLL_SECONDS)
                sentence = _sentence_of(submitted)
                in_vain = 0 if len(missing) < before else in_vain + 1
                if in_vain == IN_VAIN:
                    raise MachineFault(
                        f"{job.out}: {in_vain} arrays, one after the other, have ended and "
                        f"made nothing{sentence}; {len(missing)} of {work.objects} objects are "
                        f"missing, logs are in {job.folder / _LOGS}"
                    )
        shutil.rmtree(job.folder / _LOGS, ignore_errors=True)


@dataclass(frozen=True)
class _Rank:
    """Task of the array. At its limit of time submitit queues it again."""

    job: Job
    command: str

    def __call__(self) -> ArticugenError | None:
        """Return what ended it, where that was a sentence of ours."""
        try:
            with started(self.job, command=self.command) as run:
                run.finish(Local(self.job.jobs), on_notice=_log)
        except ArticugenError as error:
            _log(f"error: {error}")
            kind = MachineFault if isinstance(error, MachineFault) else ArticugenError
            return kind(str(error))
        return None

    def checkpoint(self) -> Any:
        return _submitit().helpers.DelayedSubmission(self)


def _log(sentence: str) -> None:
    sys.stderr.write(f"{printable(sentence)}\n")


class _Queue(AbstractContextManager["_Queue"]):
    """The data set's jobs in SLURM's queue: they are known by their name."""

    def __init__(self, job: Job, array: Array, notice: Callable[[str], None]) -> None:
        submitit = _submitit()
        self._name = f"articugen-{hashlib.sha256(bytes(job.folder)).hexdigest()[:12]}"
        self._notice, self._heard, self._ids = notice, True, set[str]()
        self._executor = submitit.SlurmExecutor(job.folder / _LOGS, max_num_timeout=_REQUEUES)
        self._executor.update_parameters(
            job_name=self._name,
            partition=array.partition or None,
            cpus_per_task=array.cpus,
            time=array.time,
            array_parallelism=array.tasks,
            signal_delay_s=_NOTICE_SECONDS,
            srun_args=[f"--cpus-per-task={array.cpus}"],  # which it does not take from sbatch
            additional_parameters={"requeue": True, **array.others},
        )

    def submit(self, tasks: Sequence[_Rank]) -> Sequence[Any]:
        """Queue an array; submitit's jobs, or ArticugenError where SLURM refuses it."""
        submitit = _submitit()
        try:
            with redirect_stderr(io.StringIO()):
                jobs = self._executor.submit_array(tasks)
        except submitit.core.utils.FailedJobError as error:
            why = str(error).strip().split("\n")[-1]
            raise ArticugenError(f"sbatch refuses the array ({why}); {_LIKE}") from None
        number = jobs[0].job_id.partition("_")[0]
        self._ids = {number}
        many = f"{len(jobs)} task" + ("" if len(jobs) == 1 else "s")
        self._notice(f"SLURM has job {number}, an array of {many}")
        return jobs

    def listed(self) -> bool:
        """Return whether any is waiting or at work; also where SLURM does not answer."""
        command = ["squeue", "--me", "--noheader", f"--name={self._name}", "--format=%F"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            self._heard, self._ids = True, set(done.stdout.split())
            return bool(self._ids)
        if self._heard:
            self._notice(f"SLURM does not answer, which is waited for ({done.stderr.strip()})")
        self._heard = False
        return True

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Take all of them out of the queue, where the run is broken off."""
        if kind is not None and self._ids:
            subprocess.run(["scancel", *sorted(self._ids)], capture_output=True, check=False)


def _sentence_of(tasks: Iterable[Any]) -> str:
    """Return what ended a task of an array that is over, where a machine was at fault and it could
    say so; ArticugenError where no object can be made."""
    sentence = ""
    for task in tasks:
        error = task.result() if task.paths.result_pickle.exists() else None
        if error is not None and not isinstance(error, MachineFault):
            raise error
        sentence = f" ({error})" if error else sentence
    return sentence


def _submitit() -> Any:
    """Return the module; MissingExtra where it is not installed."""
    try:
        import submitit  # noqa: PLC0415 - optional
        import submitit.helpers  # noqa: PLC0415
    except ImportError:
        raise MissingExtra("submitit", "cluster") from None
    return submitit
