"""A data set by an array of SLURM jobs, from one command (alone in knowing submitit).

The array's tasks are ranks, see `ranks`, and know nothing of the process that submits them. That
one follows their journals, submits again what was lost, and merges at the end. Where it is killed
they go on, and the same command follows them.
"""

import hashlib
import io
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
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
from articugen.pipeline import ranks
from articugen.pipeline import run as pipeline
from articugen.pipeline.rank_journal import CommonPlan, Following, Name, Share
from articugen.pipeline.run import Job, ObjectReport, Plan, report_of, timings_of
from articugen.store.manifest import Manifest

POLL_SECONDS = 5.0
IN_VAIN = 3
"""Arrays one after the other in which nothing is made, before the run ends."""

_REQUEUES = 100
"""Of one task at its limit of time."""
_NOTICE_SECONDS = 30
"""Before the limit of time a task is told of it, and queues again; SLURM may be a minute early."""
_LEAST_MINUTES = 5
_LOGS = ".articugen-slurm"

_LIKE = "give slurm, or slurm://partition?tasks=100&cpus=4&time=60, and other options of sbatch"


@dataclass(frozen=True)
class Array:
    """What is asked of SLURM.

    Attributes:
        partition: "" for the default one.
        tasks: at most so many at a time.
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
        """
        Raises:
            InvalidArgument: it is not like slurm://partition?tasks=100&cpus=4&time=60.
        """
        parts = urlsplit(address if "://" in address else f"{address}://")
        try:
            said = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=True))
            numbers = {n: int(said.pop(n)) for n in ("tasks", "cpus", "time") if n in said}
        except ValueError:
            numbers, said = {"tasks": 0}, {}
        array = Array(parts.netloc, **numbers, others=said)
        if parts.path or min(array.tasks, array.cpus) < 1 or array.time < _LEAST_MINUTES:
            raise InvalidArgument(
                f"{address}: {_LIKE}; time is in minutes, {_LEAST_MINUTES} or more"
            )
        return array


def is_array(address: str) -> bool:
    """Whether a scheduler's address is SLURM's."""
    return address == "slurm" or address.startswith("slurm:")


@contextmanager
def started(job: Job, *, command: str = "") -> Iterator["ArrayRun"]:
    """A run that has a plan, and has submitted nothing yet.

    Args:
        job: the data set; its `scheduler` says what is asked of SLURM.
        command: that makes it, as people write it.

    Raises:
        InvalidArgument: the scheduler's address makes no sense.
        ArticugenError: a run that is no rank is at work in the folder, or ranks that make something
            else.
    """
    array = Array.of_address(job.scheduler)
    job = replace(pipeline.as_its_source_is(job), out=job.out.resolve(), scheduler="")
    following = Following(job.out)
    following.news()  # what the plan knows
    with ranks.started(job, Share(number=0, of=1), command=command) as rank:
        plan = rank.plan
    yield ArrayRun(job, array, plan, command, following)


@dataclass(frozen=True)
class ArrayRun:
    """A run with a plan; see `started`."""

    job: Job
    array: Array
    plan: Plan
    command: str
    following: Following

    def finish(
        self,
        on_object: Callable[[ObjectReport], None] = lambda _: None,
        on_notice: Callable[[str], None] = lambda _: None,
    ) -> Manifest:
        """Have what is missing made, as often as it takes, and write the manifest.

        Raises:
            MissingExtra: submitit is not installed.
            ArticugenError: the folder holds another data set; no object can be made; SLURM is not
                here, or refuses the array.
            MachineFault: what was submitted again and again made nothing.
            KeyboardInterrupt: the array is cancelled; finished objects are kept.
        """
        if self.plan.conflict:
            raise ArticugenError(self.plan.conflict)
        self.plan.check_room(self.job.out, on_notice)
        began = time.perf_counter()
        for outcome in self.plan.done:
            on_object(report_of(outcome, reused=True))
        instances = self._make(on_object, on_notice) if self.plan.tasks else 0
        if CommonPlan.read(self.job.out) is None:  # no rank was needed
            with pipeline.started(self.job) as run:
                return run.finish(lambda _: None, on_notice)
        width = self.array.cpus * min(self.array.tasks, len(self.plan.keys))
        timings = timings_of(instances, time.perf_counter() - began, width)
        jobs = max(1, self.job.jobs)
        manifest = ranks.merge(self.job.out, jobs=jobs, sizes_only=True, timings=timings)
        shutil.rmtree(self.job.out / _LOGS, ignore_errors=True)
        return manifest

    def _make(
        self, on_object: Callable[[ObjectReport], None], on_notice: Callable[[str], None]
    ) -> int:
        """Until all objects are recorded; how many instances were made."""
        places = {(k.split, k.object_id): place for place, k in enumerate(self.plan.keys)}
        missing = {(task.key.split, task.key.object_id) for task in self.plan.tasks}
        instances = in_vain = 0
        with _Queue(self.job, self.array, on_notice) as queue:
            compile_kernels("generate", jobs=self.job.jobs, notice=on_notice)
            while missing:
                before = len(missing)
                tasks = [] if queue.listed() else self._submitted(queue, missing, places)
                for outcome in self._recorded(queue):
                    name = (outcome.key.split, outcome.key.object_id)
                    if name in missing:
                        missing.remove(name)
                        instances += outcome.made.instances if outcome.made else 0
                        on_object(report_of(outcome, reused=False))
                said = _sentence_of(tasks)
                in_vain = 0 if len(missing) < before else in_vain + 1
                if in_vain == IN_VAIN:
                    raise MachineFault(
                        f"{self.job.out}: {in_vain} arrays, one after the other, have ended and "
                        f"made nothing{said}; {len(missing)} of {len(places)} objects are missing, "
                        f"logs are in {self.job.out / _LOGS}"
                    )
        return instances

    def _submitted(
        self, queue: "_Queue", missing: set[Name], places: Mapping[Name, int]
    ) -> Sequence[Any]:
        """submitit's jobs, one a share that has missing objects."""
        of = min(self.array.tasks, len(places))
        numbers = sorted({places[name] % of for name in missing})
        job = replace(self.job, jobs=self.array.cpus)
        shares = [Share(number=number, of=of) for number in numbers]
        return queue.submit([_Rank(job, share, self.command) for share in shares])

    def _recorded(self, queue: "_Queue") -> Iterator[Any]:
        """What ranks record, until SLURM lists none of them."""
        while queue.listed():
            yield from self.following.news()
            time.sleep(POLL_SECONDS)
        yield from self.following.news()


@dataclass(frozen=True)
class _Rank:
    """What a task of the array does. At its limit of time submitit queues it again."""

    job: Job
    share: Share
    command: str

    def __call__(self) -> ArticugenError | None:
        """What ended it, where that was a sentence of ours."""
        try:
            with ranks.started(self.job, self.share, command=self.command) as rank:
                rank.finish(on_notice=_log)
        except ArticugenError as error:
            _log(f"error: {error}")
            kind = MachineFault if isinstance(error, MachineFault) else ArticugenError
            return kind(str(error))
        return None

    def checkpoint(self) -> Any:
        return _submitit().helpers.DelayedSubmission(self)


def _log(sentence: str) -> None:
    sys.stderr.write(f"{printable(sentence)}\n")


class _Queue:
    """The data set's jobs in SLURM's queue: they are known by their name."""

    def __init__(self, job: Job, array: Array, notice: Callable[[str], None]) -> None:
        """
        Raises:
            MissingExtra, ArticugenError: neither submitit nor SLURM may be here.
        """
        submitit = _submitit()
        if not all(map(shutil.which, ("sbatch", "squeue", "srun"))):
            raise ArticugenError(
                "there is no sbatch here; run this where jobs of SLURM are submitted, or give each "
                "machine a --shard"
            )
        self._name = f"articugen-{hashlib.sha256(bytes(job.out)).hexdigest()[:12]}"
        self._notice, self._heard, self._ids = notice, True, set[str]()
        self._executor = submitit.SlurmExecutor(job.out / _LOGS, max_num_timeout=_REQUEUES)
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
        """Queue an array; submitit's jobs.

        Raises:
            ArticugenError: SLURM refuses it.
        """
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
        """Whether any is waiting or at work; also where SLURM does not answer."""
        command = ["squeue", "--me", "--noheader", f"--name={self._name}", "--format=%F"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            self._heard, self._ids = True, set(done.stdout.split())
            return bool(self._ids)
        if self._heard:
            self._notice(f"SLURM does not answer, which is waited for ({done.stderr.strip()})")
        self._heard = False
        return True

    def __enter__(self) -> "_Queue":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Take all of them out of the queue, where the run is broken off."""
        if kind is not None and self._ids:
            subprocess.run(["scancel", *sorted(self._ids)], capture_output=True, check=False)


def _sentence_of(tasks: Iterable[Any]) -> str:
    """What ended a task of an array that is over, where a machine was at fault and it could say so.

    Raises:
        ArticugenError: no object can be made.
    """
    said = ""
    for task in tasks:
        error = task.result() if task.paths.result_pickle.exists() else None
        if error is not None and not isinstance(error, MachineFault):
            raise error
        said = f" ({error})" if error else said
    return said


def _submitit() -> Any:
    """
    Raises:
        MissingExtra: it is not installed.
    """
    try:
        import submitit  # noqa: PLC0415 - optional
        import submitit.helpers  # noqa: PLC0415
    except ImportError:
        raise MissingExtra("submitit", "cluster") from None
    return submitit
