"""Neural Star Domain: its layers and losses against a literal reading, and that it learns."""

import numpy as np
import pytest
import torch
from digests import resumed_exactly
from hypothesis import given, settings
from hypothesis import strategies as st
from learners import batch_of, parameters
from ppd_data import write_boxes

from articugen.learning.commands import evaluate
from articugen.learning.loop import Training
from articugen.learning.method import load_recipe
from articugen.learning.nsd.learner import NSDLearner, nearest, sphere, surface_loss, visible
from articugen.learning.nsd.network import directions_of, indicator
from articugen.learning.nsd.settings import LossSettings, ModelSettings, NSDRecipe

CPU = torch.device("cpu")
SMALL = {"code": 6, "stars": 3, "width": 5, "directions": 4}


def learner_of(model=SMALL, iterations=1, seed=0, device=CPU) -> NSDLearner:
    data = {
        "surface_points": 200, "grid_points": 0, "uniform_points": 200, "validation_objects": 1,
    }  # fmt: skip
    stages = [{"resolution": 16, "iterations": iterations}]
    schedule = {"batch": 4, "learning_rate": 1e-2, "stages": stages, "validate_every": 1000}
    about = {"name": "tiny", "model": model, "data": data, "schedule": schedule}
    return NSDLearner(NSDRecipe.model_validate(about), seed, device)


def test_parameters_are_those_that_were_published():
    net = learner_of({}, device=torch.device("meta")).network
    assert parameters(net) == 665_720  # 6.657 x 10^5 in Table 4
    assert parameters(net.encoder) == 165_632
    paper = load_recipe("nsd_paper")
    assert isinstance(paper, NSDRecipe)
    assert (paper.model, paper.losses) == (ModelSettings(), LossSettings())
    assert load_recipe(method="nsd").name == "nsd"


def leaky(x, slope=0.01):
    return np.where(x > 0.0, x, slope * x)


class Literal:
    """Stars one at a time, from a network's weights and a code."""

    def __init__(self, net, code) -> None:
        self.f = code.numpy()
        self.W = {name: p.detach().numpy() for name, p in net.state_dict().items()}
        x = leaky(self._linear("poses.translation.0", self.f), 0.2)
        self.t = self.W["begin"] + self._linear("poses.translation.2", x).reshape(-1, 3)

    def _linear(self, name, x):
        return self.W[f"{name}.weight"] @ x + self.W[f"{name}.bias"]

    def r(self, i, d):
        x = np.concatenate([self.f, self.t[i] + d])
        for layer in range(3):
            x = x @ self.W[f"weights.{layer}"][i] + self.W[f"biases.{layer}"][i, 0]
            x = leaky(x) if layer < 2 else x
        return max(1.0 + 0.1 * x[0], 1e-7)

    def tau(self, i, x):
        far = np.linalg.norm(x - self.t[i])
        return 1.0 - far / self.r(i, (x - self.t[i]) / far)


def drawn_net(seed):
    """Return a small network with weights that matter, and two codes."""
    net = learner_of().network.double()
    torch.manual_seed(seed)
    for p in net.parameters():
        torch.nn.init.normal_(p, std=0.5)
    return net, torch.randn(2, 6).double()


@settings(max_examples=15)
@given(st.integers(0, 2**32))
def test_stars_and_surfaces_are_what_their_formulas_say(seed):
    net, codes = drawn_net(seed)
    points, directions = torch.randn(2, 5, 3).double(), directions_of(torch.rand(2, 4, 2).double())
    with torch.no_grad():
        tau, surfaces = net.stars(codes, points), net.surfaces(codes, directions)
        fields = net.fields(codes, points / 6.0)
    for b, code in enumerate(codes):
        literal = Literal(net, code)
        for i in range(3):
            for n, x in enumerate(points[b].numpy()):
                assert float(tau[b, i, n]) == pytest.approx(literal.tau(i, x), abs=1e-9)
                assert float(fields[b, i, n]) == pytest.approx(10.0 * literal.tau(i, x), abs=1e-8)
            for n, d in enumerate(directions[b].numpy()):
                assert np.linalg.norm(d) == pytest.approx(1.0)
                point = literal.t[i] + literal.r(i, d) * d
                np.testing.assert_allclose(surfaces[b, i, n], point, atol=1e-9)
                assert literal.tau(i, point) == pytest.approx(0.0, abs=1e-6)


@settings(max_examples=15)
@given(st.integers(0, 2**32))
def test_each_loss_is_what_its_formula_says(seed):
    learner = learner_of()
    learner.network, codes = drawn_net(seed)
    learner.network.begin.mul_(0.2)  # stars that overlap
    cloud, points = torch.rand(2, 7, 3).double() - 0.5, 0.4 * (torch.rand(2, 6, 3).double() - 0.5)
    occupied, chance = torch.rand(2, 6) < 0.5, torch.rand(2, 8).double()
    learner.network.encode = lambda cloud: codes
    with torch.no_grad():
        terms = learner.loss(batch_of(cloud, points, occupied, chance=chance))
    entropy, shared, there, back = [], [], [], []
    for b, code in enumerate(codes):
        literal = Literal(learner.network, code)
        for x, o in zip(6.0 * points[b].numpy(), occupied[b].numpy(), strict=True):
            tau = np.array([literal.tau(i, x) for i in range(3)])
            total = (0.5 + 0.5 * np.tanh(50.0 * tau)).sum()
            entropy.append(np.log1p(np.exp(total)) - o * total)
            shared.append(max(total - 1.2, 0.0))
        target, drawn = 6.0 * cloud[b].numpy(), []
        for longitude, latitude in (chance[b].numpy().reshape(4, 2) - 0.5) * [2 * np.pi, np.pi]:
            d = np.array([np.cos(longitude), np.sin(longitude), np.tan(latitude)])
            d *= np.cos(latitude)
            drawn += [literal.t[i] + literal.r(i, d) * d for i in range(3)]
        for p in drawn:
            hidden = sum(max(literal.tau(i, p), 0.0) for i in range(3)) > 0.1
            there.append(0.0 if hidden else min(np.linalg.norm(p - y) for y in target))
        back += [min(np.linalg.norm(p - y) for p in drawn) for y in target]
    assert float(terms["occupancy"]) == pytest.approx(np.mean(entropy))
    assert float(terms["overlap"]) == pytest.approx(10.0 * np.mean(shared))
    assert float(terms["surface"]) == pytest.approx(5.0 * (np.mean(there) + np.mean(back)))


def test_what_lies_in_other_stars_does_not_count_and_yet_can_be_nearest():
    drawn = torch.tensor([[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]])
    cloud = torch.tensor([[[1.0, 0.0, 0.0]]])
    assert nearest(drawn, cloud).tolist() == [[1.0, 3.0]]
    assert float(surface_loss(drawn, torch.tensor([[True, True]]), cloud)) == (2.0 + 1.0) / 2.0
    assert float(surface_loss(drawn, torch.tensor([[False, True]]), cloud)) == (1.5 + 1.0) / 2.0


def test_meshes_lie_on_the_surfaces_and_leave_out_what_others_cover():
    learner = learner_of(SMALL | {"stars": 2})
    net = learner.network
    for p in net.parameters():
        torch.nn.init.zeros_(p)
    net.begin.copy_(torch.tensor([[-0.6, 0.0, 0.0], [0.6, 0.0, 0.0]]))  # spheres of radius 1
    shape = learner.reconstruct(np.zeros((10, 3)), resolution=48)
    near = np.linalg.norm(6.0 * shape.triangles - [-0.6, 0.0, 0.0], axis=2)[shape.part == 0]
    np.testing.assert_allclose(near, 1.0, atol=1e-5)
    a, b, c = shape.triangles[shape.part == 0].transpose(1, 0, 2)
    outward = np.cross(b - a, c - a)
    assert ((outward * (a + np.array([0.1, 0.0, 0.0]))).sum(1) >= -1e-10).all()
    assert 0.2 < 6.0 * shape.triangles[shape.part == 0][..., 0].max() < 0.5
    cap = np.pi * 0.4**2 * (3.0 - 0.4) / 3.0
    union = (2.0 * 4.0 / 3.0 * np.pi - 2.0 * cap) / 6.0**3
    assert shape.occupied.mean() == pytest.approx(union, rel=0.02)
    _, faces = sphere()
    assert len(faces) == 2 * 19 * 19
    code = net.encode(torch.zeros(1, 4, 3))
    inside = torch.tensor([[[0.0, 0.0, 0.0], [-0.6, 1.0, 0.0]]])
    assert visible(net, code, inside).tolist() == [[False, True]]
    assert indicator(net.stars(code, inside)).tolist()[0] == pytest.approx([2.0, 0.5], abs=1e-4)


def test_it_learns_resumes_and_is_judged(tmp_path):
    boxes = write_boxes(tmp_path / "boxes", train=3, test=1, states=1)
    model = {"code": 32, "stars": 4, "width": 32, "directions": 60}
    plan = learner_of(model, 120).settings
    whole = resumed_exactly(Training(plan, category="box", data=boxes, runs=tmp_path / "runs"), 60)
    terms = [line["terms"] for line in whole.metrics() if "terms" in line]
    assert np.mean([t["surface"] for t in terms[-3:]]) < 0.5 * terms[0]["surface"]
    found = evaluate(whole.path, boxes, resolution=16)
    assert (found.run.method, len(found.votes)) == ("nsd", 4)
    assert found.means["reconstruction_iou"] > 0.2
    assert not [name for name in found.means if "joint" in name or "_below_" in name]
