"""PPD's training: recipes, the loop, stop and resume, terms that are not finite."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from digests import curve, resumed_exactly, same_state
from learners import assert_alike, tiny
from ppd_data import rewrite, write_boxes

from articugen.core.errors import InvalidCheckpoint, InvalidRecipe, TrainingDiverged, UnfitData
from articugen.core.yaml_files import known
from articugen.learning.data import split
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import load_split
from articugen.learning.loop import Training, batch_rows, split_objects, train
from articugen.learning.method import load_recipe
from articugen.learning.ppd import losses, objective
from articugen.learning.ppd.discriminator import Discriminator
from articugen.learning.ppd.network import PPD
from articugen.learning.ppd.settings import (
    LossSettings,
    ModelSettings,
    PPDRecipe,
    PPDStage,
)
from articugen.learning.recipe import DataSettings
from articugen.learning.run_folder import BEST, LATEST, METRICS, read_checkpoint

TINY = tiny(
    {"surface_points": 400, "grid_points": 150, "near_points": 50}, (8, 3), (16, 2),
    batch=3, learning_rate=1e-3, final_learning_rate=1e-4, validate_every=3,
)  # fmt: skip

SPEC = BatchSpec.of(TINY.data)


def start(boxes, runs, recipe=TINY, *, seed=0, resume=None, **options):
    return train(Training(recipe, "box", boxes, runs, seed, resume), **options)


@pytest.fixture(scope="module")
def whole(boxes, tmp_path_factory):
    """A run that nothing interrupted."""
    return start(boxes, tmp_path_factory.mktemp("whole"))


def test_an_object_whose_coarse_grids_are_empty_is_trained_on(tmp_path):
    """Plates between all centres of the first stages' grids: the model still learns that they are
    there, and no term is starved of occupied points."""
    folder = write_boxes(tmp_path / "thin", train=3, test=1, states=2)
    none = {r: np.zeros((r,) * 3, np.uint8) for r in (8, 16)}
    for path in sorted(folder.glob("*.h5")):
        rewrite(path, lambda rows: [replace(r, occupancy={**r.occupancy, **none}) for r in rows])
    packed = load_split(folder, "train", SPEC, [8, 16])
    for resolution in (8, 16):
        batch = packed.batch([0, 4, 8], SPEC, resolution, torch.Generator().manual_seed(0))
        assert (batch.occupied[:, : batch.spread].sum(1) > 2).all()
    run = start(folder, tmp_path / "runs")
    told = [record["terms"] for record in run.metrics() if record.get("terms")]
    assert told
    assert all(math.isfinite(value) for terms in told for value in terms.values())


def test_the_paper_s_recipe_has_the_paper_s_numbers():
    recipe = load_recipe("ppd_paper")
    weigh, plan = recipe.losses, recipe.schedule
    assert (weigh.rec, weigh.rec_common, weigh.dev, weigh.var_state) == (0.01, 0.001, 0.1, 0.1)
    assert (weigh.loc, weigh.var_pivot, weigh.vol) == (100, 0.01, 1000)
    assert (weigh.adv_g, weigh.adv_d, weigh.gradient_penalty) == (0.65, 0.35, 1.0)
    assert (weigh.var_width, recipe.model.codes, plan.batch) == (0.01, 4, 18)
    assert (weigh.most_revolute, weigh.most_prismatic) == (math.pi / 2, 0.4)
    assert (recipe.data.surface_points, recipe.data.grid_points) == (4096, 4096)
    assert (plan.learning_rate, plan.final_learning_rate) == (1e-4, None)
    assert [stage.resolution for stage in plan.stages] == [16, 32]
    assert [stage.residual_direction for stage in plan.stages] == [False, True]
    assert recipe.model.revolute == ((0, 0, 1), (0, 0, -1), (0, 1, 0))
    assert recipe.model.prismatic == ((1, 0, 0),) * 4


def test_the_paper_s_text_is_the_default():
    """But for what is called occupied: material, unless a recipe says otherwise."""
    paper = load_recipe("ppd_paper")
    assert paper.sha256() == PPDRecipe(name="p", data=DataSettings(occupancy="visible")).sha256()


@pytest.mark.parametrize(
    ("name", "occupancy"),
    [
        ("ppd_paper", "visible"),
        ("ppd_release", "visible"),
        ("ppd_quick", "material"),
        ("ppd_hour", "material"),
        ("ppd_plain", "material"),
    ],
)
def test_our_recipes_learn_material_and_the_paper_s_what_is_not_seen_free(name, occupancy):
    data = load_recipe(name).data
    assert data.occupancy == occupancy
    if occupancy == "visible":
        assert (data.band_points, data.varying_points) == (0, 0)


@pytest.mark.parametrize("name", known(learner=True))
def test_every_recipe_is_a_valid_one(name):
    recipe = load_recipe(name)
    assert recipe.name == name
    assert recipe.seeds.count == 1 or recipe.data.validation_objects


def test_recipes_extend_one_another():
    quick, release = load_recipe("ppd_plain"), load_recipe("ppd_release")
    assert quick.losses.form == release.losses.form == "release"
    assert quick.losses.adv_g == 0.0
    assert release.losses.adv_d == 3.25
    assert quick.model.latent_start == "he"
    assert quick.model.part_frame == release.model.part_frame == "joint"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("losses: {rek: 1}", "unknown key 'losses.rek'; did you mean 'rec'"),
        ("schedule: {stages: [{resolutoin: 16, iterations: 1}]}", "did you mean 'resolution'"),
        ("model: {revolute: [[1, 1, 0]]}", "not of unit length"),
        ("data: {grid_points: 0}", "must be more than 0"),
        ("{model: {local_points: 9}, data: {surface_points: 11}}", "surface_points of 12 or more"),
        ("schedule: {stages: []}", "schedule.stages: has none; give it one"),
        ("model: {states: points}", "needs model.part_boxes and a warm start"),
        ("losses: {vol: -1}", "losses.vol"),
        ("extends: ppd_papre", "did you mean 'ppd_paper'"),
        ("[1, 2]", "a recipe is a mapping"),
    ],
)
def test_bad_recipes_are_refused_in_one_sentence(tmp_path, text, said):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InvalidRecipe, match=said):
        load_recipe(path)


def test_a_run_leaves_what_one_needs_to_trust_it(whole):
    assert whole.path.name == "000"
    assert whole.recipe() == TINY
    about = json.loads((whole.path / "run.json").read_text())
    assert about["recipe_sha256"] == TINY.sha256()
    assert len(about["data"]["content_sha256"]) == 64
    terms = whole.metrics()[0]["terms"]
    assert set(terms) == {
        "rec", "rec_common", "vol", "vq", "dev", "loc", "var_state", "var_pivot", "adv_g",
        "adv_d", "gradient_penalty",
    }  # fmt: skip
    last = read_checkpoint(whole.path / LATEST)
    assert last.iteration == 5
    assert read_checkpoint(whole.path / BEST).best == last.best < math.inf
    assert last.learner().state().keys() == last.state.keys()


def test_a_schedule_without_iterations_leaves_a_checkpoint(boxes, tmp_path):
    stage = TINY.schedule.stages[0].model_copy(update={"iterations": 0})
    none = TINY.schedule.model_copy(update={"stages": (stage,)})
    run = start(boxes, tmp_path, TINY.model_copy(update={"schedule": none}))
    assert read_checkpoint(run.path / LATEST).iteration == 0


@pytest.mark.parametrize("stop", [2, 3, 4])
def test_stop_and_resume_gives_the_same_curve_and_weights(boxes, tmp_path, whole, stop):
    """Also where the stop is at the end of a stage."""
    part = start(boxes, tmp_path / "part", stop_after=stop)
    assert read_checkpoint(part.path / LATEST).iteration == stop
    part.log({"iteration": stop + 1, "terms": {"rec": 0.0}})  # written, but lost with the weights
    resumed = start(boxes, tmp_path / "part", resume=part.path)
    assert curve(resumed) == curve(whole)
    assert same_state(resumed, whole)


def with_soap():
    plan = TINY.schedule.model_copy(update={"optimiser": "soap"})
    return TINY.model_copy(update={"schedule": plan})


def of_bae():
    """A learner of fields, whose optimiser starts afresh in the second stage."""
    few = {"surface_points": 60, "grid_points": 32, "band_points": 32, "validation_objects": 1}
    stages = [{"resolution": 16, "iterations": 3}, {"resolution": 32, "iterations": 2}]
    plan = {"batch": 2, "stages": stages, "log_every": 1, "validate_every": 3}
    model = {"voxels": 16, "code": 8, "widths": [32, 16], "branches": 3}
    return load_recipe({"extends": "bae", "model": model, "data": few, "schedule": plan})


@pytest.mark.parametrize(
    ("recipe", "stop"),
    [(with_soap(), 2), (of_bae(), 2), (of_bae(), 3)],
    ids=["soap", "bae", "stage"],
)
def test_so_it_does_with_another_optimiser_and_method(boxes, tmp_path, whole, recipe, stop):
    full = resumed_exactly(Training(recipe, "box", boxes, tmp_path), stop)
    assert curve(full) != curve(whole)


def test_the_seed_decides(boxes, tmp_path):
    one, two, other = (start(boxes, tmp_path, seed=s, stop_after=1) for s in (0, 0, 1))
    assert curve(one) == curve(two)
    assert curve(one) != curve(other)


def test_another_recipe_or_seed_cannot_resume(boxes, tmp_path):
    run = start(boxes, tmp_path, stop_after=1)
    other = TINY.model_copy(update={"losses": LossSettings(vol=1.0)})
    for options in ({"recipe": other}, {"seed": 3}):
        with pytest.raises(InvalidCheckpoint, match="another recipe"):
            start(boxes, tmp_path, resume=run.path, **options)
    with pytest.raises(InvalidCheckpoint, match=r"has no latest\.safetensors"):
        start(boxes, tmp_path, resume=tmp_path / "nothing")


@pytest.mark.parametrize("name", ["vol", "dev"])
def test_a_term_that_is_not_finite_is_named(boxes, tmp_path, name, monkeypatch):
    bad = {"vol": "volume", "dev": "deviation"}[name]
    monkeypatch.setattr(losses, bad, lambda *args: args[0].sum() * float("nan"))
    with pytest.raises(TrainingDiverged, match=f"iteration 1: the loss {name} is not a finite"):
        start(boxes, tmp_path)


def test_a_gradient_that_is_not_finite_is_named_and_not_stepped(boxes, tmp_path, monkeypatch):
    def steep(before, code):
        return (before - before.detach()).square().sum(1).sqrt().sum()

    monkeypatch.setattr(losses, "quantization", steep)
    with pytest.raises(TrainingDiverged, match="iteration 1: the gradient of vq is not a finite"):
        start(boxes, tmp_path)


def test_validation_holds_objects_out_of_training():
    kept, out = split_objects([f"o{i}" for i in range(8)] * 3, 2)
    assert len(out) == 2
    assert sorted([*kept, *out]) == [f"o{i}" for i in range(8)]
    assert len(split_objects([f"o{i}" for i in range(7)], 4)[1]) == 1
    assert len(split_objects(["a", "b"], 4)[1]) == 1
    assert split_objects(["a"], 4) == (["a"], [])


def test_an_epoch_visits_each_instance_once():
    rows = [row for iteration in range(10) for row in batch_rows(iteration, 4, 10, 0, "ppd")]
    for epoch in range(4):
        assert sorted(rows[10 * epoch : 10 * epoch + 10]) == list(range(10))
    assert rows[:10] != rows[10:20]


def batch_of(boxes, kind=torch.float32):
    data = load_split(boxes, "train", SPEC, [8])
    batch = data.batch([0, 1, 2], SPEC, 8, torch.Generator().manual_seed(0))
    return replace(batch, cloud=batch.cloud.to(kind), points=batch.points.to(kind))


def test_each_loss_can_be_switched_off(boxes):
    batch = batch_of(boxes)
    names = {
        "rec_common": "rec_common", "vol": "vol", "vq": "vq", "dev": "dev", "loc": "loc",
        "var_state": "var_state", "var_pivot": "var_pivot", "adv_g": "adv_g",
    }  # fmt: skip
    model, discriminator = PPD(ModelSettings()), Discriminator()
    for setting, term in names.items():
        for weight in (1.0, 0.0):
            weigh = LossSettings(**{setting: weight})
            predicted = model(batch.cloud)
            rng = torch.Generator().manual_seed(0)
            posed = objective.random_pose(model, predicted, batch, weigh, rng)
            terms = objective.generator_terms(model, predicted, batch, weigh, discriminator, posed)
            assert (term in terms) == (weight > 0)


@pytest.mark.parametrize(("form", "of"), [("paper", "instance"), ("release", "product")])
def test_the_unmoved_volume_s_shortcut_is_exact(boxes, form, of):
    torch.manual_seed(0)
    model = PPD(ModelSettings()).double()
    with torch.no_grad():
        model.shape.head_2.bias[8:] -= 0.05  # so that only some points are inside
    batch = batch_of(boxes, torch.float64)
    points = batch.points
    predicted = model(batch.cloud)
    fields = model.fields(predicted.shape, model.motion(predicted.pose), points)
    short = objective.FORMS[form](model, predicted, fields, batch, 0.01)["vol"]()
    spread = points[:, : batch.spread]
    still = getattr(model.still(predicted.shape, spread), of)
    motion = model.motion(predicted.pose)
    moved = getattr(model.fields(predicted.shape, motion, spread), of)
    plain = losses.volume(moved, still)
    assert float(still.detach().max()) > 0
    assert_alike(short, plain, model.shape.parameters())


def test_the_adversary_s_shortcut_is_exact(boxes):
    torch.manual_seed(0)
    model, discriminator = PPD(ModelSettings()).double(), Discriminator().double().eval()
    batch = batch_of(boxes, torch.float64)
    predicted = model(batch.cloud)
    rng = torch.Generator().manual_seed(0)
    posed = objective.random_pose(model, predicted, batch, LossSettings(), rng)
    short = objective._adversarial(model, discriminator, predicted, batch, posed)
    whole = objective._composed(model, predicted, posed.state, batch.points)
    plain = -discriminator(torch.cat([batch.points, whole[..., None]], 2)).mean()
    assert_alike(short, plain, model.parameters())


@pytest.mark.parametrize("name", ["ppd_paper", "ppd_release"])
def test_the_curve_is_the_one_that_was_committed(tmp_path, monkeypatch, name):
    """Of the paper's recipe and the release's, both stages, in steps so small that they are the
    same on any processor: in larger ones Adam makes much of how sums are rounded. Points are drawn
    as they are where many are wanted, as the paper's recipe does."""
    monkeypatch.setattr(split, "FEW", 10**9)
    data = write_boxes(tmp_path / "data", train=4, test=1, states=2)
    plan = {"batch": 4, "learning_rate": 1e-6, "final_learning_rate": 1e-7, "log_every": 1}
    plan |= {"validate_every": 4, "save_every": 100}
    plan["stages"] = [
        {"resolution": 8, "iterations": 6},
        {"resolution": 16, "iterations": 5, "residual_direction": True},
    ]
    points = {"surface_points": 300, "grid_points": 150, "near_points": 50, "validation_objects": 1}
    recipe = load_recipe({"extends": name, "data": points, "schedule": plan})
    drawn = start(data, tmp_path / "runs", recipe).metrics()
    committed = Path(__file__).parent / "data" / f"{name}_curve.jsonl"
    for have, line in zip(drawn, committed.read_text().splitlines(), strict=True):
        want = json.loads(line)
        assert have.keys() - {"seconds"} == want.keys()
        for what in want:
            assert have[what] == pytest.approx(want[what], rel=1e-3, abs=1e-5), what


def test_a_grid_has_fewer_cells_than_points_are_asked_for(boxes, tmp_path):
    recipe = TINY.model_copy(update={"data": DataSettings(grid_points=513, surface_points=200)})
    with pytest.raises(UnfitData, match=r"lower it, a stage's grid has 8\^3 cells"):
        start(boxes, tmp_path, recipe)
    assert not list(tmp_path.rglob("recipe.yaml"))


def test_training_learns(boxes, tmp_path):
    recipe = load_recipe("ppd_plain")
    plan = {"batch": 4, "learning_rate": 3e-3, "log_every": 1, "validate_every": 100}
    plan |= {"stages": (PPDStage(resolution=16, iterations=40),)}
    points = {"surface_points": 300, "uniform_points": 300, "near_points": 300}
    recipe = recipe.model_copy(
        update={
            "schedule": recipe.schedule.model_copy(update=plan),
            "data": DataSettings(grid_points=0, validation_objects=0, **points),
        }
    )
    run = start(boxes, tmp_path, recipe)
    rec = [record["terms"]["rec"] for record in run.metrics()]
    assert rec[-1] < 0.7 * rec[0]
    assert (run.path / METRICS).is_file()
    assert not (run.path / BEST).exists()
