"""OP-Align, frame given: its layers, alignment and losses against a literal reading, and that it
learns."""

import numpy as np
import pytest
from digests import resumed_exactly
from hypothesis import given, settings
from hypothesis import strategies as st
from ppd_data import write_boxes

torch = pytest.importorskip("torch", reason="learners need torch")

from learners import parameters

import articugen
from articugen.core.errors import InvalidRecipe, UnfitData
from articugen.core.geometry import rotation_about
from articugen.learning.commands import evaluate
from articugen.learning.loop import Training, train
from articugen.learning.method import find_method, load_recipe
from articugen.learning.opalign.learner import OPAlignLearner, astray, sides, terms_of
from articugen.learning.opalign.network import (
    Joints,
    OPAlignNet,
    Posed,
    Segmenter,
    alignment,
    between,
    turn,
)
from articugen.learning.opalign.settings import ModelSettings, OPAlignRecipe

torch.set_num_threads(1)

CPU = torch.device("cpu")


def plan(iterations=1, model=None) -> OPAlignRecipe:
    return OPAlignRecipe.model_validate({
        "name": "tiny",
        "model": {"width": 32} | (model or {}),
        "data": {"surface_points": 96, "grid_points": 0, "validation_objects": 1},
        "schedule": {
            "batch": 6, "learning_rate": 3e-3, "halve_after": 60, "validate_every": 1000,
            "stages": [{"resolution": 16, "iterations": iterations}],
        },
    })  # fmt: skip


def test_pivots_of_few_points_are_as_far_as_all_of_them():
    points, pivot = torch.tensor([[[0.0, 0, 0], [0.2, 0, 0]]]), torch.zeros(1, 1, 3)
    assert astray(pivot, points) == astray(pivot, points.repeat(1, 4, 1))


def test_parameters_and_rates_are_those_that_were_published():
    with torch.device("meta"):
        net = OPAlignNet(ModelSettings(), 1024)
    assert parameters(net.segmenter) == 1_783_210
    H, N = 256, 1024
    assert parameters(net.shape) + N * 3 == 3 * (H * H + 3 * H) + (H + 1) * 3 * N + 3 * N
    paper, own = load_recipe("opalign_paper"), load_recipe(method="opalign")
    assert isinstance(paper, OPAlignRecipe)
    assert (paper.model, own.name) == (ModelSettings(), "opalign")
    rates = [paper.schedule.rate_at(i) for i in (0, 4999, 5000, 10_000)]
    assert rates == pytest.approx([1e-4, 1e-4, 5e-5, 2.5e-5])
    two = find_method("opalign").start(plan(model={"revolute": 2}), seed=0, device=CPU)
    assert two.inputs.joints == (2, 0)


@pytest.mark.parametrize("model", [{"prismatic": 1}, {"revolute": 0}, {"revolute": 3}])
def test_one_or_two_joints_of_one_kind_are_all_it_knows(model):
    with pytest.raises(InvalidRecipe):
        load_recipe({"extends": "opalign", "model": model})


def test_drawers_with_more_joints_are_refused_before_training(tmp_path):
    boxes = write_boxes(tmp_path / "boxes", train=2, test=1, states=1)  # a hinge and a slide
    with pytest.raises(UnfitData, match=r"prismatic joint.* the recipe.s model"):
        train(Training(plan(), "box", boxes, tmp_path / "runs"))


def norm(W, name, x):
    x = (x - W[f"{name}.running_mean"]) / np.sqrt(W[f"{name}.running_var"] + 1e-5)
    return x * W[f"{name}.weight"] + W[f"{name}.bias"]


def dense(W, name, x):
    return x @ W[f"{name}.weight"].T + W.get(f"{name}.bias", 0.0)


@pytest.mark.parametrize("joints", [1, 2])
def test_the_segmenter_is_five_residual_blocks_with_what_they_pool(joints):
    torch.manual_seed(0)
    net = Segmenter(ModelSettings(width=8, revolute=joints)).double().eval()
    for name, values in net.state_dict().items():
        if values.is_floating_point():
            torch.nn.init.uniform_(values, 0.1 if "var" in name else -0.6, 0.8)
    W = {name: values.numpy() for name, values in net.state_dict().items()}
    shapes = torch.rand(2, 7, 3).double() - 0.5
    with torch.no_grad():
        label, found = net(shapes)
    for b, points in enumerate(shapes.numpy()):
        x = dense(W, "position", points)
        for i in range(5):
            hidden = dense(W, f"blocks.{i}.first", np.maximum(x, 0.0))
            y = dense(W, f"blocks.{i}.second", np.maximum(hidden, 0.0))
            y = norm(W, f"norms.{i}", y + dense(W, f"blocks.{i}.shortcut", x))
            x = np.concatenate([y, np.tile(y.max(0), (7, 1))], 1)
        z = np.maximum(norm(W, "label.1", dense(W, "label.0", y)), 0.0)
        z = np.maximum(norm(W, "label.4", dense(W, "label.3", z)), 0.0)
        z = np.exp(dense(W, "label.6", z))
        np.testing.assert_allclose(label[b], z / z.sum(1, keepdims=True), atol=1e-9)
        j = np.maximum(norm(W, "joint.1", dense(W, "joint.0", y.max(0))), 0.0)
        j = dense(W, "joint.4", dense(W, "joint.3", j)).reshape(8, joints)
        np.testing.assert_allclose(found.pivot[b], j[:3].T, atol=1e-9)
        direction = j[3:6] / np.linalg.norm(j[3:6], axis=0)
        np.testing.assert_allclose(found.direction[b], direction.T, atol=1e-9)
        state = np.pi * (1.0 / (1.0 + np.exp(-j[6:])) - 0.5)
        np.testing.assert_allclose(found.state[b], state.T, atol=1e-9)


def random_joints(rng, J) -> Joints:
    u = rng.normal(size=(2, J, 3))
    u /= np.linalg.norm(u, axis=2, keepdims=True)
    parts = rng.random((2, J, 3)) - 0.5, u, rng.uniform(-1.0, 1.0, (2, J, 2))
    return Joints(*map(torch.from_numpy, parts))


@settings(max_examples=6)
@given(st.integers(0, 2**32), st.booleans())
def test_alignment_turns_directions_pivots_and_states_into_each_other(seed, turns):
    rng = np.random.default_rng(seed)
    there, canonical = random_joints(rng, 2), random_joints(rng, 2)
    R, offset = (x.numpy() for x in alignment(there, canonical, turns=turns))
    x = rng.random(3)
    for b, j, a in np.ndindex(2, 2, 2):
        q, u, s = (values[b, j].numpy() for values in there)
        p, v, c = (values[b, j].numpy() for values in canonical)
        axis = np.cross(u, v)
        to = rotation_about(axis / np.linalg.norm(axis), np.arctan2(np.linalg.norm(axis), u @ v))
        np.testing.assert_allclose(to @ u, v, atol=1e-12)
        moved = to @ (x - q)
        moved = rotation_about(v, c[a] - s[a]) @ moved if turns else moved + (c[a] - s[a]) * v
        np.testing.assert_allclose(R[b, j, a] @ x + offset[b, j, a], moved + p, atol=1e-7)
    same = between(there.direction, there.direction)
    np.testing.assert_allclose(same[0, 0], np.eye(3), atol=1e-12)
    still = turn(there.direction, torch.zeros(2, 2).double())
    np.testing.assert_allclose(still[1, 1], np.eye(3))


def literal_terms(there, canonical, offset, whole, turns):
    """Return the terms of section 3 of the paper and of the authors' program, sample by sample."""
    B, J = there.joints.pivot.shape[:2]
    R, shift = (x.numpy() for x in alignment(there.joints, canonical.joints, turns=turns))
    names = ("whole", "parts", "spread", "offset", "centre", "joint", "pivot", "label", "common")
    t = dict.fromkeys(names, 0.0)
    mean_u = canonical.joints.direction.numpy().mean(0)
    for b in range(B):
        x, y = there.points[b].numpy(), canonical.points[b].numpy()
        w, z = there.label[b].numpy(), canonical.label[b].numpy()

        def here(a, k, y=y):
            return 1.0 - np.exp(-k * ((a[:, None] - y) ** 2).sum(2).min(1))

        def back(a, y=y):
            return 0.25 * (1.0 - np.exp(-120.0 * ((y[:, None] - a) ** 2).sum(2).min(1)))

        t["whole"] += 10 * whole * (here(x, 30.0).mean() + back(x).mean())
        moved = [[x @ R[b, j, a].T + shift[b, j, a] for a in range(2)] for j in range(J)]
        parts = [np.mean([m[0] for m in moved], 0), *(m[1] for m in moved)]
        each = sum((here(a, 30.0) * w[:, k]).mean() + (back(a) * z[:, k]).mean()
                   for k, a in enumerate(parts))  # fmt: skip
        t["parts"] += 10 * (1 - whole) * each
        far = np.sort(np.linalg.norm(y[:, None] - y, axis=2), 1)[:, 1:65]
        t["spread"] += 200 * far.var(0, ddof=1).mean()
        t["offset"] += 10 * (1 - np.exp(-60 * (offset[b].numpy() ** 2).sum(1))).mean()
        t["centre"] += (y.mean(0) ** 2).sum()
        u = canonical.joints.direction[b].numpy()
        calm = (canonical.joints.state[b].numpy() ** 2).mean()
        t["joint"] += 10 * (calm + ((u - mean_u) ** 2).sum(1).mean())
        for pivots, shape in ((canonical.joints.pivot, y), (there.joints.pivot, x)):
            for q in pivots[b].numpy():
                near = np.sort(np.linalg.norm(shape - q, axis=1))[:8].mean()
                t["pivot"] += 0.1 * (1 - np.exp(-30 * near**2)) / J
        lacks = np.maximum(0.1 - z.mean(0), 0).mean()
        lacks += sum(np.maximum(0.01 - p.min(1), 0).mean() for p in (w, z))
        t["label"] += 10 * lacks
        if J == 2:
            to = between(there.joints.direction, canonical.joints.direction)[b].numpy()
            t["common"] += 10 * ((moved[0][0] - moved[1][0]) ** 2).sum(1).mean()
            t["common"] += ((to[0] - to[1]) ** 2).mean()
    return {name: value / B for name, value in t.items()}


@settings(max_examples=10)
@given(st.integers(0, 2**32), st.booleans(), st.integers(1, 2))
def test_each_loss_is_what_its_formula_says(seed, turns, joints):
    rng = np.random.default_rng(seed)

    def posed():
        label = rng.dirichlet(np.full(joints + 1, 0.2), (2, 70))
        points = torch.from_numpy(0.6 * rng.random((2, 70, 3)) - 0.2)
        return Posed(points, torch.from_numpy(label), random_joints(rng, joints))

    there, canonical = posed(), posed()
    offset = torch.from_numpy(0.1 * rng.normal(size=(2, 70, 3)))
    wanted = literal_terms(there, canonical, offset, 0.3, turns)
    found = terms_of(there, canonical, offset, whole=0.3, turns=turns)
    assert {"common": 0.0} | {k: float(v) for k, v in found.items()} == pytest.approx(wanted)


def test_a_part_s_transform_undoes_its_alignment_and_moves_by_its_own_state():
    torch.manual_seed(2)
    learner = OPAlignLearner(plan(model={"revolute": 2}), 0, CPU)
    cloud = np.random.default_rng(1).random((50, 3)) - 0.5
    found = learner.reconstruct(cloud, resolution=16)
    assert (found.parts, found.whole, len(found.part)) == (3, None, 96)
    learner.network.eval()
    again = torch.as_tensor(cloud[np.arange(96) % 50], dtype=torch.float32)[None]
    with torch.no_grad():
        there, canonical, _ = learner.network(again)
    R, offset = (sides(x)[0].numpy() for x in alignment(there.joints, canonical.joints, turns=True))
    for k, (joint, side) in enumerate(((0, 0), (0, 1), (1, 1))):
        both = np.eye(4)
        both[:3, :3], both[:3, 3] = R[k], offset[k]
        np.testing.assert_allclose(found.T_part[k] @ both, np.eye(4), atol=1e-5)
        assert found.joints.state[k] == pytest.approx(float(there.joints.state[0, joint, side]))
        np.testing.assert_allclose(found.joints.pivot[k], there.joints.pivot[0, joint], atol=1e-6)
    assert set(found.joints.kind) == {1}


@pytest.fixture(scope="module")
def laptops(tmp_path_factory):
    recipe = {
        "articulation": {"states": 3},
        "views": {"count": 8, "resolution": 48},
        "sampling": {"grids": [16], "surface_points": 500, "partial_views": 0},
    }
    out = tmp_path_factory.mktemp("laptops")
    articugen.generate("laptop", out=out, recipe=recipe, objects=4, jobs=0)
    return out / "laptop"


def test_it_resumes_exactly(laptops, tmp_path):
    resumed_exactly(Training(plan(6), category="laptop", data=laptops, runs=tmp_path / "runs"), 3)


def test_it_learns_and_is_judged_without_surfaces(laptops, tmp_path):
    run = train(Training(plan(120), category="laptop", data=laptops, runs=tmp_path / "runs"))
    terms = [line["terms"] for line in run.metrics() if "terms" in line]
    assert all(terms[-1][name] < 0.5 * terms[0][name] for name in ("whole", "spread", "joint"))
    found = evaluate(run.path, laptops, resolution=16)
    assert (found.run.method, len(found.votes)) == ("opalign", 2)
    assert found.means["label_iou"] > 0.25  # that of one part for everything
    assert {"epe_joint_all", "epe_transform_all", "type_accuracy"} <= found.means.keys()
    absent = {"f_score", "chamfer_l1", "reconstruction_iou", "no_surface", "finer_label_iou"}
    assert not absent & found.means.keys()
