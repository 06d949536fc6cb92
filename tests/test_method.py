"""The seam for learners: another package's method trains, races, resumes, is judged and predicts
through the same functions and commands as PPD."""

import json

import pytest
from command_line import run
from digests import digest

from articugen.core.errors import ArticugenError, BrokenPlugin, InvalidCheckpoint, InvalidRecipe
from articugen.evaluation.results import read_evaluation
from articugen.learning import commands
from articugen.learning.method import find_method, load_recipe
from articugen.learning.run_folder import BEST, LATEST, read_checkpoint

BOXES = {"train": 3, "test": 1, "states": 2}

RECIPE = """
method: nearest
data: {surface_points: 200, validation_objects: 1}
schedule:
  batch: 2
  stages: [{resolution: 1, iterations: 3}, {resolution: 1, iterations: 3}]
  log_every: 1
  validate_every: 2
  save_every: 2
"""


@pytest.fixture(autouse=True)
def installed(tmp_path, monkeypatch, forget_plugins):
    """The other package, as pip leaves it: an entry point beside its code."""
    about = tmp_path / "site" / "nearest-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: nearest\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[articugen.methods]\nnearest = nearest:METHOD\nbroken = no_such_module:METHOD\n"
    )
    monkeypatch.syspath_prepend(str(about.parent))
    (tmp_path / "mine.yaml").write_text(RECIPE)
    forget_plugins()
    yield
    forget_plugins()


def articugen(*arguments: object) -> str:
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    return done.output


def test_a_method_of_another_package_is_found_by_its_entry_point(tmp_path):
    assert find_method("nearest").name == "nearest"
    assert load_recipe(tmp_path / "mine.yaml").method == "nearest"
    assert load_recipe().name == "ppd_quick"
    with pytest.raises(
        InvalidRecipe, match=r"'nearst'; did you mean 'nearest'\?; there are: bae, .*ppd.*"
    ):
        find_method("nearst")
    with pytest.raises(BrokenPlugin, match=r"package nearest: .*'broken' .* cannot be loaded"):
        find_method("broken")
    with pytest.raises(InvalidRecipe, match=r"mine\.yaml: is of method nearest, not ppd"):
        load_recipe(tmp_path / "mine.yaml", method="ppd")
    with pytest.raises(InvalidRecipe, match="unknown key 'losses'"):
        load_recipe({"method": "nearest", "losses": {"vol": 1.0}})
    with pytest.raises(InvalidRecipe, match="no method"):
        load_recipe({"method": "nearst"})


def test_a_mapping_can_be_a_recipe():
    recipe = load_recipe({"extends": "ppd_quick", "data": {"near_points": 7}})
    quick = load_recipe("ppd_quick")
    assert (recipe.data.near_points, recipe.losses) == (7, quick.losses)
    assert load_recipe(recipe) is recipe


def test_the_same_commands_train_judge_and_rig(boxes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    base = ("train", "-c", "box", "-d", boxes, "--runs", "runs", "--method", "nearest")
    told = articugen(*base, "-r", "mine.yaml")
    assert "6/6 held-out objects: distance 0." in told
    run = tmp_path / "runs" / "box" / "000"
    assert read_checkpoint(run / BEST).best < 0.5
    told = articugen("evaluate", run, "-d", boxes)
    result = read_evaluation(run)
    assert (result.run.method, result.instances, result.joint_states) == ("nearest", 3, ())
    assert result.means["label_iou"] > 0.5
    assert not [name for name in result.means if "joint" in name or "_below_" in name]
    assert "EPE" not in told.split("also measured")[0].split("table 5")[0]
    assert (run / "evaluation" / "reconstructions.png").is_file()
    assert not (run / "evaluation" / "joints.png").exists()
    assert "label IoU" in articugen("tables", run)
    told = articugen("predict", run, boxes / "test-00003.h5", "--out", "rig")
    assert "part 1\n" in told
    assert (tmp_path / "rig" / "predicted.urdf").is_file()


def test_stop_and_resume_comes_to_the_same(boxes, tmp_path):
    recipe = load_recipe(tmp_path / "mine.yaml")
    what = commands.loop.Training(recipe, "box", boxes, tmp_path / "runs")
    whole, part = (commands.loop.train(what, stop_after=stop) for stop in (None, 3))
    articugen("train", "-c", "box", "-d", boxes, "--resume", part.path)
    one, two = (read_checkpoint(run.path / LATEST).state for run in (whole, part))
    assert digest(one) == digest(two)
    assert one["seen"] == 12


def test_its_seeds_race(boxes, tmp_path):
    run = commands.train(boxes, tmp_path / "mine.yaml", runs=tmp_path, seeds=2, jobs=1)
    told = json.loads((run.path / "race.json").read_text())
    assert told["chosen_by"] == "validation distance"
    scores = told["rounds"][-1]["validation"]
    assert told["winner"] == min((0, 1), key=lambda s: scores[str(s)]["distance"])


def test_a_state_that_is_not_its_own_is_refused(boxes, tmp_path):
    run = commands.train(boxes, tmp_path / "mine.yaml", runs=tmp_path)
    point = read_checkpoint(run.path / LATEST)
    for harm in ({"seen": 1.5}, {"clouds": point.state["clouds"][:1]}, {"more": 1}):
        state = point.state | harm
        type(point)(**{**vars(point), "state": state}).write(run.path / LATEST)
        with pytest.raises(InvalidCheckpoint, match="is that of another recipe or method"):
            read_checkpoint(run.path / LATEST)


def test_what_it_has_not_is_said(boxes, tmp_path):
    run = commands.train(boxes, tmp_path / "mine.yaml", runs=tmp_path)
    with pytest.raises(ArticugenError, match=r"--protocol release: .* has paper alone"):
        commands.evaluate(run, boxes, protocol="release")
