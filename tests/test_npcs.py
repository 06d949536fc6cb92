"""NPCS: its layers, losses and fits against a literal reading in numpy, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest
from digests import resumed_exactly
from hypothesis import given, settings
from hypothesis import strategies as st
from ppd_data import write_boxes

torch = pytest.importorskip("torch", reason="learners need torch")

from articugen.core.errors import ArticugenError, UnfitData
from articugen.core.geometry import rotation_about, transform
from articugen.evaluation.evaluate import evaluate as evaluate_as_paper
from articugen.evaluation.reconstruction import joints_of, labelled_points, truth, turn_of
from articugen.evaluation.tally import Protocol
from articugen.learning.commands import draw, evaluate, predict
from articugen.learning.data.batch import Batch
from articugen.learning.loop import Training, train
from articugen.learning.method import load_recipe
from articugen.learning.npcs.fit import pose, similarity
from articugen.learning.npcs.learner import NPCSLearner, errors
from articugen.learning.npcs.network import WIDTH, NPCSNet, farthest, interpolated, within
from articugen.learning.npcs.settings import Level, ModelSettings, NPCSRecipe

torch.set_num_threads(1)

BOXES = {"train": 3, "test": 1, "states": 3}

CPU = torch.device("cpu")
LEVELS = (
    {"centres": 16, "radius": 0.25, "neighbours": 8},
    {"centres": 4, "radius": 0.5, "neighbours": 8},
)


def plan(iterations=1, parts=3) -> NPCSRecipe:
    data = {"surface_points": 96, "grid_points": 0, "validation_objects": 1}
    schedule = {
        "batch": 6, "learning_rate": 4e-3, "stages": [{"resolution": 16, "iterations": iterations}],
        "validate_every": 1000,
    }  # fmt: skip
    model = {"parts": parts, "levels": LEVELS}
    return NPCSRecipe.model_validate(
        {"name": "tiny", "model": model, "data": data, "schedule": schedule}
    )


def test_parameters_are_those_that_were_published():
    paper = load_recipe("npcs_paper")
    assert isinstance(paper, NPCSRecipe)
    assert paper.model == ModelSettings()
    assert load_recipe(method="npcs").name == "npcs"
    for parts, count in ((2, 1_403_337), (5, 1_403_337 + 3 * 516)):
        with torch.device("meta"):
            net = NPCSNet(ModelSettings(parts=parts))
        assert sum(p.numel() for p in net.parameters()) == count


def test_the_rate_and_the_momentum_fall_by_steps_of_samples():
    schedule = load_recipe("npcs_paper").schedule
    assert [schedule.rate_at(i) for i in (0, 12_499, 12_500, 25_000)] == pytest.approx(
        [1e-3, 1e-3, 0.7e-3, 0.49e-3]
    )


# what PointNet++ does, point by point


def literal_within(centre, points, radius, count):
    near = [i for i, p in enumerate(points) if np.linalg.norm(p - centre) < radius][:count]
    return near + (count - len(near)) * near[:1]


def literal_interpolated(point, centres, features):
    squared = ((centres - point) ** 2).sum(1)
    near = np.argsort(squared)[:3]
    weight = 1.0 / np.maximum(squared[near], 1e-10)
    return (weight[:, None] * features[near]).sum(0) / weight.sum()


def literal_layers(W, name, x):
    for i in range(3):
        if f"{name}.{i}.linear.weight" not in W:
            break
        x = x @ W[f"{name}.{i}.linear.weight"].T + W[f"{name}.{i}.linear.bias"]
        mean, var = W[f"{name}.{i}.norm.running_mean"], W[f"{name}.{i}.norm.running_var"]
        x = (x - mean) / np.sqrt(var + 1e-5)
        x = np.maximum(x * W[f"{name}.{i}.norm.weight"] + W[f"{name}.{i}.norm.bias"], 0.0)
    return x


def literal_net(W, levels, points):
    at, known, layer = points, None, []
    for name, level in zip(("fine", "coarse"), levels, strict=True):
        chosen = [0]
        while len(chosen) < level.centres:
            away = np.linalg.norm(at[:, None] - at[chosen], axis=2).min(1)
            chosen.append(int(away.argmax()))
        rows = []
        for centre in at[chosen]:
            near = literal_within(centre, at, level.radius, level.neighbours)
            x = at[near] - centre
            x = x if known is None else np.concatenate([x, known[near]], 1)
            rows.append(literal_layers(W, f"{name}.layers", x).max(0))
        at, known = at[chosen], np.stack(rows)
        layer.append((at, known))
    (fine, of_fine), (coarse, of_coarse) = layer
    whole = literal_layers(W, "whole", np.concatenate([coarse, of_coarse], 1)).max(0)
    x = np.stack([literal_layers(W, "to_coarse", np.append(whole, f)) for f in of_coarse])
    x = np.stack([np.append(literal_interpolated(p, coarse, x), f) for p, f in zip(fine, of_fine)])  # noqa: B905
    x = literal_layers(W, "to_fine", x)
    x = np.stack([np.append(literal_interpolated(p, fine, x), p) for p in points])
    x = literal_layers(W, "each", literal_layers(W, "to_points", x))
    label = np.exp(x @ W["label.weight"].T + W["label.bias"])
    coordinate = 1.0 / (1.0 + np.exp(-x @ W["coordinate.weight"].T - W["coordinate.bias"]))
    return label / label.sum(1, keepdims=True), coordinate.reshape(len(points), -1, 3)


def test_the_network_is_pointnet_plus_plus_point_by_point():
    torch.manual_seed(0)
    levels = (
        Level(centres=9, radius=0.5, neighbours=4),
        Level(centres=4, radius=0.7, neighbours=5),
    )
    net = NPCSNet(ModelSettings(parts=3, levels=levels)).double().eval()
    for layer in net.modules():
        if isinstance(layer, torch.nn.BatchNorm1d):
            for values in (layer.running_mean, layer.weight, layer.bias, layer.running_var):
                torch.nn.init.uniform_(values, 0.1, 1.0)
    W = {name: values.detach().numpy() for name, values in net.state_dict().items()}
    cloud = torch.rand(2, 20, 3).double() - 0.5
    with torch.no_grad():
        label, coordinate = net(cloud)
    for b, points in enumerate(cloud.numpy()):
        wanted = literal_net(W, levels, points)
        np.testing.assert_allclose(label[b], wanted[0], atol=1e-9)
        np.testing.assert_allclose(coordinate[b], wanted[1], atol=1e-9)
    kept = torch.zeros(2, 20, WIDTH, dtype=torch.bool)
    nothing = net(cloud, kept)[0].detach()  # biases alone, which begin at 0
    np.testing.assert_allclose(nothing, 1.0 / 3.0)


def test_neighbourhoods_are_those_that_their_names_say():
    line = torch.tensor([[[0.0], [0.1], [0.2], [1.0], [0.6]]]) * torch.tensor([1.0, 0.0, 0.0])
    assert farthest(line, 4).tolist() == [[0, 3, 4, 2]]
    near = within(line[:, [1, 3]], line, 0.15, 4)
    assert near.tolist() == [[[0, 1, 2, 0], [3, 3, 3, 3]]]
    known = torch.eye(5)[None]
    at = torch.tensor([[[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]])
    weights = interpolated(at, line, known)[0].numpy()
    np.testing.assert_allclose(weights[0], [1.0, 0, 0, 0, 0], atol=1e-6)
    inverse = np.array([1 / 0.09, 1 / 0.04, 1 / 0.01, 0.0, 1 / 0.09])
    inverse[4 if weights[1][0] else 0] = 0.0  # both are as far
    np.testing.assert_allclose(weights[1], inverse / inverse.sum(), atol=1e-6)


@settings(max_examples=15)
@given(st.integers(0, 2**32))
def test_both_losses_are_what_their_formulas_say(seed):
    rng = np.random.default_rng(seed)
    label = rng.dirichlet(np.ones(4), (2, 9))
    coordinate, rest = rng.random((2, 9, 4, 3)), rng.random((2, 9, 3)) - 0.5
    part = rng.integers(0, 3, (2, 9))  # part 3 is nowhere
    middle, diagonal = rng.random((5, 4, 3)) - 0.5, 0.2 + rng.random((5, 4, 1))
    away, lacks = [], []
    for b, row in enumerate((4, 1)):
        for i, k in enumerate(part[b]):
            wanted = (rest[b, i] - middle[row, k]) / diagonal[row, k] + 0.5
            away.append(np.linalg.norm(coordinate[b, i, k] - wanted))
        each = []
        for k in np.unique(part[b]):
            w, true = label[b, :, k], part[b] == k
            both = (w * true).sum()
            each.append(1.0 - both / (w.sum() + true.sum() - both))
        lacks.append(np.mean(each))
    none = torch.zeros(2, 0)
    cloud = torch.zeros(2, 9, 3)
    batch = Batch(
        torch.tensor([4, 1]), cloud, torch.from_numpy(part), cloud[:, :0], none > 0, 0, none,
        rest=torch.from_numpy(rest),
    )  # fmt: skip
    output = torch.from_numpy(label), torch.from_numpy(coordinate)
    found = errors(output, batch, (torch.from_numpy(middle), torch.from_numpy(diagonal)))
    assert [float(x) for x in found] == pytest.approx([np.mean(away), np.mean(lacks)])


def test_targets_are_the_same_in_every_pose_and_fill_each_part_s_box(boxes):
    learner = NPCSLearner(plan(), 0, CPU)
    training, _ = Training(plan(), "box", boxes, boxes).split(learner)
    learner.begin(training, boxes)
    batch = training.batch(range(len(training)), learner.inputs, 0, torch.Generator())
    middle, diagonal = learner.boxes
    at = batch.rows[:, None], batch.part.long()
    wanted = ((batch.rest - middle[at]) / diagonal[at]).numpy()
    assert np.abs(wanted).max() <= 0.5 + 1e-4  # half of a diagonal
    for k in range(3):
        corners = np.abs(wanted[batch.part.numpy() == k]).max(0)
        assert 0.46 < np.linalg.norm(corners) <= 0.5 + 1e-4
    assert len(middle.unique(dim=0)) == 2  # of two objects, whatever the pose
    kept = batch.chance.view(*batch.cloud.shape[:2], WIDTH) < 0.5
    with torch.no_grad():
        terms = learner.loss(batch)
        away, lacks = errors(learner.network(batch.cloud, kept), batch, learner.boxes)
    assert float(terms["coordinate"]) == pytest.approx(10.0 * float(away), rel=1e-4)
    assert float(terms["label"]) == pytest.approx(float(lacks), rel=1e-4)
    assert {m.momentum for m in learner.network.modules() if hasattr(m, "momentum")} == {0.5}


@settings(max_examples=25)
@given(st.integers(0, 2**32))
def test_a_similarity_is_kabsch_s_rotation_and_the_scale_of_pairwise_distances(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    R, scale = rotation_about(axis / np.linalg.norm(axis), 3.0 * rng.random()), 0.2 + rng.random()
    source, shift = rng.random((12, 3)) - 0.5, rng.random(3)
    target = scale * source @ R.T + shift
    fit = similarity(source, target)
    for ours, true in zip(fit, (scale, R, shift), strict=True):
        np.testing.assert_allclose(ours, true, atol=1e-9)
    noisy = target + 0.05 * rng.normal(size=target.shape)
    pairs = [(i, j) for i in range(12) for j in range(12)]
    a = np.array([np.linalg.norm(source[i] - source[j]) for i, j in pairs])
    b = np.array([np.linalg.norm(noisy[i] - noisy[j]) for i, j in pairs])
    ours, turned, _ = similarity(source, noisy)
    assert ours == pytest.approx((a @ b) / (a @ a))
    assert np.linalg.det(turned) == pytest.approx(1.0)
    flat = similarity(source * [1, 1, 0], noisy * [1, 1, -1])[1]  # a mirror would fit better
    assert np.linalg.det(flat) == pytest.approx(1.0)


def test_a_pose_is_fitted_to_most_points_and_always_the_same():
    rng = np.random.default_rng(2)
    R, middle = rotation_about([0.6, 0.0, -0.8], 1.2), np.array([0.1, -0.2, 0.3])
    coordinates = 0.6 * (rng.random((100, 3)) - 0.5)
    points = 0.8 * coordinates @ R.T + middle
    points[:35] = rng.random((35, 3)) - 0.5
    fits = [pose(coordinates, points, np.random.default_rng(7)) for _ in range(2)]
    np.testing.assert_array_equal(*fits)
    np.testing.assert_allclose(fits[0][:3, 3], middle, atol=0.02)
    assert np.degrees(turn_of(R.T @ fits[0][:3, :3])[0]) < 4.0
    assert np.isnan(pose(coordinates[:2], points[:2], rng)).all()


def test_joints_are_read_off_motions_relative_to_the_base():
    base = transform(rotation_about([0, 0, 1.0], 0.3), [0.1, 0.0, 0.2])
    axis = np.array([0.6, 0.0, -0.8])
    turned = transform(rotation_about(axis, 2.0), [0.3, 0.1, 0.0])
    slid = transform(None, [0.0, -0.25, 0.0])
    gone = transform(rotation_about(axis, 1.0), np.full(3, np.nan))  # a fit without inliers
    points, part = np.zeros((4, 3)), np.arange(4)
    first = labelled_points(points, part, 4, T_part=np.tile(np.eye(4), (4, 1, 1)))
    T_part = np.stack([base, base @ turned, base @ slid, gone])
    posed = labelled_points(points, part, 4, T_part=T_part)
    kind = np.array([0, 1, 2, 1])
    both = joints_of(first, posed, kind, np.zeros(4, int))
    assert both is not None
    np.testing.assert_allclose(both[1].state[:3] - both[0].state[:3], [0.0, 2.0, 0.25])
    np.testing.assert_allclose(both[1].direction[1:3], [axis, [0.0, -1.0, 0.0]], atol=1e-12)
    assert np.isnan(both[1].pivot).all()
    motion = first.motion_to(posed)
    assert motion is not None
    np.testing.assert_array_equal(motion[3], np.eye(4))  # it is taken not to move
    motion = posed.motion_to(first)
    assert motion is not None
    np.testing.assert_array_equal(motion[3], np.eye(4))
    assert joints_of(first, labelled_points(points, part, 4), kind, kind) is None
    for angle in (0.0, 1e-4, np.pi):
        assert turn_of(rotation_about(axis, angle))[0] == pytest.approx(angle, abs=1e-9)


def test_true_motions_alone_are_judged_without_pivots_and_surfaces(boxes):
    found = evaluate_as_paper(
        boxes,
        lambda instance: replace(truth(instance), joints=None, whole=None),
        Protocol(points=60),
    )
    means = found.means
    assert means["epe_transform_all"] < 1e-4 < means["epe_nothing_moves"]
    assert means["revolute_state_below_5"] == 100.0
    assert means["revolute_direction_below_5"] == 100.0
    assert means["prismatic_state_below_0.025"] == 100.0  # the knob is on the lid
    assert means["prismatic_direction_below_5"] == 100.0
    assert means["matched_direction_degrees"] < 0.1
    assert 0.0 <= means["direction_not_judged"] < 50.0
    absent = {"f_score", "chamfer_l1", "no_surface", "type_accuracy", "matched_pivot_distance"}
    assert not absent & means.keys()
    assert not [name for name in means if "axis" in name or name.startswith("epe_joint")]
    assert {e.axis for e in found.joint_errors} == {None}


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ({"states": 0}, r"articulation\.states above 0"),
        ({"parts": 2}, r"has 3 parts, the recipe's network 2; set model\.parts to 3"),
    ],
)
def test_unfit_data_are_refused_before_training(tmp_path, how, sentence):
    data = write_boxes(tmp_path / "boxes", train=2, test=1, states=how.get("states", 1))
    with pytest.raises(UnfitData, match=sentence):
        train(Training(plan(parts=how.get("parts", 3)), "box", data, tmp_path / "runs"))


def test_points_of_grids_are_not_needed_and_hinder_nobody(boxes, tmp_path):
    recipe = plan(2)
    data = recipe.data.model_copy(update={"grid_points": 8})
    recipe = recipe.model_copy(update={"data": data})
    run = train(Training(recipe, category="box", data=boxes, runs=tmp_path / "runs"))
    assert run.metrics()[-1]["validation"]["loss"] > 0


def test_it_resumes_exactly(boxes, tmp_path):
    resumed_exactly(Training(plan(6), category="box", data=boxes, runs=tmp_path / "runs"), 3)


@pytest.mark.usefixtures("few_pictures")
def test_it_learns_and_is_judged_and_makes_no_mesh(boxes, tmp_path):
    run = train(Training(plan(300), category="box", data=boxes, runs=tmp_path / "runs"))
    found = evaluate(run.path, boxes, resolution=16)
    means = found.means
    assert (found.run.method, len(found.votes)) == ("npcs", 3)
    assert means["label_iou"] > 0.35  # one part for everything has 1 / 9
    assert means["epe_transform_all"] < 0.8 * means["epe_nothing_moves"]
    assert not {"f_score", "chamfer_l1", "reconstruction_iou", "type_accuracy"} & means.keys()
    with pytest.raises(ArticugenError, match="makes no surface"):
        predict(run.path, next(boxes.glob("test-*.h5")), out=tmp_path / "rig")
    assert not (tmp_path / "rig").exists()
    assert len(list(draw(run.path, boxes, found))) == 1  # labelled points
