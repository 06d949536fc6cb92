"""PPD's losses against slow, literal readings of the equations in numpy, and by gradcheck."""

import math

import numpy as np
import pytest
import torch

from articugen.learning.ppd import losses
from articugen.learning.ppd.discriminator import Discriminator

B, P, R, N = 3, 8, 3, 40


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def normal(*shape):
    return torch.randn(*shape, dtype=torch.float64)


def sigmoid(x):
    return 1.0 / (1.0 + math.exp(-x))


def agree(value, wanted):
    assert value.shape == ()
    assert float(value.detach()) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def differentiable(function, *inputs):
    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(function, leaves)


def test_eq_2_reconstruction():
    logits, occupied = normal(B, P, N), torch.rand(B, N) > 0.5
    total = 0.0
    for b in range(B):
        for x in range(N):
            whole = sigmoid(math.log(sum(math.exp(logits[b, i, x]) for i in range(P))))
            total -= math.log(whole if occupied[b, x] else 1.0 - whole)
    agree(losses.reconstruction(logits, occupied), 4096 * total / (B * N))
    differentiable(lambda v: losses.reconstruction(v, occupied), logits)


def test_eq_3_volume():
    moved, still = normal(B, P, N), normal(B, P, N) - 1.0

    def mean_relu_max(fields):
        total = 0.0
        for b in range(B):
            for x in range(N):
                total += max(0.0, *(float(fields[b, i, x]) for i in range(P)))
        return total / (B * N)

    agree(losses.volume(moved, still), (mean_relu_max(moved) - mean_relu_max(still)) ** 2)
    differentiable(losses.volume, moved, still)


def test_eq_4_quantization():
    z, c = normal(B, 5), normal(B, 5)
    agree(
        losses.quantization(z, c),
        np.mean([math.sqrt(sum((z[b, k] - c[b, k]) ** 2 for k in range(5))) for b in range(B)]),
    )
    differentiable(lambda v: losses.quantization(v, c), z)
    assert not losses.quantization(z, c.clone().requires_grad_()).requires_grad  # sg(c)
    square = np.mean([float((z[b, k] - c[b, k]) ** 2) for b in range(B) for k in range(5)])
    agree(losses.release_quantization(z, c), square)
    differentiable(losses.release_quantization, z, c)


def test_eq_5_deviation():
    residual = normal(B, R, 3)
    wanted = 0.0
    for b in range(B):
        wanted += (
            sum(math.sqrt(sum(residual[b, i, k] ** 2 for k in range(3))) for i in range(R)) / R
        )
    agree(losses.deviation(residual), wanted / B)
    differentiable(losses.deviation, residual)
    common = normal(B, R, 3)
    agree(losses.release_deviation(residual, common), np.mean((residual - common).numpy() ** 2))
    differentiable(losses.release_deviation, residual, common)


def distance(a, b):
    return math.sqrt(sum((float(a[k]) - float(b[k])) ** 2 for k in range(3)))


def nearest(q, points, chosen):
    found = [distance(q, x) for x, c in zip(points, chosen, strict=True) if c]
    return min(found) if found else None


@pytest.mark.parametrize("share", [0.3, 0.0])
def test_eq_6_location(share):
    pivots, points = normal(B, R, 3), normal(B, N, 3)
    occupied, inside = torch.rand(B, N) < 0.5, torch.rand(B, R, N) < share
    total = 0.0
    for b in range(B):
        for i in range(R):
            other = [any(inside[b, j, x] for j in range(R) if j != i) for x in range(N)]
            to_any = nearest(pivots[b, i], points[b], occupied[b])
            to_own = nearest(pivots[b, i], points[b], inside[b, i]) or 0.0
            to_other = nearest(pivots[b, i], points[b], other) or 0.0
            total += to_any + 0.5 * (to_own + to_other)
    agree(losses.location(pivots, points, occupied, inside), total / (B * R))
    differentiable(lambda q: losses.location(q, points, occupied, inside), pivots)


def test_eq_6_at_a_pivot_on_a_point_has_a_finite_gradient():
    points = normal(1, N, 3)
    pivots = points[:, :R].clone().requires_grad_()
    everything = torch.ones(1, R, N, dtype=torch.bool)
    losses.location(pivots, points, everything[:, 0], everything).backward()
    assert pivots.grad.isfinite().all()


@pytest.mark.parametrize("bias", [0.0, -2.5])
def test_release_location(bias):
    pivots, points, fields = normal(B, R, 3), normal(B, N, 3), normal(B, P, N) + bias
    occupied = torch.rand(B, N) < 0.5
    total, fell_back = 0.0, 0
    for b in range(B):
        for i in range(R):
            meeting = [
                bool(occupied[b, x]) and fields[b, 0, x] > 0 and fields[b, 1 + i, x] > 0
                for x in range(N)
            ]
            fell_back += not any(meeting)
            total += nearest(pivots[b, i], points[b], meeting if any(meeting) else occupied[b]) ** 2
    assert (fell_back > 0) == (bias < 0)
    agree(losses.release_location(pivots, points, occupied, fields), total / (B * R))
    differentiable(lambda q: losses.release_location(q, points, occupied, fields), pivots)


@pytest.mark.parametrize("bias", [0.0, -2.5])
def test_release_chain(bias):
    pivots, points, fields = normal(B, R, 3), normal(B, N, 3), normal(B, P, N) + bias
    wanted = 0.0
    for i in range(R):
        for own in (True, False):
            found = []
            for b in range(B):
                owned = []
                for x in range(N):
                    column = [float(fields[b, k, x]) for k in range(P)]
                    owner = column.index(max(column))
                    owned.append(max(column) > 0 and (owner == 1 + i) == own)
                to = nearest(pivots[b, i], points[b], owned)
                found += [] if to is None else [to**2]
            wanted += 0.5 * (np.mean(found) if found else 0.0) / R

    def chain(q):
        return losses.release_chain(q, points, fields)

    agree(chain(pivots), wanted)
    differentiable(chain, pivots)


def std(values):
    mean = sum(values) / len(values)
    return math.sqrt(sum((v - mean) ** 2 for v in values) / (len(values) - 1) + 1e-7)


def test_eq_7_variation():
    J, v = P - 1, 0.5
    state, pivots = torch.rand(B, J, dtype=torch.float64), normal(B, R, 3)
    each = [1.0 / std(state[:, i].tolist()) for i in range(J)]
    agree(losses.state_variation(state), sum(each) / J)
    spread = 0.0
    for b in range(B):
        for i in range(R):
            for j in range(R):
                if j != i:
                    spread += math.exp(-distance(pivots[b, i], pivots[b, j]) / v)
    agree(losses.pivot_variation(pivots, J, v), spread / B / J)
    differentiable(losses.state_variation, state)
    differentiable(lambda q: losses.pivot_variation(q, J, v), pivots)

    agree(losses.release_state_variation(state, R), 0.5 * (max(each[:R]) + max(each[R:])))
    spread = 0.0
    for b in range(B):
        for i in range(R):
            for j in range(i, R):
                spread += math.exp(-(distance(pivots[b, i], pivots[b, j]) ** 2) / (2 * v)) / R
    agree(losses.release_pivot_variation(pivots, v), spread)
    differentiable(lambda s: losses.release_state_variation(s, R), state)
    differentiable(lambda q: losses.release_pivot_variation(q, v), pivots)


def test_a_static_state_costs_much_but_is_finite():
    state = torch.full((B, 7), 0.3, dtype=torch.float64, requires_grad=True)
    loss = losses.state_variation(state)
    loss.backward()
    assert 1e3 < float(loss.detach()) < 1e4
    assert state.grad.isfinite().all()


def test_eq_8_gradient_penalty_against_finite_differences():
    discriminator = Discriminator().double().eval()
    with torch.no_grad():
        for layer in discriminator.layers:
            layer.weight.mul_(30)
    fake, real, mix = torch.rand(2, 9, 4).double(), torch.rand(2, 9, 4).double(), torch.rand(2)
    step, wanted = 1e-6, 0.0
    for b in range(2):
        at = (1 - mix[b]) * fake[b] + mix[b] * real[b]
        square = 0.0
        for x in range(9):
            for k in range(4):
                ahead, behind = at.clone(), at.clone()
                ahead[x, k] += step
                behind[x, k] -= step
                with torch.no_grad():
                    slope = (discriminator(ahead[None]) - discriminator(behind[None])) / (2 * step)
                square += float(slope) ** 2
        wanted += (math.sqrt(square) - 1.0) ** 2 / 2
    penalty = losses.gradient_penalty(discriminator, fake, real, mix.double())
    assert float(penalty.detach()) == pytest.approx(wanted, rel=1e-5)
    penalty.backward()
    assert (
        sum(float(p.grad.abs().sum()) for p in discriminator.parameters() if p.grad is not None) > 0
    )
