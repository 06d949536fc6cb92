"""PPD's commands, one after the other, on a small data set."""

import json
import re
import shutil

import numpy as np
import pytest
from command_line import run as articugen
from PIL import Image
from ppd_data import write_boxes

from articugen.cli.saying import command
from articugen.evaluation.results import RunEvaluation
from articugen.learning.commands import draw, evaluation_folder

RECIPE = """
extends: ppd_plain
data: {surface_points: 256, uniform_points: 128, near_points: 128, validation_objects: 1}
schedule: {batch: 3, stages: [{resolution: 16, iterations: 3}], validate_every: 3}
seeds: {count: 1, halve_at: []}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set, a recipe and a run."""
    folder = tmp_path_factory.mktemp("ppd")
    write_boxes(folder / "data", train=2, test=1, states=1)
    (folder / "tiny.yaml").write_text(RECIPE)
    arguments = ("-c", "box", "-d", folder / "data", "-r", folder / "tiny.yaml")
    done = articugen("train", *arguments, "--runs", folder / "runs")
    assert done.exit_code == 0, done.output
    assert "3/3 held-out objects: rec 0." in done.output
    assert f"next: {command('evaluate', folder / 'runs')}" in done.output
    assert "data: 2 training objects show that all works" in done.output.replace("\n", " ")
    return folder


def test_training_says_what_was_found_of_joints(tmp_path):
    """Once, whichever of the seeds says so; of what is counted only the end stays."""
    data = write_boxes(tmp_path / "data", train=3, test=1, states=7, slides=0.0)
    recipe = tmp_path / "warm.yaml"
    recipe.write_text(RECIPE.replace("ppd_plain", "ppd_quick").replace("count: 1", "count: 2"))
    told = ("-c", "box", "-d", data, "-r", recipe, "--runs", tmp_path / "runs", "-j", 1)
    done = articugen("train", *told)
    assert done.exit_code == 0, done.output
    assert done.output.count("looking for joints") == 1
    assert "looking for joints in the training objects: 2 of 2" in done.output
    assert done.output.count("joints are known of 2 of 2 training objects") == 1


@pytest.mark.usefixtures("few_pictures")
def test_evaluate_predict(folder):
    data, runs = folder / "data", folder / "runs"
    done = articugen("evaluate", runs / "box", "-d", data, "--no-figures")
    assert re.search(r"box, labels +\| T2 label IoU \| T2 finer ", done.output)
    done = articugen("evaluate", runs / "box", "-d", data, "--resolution", 8)
    assert "T2 finer" not in done.output
    assert done.exit_code == 0, done.output
    assert "T2 label IoU" in done.output
    result = json.loads((runs / "box" / "000" / "evaluation" / "evaluation.json").read_text())
    assert (result["objects"], result["instances"]) == (1, 2)
    with Image.open(runs / "box" / "000" / "evaluation" / "reconstructions.png") as picture:
        assert min(picture.size) > 200
    done = articugen("evaluate", runs / "box", "-d", data, "--resolution", 8, "--on", data, "-j", 1)
    assert done.exit_code == 0, done.output
    assert f"3 objects of {data}, 6 instances" in done.output  # two of them trained on
    for figure in ("reconstructions", "interpolations"):
        assert (runs / "box" / "000" / "evaluation-on-data" / f"{figure}.png").is_file()
    others = ("--resolution", 8, "--no-figures", "-j", 3, "--on", data, "--on")
    shutil.copytree(data, folder / "again")
    done = articugen("evaluate", runs / "box", "-d", data, *others, folder / "again")
    assert done.exit_code == 0, done.output
    first, again = (runs / "box" / "000" / f"evaluation-on-{name}" for name in ("data", "again"))
    assert (again / "evaluation.md").read_text().count("\n| box-") == 3
    measures = [json.loads((f / "evaluation.json").read_text())["measures"] for f in (first, again)]
    assert measures[0] == measures[1]  # one object or three at a time
    done = articugen("evaluate", runs / "box", "-d", data, *others, data)
    assert done.exit_code == 2
    assert "two of the data sets have one name" in done.output
    done = articugen("evaluate", runs / "box", "-d", data, *others, folder / "gone")
    assert done.exit_code == 1
    assert str(folder / "gone") in done.output
    assert " instances. " not in done.output  # refused before the first is measured
    done = articugen("tables", runs / "box")
    assert done.exit_code == 0, done.output
    assert re.search(r"\| tiny +\| +\d+\.\d\d \|", done.output)
    drawn = []
    (folder / "sets").mkdir()
    (folder / "sets" / "box").symlink_to(data)
    for given in ((), ("--data", folder / "sets")):
        drawn.append(folder / f"examples-{len(given)}.png")
        done = articugen("tables", runs / "box", "--figure", drawn[-1], *given)
        assert done.exit_code == 0, done.output
        assert "drawn: " in done.output
    assert drawn[0].read_bytes() == drawn[1].read_bytes()
    assert articugen("tables", runs / "box", "--data", data).exit_code == 2
    assert articugen("train-all", data, "--budget", "inf").exit_code == 2
    for wrong, said in (
        (("--figure", folder / "none" / "x.png"), "x.png: not written"),
        (("--figure", drawn[0], "--data", folder / "none"), "none/manifest.json"),
    ):
        done = articugen("tables", runs / "box", *wrong)
        assert done.exit_code == 1
        assert said in done.output.replace("\n", "")
    shard = data / "test-00002.h5"
    done = articugen("predict", runs / "box", shard, "--out", folder / "rig", "--resolution", 16)
    assert done.exit_code in (0, 1), done.output
    assert (done.exit_code == 0) == (folder / "rig" / "predicted.urdf").is_file()


def test_an_evaluation_bears_the_data_set_s_name_wherever_one_stands(folder, monkeypatch):
    monkeypatch.chdir(folder / "data")
    assert evaluation_folder("../runs/box", on=".").name == "evaluation-on-data"


def test_an_evaluation_on_another_data_set_of_the_name_stays(folder):
    data, other = folder / "data", folder / "other" / "data"
    shutil.copytree(data, other)
    base = ("evaluate", folder / "runs" / "box", "-d", data, "--resolution", 8, "--no-figures")
    assert articugen(*base, "--on", data).exit_code == 0
    done = articugen(*base, "--on", other)
    assert done.exit_code == 1
    assert f"evaluation-on-data: is of {data}; move it away" in done.output.replace("\n", "")
    assert articugen(*base, "--on", data).exit_code == 0


def test_seeds_race_and_a_race_resumes(folder):
    data, runs = folder / "data", folder / "race"
    base = ("train", "-c", "box", "-d", data, "-r", folder / "tiny.yaml", "--runs", runs, "-j", 1)
    done = articugen(*base, "--seeds", 2, "--seed", 3)
    assert done.exit_code == 0, done.output
    assert "seed 3: 3/3 held-out objects: rec 0." in done.output
    told = json.loads((runs / "box" / "000" / "race.json").read_text())
    assert told["winner"] in (3, 4)
    done = articugen(*base, "--resume", runs / "box" / "000")
    assert done.exit_code == 0, done.output
    assert json.loads((runs / "box" / "000" / "race.json").read_text()) == told


def test_several_data_sets_are_learned_from_together(folder, tmp_path):
    data, runs = folder / "data", tmp_path / "runs"
    other = write_boxes(tmp_path / "other", train=2, test=0, states=1, first=10)
    base = ("train", "-c", "box", "-d", data, "-r", folder / "tiny.yaml", "--runs", runs)
    done = articugen(*base, "-d", other)
    assert done.exit_code == 0, done.output
    run = runs / "box" / "000"
    told = json.loads((run / "run.json").read_text())["data"]
    assert (told["folder"], told["also"][0]["folder"]) == (str(data), str(other))
    assert articugen(*base, "-d", other, "--resume", run).exit_code == 0
    few = ("--resolution", 8, "--no-figures")
    assert articugen("evaluate", run, "-d", data, *few).exit_code == 0
    done = articugen(*base, "--resume", run)
    assert done.exit_code == 1
    assert "was started on other data" in " ".join(done.output.split())


@pytest.mark.usefixtures("few_pictures")
def test_depth_input_and_the_release_s_protocol(folder, monkeypatch):
    monkeypatch.chdir(folder)
    data, run = folder / "data", folder / "runs-depth" / "box" / "000"
    few = ("--set", "schedule.stages=[{resolution: 1, iterations: 2}]", "--set", "schedule.batch=2")
    done = articugen("train-depth", folder / "runs" / "box", "-d", data, *few, "--seed", 3)
    assert done.exit_code == 0, done.output
    assert json.loads((run / "run.json").read_text())["seed"] == 3
    assert "2/2 held-out objects: latent" in done.output
    again = ("train-depth", folder / "runs" / "box", "-d", data, "--resume", run)
    assert articugen(*again, *few).exit_code == 0
    assert articugen(*again).exit_code == 0  # its own recipe holds
    other = articugen(*again, "-r", "ppd_depth")
    assert "was started with another recipe" in " ".join(other.output.split())
    rough = ("--resolution", 8, "--states", 1)
    done = articugen("evaluate", run, "-d", data, *rough, "--protocol", "release")
    assert done.exit_code == 0, done.output
    assert "as the authors' release does; left out" in done.output
    assert "| ppd_depth_quick, depth |" in done.output
    result = json.loads((run / "evaluation-release" / "evaluation.json").read_text())
    assert (result["run"]["input"], result["run"]["method"]) == ("depth", "ppd_depth")
    drawn = draw(run, data, RunEvaluation.model_validate_json(json.dumps(result)))
    assert {path.parent.name for path in drawn} == {"evaluation-release"}
    rig = ("--camera", 1, "--out", folder / "rig-depth", "--resolution", 16)
    done = articugen("predict", run, data / "test-00002.h5", *rig)
    assert (done.exit_code, "sees no surface" in done.output) in ((0, False), (1, True))
    done = articugen("predict", run, data / "test-00002.h5", "--camera", 9)
    assert "has 2 cameras, from 0; there is no 9" in " ".join(done.output.split())


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    """Clouds and data sets that something is wrong with."""
    bad = tmp_path_factory.mktemp("bad")
    cloud = np.random.default_rng(0).uniform(-0.4, 0.4, (100, 3))
    np.savetxt(bad / "ten.xyz", cloud[:10])
    np.savetxt(bad / "far.xyz", 100 * cloud)
    cloud[4, 2] = np.nan
    np.savetxt(bad / "nan.xyz", cloud)
    write_boxes(bad / "trained", train=1, test=0, states=1)
    write_boxes(bad / "other", train=1, test=1, states=1, category="jar")
    return bad


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("train", "-c", "oven", "-d", "{data}"), "holds box, not oven"),
        (("train", "-c", "box", "-d", "{data}", "-r", "ppd_papre"), "did you mean 'ppd_paper'"),
        (
            ("train", "-c", "box", "-d", "{data}", "--set", "schedule.batches=3"),
            "--set schedule.batches=3: unknown key 'schedule.batches'; did you mean 'batch'?",
        ),
        (("train", "-c", "box", "-d", "{data}", "--device", "cuda:9"), "torch sees no such device"),
        (("train", "-c", "box", "-d", "{bad}/none"), "none/manifest.json"),
        (("evaluate", "{data}", "-d", "{data}"), "holds no run"),
        (("evaluate", "{run}", "-d", "{data}", "--protocol", "mine"), "paper or release"),
        (("evaluate", "{run}", "-d", "{bad}/trained"), "has no object in split 'test'"),
        (("evaluate", "{run}", "-d", "{bad}/other"), "holds jar, the model is of box"),
        (
            ("train", "-c", "box", "-d", "{data}", "--resume", "{run}", "-r", "ppd_paper"),
            "was started with another recipe; leave out --recipe and --set",
        ),
        (
            ("train", "-c", "box", "-d", "{bad}/trained", "--resume", "{run}"),
            "was started on other data",
        ),
        (("predict", "{run}", "{bad}/ten.xyz"), "has 10 points, too few"),
        (("predict", "{run}", "{bad}/nan.xyz"), "1 points are not finite"),
        (("predict", "{run}", "{bad}/far.xyz"), "--fit brings it there"),
        (("predict", "{run}", "{bad}/none.ply"), "cannot be read"),
        (("predict", "{run}", "{data}/test-00002.h5", "--row", "9"), "there is no 9"),
        (("predict", "{run}", "{data}/manifest.json"), "neither a shard"),
        (("train-depth", "{run}", "-d", "{bad}/other"), "holds jar, not box"),
    ],
)
def test_mistakes_are_said_in_one_sentence(folder, bad, arguments, said):
    where = {"data": folder / "data", "run": folder / "runs" / "box", "bad": bad}
    if "--resume" in arguments:
        where["run"] /= "000"
    filled = [a.format(**where) for a in arguments]
    done = articugen(*filled, *(("--runs", folder / "none") if filled[0] == "train" else ()))
    assert done.exit_code == 1
    assert said in " ".join(done.output.split())
    assert "Traceback" not in done.output
