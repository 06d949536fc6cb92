"""BSP-Net's layers: planes of a cloud, convexes of planes, and the shape as their union."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from articugen.learning.blocks import VoxelEncoder
from articugen.learning.bsp.settings import ModelSettings
from articugen.learning.fields import PartFields

SLOPE = 0.01  # of the leaky ReLUs
START = 1e-5, 0.02  # mean and standard deviation of the first T and W
USED = 0.01  # a plane whose entry of T is greater bounds the convex
NEAR = 0.01  # a point that is less outside of a convex than this counts as inside


class BSPNet(PartFields):
    """The encoder and the two layers behind it, p planes and c convexes.

    Attributes:
        T: (p, c) how much each plane bounds each convex.
        W: (c, 1) how much each convex fills the shape; used by continuous stages alone.
    """

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.parts = settings.convexes
        self.encoder = VoxelEncoder(settings.voxels, settings.code, slope=SLOPE, normalised=False)
        layers: list[nn.Module] = []
        for before, after in pairwise((settings.code, *settings.widths)):
            layers += [nn.Linear(before, after), nn.LeakyReLU(SLOPE)]
        self.hidden = nn.Sequential(*layers)
        self.planes = nn.Linear(settings.widths[-1], 4 * settings.planes)
        for layer in (*layers, self.planes):
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
        self.T = nn.Parameter(torch.empty(settings.planes, settings.convexes).normal_(*START))
        self.W = nn.Parameter(torch.empty(settings.convexes, 1).normal_(*START))

    def all_planes(self, cloud: Tensor) -> Tensor:
        """Return (B, 4, p): normals and offsets; n . x + d > 0 is outside of a plane."""
        return self.planes(self.hidden(self.encoder(cloud))).unflatten(1, (4, -1))

    def used(self) -> Tensor:
        """Return (u,), the numbers of the planes that bound any convex."""
        return (self.T.detach() > USED).any(1).nonzero()[:, 0]

    def bounds(self) -> Tensor:
        """Return (u, c): 1 where a used plane bounds a convex, else 0; no gradient passes."""
        return (self.T.detach()[self.used()] > USED).to(self.T.dtype)

    def encode(self, cloud: Tensor) -> Tensor:
        """Return (B, 4, u), the used planes of clouds (B, n, 3).

        The others reach nothing that is made of `bounds`, so values and gradients are the same.
        """
        weight = self.planes.weight.unflatten(0, (4, -1))[:, self.used()].flatten(0, 1)
        bias = self.planes.bias.unflatten(0, (4, -1))[:, self.used()].flatten()
        return linear(self.hidden(self.encoder(cloud)), weight, bias).unflatten(1, (4, -1))

    def fields(self, code: Tensor, points: Tensor) -> Tensor:
        """Return (B, c, n) of used planes: 2 in a convex, 0 where it ends, at least -2."""
        out = outside(code, self.bounds(), points)
        return 2.0 * (1.0 - out / NEAR).clamp(min=-1.0).mT


def outside(planes: Tensor, T: Tensor, points: Tensor) -> Tensor:
    """Return (B, n, c), how far points (B, n, 3) are beyond the planes (B, 4, p) of each convex,
    weighted by T (p, c) and summed: 0 inside."""
    normal, offset = planes.split([3, 1], 1)
    return torch.baddbmm(offset, points, normal).relu() @ T


def filled(out: Tensor, W: Tensor) -> Tensor:
    """Return (B, n) in [0, 1]: how much convexes with weights W (c, 1) fill points, together."""
    return ((1.0 - out).clamp(0.0, 1.0) @ W)[..., 0].clamp(0.0, 1.0)
