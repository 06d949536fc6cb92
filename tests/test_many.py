"""Seeds that learn at once learn what each of them learns alone."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from ppd_data import write_boxes

from articugen.core.errors import InvalidRecipe
from articugen.learning.method import find_method, load_recipe
from articugen.learning.ppd.settings import ModelSettings, PPDRecipe

torch = pytest.importorskip("torch", reason="PPD needs torch")

from articugen.learning.data.split import load_split
from articugen.learning.loop import train
from articugen.learning.ppd.learner import PPDLearner
from articugen.learning.ppd.many import Many
from articugen.learning.ppd.warm.targets import Targets
from articugen.learning.race import can_run_at_once, race
from articugen.learning.run_folder import (
    LATEST,
    METRICS,
    RunFolder,
    read_checkpoint,
)
from articugen.learning.tensors import check_like, digest
from articugen.learning.together import train_together

torch.set_num_threads(1)

META = torch.device("meta")
SEEDS = (3, 1)
FEW = {"surface_points": 150, "uniform_points": 60, "near_points": 60}
PLAN = {
    "batch": 3,
    "learning_rate": 1e-4,
    "final_learning_rate": 1e-5,
    "log_every": 1,
    "validate_every": 2,
    "save_every": 2,
    "stages": [
        {"resolution": 8, "iterations": 5},
        {"resolution": 16, "iterations": 3, "residual_direction": True},
    ],
}
"""8 iterations; the second stage begins anew after the fifth."""


def tiny(base: str = "ppd_plain", **sections: dict) -> PPDRecipe:
    """A small recipe with other values in some of its sections."""
    grid = {"grid_points": 60} if base == "ppd_paper" else {"grid_points": 0}
    own = {"data": FEW | grid | {"validation_objects": 0}, "schedule": PLAN, "seeds": {"count": 1}}
    for section, keys in sections.items():
        own[section] = own.get(section, {}) | keys
    recipe = load_recipe({"extends": base, "name": "tiny", **own})
    assert isinstance(recipe, PPDRecipe)
    return recipe


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    return write_boxes(tmp_path_factory.mktemp("boxes"), train=3, test=0, states=1)


def at_once(recipe, boxes, runs, *, stop, seeds=SEEDS, **more):
    told = {"category": "box", "data": boxes, "device": "cpu"}
    return train_together(recipe, **told, runs=runs, seeds=seeds, stop_after=stop, **more)


@pytest.fixture(scope="module")
def alone(boxes, tmp_path_factory):
    """Each seed by itself."""
    runs = tmp_path_factory.mktemp("alone")
    told = {"category": "box", "data": boxes, "runs": runs}
    return {seed: train(tiny(), seed=seed, name=str(seed), **told) for seed in SEEDS}


def check_same_curve(run: RunFolder, other: RunFolder, near: float) -> None:
    lines, others = run.metrics(), other.metrics()
    assert [line["iteration"] for line in lines] == [line["iteration"] for line in others]
    for line, wanted in zip(lines, others, strict=True):
        for name in ("stage", "learning_rate"):
            assert line.get(name) == wanted.get(name)
        for name in ("terms", "validation"):
            assert line.get(name, {}) == pytest.approx(wanted.get(name, {}), rel=near, abs=near)


def test_each_seed_draws_its_own_curve(boxes, alone, tmp_path):
    assert at_once(tiny(), boxes, tmp_path, stop=8) == set()
    for seed, run in alone.items():
        together = RunFolder(tmp_path / str(seed))
        check_same_curve(together, run, near=1e-3)
        assert together.recipe() == run.recipe()
        point = read_checkpoint(together.path / LATEST)
        assert (point.seed, point.iteration) == (seed, 8)
    assert len({digest(read_checkpoint(tmp_path / str(s) / LATEST).state) for s in SEEDS}) == 2


FORMS = {
    "release's": {},
    "paper's": {
        "losses": {"loc_form": "paper", "var_form": "paper", "vq_form": "norm", "dev_form": "paper"}
    },
    "without common pose": {"losses": {"vol_logit": "instance"}, "model": {"common_pose": False}},
    "Muon": {"schedule": {"optimiser": "muon"}},
    "SOAP": {"schedule": {"optimiser": "soap"}},
    "a warm start": {
        "model": {"part_boxes": True, "part_frame": "world"},
        "warm_start": {"share": 0.5},
        "data": {"varying_points": 20},
    },
    "varied, seen as a grid": {
        "model": {"part_boxes": True, "part_frame": "world", "encoder": "both"},
        "warm_start": {"share": 0.5},
        "vary": {"stretch": 0.3, "warp": 0.3, "shrink": 0.2, "mirror": True, "shift": True},
    },
    "in the world, few decisive points": {
        "model": {"part_frame": "world"},
        "data": {"surface_points": 500, "uniform_points": 30, "grid_points": 30},
    },
}


@pytest.mark.parametrize("name", FORMS)
def test_in_double_precision_there_is_no_difference(boxes, name):
    """Over both stages, handed out and stacked again in between. SOAP's first bases are any where a
    gradient's rank is not full: rounding chooses."""
    near = 2e-2 if name == "SOAP" else 1e-9
    recipe = tiny(**FORMS[name])
    alone, joined = (
        [PPDLearner(recipe, seed, torch.device("cpu")) for seed in SEEDS] for _ in range(2)
    )
    for learner in (*alone, *joined):
        learner.model.double()
        learner._begin_stage()  # optimisers of double precision too
    split = load_split(boxes, "train", alone[0].inputs, [8, 16])
    for learner in (*alone, *joined):
        learner.targets = some_targets(2 * len(split), recipe.model)
    team = Many(joined)
    for iteration in range(8):
        if iteration in (3, 6):
            team.hand_out()
            team = Many(joined)
        rngs = [torch.Generator().manual_seed(100 * iteration + s) for s in SEEDS]
        resolution = recipe.schedule.stage_at(iteration).resolution
        rows = [(iteration + k) % len(split) for k in range(6)]
        batch = double(split.batch(rows, alone[0].inputs, resolution, rngs))
        found = team.learn(batch, iteration=iteration)
        for s, learner in enumerate(alone):
            rng = torch.Generator().manual_seed(100 * iteration + SEEDS[s])
            own = split.batch(rows[3 * s : 3 * s + 3], learner.inputs, resolution, rng)
            wanted = learner.learn(double(own), rng, iteration=iteration)
            assert found.keys() == wanted.keys()
            for term, value in wanted.items():
                torch.testing.assert_close(found[term][s], value, rtol=near, atol=near)
    team.hand_out()
    assert team.diverged() == [False] * 2
    for one, other in zip(alone, joined, strict=True):
        wanted, state = one.state(), other.state()
        check_like(state, wanted, Path("handed out"))
        for weight, value in wanted["model"].items():
            torch.testing.assert_close(state["model"][weight], value, rtol=1e3 * near, atol=near)


def some_targets(instances: int, model: ModelSettings) -> Targets:
    """What a warm start might have found, though not in these boxes."""
    some, J = torch.Generator().manual_seed(0), model.joints

    def of(*shape: int) -> torch.Tensor:
        return torch.rand(instances, *shape, generator=some, dtype=torch.float64)

    R = 16
    return Targets(
        known=(of() > 0.3).double(),
        there=(of(J) > 0.5).double(),
        still=(of(J) > 0.5).double(),
        state=0.1 + 0.5 * of(J),
        axis=of(J, 3),
        pivot=of(J, 3) - 0.5,
        owns=(of(J + 1) > 0.5).double(),
        middle=of(J + 1, 3) - 0.5,
        size=0.1 + 0.4 * of(J + 1, 3),
        rotation=of(J + 1, 3, 3),
        offset=of(J + 1, 3) - 0.5,
        centre=0.1 * of(3),
        extent=0.5 + 0.4 * of(3),
        alike=torch.eye(3, dtype=torch.float64).repeat(instances, 1, 1),
        free=(of(3) > 0.5).double(),
        grid=(3 * of(J + 1)).long(),
        doubt=torch.rand(3, R**3, generator=some),
        cells=R,
    )


def double(batch):
    exact = {name: getattr(batch, name).double() for name in ("cloud", "points", "chance")}
    return replace(batch, **exact)


def test_they_go_on_alone_and_together_wherever_they_stand(boxes, alone, tmp_path):
    """Seed 3 is ahead of the others, as it is where a run was killed while it saved."""
    at_once(tiny(), boxes, tmp_path, stop=2)
    told = {"category": "box", "data": boxes, "runs": tmp_path}
    train(tiny(), seed=3, resume=tmp_path / "3", stop_after=4, **told)
    at_once(tiny(), boxes, tmp_path, stop=8)
    for seed, run in alone.items():
        check_same_curve(RunFolder(tmp_path / str(seed)), run, near=1e-3)


def test_one_that_diverges_spoils_no_other(boxes, alone, tmp_path):
    """Seed 1's optimiser is about to throw its weights far away."""
    at_once(tiny(), boxes, tmp_path, stop=2)
    point = read_checkpoint(tmp_path / "1" / LATEST)
    for value in point.state["adam"]["exp_avg"].values():
        value.fill_(1e38)
    point.write(tmp_path / "1" / LATEST)
    assert at_once(tiny(), boxes, tmp_path, stop=8) == {1}
    assert read_checkpoint(tmp_path / "1" / LATEST).iteration == 2
    check_same_curve(RunFolder(tmp_path / "3"), alone[3], near=1e-3)


def test_a_race_at_once_is_the_race_one_by_one(boxes, tmp_path, monkeypatch):
    monkeypatch.setattr("articugen.learning.ppd.learner.VALIDATION_GRID", 8)
    plan = {"stages": PLAN["stages"][1:], "validate_every": 1}  # of 3 iterations
    some = {"data": {"validation_objects": 1}, "schedule": plan}
    recipe = tiny(**some, seeds={"count": 2, "halve_at": [1]})
    told = {"category": "box", "data": boxes, "seed": 1}
    plain = race(recipe, runs=tmp_path / "plain", **told)
    early = race(recipe, runs=tmp_path / "once", **told, at_once=True, stop_after=1)
    assert len(json.loads((early.path / "race.json").read_text())["rounds"]) == 1
    assert not (early.path / LATEST).exists()
    once = race(recipe, runs=tmp_path / "once", **told, at_once=True, resume=early.path)
    one, two = (json.loads((run.path / "race.json").read_text()) for run in (plain, once))
    assert one["winner"] == two["winner"]
    for left, right in zip(one["rounds"], two["rounds"], strict=True):
        assert left["go_on"] == right["go_on"]
        for seed, found in left["validation"].items():
            assert right["validation"][seed] == pytest.approx(found, rel=1e-3)
    own = once.path / "seeds" / str(two["winner"])
    assert (once.path / METRICS).read_bytes() == (own / METRICS).read_bytes()


@pytest.mark.parametrize("name", ["ppd_plain"])
def test_on_a_gpu_seeds_learn_at_once_without_waiting_for_it(boxes, name):
    """Torch's meta device goes a GPU's ways, and to read a number from it raises."""
    recipe = load_recipe(name)
    assert can_run_at_once(recipe, "cuda")
    assert not can_run_at_once(recipe, "cpu")
    learners = [PPDLearner(recipe, seed, META) for seed in range(2)]
    team, inputs = find_method("ppd").team(learners), replace(learners[0].inputs, **FEW)
    assert team is not None
    split = load_split(boxes, "train", inputs, [8]).to(META)
    for iteration in range(2):
        batch = split.batch([0, 3, 1, 2], inputs, 8, None)
        terms = team.learn(batch, iteration=iteration)
    assert {value.shape for value in terms.values()} == {(2,)}


def test_the_adversary_s_seeds_cannot(boxes, tmp_path):
    assert not can_run_at_once(load_recipe("ppd_paper"), "cuda")
    with pytest.raises(InvalidRecipe, match="its seeds cannot learn at once"):
        at_once(tiny("ppd_paper"), boxes, tmp_path, stop=2)
