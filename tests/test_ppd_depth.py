"""The encoder for depth input: it learns the first one's latents, stops and resumes exactly."""

import dataclasses
import json
import math
import shutil

import pytest
import torch
from digests import curve, same_state
from instances import hinged_box
from learners import tiny
from PIL import Image
from ppd_data import write_boxes

from articugen.core.errors import InvalidCheckpoint, InvalidRecipe, UnfitData
from articugen.core.records import dequantize
from articugen.learning import recorded
from articugen.learning.commands import draw, draw_examples, evaluate
from articugen.learning.commands import train as trained
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import load_split, unpacked
from articugen.learning.loop import Training, train
from articugen.learning.method import find_method, load_recipe
from articugen.learning.ppd.depth import DepthLearner, latents
from articugen.learning.ppd.settings import LossSettings, VarySettings, WarmStart
from articugen.learning.predict import seen_by_a_camera
from articugen.learning.recorded import watch
from articugen.learning.run_folder import LATEST, RunFolder, read_checkpoint
from articugen.pictures.layout import TILE
from tests.test_recorded import LAYOUTS, scene

BOXES = {"train": 3, "test": 1, "states": 2}

TINY = tiny(
    {"surface_points": 200, "grid_points": 50}, (8, 1), (8, 1), batch=2, validate_every=20,
    losses={"adv_g": 0.0, "adv_d": 0.0, "gradient_penalty": 0.0},
)  # fmt: skip

PARTIAL = BatchSpec(50, partial=True)

PLAN = {
    "batch": 4, "learning_rate": 2e-3, "final_learning_rate": 2e-5, "log_every": 1,
    "validate_every": 20, "stages": [{"resolution": 1, "iterations": 20}],
}  # fmt: skip


@pytest.fixture(scope="module")
def base(boxes, tmp_path_factory):
    """A run whose first two stages are done."""
    return train(Training(TINY, "box", boxes, tmp_path_factory.mktemp("runs"))).path


def third_stage(boxes, base, runs, *, stop_after=None, **more) -> RunFolder:
    recipe = load_recipe({"extends": "ppd_depth", "teacher": str(base), "schedule": PLAN})
    return train(Training(recipe, "box", boxes, runs, **more), stop_after=stop_after)


@pytest.fixture(scope="module")
def whole(base, boxes, tmp_path_factory):
    """Its third stage, which nothing interrupted."""
    return third_stage(boxes, base, tmp_path_factory.mktemp("whole"))


def test_it_learns_to_give_the_first_encoder_s_latents(base, whole, boxes):
    curve = whole.metrics()
    differences = [r["terms"]["latent"] for r in curve if "terms" in r]
    assert len(differences) == 20
    assert differences[-1] < 0.2 * differences[0]
    (checked,) = [r["validation"] for r in curve if "validation" in r]
    assert set(checked) == {"latent", "rec", "iou"}
    data = load_split(boxes, "train", BatchSpec.of(TINY.data, partial=True), [8])
    teacher, learner = (read_checkpoint(path / LATEST).learner() for path in (base, whole.path))
    first, second = teacher.model, learner.model
    assert learner.residual_direction
    wanted = latents(first.encoder, data.surface[:, :200])
    assert wanted.shape == (9, 512)
    with torch.no_grad():
        before, after = (
            (model.encoder(unpacked(data.partial[:, 1])) - wanted).square().mean()
            for model in (first, second)
        )
    assert float(after) < float(wanted.var())
    assert float(after) != float(before)
    decoders = {n: v for n, v in first.state_dict().items() if not n.startswith("encoder.")}
    assert all(torch.equal(v, second.state_dict()[n]) for n, v in decoders.items())


@pytest.mark.parametrize("stop", [7, 19])
def test_stop_and_resume_gives_the_same_curve_and_weights(base, whole, boxes, tmp_path, stop):
    """Also where the teacher is no longer there."""
    teacher = shutil.copytree(base, tmp_path / "teacher")
    part = third_stage(boxes, teacher, tmp_path / "part", stop_after=stop)
    shutil.rmtree(teacher)
    done = trained(boxes, resume=part.path)
    assert curve(done) == curve(whole)
    assert same_state(done, whole)


@pytest.fixture(scope="module")
def varied(tmp_path_factory):
    """Boxes, and a run whose objects were varied; its joints lie beside it."""
    boxes = write_boxes(tmp_path_factory.mktemp("varied") / "box", train=3, test=0, states=5)
    wild = {"vary": VarySettings(stretch=0.3, shrink=0.3, mirror=True, shift=True),
            "warm_start": WarmStart(share=0.5, groups="given")}  # fmt: skip
    recipe = TINY.model_copy(update=wild)
    return boxes, train(Training(recipe, "box", boxes, tmp_path_factory.mktemp("runs"))).path


def test_both_clouds_are_varied_alike_where_the_teacher_s_objects_were(varied, tmp_path):
    boxes, teacher = varied
    recipe = load_recipe({"extends": "ppd_depth", "teacher": str(teacher), "schedule": PLAN})
    learner = find_method(recipe.method).start(recipe, seed=0, device=torch.device("cpu"))
    assert isinstance(learner, DepthLearner)
    what, notes = Training(recipe, "box", boxes, tmp_path), []
    training = next(what.instances(learner, 0, notes.append)[0])
    learner.begin(training, tmp_path, notes.append)
    assert not any("looking for joints" in note for note in notes)
    there, copied = (sorted(p.name for p in (f / "joints").iterdir())
                     for f in (teacher.parent, tmp_path))  # fmt: skip
    assert there == copied
    assert there
    clouds = {}
    for name, network in (("partial", learner.student), ("complete", learner.teacher)):
        network.register_forward_pre_hook(
            lambda _, given, name=name: clouds.update({name: given[0].clone()})
        )
    rows, rng = list(range(len(training))), torch.Generator().manual_seed(0)
    batch = training.batch(rows, learner.inputs, 1, rng)
    learner.learn(batch, rng, iteration=0)
    before = {"partial": batch.cloud, "complete": unpacked(training.surface[rows, :200])}
    maps = {}
    for name, cloud in clouds.items():
        was, now = (c - c.mean(1, keepdim=True) for c in (before[name], cloud))
        scale = (was * now).sum(1) / was.square().sum(1)
        shift = cloud.mean(1) - scale * before[name].mean(1)
        torch.testing.assert_close(cloud, before[name] * scale[:, None] + shift[:, None])
        maps[name] = torch.stack([scale, shift])
    torch.testing.assert_close(maps["partial"], maps["complete"], atol=1e-4, rtol=1e-4)
    scale, shift = maps["complete"]
    assert scale.abs().std(0).min() > 0.02
    assert {True, False} == set((scale[:, 1] < 0.0).tolist())
    assert shift.abs().max() > 0.02


def test_the_third_stage_of_varied_objects_resumes_exactly_without_its_teacher(varied, tmp_path):
    boxes, base = varied
    done = third_stage(boxes, base, tmp_path / "whole")
    teacher = shutil.copytree(base, base.parent / "teacher")  # beside the joints
    part = third_stage(boxes, teacher, tmp_path / "part", stop_after=7)
    shutil.rmtree(teacher)
    again = trained(boxes, resume=part.path)
    assert curve(again) == curve(done)
    assert same_state(again, done)


def test_a_teacher_that_was_trained_by_another_recipe_meanwhile_is_refused(base, boxes, tmp_path):
    recipe = load_recipe({"extends": "ppd_depth", "teacher": str(base), "schedule": PLAN})
    taught = recipe.taught.model_copy(update={"losses": LossSettings(vol=1.0)})
    other = recipe.model_copy(update={"taught": taught})
    with pytest.raises(InvalidCheckpoint, match="is of another recipe than `taught`"):
        train(Training(other, "box", boxes, tmp_path))


@pytest.mark.usefixtures("few_pictures")
def test_figures_show_what_it_makes_of_what_one_camera_sees(whole, boxes, tmp_path, monkeypatch):
    threads, given = torch.get_num_threads() + 1, []
    reconstruct = DepthLearner.reconstruct
    monkeypatch.setattr(DepthLearner, "reconstruct", lambda self, cloud, **how: (
        given.append(len(cloud)), reconstruct(self, cloud, **how))[1])  # fmt: skip
    run = shutil.copytree(whole.path, tmp_path / "run")
    torch.set_num_threads(threads)
    result = evaluate(run, boxes, resolution=8, states=2)
    assert torch.get_num_threads() == threads
    torch.set_num_threads(1)
    measured = set(given)
    given.clear()
    assert all(path.is_file() for path in draw(run, boxes, result))
    draw_examples([run], tmp_path / "examples.png", boxes)
    assert set(given) == measured == {len(load_split(boxes, "test", PARTIAL, []).partial[0, 0])}


def test_parts_of_surface_points_are_none_of_a_partial_cloud(boxes):
    asks = BatchSpec(50, parts=True, partial=True)
    batch = load_split(boxes, "train", asks, []).batch([0, 1], asks, 8, None)
    assert batch.part.shape == (2, 0)


def test_a_recipe_takes_model_and_data_from_its_teacher(base, whole, tmp_path):
    recipe = whole.recipe()
    assert (recipe.taught, recipe.data) == (TINY, TINY.data)
    assert recipe.variant == TINY.variant
    with pytest.raises(InvalidRecipe, match="names no teacher; set teacher to a run's folder"):
        train(Training(load_recipe("ppd_depth"), "box", tmp_path, tmp_path))
    for teacher, said in ((whole.path, "is of method ppd_depth; name a run of PPD"),
                          (tmp_path, "cannot be read")):  # fmt: skip
        with pytest.raises(InvalidRecipe, match=said):
            load_recipe({"extends": "ppd_depth", "teacher": str(teacher)})


def test_a_camera_sees_a_part_of_the_surface_and_is_the_same_each_time():
    rows = hinged_box([(0.0, 0.0)] + [(0.1 * k, 0.0) for k in range(1, 9)])
    chosen = set()
    for instance in rows:
        seen = seen_by_a_camera(instance)
        assert (seen == seen_by_a_camera(instance)).all()
        clouds = [dequantize(cloud) for cloud in instance.partial_points]
        (which,) = [i for i, cloud in enumerate(clouds) if (cloud == seen).all()]
        chosen.add(which)
    assert chosen == {0, 1}
    blind = dataclasses.replace(
        rows[0],
        **{
            name: getattr(rows[0], name)[:0]
            for name in (
                "partial_points",
                "partial_part",
                "partial_T_camera_world",
                "partial_intrinsics",
            )
        },
    )
    with pytest.raises(UnfitData, match=r"has no partial clouds; set sampling\.partial_views"):
        seen_by_a_camera(blind)


def without_direction(labels, dominant, numbers):
    """What is measured where no part stands for the lid."""
    return labels, dominant, {**numbers, "direction_degrees": math.nan}


@pytest.mark.usefixtures("few_pictures")
def test_it_watches_a_recorded_laptop(tmp_path, monkeypatch):
    data = write_boxes(tmp_path / "laptop", category="laptop", **BOXES)
    base = train(Training(TINY, "laptop", data, tmp_path / "runs")).path
    recipe = load_recipe({"extends": "ppd_depth", "teacher": str(base), "schedule": PLAN})
    run = train(Training(recipe, "laptop", data, tmp_path / "depth")).path
    real = recorded.measured
    monkeypatch.setattr(recorded, "measured", lambda *of: without_direction(*real(*of)))
    write, intrinsics = LAYOUTS["aod"]
    folder = write(scene(tmp_path, 3, intrinsics), tmp_path)
    numbers = watch(run, folder, images=3, out=tmp_path / "out", resolution=16)
    assert numbers["images"] == 3
    assert 0.0 < numbers["label_iou"] <= 1.0
    assert json.loads((tmp_path / "out/numbers.json").read_text()).keys() == numbers.keys()
    with Image.open(tmp_path / "out/figure.png") as picture:
        assert picture.width > 2 * TILE
        assert len(set(picture.convert("L").tobytes())) > 50
    assert math.isnan(numbers["direction_degrees"])
    assert json.loads((tmp_path / "out/numbers.json").read_text())["direction_degrees"] is None
    with pytest.raises(InvalidCheckpoint, match="make depth CATEGORY=laptop"):
        watch(base, folder, out=tmp_path)
