"""SOAP against a plain reading of its paper, one matrix at a time."""

import copy
from pathlib import Path

import pytest
import torch

from articugen.learning.optimisers import GREATEST_SIDE, Soap, optimiser_of
from articugen.learning.ppd.shape import Grouped
from articugen.learning.tensors import check_like

NAMES = ("adam", "soap")
WIDE = GREATEST_SIDE + 6


class Net(torch.nn.Module):
    """Matrices of several shapes, two layers of one shape, sides of 1 and too great ones."""

    def __init__(self):
        super().__init__()
        self.linear, self.wide = torch.nn.Linear(5, 4), torch.nn.Linear(WIDE, 4)
        self.great = torch.nn.Linear(WIDE, WIDE)
        self.groups, self.same = Grouped(3, 5, 4), Grouped(2, 5, 4)
        self.row = Grouped(3, 5, 1)
        self.codes = torch.nn.Parameter(torch.rand(4, 6))
        self.norm = torch.nn.GroupNorm(1, 3)


def network(kind=Net):
    torch.manual_seed(0)
    return kind().double()


def give_gradients(net, step):
    """The same at each step, whatever came before."""
    rng = torch.Generator().manual_seed(step)
    for parameter in net.parameters():
        scale = torch.linspace(1.0, 0.1, parameter.shape[-1], dtype=torch.float64)
        noise = torch.randn(parameter.shape, generator=rng, dtype=torch.float64)
        parameter.grad = scale * (noise + 0.3)


def stepped(net, optimiser, steps, rate=0.01):
    for step in steps:
        give_gradients(net, step)
        optimiser.step(rate)
    return net


def sides_of(soap):
    """Gram matrices and bases by the names of the weights."""
    grams, bases = {}, {}
    for stack, (_, m, n), both in zip(soap.stacks, soap.shapes, soap.sides, strict=True):
        counts = [weight.numel() // (m * n) for weight in stack.values()]
        for which, side in zip(("left", "right"), both, strict=True):
            if side:
                names = [f"{name}.{which}" for name in stack]
                grams |= zip(names, side.gram.split(counts), strict=True)
                bases |= zip(names, side.basis.split(counts), strict=True)
    return grams, bases


def plain_soap(W, gradients, Q_L, Q_R, rate, b=0.95, every=10):
    """Algorithm 3 for one matrix, with Adam's correction of the moments; the first gradient, of
    which the bases are, makes no step. A basis that is None is the identity, for ever."""
    m, n = W.shape
    learns_L, learns_R = Q_L is not None, Q_R is not None
    Q_L = Q_L if learns_L else torch.eye(m, dtype=W.dtype)
    Q_R = Q_R if learns_R else torch.eye(n, dtype=W.dtype)
    L, R = torch.zeros(m, m, dtype=W.dtype), torch.zeros(n, n, dtype=W.dtype)
    M, V = torch.zeros_like(W), torch.zeros_like(W)
    for t, G in enumerate(gradients):
        if t > 0:
            G_turned = Q_L.T @ G @ Q_R
            M = b * M + (1 - b) * G
            M_turned = Q_L.T @ M @ Q_R
            V = b * V + (1 - b) * G_turned * G_turned
            N_turned = (M_turned / (1 - b**t)) / ((V / (1 - b**t)).sqrt() + 1e-8)
            W = W - rate * Q_L @ N_turned @ Q_R.T
        L = b * L + (1 - b) * G @ G.T
        R = b * R + (1 - b) * G.T @ G
        if t > 0 and t % every == 0:
            Q_L = torch.linalg.qr(L @ Q_L).Q if learns_L else Q_L
            Q_R = torch.linalg.qr(R @ Q_R).Q if learns_R else Q_R
    return W


def test_soap_is_the_paper_s_algorithm():
    steps, rate = range(24), 0.01  # two renewals of the bases
    gradients = []
    for step in steps:
        given = network()
        give_gradients(given, step)
        gradients.append({name: p.grad for name, p in given.named_parameters()})
    net, start = network(), dict(network().named_parameters())
    soap = Soap(dict(net.named_parameters()))
    stepped(net, soap, steps[:1], rate)
    bases = copy.deepcopy(sides_of(soap)[1])
    stepped(net, soap, steps[1:], rate)
    seen = set()
    for name, weight in net.named_parameters():
        sides = weight.shape[-2:]
        if name.endswith("weight") and weight.ndim > 1 and name != "great.weight":
            W = weight.reshape(-1, *sides)
            for group in range(len(W)):
                each = [g[name].reshape(W.shape)[group] for g in gradients]
                left, right = (bases.get(f"{name}.{side}") for side in ("left", "right"))
                Q_L = None if left is None else left[group]
                Q_R = None if right is None else right[group]
                has = (left is not None, right is not None)
                assert has == tuple(1 < n <= GREATEST_SIDE for n in sides)
                wanted = plain_soap(start[name].reshape(W.shape)[group], each, Q_L, Q_R, rate)
                torch.testing.assert_close(W[group], wanted, rtol=1e-8, atol=1e-10)
                seen.add(has)
    assert len(seen) == 3  # both sides, or either


def test_the_first_bases_are_eigenvectors_the_greatest_value_first():
    net = network()
    soap = Soap(dict(net.named_parameters()))
    stepped(net, soap, range(1))
    grams, bases = sides_of(soap)
    for name, Q in bases.items():
        turned = Q.mT @ grams[name] @ Q
        values = turned.diagonal(dim1=1, dim2=2)
        torch.testing.assert_close(turned, torch.diag_embed(values))
        torch.testing.assert_close(Q.mT @ Q, torch.eye(Q.shape[1]).double().expand_as(Q))
        assert (values.diff() < 1e-12).all()


def test_what_is_no_matrix_gets_adam_s_step():
    net, other = network(), network()

    stepped(net, optimiser_of("soap", net), range(15))
    adam = torch.optim.Adam(other.parameters(), betas=(0.95, 0.95))

    class Own:
        def step(self, rate):
            adam.param_groups[0]["lr"] = rate
            adam.step()

    stepped(other, Own(), range(15))
    ours, theirs = dict(net.named_parameters()), dict(other.named_parameters())
    for key in ("codes", "linear.bias", "groups.bias", "norm.weight", "great.weight"):
        torch.testing.assert_close(ours[key], theirs[key], rtol=1e-9, atol=1e-12)
    assert not torch.allclose(ours["groups.weight"], theirs["groups.weight"], rtol=1e-3)


def test_a_group_is_stepped_as_a_matrix_of_its_own():
    torch.manual_seed(1)
    together = Grouped(3, 6, 4).double()
    apart = [Grouped(1, 6, 4).double() for _ in range(3)]
    for group, one in enumerate(apart):
        one.load_state_dict({k: v[group : group + 1] for k, v in together.state_dict().items()})
    all_of_them = [together, *apart]
    optimisers = [optimiser_of("soap", net) for net in all_of_them]
    for step in range(13):
        give_gradients(together, step)
        for group, one in enumerate(apart):
            for own, whole in zip(one.parameters(), together.parameters(), strict=True):
                assert whole.grad is not None
                own.grad = whole.grad[group : group + 1].clone()
        for optimiser in optimisers:
            optimiser.step(0.01)
    found = torch.cat([one.weight for one in apart])
    torch.testing.assert_close(found, together.weight, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("stopped", [0, 1, 7, 11])
def test_to_resume_is_not_to_have_stopped(name, stopped):
    whole = network()
    stepped(whole, optimiser_of(name, whole), range(23))
    net = network()
    optimiser = optimiser_of(name, net)
    stepped(net, optimiser, range(stopped))
    state = copy.deepcopy(optimiser.state())
    again = optimiser_of(name, net)
    again.load(state)
    stepped(net, again, range(stopped, 23))
    for one, other in zip(net.parameters(), whole.parameters(), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", NAMES)
def test_a_state_has_the_same_form_at_any_time(name):
    net = network()
    optimiser = optimiser_of(name, net)
    new = copy.deepcopy(optimiser.state())
    with torch.device("meta"):
        shapes = optimiser_of(name, Net().double())
    for _ in range(2):
        for wanted in (new, shapes.state()):
            check_like(optimiser.state(), wanted, Path("x"))
        stepped(net, optimiser, range(12))


class Flat(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.flat = Grouped(2, 6, 4, bias=False)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", [Flat, lambda: torch.nn.GroupNorm(1, 3)])
def test_a_network_may_have_no_vectors_or_no_matrices(name, kind):
    net, before = network(kind), network(kind)
    stepped(net, optimiser_of(name, net), range(3))
    for one, other in zip(net.parameters(), before.parameters(), strict=True):
        assert not torch.equal(one, other)


@pytest.mark.parametrize("name", NAMES)
def test_where_there_is_no_gradient_nothing_moves(name):
    net = network()
    optimiser = optimiser_of(name, net)
    for step in range(12):
        give_gradients(net, step)
        net.groups.weight.grad = net.linear.bias.grad = None
        optimiser.step(0.01)
    new = network()
    assert torch.equal(net.groups.weight, new.groups.weight)
    assert torch.equal(net.linear.bias, new.linear.bias)
    assert all(p.isfinite().all() for p in net.parameters())


def test_soap_goes_down_a_valley_that_lies_askew():
    """|A W B - C|^2, whose steep and flat directions lie along no axis."""
    ends = {}
    for name in ("adam", "soap"):
        torch.manual_seed(3)
        turned = [torch.linalg.qr(torch.randn(8, 8).double()).Q for _ in range(2)]
        steep = torch.logspace(0, -1.5, 8).double()
        A, B = (q @ torch.diag(steep) @ q.T for q in turned)
        net = torch.nn.Linear(8, 8, bias=False).double()
        C, optimiser = A @ torch.randn(8, 8).double() @ B, optimiser_of(name, net)

        def loss(net=net, A=A, B=B, C=C):
            return (A @ net.weight @ B - C).square().sum()

        for step in range(300):
            net.zero_grad()
            loss().backward()
            optimiser.step(0.05 * (1.0 - step / 300))
        ends[name] = float(loss().detach())
    assert ends["soap"] < 1e-4
    assert ends["soap"] < 0.1 * ends["adam"]
