"""Joint states read off the points of the parts; the paper does not have it.

The pose decoder's state and the part's box at rest are wrong together: a drawer that is drawn too
deep is taken to be shut. Where the points of a part, and those of the fixed part, lie along the
joint shows how far it has moved; what to make of that is learned.
"""

import math

import torch
from torch import Tensor, nn

from articugen.learning.blocks import Beside
from articugen.learning.method import Terms
from articugen.learning.ppd.network import PPD, Prediction, widest
from articugen.learning.ppd.settings import ModelSettings
from articugen.learning.ppd.shape import Grouped
from articugen.learning.ppd.warm.targets import Targets

QUANTILES = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98)

FEWEST = 12
"""Points of a part that show how far it has moved."""

_EVERY = 2  # points of a cloud that are looked at
_OUTER = 0.3  # of the greatest distance from a hinge: what is nearer says little of the angle
_INPUTS, _WIDTH = 2 * len(QUANTILES) + 8, 64


class StateReader(nn.Module):
    """Function (B, J) of what `along_joints` returns: what predicted states are wrong by."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        J = settings.joints
        self.layer_0 = Grouped(J, _INPUTS, _WIDTH, "linear")
        self.layer_1 = Grouped(J, _WIDTH, _WIDTH, "linear")
        self.layer_2 = Grouped(J, _WIDTH, 1, "linear")
        for parameter in self.layer_2.parameters():
            nn.init.zeros_(parameter)

    def forward(self, along: Tensor) -> Tensor:
        x = self.layer_0.flat(along.flatten(1)).relu()
        return self.layer_2.flat(self.layer_1.flat(x).relu())

    @torch.no_grad()
    def settled(self, model: PPD, predicted: Prediction, cloud: Tensor) -> Tensor:
        """Return the states (B, J) of clouds (B, n, 3) that are read so; those predicted where too
        few points show them."""
        along, is_shown = along_joints(model, predicted, cloud)
        read = predicted.pose.state + self(along) * is_shown
        return torch.minimum(read.clamp(min=0.0), widest(read, len(model.settings.revolute)))


class StateLearning(Beside):
    """Learning of a state reader, from what a warm start found."""

    def __init__(self, settings: ModelSettings, device: torch.device) -> None:
        self.reader = StateReader(settings).to(device)
        super().__init__("states", self.reader)

    def learn(
        self,
        model: PPD,
        predicted: Prediction,
        cloud: Tensor,
        aim: Targets,
        iteration: int,
        rate: float,
    ) -> Terms:
        """Return the mean error of the states of clouds (B, n, 3), which one step lowered."""
        along, is_shown = along_joints(model, predicted, cloud)
        shown = aim.there * aim.known[:, None] * is_shown
        wrong = aim.state - predicted.pose.state.detach()

        def differ() -> Terms:
            off = (self.reader(along) - wrong).abs() * shown
            return {"states": off.sum() / shown.sum().clamp(min=1.0)}

        return self.descent.lower(differ, iteration, rate)


@torch.no_grad()
def along_joints(model: PPD, predicted: Prediction, cloud: Tensor) -> tuple[Tensor, Tensor]:
    """Return (B, J, inputs), how the points of clouds (B, n, 3) lie along each joint, and (B, J),
    whether there are FEWEST of the moving part and of the fixed one.

    That is the share of the points that are the moving part's; quantiles of its points and of the
    fixed part's, in lengths along a slide or radians about a hinge from the middle of the part's
    box, as if the predicted motion were undone; 0 where there are too few; the predicted state and
    box. No gradient goes through it.
    """
    cloud = cloud[:, ::_EVERY]
    pose, box, R = predicted.pose, predicted.shape.box, len(model.settings.revolute)
    assert box is not None  # settings ask for it
    motion = model.motion(pose)
    part = model.fields(predicted.shape, motion, cloud).product.argmax(1)[:, None]
    rest = motion.apply(cloud)[:, 1:]
    slides = torch.einsum("bjni,bji->bjn", rest[:, R:], pose.direction[:, R:])
    pivots, frames = pose.pivot[:, 1 : 1 + R, None], pose.frames[:, :R]
    arm, middle = (rest[:, :R] - pivots) @ frames, box.middle[:, 1 : 1 + R, None] - pivots
    turns = _angle(arm) - _angle(middle @ frames)
    turns = torch.remainder(turns + math.pi, 2.0 * math.pi) - math.pi
    moving = part == torch.arange(1, 1 + rest.shape[1], device=part.device)[:, None]
    far = torch.where(moving[:, :R], torch.linalg.vector_norm(arm[..., :2], dim=3), 0.0)
    moving[:, :R] &= far > _OUTER * far.amax(2, keepdim=True)
    fixed = (part == 0).expand_as(moving)
    at = torch.cat([turns, slides], 1)
    known = moving.float().mean(2)[..., None], _quantiles(at, moving), _quantiles(at, fixed)
    is_shown = (moving.sum(2) >= FEWEST) & (fixed.sum(2) >= FEWEST)
    known = torch.where(is_shown[..., None], torch.cat(known, 2), 0.0)
    along = torch.cat([known, pose.state[..., None], box.middle[:, 1:], box.size[:, 1:]], 2)
    return along, is_shown


def _angle(arm: Tensor) -> Tensor:
    """Return (...) the angles of vectors (..., 3) about z."""
    return torch.atan2(arm[..., 1], arm[..., 0])


def _quantiles(values: Tensor, among: Tensor) -> Tensor:
    """Return (B, J, quantiles) of those values (B, J, n) that are `among` them."""
    ordered = values.masked_fill(~among, math.inf).sort(2).values
    share = torch.tensor(QUANTILES, device=values.device)
    at = share * (among.sum(2, keepdim=True) - 1).clamp(min=0)
    return ordered.gather(2, at.round().long())
