"""The encoder for depth input: it learns the first one's latents, stops and resumes exactly."""

import dataclasses
import shutil

import pytest
from ppd_data import write_boxes

from articugen.core.errors import InvalidCheckpoint, UnfitData
from articugen.learning.ppd.settings import (
    DepthSettings,
    LossSettings,
    PPDRecipe,
    PPDSchedule,
    PPDStage,
)
from articugen.learning.recipe import DataSettings

torch = pytest.importorskip("torch", reason="PPD needs torch")

from instances import hinged_box

from articugen.core.records import dequantize
from articugen.learning.clouds import seen_by_a_camera
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import load_split, unpacked
from articugen.learning.loop import train, train_depth
from articugen.learning.ppd.depth import latents
from articugen.learning.run_folder import DEPTH, LATEST, RunFolder, depth_learner, read_checkpoint
from articugen.learning.tensors import digest

torch.set_num_threads(1)

TINY = PPDRecipe(
    name="tiny",
    losses=LossSettings(adv_g=0.0, adv_d=0.0, gradient_penalty=0.0),
    data=DataSettings(surface_points=200, grid_points=50, validation_objects=1),
    schedule=PPDSchedule(
        batch=2,
        stages=(PPDStage(resolution=8, iterations=2),),
        log_every=1,
        validate_every=20,
        save_every=100,
    ),
    depth=DepthSettings(iterations=20, batch=4, learning_rate=2e-3),
)


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    return write_boxes(tmp_path_factory.mktemp("boxes"), train=3, test=1, states=2)


@pytest.fixture(scope="module")
def base(boxes, tmp_path_factory):
    """A run whose first two stages are done."""
    runs = tmp_path_factory.mktemp("runs")
    return train(TINY, category="box", data=boxes, runs=runs).path


@pytest.fixture(scope="module")
def whole(base, boxes, tmp_path_factory):
    """Its third stage, which nothing interrupted."""
    run = copied(base, tmp_path_factory.mktemp("whole") / "run")
    train_depth(run, boxes)
    return run


def copied(path, to) -> RunFolder:
    shutil.copytree(path, to)
    return RunFolder(to)


def test_it_learns_to_give_the_first_encoder_s_latents(whole, boxes):
    curve = whole.metrics(DEPTH.metrics)
    differences = [r["terms"]["latent"] for r in curve if "terms" in r]
    assert len(differences) == 20
    assert differences[-1] < 0.2 * differences[0]
    (checked,) = [r["validation"] for r in curve if "validation" in r]
    point = read_checkpoint(whole.path / LATEST)
    assert set(checked) == {"latent", "rec", "iou"}
    data = load_split(boxes, "train", BatchSpec.of(TINY.data, partial=True), [8])
    first, second = point.learner().model, depth_learner(whole.path, point).model
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
    run = copied(base, tmp_path / "run")
    train_depth(run, boxes, stop_after=stop)
    train_depth(run, boxes)
    one, two = (
        [r | {"seconds": 0.0} for r in each.metrics(DEPTH.metrics)] for each in (whole, run)
    )
    assert one == two
    left, right = (
        depth_learner(each.path, read_checkpoint(each.path / LATEST)) for each in (whole, run)
    )
    assert digest(left.state()) == digest(right.state())
    assert digest(left.model.state_dict()) == digest(right.model.state_dict())


def test_what_is_trained_already_is_left_alone(whole, boxes):
    before = (whole.path / DEPTH.latest).read_bytes()
    train_depth(whole, boxes)
    assert (whole.path / DEPTH.latest).read_bytes() == before


def test_an_encoder_of_other_weights_is_refused_and_trained_anew(whole, boxes, tmp_path):
    run = copied(whole.path, tmp_path / "run")
    point = read_checkpoint(run.path / LATEST)
    point.state["model"]["pose.common_euler"] += 0.1
    point.write(run.path / LATEST)
    changed = read_checkpoint(run.path / LATEST)
    with pytest.raises(InvalidCheckpoint, match=r"depth\.pt: belongs to other weights"):
        depth_learner(run.path, changed)
    train_depth(run, boxes, stop_after=1)
    assert [r["iteration"] for r in run.metrics(DEPTH.metrics) if "terms" in r] == [1]
    depth_learner(run.path, changed)


def test_a_run_without_one_says_how_to_make_it(base):
    with pytest.raises(InvalidCheckpoint, match="make one with: articugen train-depth"):
        depth_learner(base, read_checkpoint(base / LATEST))


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
