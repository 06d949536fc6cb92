"""BAE-Net's layers: an encoder of voxels, and three linear layers that end in branches."""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, linear

from articugen.learning.bae.settings import ModelSettings
from articugen.learning.blocks import VoxelEncoder
from articugen.learning.fields import PartFields

SLOPE = 0.02
"""Of the leaky ReLUs."""

START = 0.02
"""The standard deviation of the decoder's first weights."""


class BAENet(PartFields):
    """The encoder and the branched decoder."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.parts, self.from_zero = settings.branches, settings.from_zero
        output = (settings.level + 1.0) / 2.0 if settings.from_zero else settings.level
        self.level = math.log(output / (1.0 - output))
        self.encoder = VoxelEncoder(settings.voxels, settings.code, slope=SLOPE, normalised=True)
        first, second = settings.widths
        self.first = nn.Linear(3 + settings.code, first)
        self.second = nn.Linear(first, second)
        self.branches = nn.Linear(second, settings.branches)
        for layer in (self.first, self.second, self.branches):
            nn.init.normal_(layer.weight, std=START)
            nn.init.zeros_(layer.bias)

    def encode(self, cloud: Tensor) -> Tensor:
        return self.encoder(cloud)

    def logits(self, code: Tensor, points: Tensor) -> Tensor:
        """Return (B, n, P), the branches before their sigmoid, of codes (B, C) at points (B, n, 3).

        The first layer is the sum of a point's share and the code's, which is computed once.
        """
        of_point, of_code = self.first.weight.split([3, code.shape[1]], 1)
        common = linear(code, of_code, self.first.bias)
        x = leaky_relu(linear(points, of_point) + common[:, None], SLOPE)
        return self.branches(leaky_relu(self.second(x), SLOPE))

    def fields(self, code: Tensor, points: Tensor) -> Tensor:
        """Return (B, P, n), above 0 where a branch's output is above the level of its surface."""
        return (self.logits(code, points) - self.level).mT

    def whole(self, code: Tensor, points: Tensor) -> Tensor:
        """Return the output (B, n): the greatest branch's, as the sigmoid of the greatest logit."""
        greatest = torch.sigmoid(self.logits(code, points).amax(2))
        return 2.0 * greatest - 1.0 if self.from_zero else greatest
