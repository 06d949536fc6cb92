"""Joint states that are read off the points of the parts, and what is read, point by point."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from few import FEW
from hypothesis import given
from hypothesis import strategies as st
from learners import tiny

from articugen.learning.ppd.network import PPD
from articugen.learning.ppd.states import (
    FEWEST,
    QUANTILES,
    StateLearning,
    StateReader,
    along_joints,
)

MODEL = tiny({"surface_points": 400}, (4, 1)).model.model_copy(update={"part_boxes": True})
R, J = len(MODEL.revolute), MODEL.joints


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return PPD(MODEL)


def shown(monkeypatch, model, part):
    """Make the fields at the points that are looked at say that they are of parts (B, n)."""
    fields = torch.eye(MODEL.parts)[torch.as_tensor(part)].mT
    monkeypatch.setattr(model, "fields", lambda *_: SimpleNamespace(product=fields))


def naive(model, predicted, b, j, cloud, part):
    """What is read of joint j in sample b, point by point."""
    pose, box, motion = predicted.pose, predicted.shape.box, model.motion(predicted.pose)
    rotation, offset = (t[b, j + 1].double().numpy() for t in (motion.rotation, motion.offset))
    frame, pivot = pose.frames[b, j].double().numpy(), pose.pivot[b, j + 1].double().numpy()
    middle, size = (t[b, j + 1].double().numpy() for t in (box.middle, box.size))
    at, far = [], []
    for x in cloud[::2].astype(float) @ rotation.T + offset:
        u, v = frame[:, :2].T @ (x - pivot)
        turned = math.atan2(v, u) - math.atan2(*(frame[:, :2].T @ (middle - pivot))[::-1])
        at.append((turned + math.pi) % (2 * math.pi) - math.pi if j < R else frame[:, 2] @ x)
        far.append(math.hypot(u, v))
    at, far = np.array(at), np.array(far)
    moving, fixed = part == j + 1, part == 0
    if j < R and moving.any():
        moving &= far > 0.3 * far[moving].max()
    known = np.zeros(1 + 2 * len(QUANTILES))
    if min(moving.sum(), fixed.sum()) >= FEWEST:
        quantiles = [np.quantile(at[some], QUANTILES, method="nearest") for some in (moving, fixed)]
        known = np.concatenate([[moving.mean()], *quantiles])
    return np.concatenate([known, [pose.state[b, j].item()], middle, size])


@torch.no_grad()
@FEW
@given(st.integers(0, 2**32 - 1), st.integers(2, 300))
def test_how_points_lie_along_joints_read_literally(model, seed, points):
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-0.5, 0.5, (2, points, 3)).astype(np.float32)
    part = rng.choice([0, 1, R, R + 1, J], (2, -(-points // 2)))
    predicted = model(torch.tensor(cloud))
    with pytest.MonkeyPatch.context() as patch:
        shown(patch, model, part)
        along, is_shown = along_joints(model, predicted, torch.tensor(cloud))
    for b, j in np.ndindex(2, J):
        expected = naive(model, predicted, b, j, cloud[b], part[b])
        np.testing.assert_allclose(along[b, j], expected, atol=2e-4)
        assert bool(is_shown[b, j]) == (expected[0] > 0.0)


@torch.no_grad()
def test_states_stay_as_predicted_until_something_is_learned_and_where_no_point_shows_them(
    model, monkeypatch
):
    cloud, reader = torch.rand(1, 400, 3) - 0.5, StateReader(MODEL)
    predicted = model(cloud)
    state = predicted.pose.state
    shown(monkeypatch, model, torch.arange(200)[None] % 2)  # parts 0 and 1 alone
    assert torch.equal(reader.settled(model, predicted, cloud), state)
    reader.layer_2.bias += 10.0
    settled = reader.settled(model, predicted, cloud)
    assert settled[0, 0].item() == pytest.approx(math.pi)  # no farther than a joint goes
    assert torch.equal(settled[0, 1:], state[0, 1:])


def test_a_drawer_that_is_drawn_too_deep_and_too_far_in_is_read_off_its_front(model, monkeypatch):
    """The fixed part's front is at x = .2; the predicted state and box are wrong by the same."""
    torch.manual_seed(1)
    learning, slide, B = StateLearning(MODEL, torch.device("cpu")), R, 16
    learning.begin_stage()
    part = torch.where(torch.arange(200) < 100, 0, 1 + slide).expand(B, -1)
    shown(monkeypatch, model, part)

    def samples():
        state, wrong = 0.1 + 0.3 * torch.rand(B), 0.05 * torch.randn(B)
        cloud = torch.rand(B, 400, 3) * 0.5 - 0.3
        with torch.no_grad():
            rough = model(cloud)
        box, states, along = rough.shape.box, rough.pose.state, rough.pose.direction[:, slide]
        cloud[:, 200:] += (state[:, None] * along)[:, None]
        middle, states = box.middle.clone(), states.clone()
        middle[:, 1 + slide, 0], states[:, slide] = -0.05 - wrong, state + wrong
        shape = replace(rough.shape, box=replace(box, middle=middle))
        predicted = replace(rough, shape=shape, pose=replace(rough.pose, state=states))
        target, moves = states.clone(), torch.zeros(B, J)
        target[:, slide], moves[:, slide] = state, 1.0
        aim = SimpleNamespace(state=target, there=moves, known=torch.ones(B))
        return predicted, cloud, aim, wrong

    for iteration in range(250):
        predicted, cloud, aim, _ = samples()
        learning.learn(model, predicted, cloud, aim, iteration, 3e-3)
    predicted, cloud, aim, wrong = samples()
    settled = learning.reader.settled(model, predicted, cloud)
    off = (settled - aim.state)[:, slide].abs().mean()
    assert off < 0.25 * wrong.abs().mean()
    assert torch.equal(settled[:, :slide], predicted.pose.state[:, :slide])  # too few points
