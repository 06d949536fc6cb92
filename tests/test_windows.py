"""Training from a stream: held-out objects, resumed runs, whatever learns."""

import pickle
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import run as articugen

import articugen as ag
from articugen.core.errors import ArticugenError, InvalidArgument, InvalidCheckpoint

pytest.importorskip("torch", reason="learning needs torch")
from digests import resumed_exactly

from articugen.core.processes import Crew
from articugen.learning.data import windows
from articugen.learning.loop import Training, train
from articugen.learning.method import load_recipe
from articugen.learning.ppd.warm import found

ROWS = {
    "extends": "stream",
    "articulation": {"states": 3},
    "views": {"count": 24, "resolution": 64},
    "sampling": {
        "surface_points": 1024,
        "uniform_points": 64,
        "near_points": 64,
        "grids": [16, 32],
    },
}
STREAM = ag.stream("laptop", ROWS).for_training()
TINY = {
    "ppd_quick": {
        "data": {"surface_points": 256, "uniform_points": 32, "near_points": 32, "band_points": 16,
                 "varying_points": 16, "validation_objects": 1},
        "schedule": {"batch": 16, "log_every": 1, "validate_every": 2,
                     "stages": [{"resolution": 16, "iterations": 6}]},
        "seeds": {"count": 1},
    },
    "bae": {
        "data": {"surface_points": 256, "grid_points": 32, "band_points": 0},
        "model": {"widths": [32, 16], "branches": 4},
        "schedule": {"batch": 16, "stages": [{"resolution": 16, "iterations": 6}]},
    },
}  # fmt: skip


def training(name: str, runs: Path, **how: object) -> Training:
    recipe = load_recipe({"extends": name, **TINY[name]})
    what = Training(recipe, "laptop", STREAM, runs, window=2)
    return replace(what, **how)  # type: ignore[arg-type]


@pytest.fixture
def _here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything in this process: others take seconds to start."""
    monkeypatch.setattr(windows, "in_order", lambda f, some, **_: map(f, some))
    monkeypatch.setattr(found, "Crew", lambda f, **of: Crew(f, **{**of, "workers": 0}))


@pytest.mark.usefixtures("_here")
def test_a_stopped_run_goes_on_with_the_same_batches(tmp_path: Path) -> None:
    """In the midst of a window, and where one ends: two iterations are learned from each."""
    run = resumed_exactly(training("ppd_quick", tmp_path, window=1), 3)
    other = training("ppd_quick", tmp_path, resume=run.path, window=3)
    with pytest.raises(InvalidCheckpoint, match="started on other data than train laptop of pro"):
        train(other)


@pytest.mark.usefixtures("_here")
def test_objects_are_new_in_each_window_and_none_is_held_out(tmp_path: Path) -> None:
    some = pickle.loads(pickle.dumps(training("ppd_quick", tmp_path).windows))
    assert some.stay == 4
    names = [list(dict.fromkeys(w.object_id.tolist())) for w in some.since(3, lambda _: None)]
    held_out = set(some.held_out().object_id.tolist())
    train_ids = [ref.object_id for ref in STREAM.refs if ref.split == "train"]
    assert [*held_out] == train_ids[:1]
    assert names == [train_ids[1:3], train_ids[3:5]]


@pytest.mark.usefixtures("_here")
def test_other_methods_learn_from_a_stream(tmp_path: Path) -> None:
    few = ag.stream("box", ROWS, "procedural", states=1)
    run = ag.train(few, {"extends": "bae", **TINY["bae"]}, runs=tmp_path)
    assert run.metrics()[-1]["iteration"] == 6
    assert run.about()["category"] == "box"


def test_what_ends_or_is_twice_given_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.urdf").write_text("<robot")
    with pytest.raises(InvalidArgument, match="make a data set of them"):
        ag.train(ag.stream("box", ROWS, tmp_path), runs=tmp_path)
    for told in ((), ("--data", tmp_path, "--stream", "procedural")):
        done = articugen("train", "-c", "laptop", *told)
        assert done.exit_code == 2
        assert "--stream a source" in " ".join(done.output.split())
    less = ag.stream("laptop", {**ROWS, "sampling": {"grids": []}})
    with pytest.raises(ArticugenError, match="no grid of 64 or less"):
        ag.train(less, {"extends": "ppd_quick", "seeds": {"count": 1}}, runs=tmp_path)
