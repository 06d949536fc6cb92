"""A study in one command: how fast a device learns, races of seeds, full schedules, evaluations.

Step by step, each of which is done once: a study that was killed goes on where it stood when it is
called again. Everything worth keeping goes to one folder of some megabytes; the checkpoints, which
are many times as large, lie beside it in `<folder>-work`.
"""

import json
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from articugen.core import processes
from articugen.core.content import VERSION
from articugen.core.errors import ArticugenError, InvalidCheckpoint, MachineFault
from articugen.core.files import make_folder, write_atomically
from articugen.core.yaml_files import validated
from articugen.learning import commands
from articugen.learning.benchmark import Pace, pace, pace_table
from articugen.learning.method import load_recipe
from articugen.learning.race import RACE, race
from articugen.learning.recipe import TrainRecipe
from articugen.learning.run_folder import LATEST, METRICS, WEIGHTS, RunFolder, read_checkpoint
from articugen.store.manifest import Manifest, this_commit, this_machine

STUDY, TABLES, CURVES = "study.json", "tables.md", "curves.jsonl"
BENCHED = ("ppd_paper", "ppd_release", "ppd_quick")
FINALISTS = 4
"""So many seeds follow the second half of the schedule; before that they are halved."""

RESERVED = 0.15
"""The share of the time that is kept for evaluations."""

PRUDENCE = 0.85
"""The share of the time left that a plan may fill."""

CURVE_POINTS = 64
"""Of each seed's curve, in CURVES."""

Say = Callable[[str], None]
MakeData = Callable[[str, Path], None]


@dataclass(frozen=True)
class Asked:
    """What a study is of; one that goes on must be asked for the same.

    Attributes:
        categories, data: data sets lie under <data>/<category>.
        recipe: what all seeds follow, shortened where the time is too short for it.
        seeds: how many race in each category.
        minutes: for all of it; what is spent in earlier calls counts.
        device: cuda, or cpu.
        quick: next to nothing of everything, to see that it works.
    """

    categories: tuple[str, ...]
    data: Path
    recipe: TrainRecipe
    seeds: int = 64
    minutes: float = 40.0
    device: str = "cuda"
    quick: bool = False

    def plain(self) -> dict[str, Any]:
        """What must be the same, as JSON has it."""
        return {
            "categories": list(self.categories),
            "data": str(self.data),
            "recipe": self.recipe.plain(),
            "seeds": self.seeds,
            "device": self.device,
            "quick": self.quick,
        }


def made_quick(asked: Asked) -> Asked:
    """The same study of next to nothing."""
    points = dict.fromkeys(("surface_points", "uniform_points", "near_points"), 64)
    data = asked.recipe.model_dump()
    data["data"] |= points | {"grid_points": 0, "validation_objects": 1}
    data["schedule"] |= {"batch": 3}
    for stage in data["schedule"]["stages"]:
        stage |= {"iterations": 2, "resolution": 16}
    data["seeds"] |= {"count": 1, "halve_at": ()}
    recipe = validated(type(asked.recipe), data, "--quick")
    return replace(asked, recipe=recipe, seeds=min(asked.seeds, 5), quick=True)


@dataclass
class Journal:
    """What is done of a study, in study.json.

    Attributes:
        asked, facts: what was asked for, on what it runs.
        spent: seconds of all calls so far.
        bench: what was measured first.
        plans: how long the schedule of each category is.
        steps: the seconds that each finished step took in the call that finished it.
        failed: the sentence of each step that cannot be done.
    """

    path: Path
    asked: dict[str, Any]
    facts: dict[str, Any]
    spent: float = 0.0
    bench: list[Pace] = field(default_factory=list)
    plans: dict[str, dict[str, Any]] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    since: float = field(default_factory=time.monotonic)

    @staticmethod
    def of(folder: Path, asked: Asked) -> "Journal":
        """That of a study to go on with, or a new one.

        Raises:
            ArticugenError: there is one of something else.
        """
        path, plain = folder / STUDY, asked.plain()
        if not path.is_file():
            make_folder(folder)
            return Journal(path, plain, facts(asked.device))
        try:
            told = json.loads(path.read_text(encoding="utf-8"))
            journal = Journal(path, **told | {"bench": [Pace(**row) for row in told["bench"]]})
        except (ValueError, TypeError, KeyError, RecursionError):
            raise InvalidCheckpoint(f"{path}: damaged; choose another --out") from None
        if journal.asked != plain:
            raise ArticugenError(
                f"{path}: is of a study with other options; repeat those, or choose another --out"
            )
        return journal

    def write(self) -> None:
        now = time.monotonic()
        self.spent, self.since = self.spent + now - self.since, now
        told = {name: value for name, value in vars(self).items() if name not in ("path", "since")}
        told["bench"] = [asdict(row) for row in self.bench]
        write_atomically(self.path, (json.dumps(told, indent=1) + "\n").encode())

    def beat(self) -> None:
        """Note the time every now and then, so that a killed call's counts."""
        if time.monotonic() - self.since > 10.0:
            self.write()

    @contextmanager
    def step(self, name: str, say: Say) -> Iterator[None]:
        """A step, noted once it is done; what cannot be done is noted as such."""
        say(f"{name} ...")
        began, sentence = time.monotonic(), ""
        try:
            yield
        except MachineFault:
            raise
        except ArticugenError as error:
            sentence = str(error)
            say(f"{name}: {error}")
        self.ended(name, time.monotonic() - began, sentence)

    def ended(self, name: str, seconds: float, sentence: str = "") -> None:
        """Note that a step is done, or, with a sentence, that it cannot be."""
        self.failed.pop(name, None)
        if sentence:
            self.failed[name] = sentence
        else:
            self.steps[name] = round(seconds, 2)
        self.write()

    def to_do(self, name: str, *after: str) -> bool:
        """Whether a step is still to be done, and can be."""
        return name not in self.steps and all(step in self.steps for step in after)


def study(asked: Asked, out: Path, *, make_data: MakeData, say: Say = lambda _: None) -> Path:
    """Make a study, or go on with it.

    Args:
        out: the folder of what it finds.
        make_data: makes the data set of a category in a folder.
        say: is told what is done.

    Returns:
        `out`. What failed is in its README.md; all else is done.

    Raises:
        ArticugenError: the device is not there, or another study lies in `out`.
        KeyboardInterrupt, MachineFault: called again, it goes on.
    """
    commands.prepare(asked.device)
    journal = Journal.of(out, asked)
    work = out.with_name(f"{out.name}-work")
    make_folder(work)
    journal.write()
    first, *others = asked.categories

    def make(category: str) -> None:
        if journal.to_do(f"data {category}"):
            with journal.step(f"data {category}", say):
                folder = asked.data / category
                if not (folder / "manifest.json").is_file():
                    make_data(category, folder)
                Manifest.read(folder)

    make(first)
    if journal.to_do("bench", f"data {first}"):
        with journal.step("bench", say):
            journal.bench = _bench(asked, first, work, say)
    for category in others:
        make(category)
    for category in asked.categories:
        journal.plans.setdefault(category, _plan(asked, journal))
    journal.write()
    for leg in ("race", "train"):
        for category in asked.categories:
            if journal.to_do(f"{leg} {category}", "bench", f"data {category}"):
                with journal.step(f"{leg} {category}", say):
                    _train(asked, journal, category, work, out, leg)
    _evaluate(asked, journal, out, say)
    _write_report(asked, journal, out)
    journal.write()
    return out


def facts(device: str) -> dict[str, Any]:
    """The machine and the versions."""
    found: dict[str, Any] = {
        "machine": this_machine(),
        "commit": this_commit(),
        "articugen": VERSION,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
    }
    where = torch.device(device)
    if where.type == "cuda":
        about = torch.cuda.get_device_properties(where)
        found["gpu"] = f"{about.name}, {about.total_memory / 2**30:.0f} GiB"
        found["cuda"] = torch.version.cuda
    return found


def _bench(asked: Asked, category: str, work: Path, say: Say) -> list[Pace]:
    """The pace of the known recipes, and that of the study's with as many seeds as race at a
    time."""
    seconds = 0.1 if asked.quick else 5.0
    told = {"category": category, "data": asked.data / category, "beside": work}
    known = () if asked.quick else BENCHED
    todo = [(load_recipe(name), 1) for name in known]
    todo += [(asked.recipe, count) for count in _field(asked.seeds)]
    rows = []
    for recipe, count in todo:
        rows.append(pace(recipe, **told, device=asked.device, seeds=count, seconds=seconds))
        say(pace_table(rows[-1:]).splitlines()[-1])
    return rows


def _paces(asked: Asked, journal: Journal) -> dict[int, Pace]:
    """Those of the study's own recipe, by how many seeds run."""
    own = journal.bench[-len(_field(asked.seeds)) :]
    return {p.seeds: p for p in own}


def _field(seeds: int) -> list[int]:
    """How many seeds run, from halving to halving."""
    counts = [seeds]
    while counts[-1] > FINALISTS:
        counts.append((counts[-1] + 1) // 2)
    return counts


def _plan(asked: Asked, journal: Journal) -> dict[str, Any]:
    """How many iterations a category gets, and from how many seeds: as many as fit."""
    paces = {count: p for count, p in _paces(asked, journal).items() if not p.failed}
    counts = _field(asked.seeds)
    while len(counts) > 1 and counts[0] not in paces:  # it did not fit into the memory
        counts = counts[1:]
    if not all(count in paces for count in counts):
        return {"seeds": counts[0], "iterations": 0, "seconds": 0.0}
    share = 1.0 / len(asked.categories)
    left = (1.0 - RESERVED) * 60.0 * asked.minutes - journal.spent
    there, fixed = PRUDENCE * share * left, 0.0
    parts = 2 ** (len(counts) - 1)  # the schedule is cut at its half, quarter, eighth ...
    each = 0.0
    for at, count in enumerate(counts):
        p = paces[count]
        each += _length(at, len(counts)) / p.iterations_per_second
        fixed += p.begin_seconds + count * p.validate_seconds
    whole = asked.recipe.schedule.iterations
    fits = max(int(min(whole, (there - fixed) / each)), whole // 50, 1)
    iterations = max(fits // parts, 1) * parts
    predicted = round(iterations * each + fixed, 1)
    return {"seeds": counts[0], "iterations": iterations, "seconds": predicted}


def _length(at: int, heats: int) -> float:
    """The share of the schedule that heat number `at` takes: 1/8, 1/8, 1/4, 1/2 of four."""
    return 0.5 ** (heats - max(at, 1)) if heats > 1 else 1.0


def planned_recipe(recipe: TrainRecipe, seeds: int, iterations: int) -> TrainRecipe:
    """A recipe whose stages are shortened alike to so many iterations, with a race of `seeds` that
    are halved until `FINALISTS` are left, at half of the schedule."""
    heats = len(_field(seeds))
    cuts = [iterations // 2 ** (heats - at) for at in range(1, heats)]
    plan = recipe.schedule
    ends = [round(plan.first_of(i) / plan.iterations * iterations) for i in range(len(plan.stages))]
    lengths = np.diff([*ends, iterations]).tolist()
    step = iterations // 2 ** (heats - 1)
    data = recipe.model_dump()
    for stage, length in zip(data["schedule"]["stages"], lengths, strict=True):
        stage["iterations"] = length
    data["schedule"] |= {
        "validate_every": step,
        "save_every": step,
        "log_every": max(iterations // 512, 1),
    }
    data["seeds"] |= {"count": seeds, "halve_at": cuts}
    return validated(type(recipe), data, "the study's recipe")


def _train(asked: Asked, journal: Journal, category: str, work: Path, out: Path, leg: str) -> None:
    """The race until few seeds are left, or all of the schedule; what is found is kept."""
    plan = journal.plans[category]
    if not plan["iterations"]:
        raise ArticugenError(f"{category}: nothing is planned, since the bench has failed")
    recipe = planned_recipe(asked.recipe, plan["seeds"], plan["iterations"])
    runs = work / category
    begun = [p for p in sorted(runs.glob("*")) if p.name.isdecimal() and (p / "run.json").is_file()]
    early = (*recipe.seeds.halve_at[-2:], 0)[0]
    run = race(
        recipe,
        category=category,
        data=asked.data / category,
        runs=runs,
        resume=begun[-1] if begun else None,
        stop_after=early if leg == "race" else None,
        device=asked.device,
        at_once=_paces(asked, journal)[plan["seeds"]].at_once,
        on_progress=lambda _: journal.beat(),
    )
    if leg == "train":
        _keep(run, out / category)


def _keep(run: RunFolder, folder: Path) -> None:
    """Copy what is worth keeping of a race: a run's folder that predicts, but is not trained on."""
    make_folder(folder)
    read_checkpoint(run.path / LATEST).write_weights(folder / WEIGHTS)
    for name in ("recipe.yaml", "run.json", RACE, METRICS):
        write_atomically(folder / name, (run.path / name).read_bytes())
    lines = []
    for path in sorted((run.path / "seeds").iterdir(), key=lambda p: int(p.name)):
        records = RunFolder(path).metrics()
        logged = [r for r in records if "terms" in r]
        every = max(run.recipe().schedule.iterations // CURVE_POINTS, 1)
        kept = {r["iteration"] // every: r for r in reversed(logged)}  # the first of each stretch
        for record in records:
            if "validation" in record or any(record is r for r in kept.values()):
                lines.append(json.dumps({"seed": int(path.name), **record}))
    write_atomically(folder / CURVES, "".join(f"{line}\n" for line in lines).encode())


@dataclass(frozen=True)
class _Judged:
    """A category to evaluate, in a process of its own."""

    run: Path
    data: Path
    quick: bool
    threads: int

    def judge(self) -> str:
        """Evaluate it and draw its figures; the sentence of what went wrong, or nothing."""
        try:
            resolution, states = (8, 1) if self.quick else (None, 8)
            result = commands.evaluate(
                self.run, self.data, resolution=resolution, states=states, threads=self.threads
            )
            if not self.quick:
                list(commands.draw(self.run, self.data, result))
        except MachineFault:
            raise
        except ArticugenError as error:
            return str(error)
        return ""


def _evaluate(asked: Asked, journal: Journal, out: Path, say: Say) -> None:
    """Evaluate what is trained, all categories at a time."""
    left = [c for c in asked.categories if journal.to_do(f"evaluate {c}", f"train {c}")]
    if not left:
        return
    threads = max((os.cpu_count() or 1) // len(left), 1)
    todo = {f"evaluate {c}": _Judged(out / c, asked.data / c, asked.quick, threads) for c in left}
    say(f"{', '.join(todo)} ...")
    began = time.monotonic()
    at_a_time = 0 if asked.quick else len(todo)
    sentences = processes.in_order(_Judged.judge, list(todo.values()), workers=at_a_time)
    for name, sentence in zip(todo, sentences, strict=True):
        journal.ended(name, time.monotonic() - began, sentence)


def _write_report(asked: Asked, journal: Journal, out: Path) -> None:
    """The tables over all categories, and README.md, which says what is what."""
    done = [c for c in asked.categories if f"evaluate {c}" in journal.steps]
    write_atomically(out / "bench.md", pace_table(journal.bench).encode())
    if done:
        write_atomically(out / TABLES, commands.tables([out / c for c in done]).encode())
    write_atomically(out / "README.md", readme(journal, out, done).encode())


def readme(journal: Journal, out: Path, done: Sequence[str]) -> str:
    """What a study's folder says of itself."""
    told, about = journal.asked, journal.facts
    machine = about["machine"]
    lines = [
        "# A study by articugen",
        "",
        f"Recipe {told['recipe']['name']}, {told['seeds']} seeds a category, on "
        f"{about.get('gpu', 'no GPU')}, {machine['processor']} ({machine['cores']} cores); torch "
        f"{about['torch']}, articugen {about['articugen']}, commit {about['commit'] or 'unknown'}; "
        f"{journal.spent / 60.0:.1f} minutes in all.",
        *(
            ["", "`--quick`: next to nothing of everything; no figure here means anything."]
            if told["quick"]
            else []
        ),
        "",
        "| file | what it is |",
        "|---|---|",
        f"| `{STUDY}` | what was asked, machine, versions, pace, plans, the seconds of each step |",
        "| `bench.md` | the table below |",
        f"| `{TABLES}` | the evaluations beside the paper's tables |",
        f"| `<category>/{WEIGHTS}` | the winner's weights, with the recipe in the header |",
        "| `<category>/recipe.yaml`, `run.json` | what it was trained by, on which data |",
        f"| `<category>/{RACE}` | what each seed reached, who went on, who won |",
        f"| `<category>/{METRICS}` | the winner's curve, a JSON object a line |",
        f"| `<category>/{CURVES}` | all seeds' curves, thinned; `seed` says whose line it is |",
        "| `<category>/evaluation/` | evaluation.json, evaluation.md, figures |",
        "",
        "Each `<category>` is a run's folder for `articugen evaluate`, `predict` and `tables`:",
        "",
        "```console",
        f"articugen predict {out.name}/{told['categories'][0]} cloud.ply --fit",
        "```",
        "",
        "## Pace",
        "",
        pace_table(journal.bench),
        "## Races",
        "",
        "| category | iterations | planned | took | winner | held-out loss of the finalists |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for category in told["categories"]:
        if f"train {category}" in journal.steps:
            lines.append(_race_row(journal, out, category))
    lines += ["", "## Test objects", ""]
    results = {
        c: json.loads((out / c / "evaluation" / "evaluation.json").read_text()) for c in done
    }
    lines += _means(results) if results else ["Nothing was evaluated."]
    if journal.failed:
        lines += ["", "## Failed", ""]
        lines += [f"- {name}: {sentence}" for name, sentence in journal.failed.items()]
    return "\n".join(lines) + "\n"


def _race_row(journal: Journal, out: Path, category: str) -> str:
    told = json.loads((out / category / RACE).read_text())
    plan = journal.plans[category]
    losses = sorted(next(iter(v.values())) for v in told["rounds"][-1]["validation"].values() if v)
    took = sum(journal.steps.get(f"{leg} {category}", 0.0) for leg in ("race", "train"))
    found = ", ".join(f"{loss:.4f}" for loss in losses)
    return (
        f"| {category} | {plan['iterations']:,} | {plan['seconds']:.0f} s | {took:.0f} s "
        f"| {told['winner']} | {found} |"
    )


def _means(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A table of all measures, a column a category."""
    names = dict.fromkeys(name for found in results.values() for name in found["means"])
    lines = [f"| mean over test instances | {' | '.join(results)} |", "|---" * (1 + len(results))]
    lines[-1] += "|"
    for name in names:
        values = [found["means"].get(name) for found in results.values()]
        cells = " | ".join("" if value is None else f"{value:.4g}" for value in values)
        lines.append(f"| {name} | {cells} |")
    return lines
