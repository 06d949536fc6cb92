"""Races of seeds: who goes on, and that neither processes nor interruptions decide it."""

import json
import os
import re
import shutil
import signal

import pytest
from digests import same_state
from learners import tiny
from ppd_data import write_boxes
from test_workers import children

from articugen.core.errors import InvalidCheckpoint, InvalidRecipe, TrainingDiverged, UnfitData
from articugen.core.yaml_files import with_settings
from articugen.learning import commands
from articugen.learning import race as race_module
from articugen.learning.loop import Training, train
from articugen.learning.method import load_recipe
from articugen.learning.race import RACE, best_half, race
from articugen.learning.recipe import DataSettings, Seeds
from articugen.learning.run_folder import BEST, LATEST, METRICS, read_checkpoint

BOXES = {"train": 3, "test": 1, "states": 2}

TINY = tiny(
    {"surface_points": 100, "grid_points": 100}, (8, 6), batch=3, learning_rate=1e-3,
    validate_every=2, losses={"adv_g": 0.0}, seeds={"count": 3, "halve_at": [2, 4]},
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(boxes, tmp_path_factory):
    """A race that nothing interrupted, in this process."""
    return race(Training(TINY, "box", boxes, tmp_path_factory.mktemp("race"), seed=1))


def told(run) -> dict:
    return json.loads((run.path / RACE).read_text())


def test_the_worse_half_drops_out_and_the_best_is_kept(whole):
    rounds = told(whole)["rounds"]
    assert [r["iteration"] for r in rounds] == [2, 4, 6]
    assert [len(r["validation"]) for r in rounds] == [3, 2, 1]
    assert set(rounds[0]["validation"]) == {"1", "2", "3"}
    for r in rounds:
        by_loss = sorted(r["validation"], key=lambda seed: r["validation"][seed]["rec"])
        assert r["go_on"] == [int(seed) for seed in by_loss[: len(r["go_on"])]]
    winner = told(whole)["winner"]
    assert [winner] == rounds[-1]["go_on"]
    for name in (LATEST, BEST, METRICS):
        own = whole.path / "seeds" / str(winner) / name
        assert (whole.path / name).read_bytes() == own.read_bytes()
    assert read_checkpoint(whole.path / LATEST).seed == winner
    assert read_checkpoint(whole.path / LATEST).iteration == 6


def test_the_winner_is_what_its_seed_alone_would_be(boxes, whole, tmp_path):
    winner = told(whole)["winner"]
    alone = train(Training(TINY, "box", boxes, tmp_path, seed=winner))
    assert same_state(alone, whole)


def test_processes_change_nothing(boxes, whole, tmp_path):
    """Not even one that is killed, of which one reads at once."""
    heard = []

    def kill_once(progress):
        heard.append(progress)
        if progress.who and not any(p.who for p in heard[:-1]):
            os.kill(children(os.getpid(), 2)[0], signal.SIGKILL)

    run = race(Training(TINY, "box", boxes, tmp_path, seed=1), jobs=2, on_progress=kill_once)
    assert told(run) == told(whole)
    assert same_state(run, whole)
    assert {p.who for p in heard} == {"", "seed 1", "seed 2", "seed 3"}
    (lost,) = [p.said for p in heard if "worker" in p.said]
    assert re.match(r"a worker was killed .* at seed \d, which is tried once more at the end", lost)


def test_an_interrupted_race_goes_on(boxes, whole, tmp_path):
    def interrupt(progress):
        if (progress.who, progress.iteration) == ("seed 2", 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        race(Training(TINY, "box", boxes, tmp_path, seed=1), on_progress=interrupt)
    seen = []
    path = tmp_path / "000"
    run = race(
        Training(TINY, "box", boxes, tmp_path, seed=1, resume=path),
        on_progress=lambda p: seen.append((p.who, p.iteration)),
    )
    assert told(run) == told(whole)
    assert same_state(run, whole)
    assert ("seed 1", 1) not in seen  # the first seed's first heat was done
    other = with_settings(TINY, ["seeds.count=2"])
    with pytest.raises(InvalidCheckpoint, match="another recipe"):
        race(Training(other, "box", boxes, tmp_path, seed=1, resume=path))


def test_a_race_that_is_over_resumes_to_itself(boxes, whole, tmp_path):
    assert told(whole)["winner"] != 1, "whose checkpoint is of another seed than the race"
    shutil.copytree(whole.path, tmp_path / "000")
    (tmp_path / "000" / BEST).unlink()  # as if it was killed after the first copy
    again = commands.train(boxes, resume=tmp_path / "000", jobs=1)
    assert told(again) == told(whole)
    assert same_state(again, whole)


def test_a_seed_that_dropped_out_goes_on_alone(boxes, whole, tmp_path):
    shutil.copytree(whole.path, tmp_path / "000")
    (loser,) = set("123") - set(told(whole)["rounds"][1]["validation"])
    path = tmp_path / "000" / "seeds" / loser
    before = read_checkpoint(path / LATEST)
    run = commands.train(boxes, resume=path)
    assert (before.iteration, read_checkpoint(path / LATEST).iteration) == (2, 6)
    assert same_state(run, train(Training(TINY, "box", boxes, tmp_path, seed=int(loser))))
    assert not (path / RACE).exists()
    assert told(commands.train(boxes, resume=tmp_path / "000", jobs=1)) == told(whole)


def test_a_seed_that_diverges_loses(boxes, tmp_path, monkeypatch):
    def train_or_diverge(what, **options):
        if what.seed in bad:
            raise TrainingDiverged("no number")
        return train(what, **options)

    monkeypatch.setattr(race_module, "train", train_or_diverge)
    bad = {0, 1}
    run = race(Training(TINY, "box", boxes, tmp_path))
    assert told(run)["rounds"][0]["validation"]["0"] is None
    assert told(run)["winner"] == 2
    bad = {0, 1, 2}
    with pytest.raises(TrainingDiverged, match="all seeds diverged before iteration 2"):
        race(Training(TINY, "box", boxes, tmp_path))


def test_data_that_cannot_be_learnt_from_leave_no_run(tmp_path):
    data = write_boxes(tmp_path / "data", train=2, test=0, states=0)
    settings = DataSettings(surface_points=100, grid_points=100, varying_points=20)
    warm_start = TINY.warm_start.model_copy(update={"groups": "given"})
    recipe = TINY.model_copy(update={"data": settings, "warm_start": warm_start})
    with pytest.raises(UnfitData, match="holds one pose of box-0"):
        race(Training(recipe, "box", data, tmp_path / "runs"))
    assert not (tmp_path / "runs").exists()


def test_half_goes_on():
    score = {s: {"rec": float(r)} for s, r in enumerate((5, 1, 4, 1, 3))}
    assert best_half(score, last=False) == [1, 3, 4]
    assert best_half(score, last=True) == [1]
    assert best_half(score | {1: None, 3: None, 0: None, 4: None}, last=False) == [2]
    assert best_half(score | {1: {"rec": float("nan")}}, last=True) == [3]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"data": DataSettings(validation_objects=0)}, "validation_objects"),
        ({"seeds": Seeds(count=2, halve_at=(3,))}, "multiples of schedule.validate_every"),
        ({"seeds": Seeds(count=2, halve_at=(4, 2))}, "ascending"),
        ({"seeds": Seeds(count=2, halve_at=(6,))}, "before the last iteration"),
    ],
)
def test_seeds_that_cannot_be_compared_are_refused(change, said):
    bad = TINY.model_copy(update=change)
    with pytest.raises(InvalidRecipe, match=said):
        with_settings(bad, ["seeds.count=2"])
    assert with_settings(bad, ["seeds.count=1"]).seeds.count == 1


@pytest.mark.parametrize(("name", "choice"), [("ppd_quick", "rec or moved"), ("nsd", "left out")])
def test_seeds_are_chosen_by_what_their_method_measures(name, choice):
    with pytest.raises(InvalidRecipe, match=f"chosen_by must be {choice} in recipes of "):
        load_recipe({"extends": name, "seeds": {"chosen_by": "iuo"}})


def test_of_one_object_a_single_seed_is_trained(tmp_path):
    data = write_boxes(tmp_path / "box", train=1, test=1, states=2)
    run = commands.train(data, TINY, runs=tmp_path / "runs")
    assert read_checkpoint(run.path / LATEST).iteration == 6
    assert not (run.path / RACE).exists()
