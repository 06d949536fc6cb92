"""The discriminator: a PointNet over (x, y, z, occupancy), spectrally normalised (Appendix A).

Layers and widths are the release's: three point layers, a maximum, three linear ones without any
activation between them.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, normalize, selu

from articugen.learning.cpu.batches import argmax_of_points, gather_points, one_by_one

Weight = tuple[Tensor, Tensor]
_POINT_LAYERS = 3


class SpectralLinear(nn.Module):
    """A linear layer whose weight is divided by its largest singular value (Miyato et al. 2018)."""

    u: Tensor

    def __init__(self, n_in: int, n_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(nn.init.normal_(torch.empty(n_out, n_in), std=0.02))
        bound = n_in**-0.5
        self.bias = nn.Parameter(torch.empty(n_out).uniform_(-bound, bound))
        self.register_buffer("u", normalize(torch.randn(n_out, device="cpu"), dim=0))

    def normalized(self) -> Tensor:
        """Return the weight of unit norm; one step of power iteration a call while training."""
        with torch.no_grad():
            v = normalize(self.u @ self.weight, dim=0)
            if self.training:
                self.u.copy_(normalize(self.weight @ v, dim=0))
        return self.weight / (self.u.clone() @ self.weight @ v)


class Discriminator(nn.Module):
    """Scores (B,) of shapes given as points with occupancies (B, n, 4)."""

    def __init__(self) -> None:
        super().__init__()
        widths = ((4, 64), (64, 128), (128, 256), (256, 256), (256, 128), (128, 1))
        self.layers = nn.ModuleList(SpectralLinear(*width) for width in widths)

    def forward(self, cloud: Tensor, weights: list[Weight] | None = None) -> Tensor:
        """Return the scores; at most 256 points of a cloud decide its maximum, only those get a
        graph."""
        weights = weights or self.weights()
        if torch.is_grad_enabled():
            cloud = gather_points(cloud, self.decisive(cloud, weights))
        return self.score(cloud, weights)

    def weights(self) -> list[Weight]:
        """Return (normalised weight, bias) of all layers, to be used in one step for several
        clouds."""
        layers = [layer for layer in self.layers if isinstance(layer, SpectralLinear)]
        return [(layer.normalized(), layer.bias) for layer in layers]

    @torch.no_grad()
    def decisive(self, cloud: Tensor, weights: list[Weight]) -> Tensor:
        """Return (B, 256) the indices of the points that hold the maximum of each channel."""
        return one_by_one(lambda c: argmax_of_points(_each(c, weights)), cloud)

    def score(self, cloud: Tensor, weights: list[Weight]) -> Tensor:
        """Return the scores (B,) with these weights."""
        x = selu(_each(cloud, weights).amax(1))
        for weight, bias in weights[_POINT_LAYERS:]:
            x = linear(x, weight, bias)
        return x[:, 0]


def _each(cloud: Tensor, weights: list[Weight]) -> Tensor:
    """Return features of each point by the point layers, (B, n, 256), before the last activation.

    That one is monotone: it may come after the maximum, where it is applied once.
    """
    x = cloud
    for weight, bias in weights[: _POINT_LAYERS - 1]:
        x = selu(linear(x, weight, bias))
    return linear(x, *weights[_POINT_LAYERS - 1])
