"""A race of seeds: all start, the worse half drops out at each halving, the best that is left wins.

Who goes on is decided by the loss on the objects of the training split that are held out, never by
test objects (successive halving: Jamieson and Talwalkar 2016). Each seed is an ordinary run, which
stops and resumes exactly, so that the outcome depends neither on interruptions nor on how many
processes take part.
"""

import json
import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch

from articugen.core.errors import InvalidCheckpoint, TrainingDiverged
from articugen.core.files import locked, write_atomically
from articugen.core.memory import given_back
from articugen.core.processes import Crew, report
from articugen.learning.loop import SEEDS, SHARDS, Notify, Progress, Training, train
from articugen.learning.method import find_method
from articugen.learning.run_folder import BEST, LATEST, META, METRICS, RunFolder, read_checkpoint
from articugen.learning.tensors import one_thread

RACE = "race.json"


@dataclass(frozen=True)
class Heat:
    """One seed's way to an iteration; validation is what it reached there, None if it diverged."""

    what: Training
    stop: int

    def run(self) -> dict[str, float] | None:
        """Train from where the seed stands to `stop`; return the validation there."""
        seed = self.what.seed
        what, path = self.what.named(str(seed)), self.what.runs / str(seed)
        if not what.resume or read_checkpoint(path / LATEST).iteration < self.stop:
            try:
                train(
                    what,
                    stop_after=self.stop,
                    on_progress=lambda now: report(replace(now, who=f"seed {seed}")),
                )
            except TrainingDiverged:
                return None
        there = [r for r in RunFolder(path).metrics() if r["iteration"] == self.stop]
        validations = [r["validation"] for r in there if r.get("validation")]
        if not validations:
            raise InvalidCheckpoint(
                f"{path / METRICS}: lacks the validation at iteration {self.stop}; delete "
                f"{path} and resume the race"
            )
        return validations[0]


def race(what: Training, *, jobs: int = 1, on_progress: Notify = lambda _: None) -> RunFolder:
    """Train `recipe.seeds.count` seeds from the training's on, halving them, and keep the best.

    Args:
        jobs: seeds that are trained at a time, each in a process and on one thread of its own. The
            outcome is the same whatever it is.
        on_progress: called after each iteration of each seed.

    Returns:
        The race's folder, with the winner's checkpoints and metrics once it is over.

    Raises:
        TrainingDiverged: no seed was left.
        ArticugenError: another process races there.
        Others as `train`.
    """
    recipe = what.recipe
    # Shapes alone: joints are looked for once for all seeds, and data that do not fit are refused
    # before there is a folder.
    learner = find_method(recipe.method).start(recipe, seed=0, device=META)
    total = recipe.schedule.iterations

    def notify(said: str) -> None:
        on_progress(Progress(0, total, said=said))

    windows = what.instances(learner, 0, notify)[0]
    run = what.resumed(what.resume)[0] if what.resume else what.new_run()
    alone = replace(what, runs=run.path / SEEDS)
    with locked(run.path):
        with given_back(SHARDS):
            learner.begin(next(windows), what.beside, notify)
        del learner, windows  # all instances
        with one_thread(), Crew(
            Heat.run, workers=0 if jobs == 1 else jobs, ready=partial(torch.set_num_threads, 1),
            on_report=on_progress, notice=notify, name=lambda heat: f"seed {heat.what.seed}",
        ) as crew:  # fmt: skip
            racing = list(range(what.seed, what.seed + recipe.seeds.count))
            rounds: list[dict[str, Any]] = []
            for stop in (*recipe.seeds.halve_at, total):
                reached = crew.in_order([Heat(replace(alone, seed=s), stop) for s in racing])
                score = dict(zip(racing, reached, strict=True))
                racing = best_half(score, last=stop == total)
                reached_by = {str(seed): validation for seed, validation in score.items()}
                rounds.append({"iteration": stop, "validation": reached_by, "go_on": racing})
                _note(run, rounds)
                if not racing:
                    raise TrainingDiverged(
                        f"all seeds diverged before iteration {stop}; lower schedule.learning_rate"
                    )
        for name in (LATEST, BEST, METRICS):
            winner = run.path / SEEDS / str(racing[0]) / name
            write_atomically(run.path / name, winner.read_bytes())
        _note(run, rounds, winner=racing[0])
    return run


def best_half(score: dict[int, dict[str, float] | None], *, last: bool) -> list[int]:
    """Return seeds that go on, best first: half of them, rounded up, or the best one at the `last`.

    The first number of a score is the loss. Those that diverged (None) never go on; of equals the
    lower seed is taken.
    """

    def loss(seed: int) -> float:
        first = next(iter((score[seed] or {}).values()), math.inf)
        return math.inf if math.isnan(first) else first

    kept = 1 if last else (len(score) + 1) // 2
    return [s for s in sorted(score, key=lambda s: (loss(s), s)) if score[s] is not None][:kept]


def _note(run: RunFolder, rounds: list[dict[str, Any]], **more: Any) -> None:
    scores = [score for one in rounds for score in one["validation"].values() if score]
    by = f"validation {next(iter(scores[0]))}" if scores else "validation"
    record = {"chosen_by": by, "rounds": rounds, **more}
    write_atomically(run.path / RACE, (json.dumps(record, indent=1) + "\n").encode())
