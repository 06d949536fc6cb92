"""Comparisons: equal time for all, what is finished stays, what was stopped resumes."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from ppd_data import write_boxes
from python_process import ended
from test_workers import children

torch = pytest.importorskip("torch", reason="learning needs torch")

from learners import tiny

from articugen.core.errors import ArticugenError, InvalidRecipe
from articugen.core.files import locked
from articugen.evaluation.results import read_evaluation
from articugen.learning import budget
from articugen.learning.comparison import compare, recipes_of
from articugen.learning.loop import Progress, Training, clock_of
from articugen.learning.method import find_method, load_recipe
from articugen.learning.ppd.settings import WarmStart
from articugen.learning.run_folder import RunFolder

torch.set_num_threads(1)

pytestmark = pytest.mark.usefixtures("few_pictures")
"""A comparison's figure is drawn at each end of one."""

SMALL = """
  model: {voxels: 16, widths: [16, 8], branches: 3}
  data: {surface_points: 64, grid_points: 32, band_points: 32, validation_objects: 1}
"""
LIST = f"""
- one_part
- extends: bae
  name: few points
  schedule:
    batch: 2
    stages: [{{resolution: 16, iterations: 3000}}, {{resolution: 32, iterations: 1000}}]
{SMALL}
- extends: bae
  name: too many points
  model: {{voxels: 16, widths: [16, 8], branches: 3}}
  data: {{surface_points: 1000000}}
"""
KILLED = """
import os, signal, sys
from articugen.learning.comparison import compare

def kill(now):
    if now.who == "few points" and now.iteration > now.iterations / 2:
        os.kill(os.getpid(), signal.SIGKILL)

compare("boxes", "list.yaml", minutes=0.03, runs="runs", states=1, jobs=1, on_progress=kill)
"""


def test_a_comparison_that_was_killed_resumes_and_one_that_refuses_is_a_dash(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_boxes(tmp_path / "boxes", train=3, test=1, states=1)
    (tmp_path / "list.yaml").write_text(LIST)
    assert ended("-c", KILLED).returncode == -signal.SIGKILL
    folder = tmp_path / "runs" / "box" / "0.03min"
    run, done = folder / "few-points" / "0", folder / "one_part" / "0"
    recipe, stopped = (run / "recipe.yaml").read_bytes(), len(RunFolder(run).metrics())
    finished = (done / "evaluation" / "evaluation.json").stat().st_mtime_ns
    assert not (folder / "tables.md").exists()

    sentences, moments = [], []
    again = {"minutes": 0.03, "runs": "runs", "states": 1, "jobs": 1, "on_done": sentences.append}
    outcome = compare("boxes", "list.yaml", on_progress=moments.append, **again)
    mine = [m.iteration for m in moments if m.who == "few points" and not m.said]
    assert mine[0] > mine[-1] / 3  # it did not begin anew
    assert (run / "recipe.yaml").read_bytes() == recipe
    assert len(RunFolder(run).metrics()) > stopped
    assert (done / "evaluation" / "evaluation.json").stat().st_mtime_ns == finished
    assert "one_part: finished" in sentences
    (refusal,) = [s for s in sentences if s.startswith("too many points: ")]
    assert "boxes" in refusal
    assert f"Not trained: {refusal}" in outcome.text
    assert outcome.text == (folder / "tables.md").read_text()
    assert "| few points " in outcome.text
    assert outcome.figure.is_file()

    scaled = RunFolder(run).recipe()
    first, second = (stage.iterations for stage in scaled.schedule.stages)
    assert first == pytest.approx(3 * second, abs=4)
    assert scaled.budget
    assert scaled.budget.seconds == pytest.approx(1.8)
    assert RunFolder(run).seconds() + scaled.budget.start < 7.0  # rough: the machine is shared

    moments.clear()
    assert compare("boxes", "list.yaml", on_progress=moments.append, **again).text == outcome.text
    assert not [m for m in moments if m.who == "few points"]  # nothing was left to do
    (tmp_path / "list.yaml").write_text(LIST.replace("batch: 2", "batch: 3"))
    text = compare("boxes", "list.yaml", **again).text
    assert "Not trained: few points: " in text
    assert "is of another recipe few points; move" in text


def test_of_a_worker_that_is_killed_one_reads_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_boxes(tmp_path / "boxes", train=3, test=1, states=1)
    (tmp_path / "list.yaml").write_text("- one_part\n")
    sentences, killed = [], []

    def kill_once(_):
        if not killed:
            killed.extend(children(os.getpid(), 1))
            os.kill(killed[0], signal.SIGKILL)

    compare(
        "boxes", "list.yaml", minutes=0.03, runs="runs", states=1, jobs=2, on_progress=kill_once,
        on_done=sentences.append,
    )  # fmt: skip
    lost, finished = sentences
    assert re.match("a worker was killed .* at one_part, which is tried once more at the end", lost)
    assert finished == "one_part: finished"
    run = Path("runs", "box", "0.03min", "one_part", "0")
    for states in (None, 1):  # by other states it is measured again
        again = {"minutes": 0.03, "runs": "runs", "states": states, "jobs": 1}
        compare("boxes", "list.yaml", **again)
        assert read_evaluation(run).run.states == states


def test_iterations_fill_what_start_and_checks_leave_of_the_budget(tmp_path, monkeypatch):
    """A start of 5 s, stages of 0.1 and 0.3 s an iteration, 1 s each time it is validated."""
    now, recipe = [0.0], load_recipe("ppd_paper")

    def train(what, on_progress):
        (what.runs / what.name).mkdir(parents=True)
        counts = [stage.iterations for stage in what.recipe.schedule.stages]
        now[0] += 5.0
        for i in range(sum(counts)):
            now[0] += 0.1 if i < counts[0] else 0.3
            now[0] += 1.0 if i + 1 == sum(counts) else 0.0
            on_progress(Progress(i + 1, sum(counts)))

    monkeypatch.setattr(budget.loop, "train", train)
    monkeypatch.setattr(budget.loop, "clock_of", lambda _: lambda: now[0])
    what = budget.Training(recipe, "laptop", Path(), tmp_path)
    scaled = budget.scaled_to(100.0, what)
    first, second = (stage.iterations for stage in scaled.schedule.stages)
    assert 5.0 + 0.1 * first + 0.3 * second + 5 * 1.0 == pytest.approx(100.0, abs=0.5)
    assert first / second == pytest.approx(99 / 49, rel=0.01)
    assert -(-scaled.schedule.iterations // scaled.schedule.validate_every) == 5
    assert scaled.budget
    assert (scaled.budget.start, scaled.budget.recipe_sha256) == (5.0, recipe.sha256())
    assert scaled.sha256() != recipe.sha256()
    with pytest.raises(ArticugenError, match=r"^10 s are too few: .* give it a larger"):
        budget.scaled_to(10.0, what)


def test_workers_that_have_ended_count():
    clock = clock_of("cpu")
    begun = clock()
    subprocess.run([sys.executable, "-c", "sum(range(10**7))"], check=True)
    assert clock() - begun > 0.05


def test_joints_that_the_pace_has_found_are_not_looked_for_again(tmp_path):
    data = write_boxes(tmp_path / "box", train=2, test=0, states=5)
    warm = {"warm_start": WarmStart(share=1.0, groups="given")}
    recipe = tiny({"surface_points": 200, "grid_points": 50}, (8, 4000), batch=2).model_copy(
        update=warm
    )
    what = Training(recipe, "box", data, tmp_path / "runs")
    scaled = budget.scaled_to(30.0, what)
    assert [p.name for p in what.runs.iterdir()] == ["joints"]
    assert list((what.runs / "joints").iterdir())
    said = []
    learner = find_method("ppd").start(scaled, seed=0, device=torch.device("cpu"))
    learner.begin(next(what.instances(learner, 0, said.append)[0]), what.beside, said.append)
    assert not any("looking for joints" in text for text in said)


def test_a_comparison_that_is_under_way_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_boxes(tmp_path / "boxes", train=2, test=1, states=1)
    folder = tmp_path / "comparison" / "box" / "0.1min"
    folder.mkdir(parents=True)
    with (
        locked(folder),
        pytest.raises(ArticugenError, match=r"0\.1min: another run is"),
    ):
        compare("boxes", minutes=0.1, jobs=1)


def test_lists_may_name_several_categories_and_have_nothing_for_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_boxes(tmp_path / "boxes", train=2, test=1, states=1)
    Path("list.yaml").write_text("- {extends: one_part, only: [oven, drawer]}\n")
    assert len(recipes_of("list.yaml", "oven")) == len(recipes_of("list.yaml")) == 1
    with pytest.raises(ArticugenError, match=r"list\.yaml: has no recipe for box"):
        compare("boxes", "list.yaml", jobs=1)


def test_what_counts_iterations_is_scaled_and_no_seeds_race():
    scaled = load_recipe({"extends": "bsp", "fourfold": 20000}).scaled(0.1, 5)
    assert (scaled.fourfold, scaled.restart_after) == (2000, 200)
    assert [stage.iterations for stage in scaled.schedule.stages] == [400, 400, 400]
    assert load_recipe("ppd_plain").scaled(0.5, 5).seeds.count == 1
    for name in ("npcs", "opalign"):  # the rate falls as often in a short run as in a long one
        recipe = load_recipe(name)
        (counted,) = recipe.schedule.COUNTED
        short = recipe.scaled(0.1, 5).schedule
        assert getattr(short, counted) == getattr(recipe.schedule, counted) // 10
        last = recipe.schedule.rate_at(recipe.schedule.iterations - 1)
        assert short.rate_at(short.iterations - 1) == pytest.approx(last)


def test_lists_name_recipes_that_there_are(tmp_path):
    variants = {recipe.name: recipe.variant for recipe in recipes_of("ablation")}
    for name, variant in variants.items():
        if name.startswith("ppd_paper w/o"):
            assert f"ppd_paper {variant}" == name
    assert {recipe.method for recipe in recipes_of("comparison")} >= {"bae", "bsp", "nsd", "ppd"}
    hinges = {
        category: [r.model.revolute for r in recipes_of("comparison", category) if "op" in r.name]
        for category in ("laptop", "eyeglasses")
    }
    assert hinges == {"laptop": [1], "eyeglasses": [1, 2]}
    for text, error in (
        ("- bae\n- bae\n", "the name bae is taken"),
        ("- {extends: bae, name: tables.md}", "tables.md is taken"),
        ("{}", "is no list"),
    ):
        (tmp_path / "list.yaml").write_text(text)
        with pytest.raises(InvalidRecipe, match=error):
            recipes_of(str(tmp_path / "list.yaml"))
