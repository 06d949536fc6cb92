"""Shapes stretched at random: few objects teach more if each is seen in other proportions.

A stretch along the frame's axes takes slides to slides. A turn stays a turn only if the plane
across its axis keeps its angles, so the two factors in that plane are the same, or all three where
an axis leans or several axes differ. It must be known what moves how, and so which instances are of
one object.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articugen.learning.dataset import Batch

if TYPE_CHECKING:
    from articugen.learning.ppd.warm_start import Targets

ALONG = math.cos(math.radians(2.0))
"""An axis of the frame and a joint's are one if they are nearer to each other than this."""

EDGE = 0.495
"""No cloud is stretched beyond it, in the unit frame."""


def stretched(batch: Batch, aim: Targets, revolute: int, most: float) -> tuple[Batch, Targets]:
    """The batch and its targets, stretched by factors between 1 / (1 + most) and 1 + most.

    Args:
        batch: its first three chances decide the factors.
        revolute: how many of the candidates turn.
    """
    logs = (2.0 * batch.chance[:, :3] - 1.0) * math.log1p(most)
    logs = _joints_stay_joints(logs, aim.axis[:, :revolute], aim.there[:, :revolute])
    factor = (logs * aim.known[:, None]).exp()
    reach = (batch.cloud.abs().amax(1) * factor).amax(1, keepdim=True)
    factor = factor * (EDGE / reach).clamp(max=1.0)
    each = factor[:, None]
    axis = aim.axis * each
    length = axis.norm(dim=2)
    slides = aim.rest + (aim.state - aim.rest) * length
    turns = torch.arange(aim.state.shape[1], device=aim.state.device) < revolute
    state = torch.where(turns, aim.state, slides.clamp(max=1.0 - 0.5 * aim.rest[-1]))
    there = length > 0.0
    direction = torch.where(there[..., None], axis / length.clamp(min=1e-9)[..., None], aim.axis)
    new = replace(aim, axis=direction, pivot=aim.pivot * each, state=state)
    return replace(batch, cloud=batch.cloud * each, points=batch.points * each), new


def _joints_stay_joints(logs: Tensor, axis: Tensor, there: Tensor) -> Tensor:
    """The logarithms of the factors (B, 3), made equal where turns about `axis` (B, R, 3) need it;
    `there` (B, R) says which of them there are."""
    count = there.sum(1, keepdim=True)
    along = ((axis.abs() > ALONG) * there[..., None]).sum(1)
    one_axis = (along == count) & (count > 0)
    across = (~one_axis).to(logs.dtype)
    in_plane = (logs * across).sum(1, keepdim=True) / across.sum(1, keepdim=True).clamp(min=1.0)
    planar = torch.where(one_axis, logs, in_plane)
    alike = logs.mean(1, keepdim=True).expand_as(logs)
    turning = torch.where(one_axis.any(1, keepdim=True), planar, alike)
    return torch.where(count > 0, turning, logs)
