"""The layers of Neural Star Domain: an encoder, the centres of stars, and their radii.

All lengths inside are six times those of the unit frame.
"""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from articugen.learning.blocks import PointNet
from articugen.learning.fields import PartFields
from articugen.learning.nsd.settings import ModelSettings

SCALE = 6.0  # of lengths
SHARP = 100.0  # of the sigmoid that makes an indicator of a field
LEAST = 1e-7  # of radii and squared distances
LOGIT = 10.0  # times a field is read as a logit by validation
POSES = {"translation": 3, "rotation": 4, "scale": 3, "probability": 1}
"""Of a star; as published, networks predict all four and the translation alone is used."""


class NSDNet(PartFields):
    """The encoder and what it leads to, P stars."""

    begin: Tensor

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        P, code, width = settings.stars, settings.code, settings.width
        self.parts = P
        self.encoder = PointNet(code, blocks=4)
        self.poses = nn.ModuleDict(
            {
                name: nn.Sequential(
                    nn.Linear(code, code), nn.LeakyReLU(0.2), nn.Linear(code, P * size)
                )
                for name, size in POSES.items()
            }
        )
        self.register_buffer("begin", torch.empty(P, 3).uniform_(-SCALE / 2, SCALE / 2))
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for before, after in pairwise((code + 3, width, width, 1)):
            bound = 1.0 / math.sqrt(before)  # as torch draws grouped layers
            self.weights.append(torch.empty(P, before, after).uniform_(-bound, bound))
            self.biases.append(torch.empty(P, 1, after).uniform_(-bound, bound))

    def encode(self, cloud: Tensor) -> Tensor:
        return self.encoder(cloud * SCALE)

    def centres(self, code: Tensor) -> Tensor:
        """Return (B, P, 3), the centres of the stars of codes (B, C)."""
        return self.begin + self.poses["translation"](code).view(-1, self.parts, 3)

    def radii(self, code: Tensor, places: Tensor) -> Tensor:
        """Return (B, P, n), the radii of stars towards places (B, P, n, 3) on the unit spheres
        around their centres.

        The code's share of the first layer is computed once a shape.
        """
        of_code, of_place = self.weights[0].split([code.shape[1], 3], 1)
        common = torch.einsum("bc,pcw->bpw", code, of_code)[:, :, None]
        x = leaky_relu(places @ of_place + common + self.biases[0])
        x = leaky_relu(x @ self.weights[1] + self.biases[1])
        x = x @ self.weights[2] + self.biases[2]
        return (1.0 + 0.1 * x[..., 0]).clamp(min=LEAST)

    def stars(self, code: Tensor, points: Tensor) -> Tensor:
        """Return (B, P, n) at points (B, n, 3) of the larger frame: 1 at a star's centre, 0 on its
        surface."""
        centre = self.centres(code)[:, :, None]
        away = points[:, None] - centre
        far = away.square().sum(3, keepdim=True).clamp(min=LEAST).sqrt()
        return 1.0 - far[..., 0] / self.radii(code, centre + away / far)

    def surfaces(self, code: Tensor, directions: Tensor) -> Tensor:
        """Return (B, P, n, 3), in the larger frame, each star's surface in unit directions
        (B, n, 3)."""
        centre = self.centres(code)[:, :, None]
        on_sphere = directions[:, None]
        return centre + self.radii(code, centre + on_sphere)[..., None] * on_sphere

    def fields(self, code: Tensor, points: Tensor) -> Tensor:
        return LOGIT * self.stars(code, points * SCALE)


def indicator(stars: Tensor) -> Tensor:
    """Return (B, n) of `stars` (B, P, n): in about how many of them a point lies."""
    return torch.sigmoid(SHARP * stars).sum(1)


def directions_of(chance: Tensor) -> Tensor:
    """Return unit vectors (..., 3) of numbers (..., 2) in [0, 1]: longitude and latitude.

    As published they are even in both angles, and so denser at the poles.
    """
    longitude = 2.0 * math.pi * (chance[..., 0] - 0.5)
    latitude = math.pi * (chance[..., 1] - 0.5)
    flat = latitude.cos()
    return torch.stack([flat * longitude.cos(), flat * longitude.sin(), latitude.sin()], -1)
