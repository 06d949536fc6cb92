"""BSP-Net: its layers, losses and polygons against a literal reading, and that it learns."""

from itertools import combinations

import numpy as np
import pytest
import torch
from digests import digest, resumed_exactly
from hypothesis import example, given, settings
from hypothesis import strategies as st
from learners import batch_of, parameters
from ppd_data import write_boxes

from articugen.learning.bsp import learner as lesson
from articugen.learning.bsp.learner import BSPLearner
from articugen.learning.bsp.network import BSPNet, filled, outside
from articugen.learning.bsp.polytopes import cut, reconstruction_of_polytopes
from articugen.learning.bsp.settings import BSPRecipe, ModelSettings
from articugen.learning.commands import evaluate
from articugen.learning.data.batch import Batch
from articugen.learning.loop import Training
from articugen.learning.method import load_recipe

CPU = torch.device("cpu")
SMALL = {"voxels": 16, "code": 8, "widths": (12, 16, 20), "planes": 9, "convexes": 4}


def recipe(*stages: tuple[str, int], model=SMALL, **more) -> BSPRecipe:
    plan = [{"resolution": 16, "loss": loss, "iterations": count} for loss, count in stages]
    schedule = {"batch": 2, "learning_rate": 4e-3, "stages": plan, "validate_every": 9}
    data = {"surface_points": 300, "grid_points": 64, "band_points": 64, "validation_objects": 1}
    about = {"name": "tiny", "model": model, "data": data, "schedule": schedule}
    return BSPRecipe.model_validate(about | more)


@pytest.mark.parametrize(
    ("model", "count"),
    [
        ({}, 44_325_344),  # the 443.3 x 10^5 of the paper's Table 4
        ({"convexes": 8}, 43_309_288),
    ],
)
def test_parameters_are_those_that_were_published(model, count):
    net = BSPLearner(recipe(("continuous", 1), model=model), 0, torch.device("meta")).network
    assert parameters(net) == count


def test_the_recipes_are_of_the_paper_s_sizes_or_smaller():
    paper, eight, *reduced = map(load_recipe, ("bsp_paper", "bsp8_paper", "bsp", "bsp8"))
    assert isinstance(paper, BSPRecipe)
    assert isinstance(eight, BSPRecipe)
    assert paper.model == ModelSettings()
    assert eight.model == ModelSettings(convexes=8)
    assert paper.schedule == eight.schedule
    for small, convexes in zip(reduced, (256, 8), strict=True):
        assert isinstance(small, BSPRecipe)
        assert small.model.convexes == convexes
        assert [s.loss for s in small.schedule.stages] == [s.loss for s in paper.schedule.stages]
    assert load_recipe(method="bsp").name == "bsp"


def spread(net, seed: int) -> dict[str, np.ndarray]:
    """Draw weights that make some planes and convexes matter; return them for numpy."""
    torch.manual_seed(seed)
    net.double()
    for name, p in net.named_parameters():
        torch.nn.init.normal_(p, 0.0 if name != "T" else -0.02, 0.3 if name != "T" else 0.03)
    return {name: p.detach().numpy() for name, p in net.named_parameters()}


@settings(max_examples=20)
@given(st.integers(0, 2**32))
def test_the_layers_are_what_they_are_called(seed):
    net = BSPNet(ModelSettings(**SMALL))
    W = spread(net, seed)
    cloud, points = torch.rand(2, 50, 3).double() - 0.5, torch.rand(2, 7, 3).double() - 0.5
    with torch.no_grad():
        x = net.encoder(cloud).numpy()
        planes, used = net.all_planes(cloud), net.encode(cloud)
        soft = outside(planes, net.T, points)
        whole, fields = filled(soft, net.W), net.fields(used, points)
    for i in (0, 2, 4):
        x = x @ W[f"hidden.{i}.weight"].T + W[f"hidden.{i}.bias"]
        x = np.where(x > 0.0, x, 0.01 * x)
    P = (x @ W["planes.weight"].T + W["planes.bias"]).reshape(2, 4, 9)
    np.testing.assert_allclose(planes, P, atol=1e-9)
    T, binary = W["T"], W["T"] > 0.01
    D = np.maximum(np.concatenate([points, np.ones((2, 7, 1))], 2) @ P, 0.0)
    np.testing.assert_allclose(soft, D @ T, atol=1e-9)
    C = np.clip(1.0 - D @ T, 0.0, 1.0)
    np.testing.assert_allclose(whole, np.clip(C @ W["W"], 0.0, 1.0)[..., 0], atol=1e-9)
    out = (D @ binary).transpose(0, 2, 1)
    np.testing.assert_array_equal(fields.numpy() > 0.0, out < 0.01)
    np.testing.assert_allclose(fields, np.maximum(2.0 - 200.0 * out, -2.0), atol=1e-6)


@pytest.mark.parametrize("overlap", [False, True])
def test_planes_that_bound_nothing_are_left_out_exactly(overlap):
    """All of them, as the authors' program takes them: the same values and gradients."""
    net = BSPNet(ModelSettings(**SMALL))
    spread(net, 4)
    with torch.no_grad():
        net.T[[1, 5, 6]] = -1.0
        net.T[0] = 1.0
    assert len(net.used()) <= 6
    cloud, points = torch.rand(2, 50, 3).double() - 0.5, torch.rand(2, 40, 3).double() - 0.5
    true = (torch.rand(2, 40) < 0.5).double()
    all_of_them = (net.T.detach() > 0.01).double()
    some, everything = (
        lesson.union_loss(out, true) + overlap * lesson.overlap_loss(out, true)
        for out in (
            outside(net.encode(cloud), net.bounds(), points),
            outside(net.all_planes(cloud), all_of_them, points),
        )
    )
    assert float(some.detach()) == pytest.approx(float(everything.detach()), rel=1e-12)
    learned = {name: p for name, p in net.named_parameters() if name not in ("T", "W")}
    gradients = [torch.autograd.grad(loss, [*learned.values()]) for loss in (some, everything)]
    for name, ours, literal in zip(learned, *gradients, strict=True):
        np.testing.assert_allclose(ours, literal, atol=1e-13, err_msg=name)
    assert gradients[0][-2].abs().sum() > 0.0


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.sampled_from([1, 4]))
def test_each_loss_is_what_its_formula_says(seed, inside):
    rng = np.random.default_rng(seed)
    B, n, c, p = 2, 5, 3, 4
    out = np.maximum(rng.normal(0.0, 0.6, (B, n, c)), 0.0) * rng.choice([0.01, 1.0], (B, n, c))
    true = rng.integers(0, 2, (B, n)).astype(float)
    T, W = rng.normal(0.3, 0.8, (p, c)), rng.normal(0.5, 0.5, (c, 1))
    union = binary = overlap = t = 0.0
    for b, i in np.ndindex(B, n):
        least = min(out[b, i])
        union += max(least, 0.0) if true[b, i] else 1.0 - min(least, 1.0)
        within = [k for k in range(c) if out[b, i, k] < 0.01]
        if len(within) > 1:
            overlap -= sum(out[b, i, k] * true[b, i] for k in within)
    for entry in T.flat:
        t += max(entry - 1.0, 0.0) - min(entry, 0.0)
        binary += abs(entry) if entry < 0.01 else abs(entry - 1.0)
    tensors = [torch.from_numpy(x) for x in (out, true, T, W)]
    ours_out, ours_true, ours_T, ours_W = tensors
    assert float(lesson.union_loss(ours_out, ours_true)) == pytest.approx(union / (B * n))
    overlaps = float(lesson.overlap_loss(ours_out, ours_true))
    assert overlaps == pytest.approx(overlap / (B * n * c), abs=1e-12)
    assert float(lesson.binary_loss(ours_T)) == pytest.approx(binary)
    terms = lesson.weights_loss(ours_T, ours_W)
    assert float(terms["t"]) == pytest.approx(t)
    assert float(terms["w"]) == pytest.approx(sum(abs(w - 1.0) for w in W[:, 0]))


def test_each_stage_has_its_terms_and_the_first_iterations_are_fourfold():
    names = ("continuous", "hard", "hard_overlap", "soft", "soft_overlap")
    learner = BSPLearner(recipe(*((name, 2) for name in names), fourfold=1), 3, CPU)
    net = learner.network
    spread(net, 5)
    cloud, points = torch.rand(2, 40, 3).double() - 0.5, torch.rand(2, 30, 3).double() - 0.5
    occupied = torch.rand(2, 30) < 0.4
    with torch.no_grad():
        terms = []
        for learner.iteration in range(10):
            terms.append(learner.loss(batch_of(cloud, points, occupied)))
        soft = outside(net.all_planes(cloud), net.T, points)
        hard = outside(net.all_planes(cloud), (net.T > 0.01).double(), points)
    assert [set(t) for t in terms[::2]] == [
        {"rec", "w", "t"}, {"rec"}, {"rec", "overlap"}, {"rec", "t"}, {"rec", "t", "overlap"},
    ]  # fmt: skip
    S, o = filled(soft, net.W).detach().numpy(), occupied.numpy()
    assert float(terms[0]["rec"]) == pytest.approx(np.mean((4.0 * o - S) ** 2))
    assert float(terms[1]["rec"]) == pytest.approx(np.mean((o - S) ** 2))
    for i, out in ((2, hard), (4, hard), (6, soft), (8, soft)):
        rec = float(lesson.union_loss(out, occupied.double()))
        assert float(terms[i]["rec"]) == pytest.approx(rec)
    assert vars(learner.descent.optimiser)["betas"] == (0.5, 0.999)


def test_where_nothing_is_between_it_starts_again():
    learner = BSPLearner(recipe(("continuous", 900), restart_after=3), 3, CPU)
    cloud, points = torch.rand(2, 40, 3) - 0.5, torch.rand(2, 30, 3) - 0.5
    batch = batch_of(cloud, points, torch.rand(2, 30) < 0.4)
    with torch.no_grad():
        learner.network.W.fill_(-5.0)  # nothing anywhere, for hundreds of steps
    for i in range(1, 5):
        learner.learn(batch, None, iteration=i)
    assert (int(learner.stuck), learner.restarts) == (4, 0)
    before = learner.network.W.detach().clone()
    learner.learn(batch, None, iteration=100)
    assert learner.restarts == 1
    assert (learner.network.W - before).abs().min() > 1.0
    learner.stuck += 9
    learner.settings = recipe(("continuous", 150), ("hard", 100), restart_after=3)
    learner.learn(batch, None, iteration=200)
    assert learner.restarts == 1  # a hard stage trains no first weights
    again = BSPLearner(learner.settings, 3, CPU)
    assert not torch.equal(again.network.T, learner.network.T)
    again.load(learner.state())
    assert digest(again.state()) == digest(learner.state())


CUBE = np.concatenate([np.hstack([s * np.eye(3), np.full((3, 1), -0.5)]) for s in (-1.0, 1.0)])


def volume(triangles: np.ndarray) -> float:
    a, b, c = triangles.transpose(1, 0, 2)
    assert np.abs(np.cross(b - a, c - a).sum(0)).max() < 1e-9  # closed
    return float((a * np.cross(b, c)).sum() / 6.0)


def test_without_planes_the_cube_is_left_and_corners_have_their_volume():
    whole = cut(np.zeros((0, 4)))
    assert whole is not None
    assert volume(whole.triangles()) == pytest.approx(1.0)
    for h in (0.3, 1.0):  # a corner off: x + y + z <= 1.5 - h
        left = cut(np.array([[7.0, 7.0, 7.0, 7.0 * (h - 1.5)], [2.0, 0.0, 0.0, -1.0]]))
        assert left is not None
        assert volume(left.triangles()) == pytest.approx(1.0 - h**3 / 6.0)
        assert len(left.vertices) == (10 if h < 1.0 else 7)
    halved = cut(np.array([[0.0, 0.0, 1e-3, 0.0]]))
    assert halved is not None
    assert volume(halved.triangles()) == pytest.approx(0.5)
    assert cut(np.array([[1.0, 0.0, 0.0, 0.5]])) is None  # touches a face
    assert cut(np.array([[1.0, 0.0, 0.0, -0.1], [-1.0, 0.0, 0.0, 0.2]])) is None
    assert cut(np.array([[0.0, 0.0, 0.0, 1.0]])) is None
    assert cut(np.array([[0.0, 0.0, 0.0, -1.0]])) is not None


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.integers(1, 8), st.booleans())
@example(7, 8, True)
def test_polytopes_have_the_corners_that_all_triples_of_planes_say(seed, count, regular):
    rng = np.random.default_rng(seed)
    planes = np.hstack([rng.normal(size=(count, 3)), rng.normal(-0.1, 0.3, (count, 1))])
    if regular:  # many planes through one corner, and twice the same
        planes = np.round(2.0 * planes) / 2.0
    length = np.linalg.norm(planes[:, :3], axis=1)
    A = np.concatenate([CUBE, planes[length > 0.0] / length[length > 0.0, None]])
    corners = []
    for three in combinations(A, 3):
        M = np.array(three)
        if abs(np.linalg.det(M[:, :3])) > 1e-9:
            x = np.linalg.solve(M[:, :3], -M[:, 3])
            if (A[:, :3] @ x + A[:, 3]).max() < 1e-8:
                corners.append(x)
    true = np.unique(np.round(np.array(corners).reshape(-1, 3), 6) + 0.0, axis=0)
    left = cut(planes)
    if left is None:
        empty = (planes[length == 0.0, 3] > 0.0).any() or len(true) < 4
        assert empty or np.linalg.matrix_rank(true[1:] - true[0], tol=1e-6) < 3
        return
    np.testing.assert_allclose(np.unique(np.round(left.vertices, 6) + 0.0, axis=0), true, atol=2e-6)
    points = rng.uniform(-0.5, 0.5, (4000, 3))
    inside = (points @ A[:, :3].T + A[:, 3]).max(1) <= 0.0
    np.testing.assert_array_equal(left.clearance(points) >= 0.0, inside)
    assert volume(left.triangles()) == pytest.approx(inside.mean(), abs=0.035)


def test_convexes_are_parts_and_their_union_is_the_whole():
    boxes = [cut(np.hstack([CUBE[:, :3], h[:, None]])) for h in -np.array(
        [[0.4, 0.3, 0.3, -0.1, 0.3, 0.3], [0.05, 0.2, 0.2, 0.4, 0.2, 0.2]]
    )]  # fmt: skip
    shape = reconstruction_of_polytopes([boxes[0], None, boxes[1]], 40)
    assert (shape.parts, set(shape.part)) == (3, {0, 2})
    assert [volume(shape.triangles[shape.part == k]) for k in (0, 2)] == pytest.approx(
        [0.3 * 0.6 * 0.6, 0.45 * 0.4 * 0.4]
    )
    union = 0.108 + 0.45 * 0.16
    assert volume(shape.whole) == pytest.approx(union, rel=0.02)
    assert shape.occupied.mean() == pytest.approx(union, rel=0.05)
    nothing = reconstruction_of_polytopes([None], 16)
    assert (len(nothing.triangles), len(nothing.whole), nothing.occupied.any()) == (0, 0, False)


HALF = torch.tensor([[0.10, 0.20, 0.15], [0.10, 0.15, 0.25]])
MIDDLE = torch.tensor([[-0.22, -0.22, -0.066], [0.22, 0.22, 0.066]])


def in_boxes(points):
    """Return (..., 2), in which of two boxes points (..., 3) lie."""
    return ((points[..., None, :] - MIDDLE).abs() < HALF).all(-1)


def two_boxes(rng) -> Batch:
    """Draw two clouds of two boxes, and points around them."""
    side = 2.0 * torch.rand(2, 2, 150, 3, generator=rng) - 1.0
    axis = torch.randint(3, (2, 2, 150, 1), generator=rng)
    side = side.scatter(3, axis, side.gather(3, axis).sign())
    cloud = (MIDDLE[:, None] + side * HALF[:, None]).flatten(1, 2)
    which = torch.randint(2, (2, 128), generator=rng)
    around = 1.3 * HALF[which] * (2.0 * torch.rand(2, 128, 3, generator=rng) - 1.0)
    points = torch.cat([torch.rand(2, 128, 3, generator=rng) - 0.5, MIDDLE[which] + around], 1)
    return batch_of(cloud, points, in_boxes(points).any(2))


def test_it_separates_two_boxes():
    """Neither is left out and no convex spans both; a loss that is wrong does not come to that."""
    model = SMALL | {"code": 16, "widths": (32, 64, 128), "planes": 128, "convexes": 16}
    plan = recipe(("continuous", 500), ("hard", 250), model=model)
    learner, rng = BSPLearner(plan, 5, CPU), torch.Generator().manual_seed(5)
    for i in range(plan.schedule.iterations):
        learner.learn(two_boxes(rng), None, iteration=i)
    shape = learner.reconstruct(two_boxes(rng).cloud[0].double().numpy(), resolution=32)
    centres = (torch.arange(32) + 0.5) / 32 - 0.5
    true = in_boxes(torch.stack(torch.meshgrid(3 * [centres], indexing="ij"), 3)).numpy()
    found, both = shape.occupied, true.any(3)
    assert (found & both).sum() > 0.65 * (found | both).sum()  # one convex: 0.46
    for k in set(shape.part):
        reach = shape.triangles[shape.part == k][..., 0]
        assert reach.min() > 0.0 or reach.max() < 0.0


def test_it_resumes_as_if_it_had_not_stopped_and_is_judged(tmp_path):
    boxes = write_boxes(tmp_path / "boxes", train=3, test=1, states=1)
    plan = recipe(("continuous", 10), ("hard", 8))
    whole = resumed_exactly(Training(plan, "box", boxes, tmp_path / "runs"), 6, 14)  # each stage
    found = evaluate(whole.path, boxes, resolution=16)
    assert (found.run.method, len(found.votes)) == ("bsp", 4)
    assert not [name for name in found.means if "joint" in name or "_below_" in name]
