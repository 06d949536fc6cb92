"""Many recipes, each trained for equally long and measured alike: a comparison, or an ablation.

Which recipes is a list in recipes/lists/. Each has a folder, `<runs>/<category>/<budget>/<name>/`,
with a run for each seed, so that what is finished is known, and what was stopped resumes.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from articugen.core.content import RECIPES
from articugen.core.errors import ArticugenError, InvalidCheckpoint, InvalidRecipe, MachineFault
from articugen.core.files import locked, make_folder, write_atomically
from articugen.core.processes import Crew, report
from articugen.core.yaml_files import read_yaml
from articugen.evaluation.report import tables
from articugen.evaluation.results import FILE, read_evaluation
from articugen.learning import commands, loop
from articugen.learning.budget import scaled_to
from articugen.learning.loop import Notify, Progress, Training
from articugen.learning.method import load_recipe
from articugen.learning.recipe import TrainRecipe
from articugen.learning.run_folder import RunFolder
from articugen.learning.tensors import one_thread
from articugen.store.manifest import Manifest

AT_ONCE = 2
TABLES, FIGURE = "tables.md", "figure.png"


@dataclass(frozen=True)
class Entry:
    """A recipe that is compared.

    Attributes:
        what: its training, not scaled yet; `runs` are those of its seeds.
        seeds: one after the other, all by the schedule that the first one got.
        seconds: the budget of each.
        states: as `evaluate` takes them.
    """

    what: Training
    seeds: range
    seconds: float
    states: int | None

    def run(self) -> str:
        """Train and evaluate what is missing; return a sentence where that cannot be, else ""."""
        try:
            for seed in self.seeds:
                self._run(seed)
        except MachineFault:
            raise
        except ArticugenError as error:
            return str(error)
        return ""

    def _run(self, seed: int) -> None:
        def notify(now: Progress) -> None:
            report(replace(now, who=self.what.recipe.name))

        path = self.what.runs / str(seed)
        named, recipe = self.what.named(str(seed)), self._scaled(notify)
        what = replace(named, recipe=recipe, seed=seed)
        is_measured = what.resume and (path / "evaluation" / FILE).is_file()
        if is_measured and read_evaluation(path).run.states == self.states:
            what.resumed(path)  # or raise that it is another one
            return
        loop.train(what, on_progress=notify)
        n = recipe.schedule.iterations
        assert isinstance(what.data, Path)
        commands.evaluate(
            path, what.data, label_poses="all", states=self.states, jobs=1,
            on_object=lambda name: notify(Progress(n, n, said=f"evaluating: {name}")),
        )  # fmt: skip

    def _scaled(self, notify: Notify) -> TrainRecipe:
        """Return the recipe that the seeds are trained by: that of one that has begun, or new."""
        wanted = self.what.recipe
        for path in sorted(self.what.runs.glob("*/recipe.yaml")):
            recipe = RunFolder(path.parent).recipe()
            before = recipe.budget and recipe.budget.recipe_sha256  # it was scaled
            if wanted.sha256() not in (before, recipe.sha256()):
                raise InvalidCheckpoint(
                    f"{path}: is of another recipe {wanted.name}; move {self.what.runs} away"
                )
            return recipe
        return scaled_to(self.seconds, self.what, notify)


@dataclass(frozen=True)
class Compared:
    """Outcome of a comparison.

    Attributes:
        folder: of all its runs, of the tables and of the picture.
        text: the tables.
        figure: one test object, and what each run makes of it.
    """

    folder: Path
    text: str
    figure: Path


@one_thread()
def compare(
    data: commands.FolderLike,
    recipes: str = "comparison",
    *,
    minutes: float = 10.0,
    runs: commands.FolderLike | None = None,
    seeds: int = 1,
    states: int | None = commands.STATES,
    jobs: int = AT_ONCE,
    device: str = "cpu",
    on_progress: Notify = lambda _: None,
    on_done: Callable[[str], None] = lambda _: None,
) -> Compared:
    """Train each recipe of a list for equally long, evaluate all, write tables and a picture.

    Args:
        data: the folder of a data set.
        recipes: a name under recipes/lists/, or a YAML file: a list of what `train` takes.
        minutes: of CPU time that a seed of a recipe may train, or of the clock on a GPU.
        runs: where runs go; None is a folder called as the list.
        seeds: how many of each recipe, from 0.
        states: random states an object, in votes and tests; None is all.
        jobs: recipes at a time, each on one thread.
        on_done: called with a sentence for each recipe, and where a worker was lost.

    Raises:
        InvalidRecipe: the list, or a recipe in it.
        UnfitData: there is no test object.
        ArticugenError: no recipe of the list could be trained.
    """
    commands.prepare(device)
    data = Path(data)
    category = Manifest.read(data).category
    commands.check_splits(data, category)
    folder = Path(runs or Path(recipes).stem) / category / f"{minutes:g}min"
    entries = [
        Entry(
            Training(recipe, category, data, folder / _file_name(recipe.name), device=device),
            range(seeds), 60.0 * minutes, states,
        )
        for recipe in recipes_of(recipes, category)
    ]  # fmt: skip
    refused: dict[str, str] = {}
    make_folder(folder)
    workers = 0 if jobs == 1 else jobs if device == "cpu" else 1
    with locked(folder), Crew(
        Entry.run, workers=workers, ready=partial(commands.prepare, threads=1),
        on_report=on_progress, notice=on_done,
        name=lambda entry: entry.what.recipe.name,
    ) as crew:  # fmt: skip
        for ended in crew.each(entries):
            name = entries[ended.number].what.recipe.name
            if sentence := ended.value or ended.lost:
                refused[name] = sentence
            on_done(f"{name}: {sentence or 'finished'}")
    finished = [entry for entry in entries if entry.what.recipe.name not in refused]
    if not finished:
        none = (recipes, f"has no recipe for {category}")
        raise ArticugenError(": ".join(next(iter(refused.items()), none)))
    measured = [read_evaluation(e.what.runs / str(seed)) for e in finished for seed in e.seeds]
    text = f"# {category}, {minutes:g} minutes each\n\n" + tables(measured, refused)
    write_atomically(folder / TABLES, text.encode())
    commands.draw_examples([entry.what.runs / "0" for entry in finished], folder / FIGURE, data)
    return Compared(folder, text, folder / FIGURE)


def recipes_of(name: str, category: str | None = None) -> list[TrainRecipe]:
    """Return the recipes of a list: a name under recipes/lists/, or a YAML file.

    Args:
        category: leaves out what is `only:` for another one.

    Raises:
        InvalidRecipe: there is none, it is no list, or a recipe in it is wrong.
    """
    path = RECIPES / "lists" / f"{name}.yaml"
    path = path if path.is_file() else Path(name)
    entries: Any = read_yaml(path, InvalidRecipe)
    if not (isinstance(entries, list) and entries):
        raise InvalidRecipe(f"{path}: is no list of recipes; write one after a hyphen on each line")
    keys = [dict(e) if isinstance(e, Mapping) else {} for e in entries]
    recipes = [
        load_recipe({k: v for k, v in settings.items() if k != "only"} or str(entry))
        for entry, settings in zip(entries, keys, strict=True)
        if category is None
        or category in (o if isinstance(o := settings.get("only", category), list) else [o])
    ]
    names = [TABLES, FIGURE, *(_file_name(recipe.name) for recipe in recipes)]
    if twice := next((n for n in names if names.count(n) > 1), ""):
        raise InvalidRecipe(f"{path}: the name {twice} is taken; give a recipe another one")
    return recipes


def _file_name(name: str) -> str:
    return re.sub(r"[^\w.-]+", "-", name).strip(".") or "-"
