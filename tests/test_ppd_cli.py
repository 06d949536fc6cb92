"""PPD's commands, one after the other, on a small data set."""

import json

import pytest
from ppd_data import write_boxes
from typer.testing import CliRunner

from articugen.cli import app

torch = pytest.importorskip("torch", reason="PPD needs torch")
torch.set_num_threads(1)

RECIPE = """
extends: ppd_quick
data: {surface_points: 256, uniform_points: 128, near_points: 128, validation_objects: 1}
schedule: {batch: 3, stages: [{resolution: 16, iterations: 3}], validate_every: 3}
seeds: {count: 1}
"""


def articugen(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ppd")
    write_boxes(folder / "data", train=2, test=1, states=1)
    (folder / "tiny.yaml").write_text(RECIPE)
    return folder


def test_train_evaluate_predict(folder):
    data, runs = folder / "data", folder / "runs"
    done = articugen(
        "train", "-c", "box", "-d", data, "-r", folder / "tiny.yaml", "--runs", runs
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "3/3 held-out objects: rec 0." in done.output
    assert "next: articugen evaluate" in done.output
    done = articugen("evaluate", runs / "box", "-d", data, "--resolution", 8)
    assert done.exit_code == 0, done.output
    assert "| label IoU, % |" in done.output
    result = json.loads((runs / "box" / "000" / "evaluation.json").read_text())
    assert (result["objects"], result["instances"]) == (1, 2)
    shard = data / "test-00002.h5"
    done = articugen("predict", runs / "box", shard, "--out", folder / "rig", "--resolution", 16)
    assert done.exit_code in (0, 1), done.output
    assert (done.exit_code == 0) == (folder / "rig" / "predicted.urdf").is_file()


def test_seeds_race_and_a_race_resumes(folder):
    data, runs = folder / "data", folder / "race"
    recipe = folder / "race.yaml"
    recipe.write_text(RECIPE.replace("{count: 1}", "{count: 1, halve_at: []}"))
    base = ("train", "-c", "box", "-d", data, "-r", recipe, "--runs", runs, "-j", 1)
    done = articugen(*base, "--seeds", 2, "--seed", 3)
    assert done.exit_code == 0, done.output
    assert "seed 3: 3/3 held-out objects: rec 0." in done.output
    told = json.loads((runs / "box" / "000" / "race.json").read_text())
    assert told["winner"] in (3, 4)
    done = articugen(*base, "--resume", runs / "box" / "000")
    assert done.exit_code == 0, done.output
    assert json.loads((runs / "box" / "000" / "race.json").read_text()) == told


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("train", "-c", "oven", "-d", "{data}"), "holds box, not oven"),
        (("train", "-c", "box", "-d", "{data}", "-r", "ppd_papre"), "did you mean 'ppd_paper'"),
        (("evaluate", "{data}", "-d", "{data}"), "holds no run"),
    ],
)
def test_mistakes_are_said_in_one_sentence(folder, arguments, said):
    filled = [a.format(data=folder / "data") for a in arguments]
    done = articugen(*filled, *(("--runs", folder / "none") if filled[0] == "train" else ()))
    assert done.exit_code == 1
    assert said in done.output
    assert "Traceback" not in done.output
