"""Run folders are believed only as they were written: each kind of damage is one sentence."""

import dataclasses
import json
import shutil
from contextlib import suppress
from pathlib import Path

import command_line
import numpy as np
import pytest
import safetensors.torch as safetensors
import torch
import yaml
from digests import same_state
from learners import tiny
from test_report import result
from trouble import unfit

from articugen.core.errors import ArticugenError, InvalidCheckpoint, MachineFault
from articugen.core.files import locked, partial_name
from articugen.evaluation.results import read_evaluation
from articugen.learning import sealed as files
from articugen.learning.commands import newest
from articugen.learning.loop import Training, train
from articugen.learning.run_folder import FORMAT, LATEST, METRICS, RunFolder, read_checkpoint
from articugen.learning.sealed import image_of, sealed
from articugen.learning.tensors import in_numpy, read_tensors

BOXES = {"train": 2, "test": 1, "states": 1}

TINY = tiny(
    {"surface_points": 100, "grid_points": 50}, (8, 3), batch=2, validate_every=1, save_every=1
)


@pytest.fixture(scope="module")
def sound(boxes, tmp_path_factory):
    """A run that was stopped after two iterations. Look, do not touch."""
    runs = tmp_path_factory.mktemp("runs")
    return train(Training(TINY, "box", boxes, runs), stop_after=2).path


@pytest.fixture
def run(sound, tmp_path):
    """A copy of it to do harm to."""
    return RunFolder(Path(shutil.copytree(sound, tmp_path / "run")))


def refused(read, *arguments) -> str:
    """The one sentence."""
    with pytest.raises(InvalidCheckpoint) as caught:
        read(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_sealed_file_is_ordinary_safetensors(sound):
    """Any reader opens it without us."""
    weights = safetensors.load_file(sound / LATEST)
    point = read_checkpoint(sound / LATEST)
    assert point.iteration == 2
    for name, value in point.state["model"].items():
        assert torch.equal(weights[f"state/model/{name}"], value)


def test_every_flipped_bit_is_found(run):
    path, rng = run.path / LATEST, np.random.default_rng(5)
    size, header = path.stat().st_size, int.from_bytes(path.read_bytes()[:8], "little")
    places = {*rng.integers(size, size=40).tolist(), 0, 7, 8, 30, 36, 37, 100, 101, size - 1}
    places |= set(rng.integers(header, size=20).tolist())
    with path.open("r+b") as file:
        for place in sorted(places):
            file.seek(place)
            (before,) = file.read(1)
            for byte in (before ^ 1 << int(rng.integers(8)), before):
                if byte == before:
                    assert str(path) in refused(read_tensors, path, FORMAT), place
                file.seek(place)
                file.write(bytes([byte]))
                file.flush()
    assert read_tensors(path, FORMAT)


@pytest.mark.parametrize("kept", [0, 1, 21, 100, 5_000, -1, -71, -1_000])
def test_checkpoints_that_are_cut_short(run, kept):
    path = run.path / LATEST
    path.write_bytes(path.read_bytes()[:kept])
    assert f"{path}: " in refused(read_checkpoint, path)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
@pytest.mark.parametrize("part", ["model", "discriminator", "adam"])
def test_weights_that_are_not_finite(run, part, number):
    point = read_checkpoint(run.path / LATEST)
    values = point.state[part]
    tensor = next(iter((values["exp_avg"] if part == "adam" else values).values()))
    tensor.view(-1)[0] = number
    point.write(run.path / LATEST)
    assert "not finite" in refused(read_checkpoint, run.path / LATEST)


def test_a_loss_that_is_no_number(run):
    point = read_checkpoint(run.path / LATEST)
    dataclasses.replace(point, best=float("inf")).write(run.path / LATEST)  # none was measured
    assert read_checkpoint(run.path / LATEST).best == float("inf")
    dataclasses.replace(point, best=float("nan")).write(run.path / LATEST)
    assert "not a checkpoint, or damaged" in refused(read_checkpoint, run.path / LATEST)


def changed(key: str, change):
    """A checkpoint with another value in its learner's state."""
    return lambda d: d | {"state": d["state"] | {key: change(d["state"][key])}}


def rewritten(path: Path, change) -> None:
    """A checkpoint of other content, with its digest right: whoever can compute one can write
    anything."""
    data = {"format": FORMAT, **read_tensors(path, FORMAT)}
    path.write_bytes(sealed(image_of(in_numpy(change(data)))))


@pytest.mark.parametrize(
    "change",
    [
        lambda d: {},
        lambda d: d | {"format": "other"},
        lambda d: {k: v for k, v in d.items() if k != "recipe"},
        lambda d: {k: v for k, v in d.items() if k != "state"},
        lambda d: d | {"more": 1},
        lambda d: d | {"recipe": None},
        lambda d: d | {"recipe": {"name": "x", "colour": "red"}},
        lambda d: d | {"recipe": {"name": "x", "model": {"codes": 10**12}}},  # 16 TB of weights
        lambda d: d | {"iteration": "2"},
        lambda d: d | {"iteration": True},
        lambda d: d | {"iteration": -1},
        lambda d: d | {"iteration": 4},
        lambda d: d | {"seed": 0.5},
        lambda d: d | {"category": None},
        lambda d: d | {"best": None},
        lambda d: d | {"recipe": d["recipe"] | {"method": "other"}},
        lambda d: d | {"recipe": d["recipe"] | {"method": []}},
        lambda d: d | {"state": None},
        lambda d: d | {"state": {}},
        lambda d: d | {"state": [1]},
        lambda d: d | {"state": d["state"] | {"more": 1}},
        lambda d: d | {"state": d["state"] | {1: 1}},
        changed("iteration", lambda _: "2"),
        changed("iteration", lambda _: True),
        changed("model", lambda _: None),
        changed("model", lambda _: {}),
        changed("model", dict.fromkeys),
        changed("model", lambda model: {k: v.double() for k, v in model.items()}),
        changed("model", lambda model: {k: v[None] for k, v in model.items()}),
        lambda d: d | {"state": d["state"] | {"discriminator": d["state"]["model"]}},
        changed("adam", lambda _: {}),
        changed("adam", lambda adam: adam | {"step": {}}),
        changed("adam", lambda adam: adam | {"exp_avg": dict.fromkeys(adam["exp_avg"], 0.0)}),
        lambda d: d | {"state": d["state"] | {"adam": d["state"]["discriminator_adam"]}},
        lambda d: d | {"best": torch.zeros(3)},
        lambda d: d | {"best": [[[[{}]]]]},
        lambda d: d | {"best/x": torch.zeros(3)},  # below what is no dict
        lambda d: d | {"nowhere/x": torch.zeros(3)},
        lambda d: d | {"state": d["state"] | {"model/pose.common_euler": torch.zeros(3)}},
    ],
)
def test_sealed_nonsense_is_one_sentence(run, change):
    path = run.path / LATEST
    rewritten(path, change)
    assert f"{path}: " in refused(read_checkpoint, path)


@pytest.mark.parametrize(
    "change",
    [
        lambda header: b"",
        lambda header: b"{",
        lambda header: header.replace(b'\\"iteration\\": 2', b'\\"iteration\\": NaN'),
        lambda header: header.replace(b'{\\"format', b"[" * 50_000 + b'{\\"format'),
        lambda header: header.replace(b"F32", b"F99", 1),
        lambda header: header.replace(b'data_offsets":[0', b'data_offsets":[8', 1),
        lambda header: header.replace(b'"shape":[', b'"shape":[1099511627776,', 1),
        lambda header: header[:-1] + b',"x":5}',
    ],
)
def test_sealed_headers_may_hold_anything(run, change):
    path = run.path / LATEST
    image = path.read_bytes()
    end = 8 + int.from_bytes(image[:8], "little")
    header = change(image[8:end].rstrip())
    assert header != image[8:end].rstrip()
    image = len(header).to_bytes(8, "little") + header + image[end:]
    with suppress(ValueError):
        image = sealed(image)
    path.write_bytes(image)
    assert f"{path}: " in refused(read_checkpoint, path)


def test_a_recipe_that_is_refused_by_now_says_why_and_how_to_go_on(run):
    path = run.path / LATEST
    wrong = {"revolute": []}
    model = lambda d: d["recipe"]["model"] | wrong  # noqa: E731
    rewritten(path, lambda d: d | {"recipe": d["recipe"] | {"model": model(d)}})
    said = refused(read_checkpoint, path)
    assert said.startswith(f"{path}: its recipe: ")
    assert said.endswith("; train it again")


@pytest.mark.parametrize("kind", ["FIFO", "folder", "too large", "absent"])
def test_kind_and_size_of_a_checkpoint_are_looked_at_first(tmp_path, kind, monkeypatch):
    path = tmp_path / LATEST
    unfit(path, kind, files.MOST_BYTES)
    assert f"{path}: " in refused(read_checkpoint, path)


# The other files.

NESTED = "[" * 100_000


@pytest.mark.parametrize(
    "text",
    ["", "{", "null", "5", "[]", "{}", "NaN", NESTED, '{"a":' * 10_000, "9" * 5_000, "\0",
     {"seed": "0"}, {"seed": 0.5}, {"seed": None}, {"seed": True}, {"category": 1}, {"more": 1},
     {"recipe_sha256": "x"}, {"data": None}, {"data": {}}, {"machine": {"cores": float("nan")}},
     {"data": {"folder": "x", "content_sha256": 5}}],
)  # fmt: skip
def test_run_json_may_hold_anything(run, text):
    path = run.path / "run.json"
    about = json.loads(path.read_text())
    path.write_text(json.dumps(about | text) if isinstance(text, dict) else text)
    assert f"{path}: damaged (" in refused(run.about)
    assert f"{path}: " in refused(run.recipe)
    path.write_bytes(b"\xff\xfe")
    assert f"{path}: " in refused(run.about)
    path.unlink()
    assert "cannot be read" in refused(run.about)


@pytest.mark.parametrize(
    "text",
    ["", "- 1", "5", "a: [", NESTED[:500], "a: " * 3_000, "\0", "name: x", "extends: ppd_quick",
     "schedule: {batch: .nan}", "name: 2001-99-99", "seed: " + "9" * 5_000],
)  # fmt: skip
def test_recipe_yaml_may_hold_anything(run, text):
    path = run.path / "recipe.yaml"
    path.write_text(text)
    assert f"{path}: " in refused(run.recipe)


def test_a_recipe_that_was_edited_is_refused(run):
    path = run.path / "recipe.yaml"
    recipe = yaml.safe_load(path.read_text())
    recipe["losses"]["vol"] = 7.0
    path.write_text(yaml.safe_dump(recipe))
    assert "not the recipe that the run was started with" in refused(run.recipe)


@pytest.mark.parametrize(
    "line",
    ["", "null", "5", "[]", "{}", "NaN", NESTED, "\0", '{"iteration": "1"}', '{"iteration": NaN}',
     '{"iteration": -1}', '{"iteration": 1.5}', '{"iteration": 1, "terms": 5}',
     '{"iteration": 1, "validation": {"rec": "x"}}', '{"iteration": 1, "more": 1}',
     '{"iteration": ' + "9" * 5_000 + "}", '{"iteration": 1'],
)  # fmt: skip
def test_metrics_may_hold_anything(run, line):
    path = run.path / METRICS
    path.write_text('{"iteration": 1, "terms": {"rec": 0.5}}\n' + line + '\n{"iteration": 2}\n')
    assert f"{path}: line 2: damaged (" in refused(run.metrics)


def test_a_last_line_that_was_cut_short_is_none(run, boxes):
    """And the run goes on after it with whole lines."""
    path = run.path / METRICS
    before = run.metrics()
    for cut in (1, 10):
        path.write_bytes(path.read_bytes()[:-cut])
        assert run.metrics() == before[:-1]
    again = train(Training(TINY, "box", boxes, run.path.parent, resume=run.path))
    lines = path.read_text().splitlines()
    assert all(json.loads(line)["iteration"] for line in lines)
    assert again.metrics()[-1]["iteration"] == 3


def test_what_was_measured_may_be_no_number(run):
    run.log({"iteration": 3, "validation": {"rec": float("nan")}})
    assert np.isnan(run.metrics()[-1]["validation"]["rec"])


def test_a_full_disk_is_a_fault_of_the_machine(run, monkeypatch):
    (run.path / METRICS).unlink()
    (run.path / METRICS).symlink_to("/dev/full")
    with pytest.raises(MachineFault, match="the disk is full"):
        run.log({"iteration": 3})


def test_what_a_killed_process_left_is_removed(run):
    left = [partial_name(LATEST), partial_name("run.json")]
    for name in [*left, partial_name("mine.txt"), ".latest.safetensors.partial"]:
        (run.path / name).write_bytes(b"half")
    RunFolder.existing(run.path)
    rest = {p.name for p in run.path.iterdir()}
    assert not rest & set(left)
    assert ".latest.safetensors.partial" in rest
    assert sum(name.startswith(".mine.txt.") for name in rest) == 1


def test_a_run_that_was_killed_before_its_first_checkpoint_goes_on(boxes, tmp_path):
    whole = train(Training(TINY, "box", boxes, tmp_path / "whole"))
    killed = tmp_path / "killed"
    killed.mkdir()
    for name in ("recipe.yaml", "run.json"):
        shutil.copy(whole.path / name, killed)
    (killed / METRICS).write_text('{"iteration": 1, "terms": {"rec": 0.5}}\n{"itera')
    done = train(Training(TINY, "box", boxes, tmp_path, resume=killed))
    assert same_state(whole, done)
    assert [r["iteration"] for r in done.metrics()] == [r["iteration"] for r in whole.metrics()]


def test_a_folder_whose_making_was_cut_short_is_no_run(boxes, tmp_path):
    (tmp_path / "004").mkdir()
    (tmp_path / "004" / "recipe.yaml").write_text("name: tiny\n")
    done = train(Training(TINY, "box", boxes, tmp_path), stop_after=1)
    assert done.path.name == "005"
    (tmp_path / "006").mkdir()
    assert newest(tmp_path) == done.path


def test_two_do_not_train_in_one_folder(run, boxes):
    busy = pytest.raises(ArticugenError, match="another run is writing here; wait for it")
    with locked(run.path), busy:
        train(Training(TINY, "box", boxes, run.path.parent, resume=run.path))


def test_runs_with_other_names_are_no_numbers(boxes, tmp_path):
    (tmp_path / "²").mkdir()  # a digit, says Python, but no number
    made = train(Training(TINY, "box", boxes, tmp_path), stop_after=1)
    assert made.path.name == "000"


@pytest.mark.parametrize(
    "change",
    [
        lambda r: [],
        lambda r: None,
        lambda r: {},
        lambda r: r | {"run": None},
        lambda r: r | {"run": r["run"] | {"label_poses": "some"}},
        lambda r: r | {"run": {k: v for k, v in r["run"].items() if k != "variant"}},
        lambda r: r | {"means": {"label_iou": "x"}},
        lambda r: r | {"means": {"label_iou": float("nan")}},
        lambda r: r | {"means": None},
        lambda r: NESTED,
    ],
)
def test_evaluations_may_hold_anything(tmp_path, change):
    path = tmp_path / "evaluation" / "evaluation.json"
    path.parent.mkdir()
    path.write_text(result().model_dump_json())
    assert read_evaluation(tmp_path) == result()
    changed = change(result().model_dump(mode="json"))
    path.write_text(changed if isinstance(changed, str) else json.dumps(changed))
    told = refused(read_evaluation, tmp_path)
    assert f"{path}: not an evaluation (" in told
    assert f"make it with: articugen evaluate {tmp_path}" in told


@pytest.mark.parametrize("name", [LATEST, "run.json", "recipe.yaml", METRICS])
def test_commands_refuse_a_damaged_run_in_one_sentence(run, boxes, name):
    path = run.path / name
    data = path.read_bytes()
    place = len(data) // 2
    harm = b"\0" if data[place] else b"\1"
    path.write_bytes(data[:place] + harm + data[place + 1 :])
    commands = {
        "train": ("-c", "box", "-d", boxes, "--resume", run.path),
        "train-depth": (run.path, "-d", boxes, "--runs", run.path.parent),
        "predict": (run.path, boxes / "test-00002.h5"),
        "evaluate": (run.path, "-d", boxes, "--no-figures", "--resolution", 8),
    }
    reads = {
        LATEST: set(commands),
        "run.json": {"train", "train-depth"},
        "recipe.yaml": {"train", "train-depth"},
        METRICS: {"train"},
    }
    for command in sorted(reads[name]):
        done = command_line.run(command, *commands[command])
        assert done.exit_code == 1, (command, done.output)
        assert f"{path}: " in done.stderr.replace("\n", "")
        assert "Traceback" not in done.output
