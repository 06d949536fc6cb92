"""Stretched shapes: joints stay joints, and everything stays where it belongs."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from articugen.learning.dataset import Batch  # noqa: E402
from articugen.learning.ppd.kinematics import InverseMotion  # noqa: E402
from articugen.learning.ppd.stretch import EDGE, stretched  # noqa: E402
from articugen.learning.ppd.warm_start import Targets  # noqa: E402

REST = torch.tensor([0.3, 0.05])
TURNING = 1


def made(axis, slide, known=1.0, there=(1.0, 1.0), chance=(0.9, 0.1, 0.3), size=0.2):
    """One sample: a joint that turns about `axis`, one that slides along `slide`."""
    rng = np.random.default_rng(0)
    points = torch.tensor(rng.uniform(-size, size, (1, 50, 3)), dtype=torch.float32)
    none = torch.zeros(1, 0)
    batch = Batch(
        torch.tensor([0]), points, none, points.clone(), torch.ones(1, 50) > 0, 0,
        torch.tensor([chance]),
    )  # fmt: skip
    axes = torch.tensor([[axis, slide]], dtype=torch.float32)
    axes = axes / axes.norm(dim=2, keepdim=True).clamp(min=1e-9)
    motion = InverseMotion.none(1, 3, points)
    aim = Targets(
        torch.tensor([known]), torch.tensor([there]), torch.tensor([[1.0, 0.25]]), axes,
        torch.tensor([[[0.1, 0.0, 0.2], [0.0, 0.1, 0.0]]]), motion.rotation, motion.offset,
        torch.zeros(1, 3, dtype=torch.long), torch.zeros(1, 8), REST, 2,
    )  # fmt: skip
    return batch, aim


def factor(before, after):
    return (after.cloud / before.cloud)[0, 0]


def turned(x, axis, pivot, angle):
    u, d = axis / axis.norm(), x - pivot
    along = (d @ u)[:, None] * u
    across = d - along
    sideways = torch.linalg.cross(u.expand_as(d), d)
    return pivot + along + across * np.cos(angle) + sideways * np.sin(angle)


@pytest.mark.parametrize("axis", [(0, 0, 1.0), (0, -1.0, 0), (0, 0.3, 0.95)])
def test_a_turn_stays_a_turn_by_the_same_angle(axis):
    batch, aim = made(axis, (1.0, 0, 0))
    new, to = stretched(batch, aim, TURNING, 0.3)
    f = factor(batch, new)
    x = batch.cloud[0]
    before = turned(x, aim.axis[0, 0], aim.pivot[0, 0], 0.7) * f
    after = turned(x * f, to.axis[0, 0], to.pivot[0, 0], 0.7)
    torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-4)
    assert float(to.state[0, 0]) == 1.0
    assert float((f - 1).abs().max()) > 0.01


def test_a_slide_stays_a_slide_of_another_length():
    batch, aim = made((0, 0, 1.0), (0.6, 0.0, 0.8), there=(0.0, 1.0))
    new, to = stretched(batch, aim, TURNING, 0.3)
    f = factor(batch, new)
    assert len({round(float(v), 4) for v in f}) == 3  # nothing turns: all three differ
    moved = (float(aim.state[0, 1]) - 0.05) * aim.axis[0, 1] * f
    torch.testing.assert_close((to.state[0, 1] - 0.05) * to.axis[0, 1], moved)


def test_what_is_not_known_stays_as_it_is():
    batch, aim = made((0, 0, 1.0), (1.0, 0, 0), known=0.0)
    new, to = stretched(batch, aim, TURNING, 0.3)
    torch.testing.assert_close(new.points, batch.points)
    torch.testing.assert_close(to.pivot, aim.pivot)


def test_factors_are_bounded_and_clouds_stay_in_the_cube():
    batch, aim = made((0, 0, 1.0), (1.0, 0, 0), there=(0.0, 1.0), chance=(1.0, 0.0, 0.5))
    f = factor(batch, stretched(batch, aim, TURNING, 0.25)[0])
    torch.testing.assert_close(f, torch.tensor([1.25, 0.8, 1.0]))
    batch, aim = made((0, 0, 1.0), (1.0, 0, 0), there=(0.0, 1.0), chance=(1.0,) * 3, size=0.48)
    new, _ = stretched(batch, aim, TURNING, 1.0)
    assert float(new.cloud.abs().max()) == pytest.approx(EDGE)


def test_axes_that_differ_leave_one_factor():
    batch, aim = made((0, 0, 1.0), (1.0, 0, 0))
    aim = replace(aim, axis=torch.tensor([[[0, 0, 1.0], [0, 1.0, 0]]]))
    f = factor(batch, stretched(batch, aim, 2, 0.3)[0])
    assert float(f.max() - f.min()) < 1e-6
