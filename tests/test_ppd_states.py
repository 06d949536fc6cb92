"""Joint states that are read off the points of the parts, and what is read, point by point."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from few import FEW
from hypothesis import given
from hypothesis import strategies as st
from learners import tiny

from articugen.learning.ppd.network import PPD
from articugen.learning.ppd.states import FEWEST, QUANTILES, StateReader, along_joints

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


def test_a_drawer_that_is_drawn_too_deep_and_too_far_in_is_read_off_its_front():
    """The fixed part's front is at x = .2; the predicted state and box are wrong by the same."""
    rng, reader, slide = np.random.default_rng(1), StateReader(MODEL), R
    descent = torch.optim.Adam(reader.parameters(), 3e-3)
    torch.manual_seed(1)

    def samples(count=32):
        state, wrong = rng.uniform(0.0, 0.3, count), 0.05 * rng.normal(size=count)
        cloud = rng.uniform(-0.3, 0.2, (count, 400, 3))
        cloud[:, 200:, 0] += state[:, None]
        along = torch.zeros(count, J, 2 * len(QUANTILES) + 8)
        for k in range(count):
            at = (
                cloud[k, some, 0] - (state[k] + wrong[k]) for some in (slice(200, None), slice(200))
            )
            quantiles = np.concatenate([np.quantile(x, QUANTILES) for x in at])
            values = [
                0.5,
                *quantiles,
                state[k] + wrong[k],
                -0.05 - wrong[k],
                0,
                0,
                0.25,
                0.25,
                0.25,
            ]
            along[k, slide] = torch.tensor(values)
        return along, torch.tensor(wrong, dtype=torch.float32)

    for _ in range(600):
        along, wrong = samples()
        off = (reader(along)[:, slide] + wrong).abs().mean()
        descent.zero_grad()
        off.backward()
        descent.step()
    along, wrong = samples(200)
    with torch.no_grad():
        assert (reader(along)[:, slide] + wrong).abs().mean() < 0.2 * wrong.abs().mean()
