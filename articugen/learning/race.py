"""A race of seeds: all start, the worse half drops out at each halving, the best that is left wins.

Who goes on is decided by the loss on the objects of the training split that are held out, never by
test objects (successive halving: Jamieson and Talwalkar 2016). Each seed is an ordinary run, which
stops and resumes exactly, so that the outcome depends neither on interruptions nor on how many
processes take part.
"""

import json
import math
import queue
import shutil
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from articugen.errors import InvalidCheckpoint, TrainingDiverged
from articugen.learning.loop import Progress, Tell, new_run, train
from articugen.learning.recipe import TrainRecipe
from articugen.learning.runs import BEST, LATEST, METRICS, RunFolder, read_checkpoint
from articugen.store.files import write_atomically
from articugen.workers import die_with

if TYPE_CHECKING:
    from multiprocessing.queues import Queue

RACE = "race.json"


@dataclass(frozen=True)
class Heat:
    """One seed's way to an iteration; validation is what it reached there, None if it diverged."""

    recipe: TrainRecipe
    category: str
    data: Path
    folder: Path
    seed: int
    stop: int
    device: str

    def run(self, tell: Tell) -> dict[str, float] | None:
        """Train from where the seed stands to `stop`; returns the validation there."""
        path = self.folder / str(self.seed)
        started = (path / LATEST).is_file()
        if not started:
            shutil.rmtree(path, ignore_errors=True)
        if not started or read_checkpoint(path / LATEST).iteration < self.stop:
            try:
                train(
                    self.recipe,
                    category=self.category,
                    data=self.data,
                    runs=self.folder,
                    seed=self.seed,
                    name=str(self.seed),
                    resume=path if started else None,
                    stop_after=self.stop,
                    device=self.device,
                    on_progress=lambda progress: tell(replace(progress, seed=self.seed)),
                )
            except TrainingDiverged:
                return None
        told = [r for r in RunFolder(path).metrics() if r["iteration"] == self.stop]
        found = [r["validation"] for r in told if r.get("validation")]
        if not found:
            raise InvalidCheckpoint(
                f"{path / METRICS}: lacks the validation at iteration {self.stop}; delete {path} "
                "and resume the race"
            )
        return found[0]


def race(
    recipe: TrainRecipe,
    *,
    category: str,
    data: Path,
    runs: Path,
    seed: int = 0,
    resume: Path | None = None,
    device: str = "cpu",
    jobs: int = 1,
    on_progress: Tell = lambda _: None,
) -> RunFolder:
    """Train `recipe.seeds.count` seeds from `seed` on, halving them, and keep the best.

    Args:
        recipe, category, data, runs, device: as `train` takes them.
        resume: the folder of a race to go on with instead of a new one.
        jobs: seeds that are trained at a time, each in a process and on one thread of its own. The
            outcome is the same whatever it is.
        on_progress: called after each iteration of each seed.

    Returns:
        The race's folder, with the winner's checkpoints and metrics.

    Raises:
        TrainingDiverged: no seed was left.
        Others as `train`.
    """
    run = new_run(recipe, category, data, runs, seed) if resume is None else RunFolder(resume)
    if resume is not None and run.recipe().sha256() != recipe.sha256():
        raise InvalidCheckpoint(f"{resume}: was started with another recipe; start a new run")
    heat = partial(Heat, recipe, category, data, run.path / "seeds", device=device)
    racing = list(range(seed, seed + recipe.seeds.count))
    rounds: list[dict[str, Any]] = []
    with _runners(jobs, on_progress) as run_all:
        for stop in (*recipe.seeds.halve_at, recipe.schedule.iterations):
            reached = run_all([heat(seed=s, stop=stop) for s in racing])
            score = dict(zip(racing, reached, strict=True))
            racing = best_half(score, last=stop == recipe.schedule.iterations)
            told = {str(s): found for s, found in score.items()}
            rounds.append({"iteration": stop, "validation": told, "go_on": racing})
            _note(run, rounds)
            if not racing:
                raise TrainingDiverged(
                    f"all seeds diverged before iteration {stop}; lower schedule.learning_rate"
                )
    for name in (LATEST, BEST, METRICS):
        own = run.path / "seeds" / str(racing[0]) / name
        write_atomically(run.path / name, own.read_bytes())
    _note(run, rounds, winner=racing[0])
    return run


def best_half(score: dict[int, dict[str, float] | None], *, last: bool) -> list[int]:
    """The seeds that go on, best first: half of them, rounded up, or the best one at the `last`.

    The first number of a score is the loss. Those that diverged (None) never go on; of equals the
    lower seed is taken.
    """

    def loss(seed: int) -> float:
        found = next(iter((score[seed] or {}).values()), math.inf)
        return math.inf if math.isnan(found) else found

    kept = 1 if last else (len(score) + 1) // 2
    return [s for s in sorted(score, key=lambda s: (loss(s), s)) if score[s] is not None][:kept]


def _note(run: RunFolder, rounds: list[dict[str, Any]], **more: Any) -> None:
    scores = [score for each in rounds for score in each["validation"].values() if score]
    by = f"validation {next(iter(scores[0]))}" if scores else "validation"
    told = {"chosen_by": by, "rounds": rounds, **more}
    write_atomically(run.path / RACE, (json.dumps(told, indent=1) + "\n").encode())


RunAll = Callable[[list[Heat]], list[dict[str, float] | None]]


@contextmanager
def _runners(jobs: int, tell: Tell) -> Iterator[RunAll]:
    """What runs heats: here one after the other, or some at a time in processes."""
    threads = torch.get_num_threads()
    if jobs == 1:
        torch.set_num_threads(1)  # sums of floats depend on how many threads share them
        try:
            yield lambda heats: [heat.run(tell) for heat in heats]
        finally:
            torch.set_num_threads(threads)
        return
    context = get_context("spawn")
    mail = context.Queue()
    pool = ProcessPoolExecutor(jobs, context, _begin, (mail,))
    try:
        yield partial(_run_in, pool, mail, tell)
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()  # files are written in one step, so none is left half written
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _run_in(
    pool: ProcessPoolExecutor, mail: "Queue[Progress]", tell: Tell, heats: list[Heat]
) -> list[dict[str, float] | None]:
    futures = [pool.submit(_run, heat) for heat in heats]
    waiting = set(futures)
    while waiting:
        with suppress(queue.Empty):
            tell(mail.get(timeout=0.2))
        done, waiting = wait(waiting, timeout=0)
        for future in done:
            future.result()  # raises what went wrong there
    return [future.result() for future in futures]


_mail: "Queue[Progress]"


def _begin(mail: "Queue[Progress]") -> None:
    global _mail  # noqa: PLW0603
    _mail = mail
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent says when to stop
    parent = parent_process()
    if parent is not None and parent.pid is not None:
        die_with(parent.pid)
    torch.set_num_threads(1)


def _run(heat: Heat) -> dict[str, float] | None:
    return heat.run(_mail.put)
