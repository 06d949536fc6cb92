"""From a cloud to its latent: the paper's PointNet, and an encoder of the grid that it fills."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from articugen.learning.ppd.cpu.batches import (
    argmax_of_points,
    distinct,
    gather_points,
    one_by_one,
    spares,
)
from articugen.learning.ppd.cpu.patches import patches
from articugen.learning.ppd.settings import ModelSettings

POSE, SHAPE, TEMPLATE, COMMON = 128, 256, 64, 64
"""The latent is z^p, z^s, the template's and z^{p,c}, in this order."""

LATENT = POSE + SHAPE + TEMPLATE + COMMON

_GRID = 64
"""Cells along an edge of the grid that clouds fill."""

_FEW = 512
"""About so many points of a cloud are enough for a PointNet beside a grid."""

_USUAL = 2048
"""Points of a cloud whose cells are as full as counted; others are counted in proportion."""


def encoder_of(settings: ModelSettings) -> nn.Module:
    """The encoder that a recipe asks for: clouds (B, n, 3) to latents (B, 512)."""
    points = Encoder(settings.latent_start)
    return BothEncoders(points, GridEncoder()) if settings.encoder == "both" else points


class Encoder(nn.Module):
    """The simple PointNet of Occupancy Networks (Mescheder et al. 2019), three pooled blocks.

    A maximum passes its gradient to one element only. What is pooled away is evaluated without a
    graph, and what is left is evaluated again with one: value and gradient are exactly those of the
    plain network, for a tenth of the work and memory.
    """

    def __init__(self, start: Literal["release", "he"] = "release") -> None:
        super().__init__()
        self.position = nn.Linear(3, 256)
        self.first, self.second, self.third = (nn.Linear(256, 128) for _ in range(3))
        self.latent = nn.Linear(128, LATENT)
        if start == "he":
            for layer in (self.position, self.first, self.second, self.third, self.latent):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")

    def forward(self, cloud: Tensor) -> Tensor:
        """The latent (B, 512) of clouds (B, n, 3), whatever the order of their points."""
        most = 128 if spares(cloud) else 3 * 128  # of what `_decisive` keeps
        if torch.is_grad_enabled() and cloud.shape[1] > most:
            cloud = gather_points(cloud, self._decisive(cloud))
        return self.latent(self._each(cloud)[-1].amax(1).relu())

    @torch.no_grad()
    def _decisive(self, cloud: Tensor) -> Tensor:
        """(B, 384) the indices of the points that hold a maximum in any of the blocks; on a CPU
        less, since many hold several.
        """
        index = one_by_one(
            lambda c: torch.cat([argmax_of_points(each) for each in self._each(c)], 1), cloud
        )
        return distinct(index) if spares(index) else index

    def _each(self, cloud: Tensor) -> list[Tensor]:
        """What each block makes of each point: (B, n, 128).

        From the second block on, half of a point's input is the pooled vector, the same for every
        point: its share of the layer is computed once a cloud.
        """
        blocks = [self.first(self.position(cloud).relu_())]
        for block in (self.second, self.third):
            own, shared = block.weight.split(128, dim=1)
            common = nn.functional.linear(blocks[-1].amax(1).relu(), shared, block.bias)
            blocks.append(blocks[-1].relu() @ own.T + common[:, None])
        return blocks


class GridEncoder(nn.Module):
    """Where a cloud has points, and where not, cell by cell: patches of a grid, merged three times.

    A PointNet knows of each of its channels the greatest value alone; where one drawer ends and the
    next begins is told by what lies beside what. All layers are linear in patches that do not
    overlap (as in Vision Transformers, Dosovitskiy et al. 2021), since products of matrices are
    what both CPUs and the optimisers here are best at.
    """

    def __init__(self) -> None:
        super().__init__()
        self.patch = nn.Linear(4**3, 32)
        self.first, self.second = nn.Linear(2**3 * 32, 64), nn.Linear(2**3 * 64, 64)
        self.whole = nn.Linear(4**3 * 64, 256)
        self.latent = nn.Linear(256, LATENT)
        for layer in (self.patch, self.first, self.second, self.whole, self.latent):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)

    def forward(self, cloud: Tensor) -> Tensor:
        """The latent (B, 512) of clouds (B, n, 3), whatever the order of their points."""
        x = self._few(cloud) if can_spare_patches(cloud) else self._all(cloud)
        return self.latent(self.whole(x).relu())

    def _all(self, cloud: Tensor) -> Tensor:
        """What the layers before the last two make of all patches: (B, 64 64)."""
        x = 2.0 * filled(cloud, _GRID).log1p()[..., None]
        for layer, cells, along in ((self.patch, 64, 4), (self.first, 16, 2), (self.second, 8, 2)):
            x = leaky_relu(layer(_merged(x, cells, along)), 0.1)
        return x.flatten(1)

    def _few(self, cloud: Tensor) -> Tensor:
        """The same, from what holds something alone; what does not is the same everywhere."""
        place, held = map(torch.from_numpy, patches(cloud.detach().contiguous().numpy(), 64, 4))
        few = _Few(place, 2.0 * (held * (_USUAL / cloud.shape[1])).log1p(), held.new_zeros(4**3))
        few = few.joined(self.patch).merged(16).joined(self.first).merged(8).joined(self.second)
        return few.all(len(cloud) * 4**3).view(len(cloud), -1)


def can_spare_patches(cloud: Tensor) -> bool:
    """Whether patches that hold nothing are left out: on a CPU, in single precision."""
    return spares(cloud) and cloud.dtype == torch.float32 and not cloud.requires_grad


class _Few(NamedTuple):
    """Some of the cells of B grids, by their flat place (M,), with what they hold (M, C), and what
    all others hold (C,)."""

    place: Tensor
    held: Tensor
    others: Tensor

    def joined(self, layer: nn.Module) -> "_Few":
        """After a layer of `GridEncoder`."""
        held, others = leaky_relu(layer(self.held), 0.1), leaky_relu(layer(self.others), 0.1)
        return _Few(self.place, held, others)

    def merged(self, cells: int) -> "_Few":
        """As `_merged`, for blocks of two of `cells` along each edge; those of which one is here
        are."""
        x, y, z = self.place // cells**2, self.place // cells % cells, self.place % cells
        block = (x // 2 * (cells // 2) + y // 2) * (cells // 2) + z // 2
        place, at = block.unique(return_inverse=True)
        inside = (x % 2 * 2 + y % 2) * 2 + z % 2
        held = self.others.expand(8 * len(place), -1).index_copy(0, 8 * at + inside, self.held)
        return _Few(place, held.view(len(place), -1), self.others.repeat(8))

    def all(self, count: int) -> Tensor:
        """What each of `count` cells holds, (count, C)."""
        return self.others.expand(count, -1).index_copy(0, self.place, self.held)


class BothEncoders(nn.Module):
    """The sum of both latents, at first the PointNet's alone."""

    def __init__(self, points: Encoder, grid: GridEncoder) -> None:
        super().__init__()
        self.points, self.grid = points, grid
        nn.init.zeros_(grid.latent.weight)

    def forward(self, cloud: Tensor) -> Tensor:
        """The latent (B, 512) of clouds (B, n, 3)."""
        return self.points(cloud[:, :: max(cloud.shape[1] // _FEW, 1)]) + self.grid(cloud)


@torch.no_grad()
def filled(cloud: Tensor, cells: int) -> Tensor:
    """(B, cells^3) how many of 2,048 points each cell of the unit frame holds; a point counts to
    the eight cells whose centres surround it, by how near they are. Clouds (B, n, 3)."""
    at = ((cloud + 0.5) * cells - 0.5).clamp(0.0, cells - 1.001)
    low = at.floor()
    share = torch.stack([1.0 - (at - low), at - low])
    low = low.long()
    count = cloud.new_zeros(len(cloud), cells**3)
    for i, j, k in torch.cartesian_prod(*3 * [torch.arange(2)]).tolist():
        cell = ((low[..., 0] + i) * cells + low[..., 1] + j) * cells + low[..., 2] + k
        count = count.scatter_add(1, cell, share[i, ..., 0] * share[j, ..., 1] * share[k, ..., 2])
    return count * (_USUAL / cloud.shape[1])


def _merged(x: Tensor, cells: int, along: int) -> Tensor:
    """What is in cells (B, cells^3, C), joined for blocks of `along` cells an edge."""
    blocks = cells // along
    x = x.unflatten(1, 3 * (blocks, along))
    return x.permute(0, 1, 3, 5, 2, 4, 6, 7).flatten(4).flatten(1, 3)
