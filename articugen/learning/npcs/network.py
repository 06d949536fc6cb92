"""The layers of NPCS: PointNet++ (Qi, Yi, Su, Guibas 2017) with a head for each output."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from articugen.learning.cpu.batches import gather_points
from articugen.learning.npcs.settings import Level, ModelSettings

WIDTH = 128
"""Of what is known of a point before the heads."""

KEPT = 0.5
"""Share of it that dropout keeps."""


class NPCSNet(nn.Module):
    """Labels and coordinates of points, K parts."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.parts, (first, second) = settings.parts, settings.levels
        self.fine = Abstraction(first, 3, 64, 64, 128)
        self.coarse = Abstraction(second, 3 + 128, 128, 128, 256)
        self.whole = layers(3 + 256, 256, 512, 1024)
        self.to_coarse = layers(1024 + 256, 256, 256)
        self.to_fine = layers(256 + 128, 256, 128)
        self.to_points = layers(128 + 3, 128, 128, 128)
        self.each = layers(128, WIDTH)
        self.label = nn.Linear(WIDTH, self.parts)
        self.coordinate = nn.Linear(WIDTH, 3 * self.parts)
        self.confidence = nn.Linear(WIDTH, 1)  # published, but no loss uses it
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)

    def forward(self, cloud: Tensor, kept: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the labels' probabilities (B, n, K), and coordinates (B, n, K, 3) in (0, 1).

        Args:
            cloud: (B, n, 3).
            kept: (B, n, WIDTH) bool, what dropout leaves; None is all.
        """
        fine, of_fine = self.fine(cloud, None)
        coarse, of_coarse = self.coarse(fine, of_fine)
        whole = self.whole(torch.cat([coarse, of_coarse], 2)).amax(1, keepdim=True)
        x = self.to_coarse(torch.cat([whole.expand(-1, coarse.shape[1], -1), of_coarse], 2))
        x = self.to_fine(torch.cat([interpolated(fine, coarse, x), of_fine], 2))
        x = self.each(self.to_points(torch.cat([interpolated(cloud, fine, x), cloud], 2)))
        x = x if kept is None else x * kept / KEPT
        return self.label(x).softmax(2), self.coordinate(x).sigmoid().unflatten(2, (-1, 3))

    def set_momentum(self, momentum: float) -> None:
        """Set with which share batch norms take in a new batch."""
        for layer in self.modules():
            if isinstance(layer, nn.BatchNorm1d):
                layer.momentum = momentum


class Abstraction(nn.Module):
    """Set abstraction: what is near each of some centres, as the greatest of each feature."""

    def __init__(self, level: Level, *widths: int) -> None:
        super().__init__()
        self.level, self.layers = level, layers(*widths)

    def forward(self, points: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return centres (B, m, 3) and their features (B, m, C) of points (B, n, 3), and of what is
        known of these (B, n, c)."""
        centres = gather_points(points, farthest(points, self.level.centres))
        near = within(centres, points, self.level.radius, self.level.neighbours)
        x = gather_points(points, near) - centres[:, :, None]
        x = x if features is None else torch.cat([x, gather_points(features, near)], 3)
        return centres, self.layers(x).amax(2)


class Dense(nn.Module):
    """Linear layer, batch norm and ReLU of whatever is known of points."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.linear, self.norm = nn.Linear(before, after), nn.BatchNorm1d(after)

    def forward(self, x: Tensor) -> Tensor:
        """Return (..., after) of (..., before)."""
        y = self.linear(x)
        return self.norm(y.flatten(0, -2)).relu().view(y.shape)


def layers(*widths: int) -> nn.Sequential:
    return nn.Sequential(*(Dense(before, after) for before, after in pairwise(widths)))


@torch.no_grad()
def farthest(points: Tensor, count: int) -> Tensor:
    """Return (B, count) indices into points (B, n, 3): the first, and always the farthest of those
    before."""
    rows = torch.arange(len(points), device=points.device)
    at = [torch.zeros_like(rows)]
    away = torch.full_like(points[..., 0], torch.inf)
    for _ in range(count - 1):
        last = points[rows, at[-1]][:, None]
        away = torch.minimum(away, (points - last).square().sum(2))
        at.append(away.argmax(1))
    return torch.stack(at, 1)


@torch.no_grad()
def within(centres: Tensor, points: Tensor, radius: float, count: int) -> Tensor:
    """Return (B, m, count) the first points (B, n, 3) in a ball around each centre (B, m, 3); where
    there are fewer, the first one again."""
    n = points.shape[1]
    number = torch.arange(n, device=points.device)
    inside = torch.where(_distance(centres, points) < radius, number, n)
    first = inside.topk(min(count, n), largest=False).values
    return torch.where(first == n, first[..., :1], first)


def interpolated(points: Tensor, centres: Tensor, features: Tensor) -> Tensor:
    """Return (B, n, C) at points (B, n, 3): of the three nearest centres (B, m, 3) their features
    (B, m, C), weighted by the inverse squared distance."""
    few = min(3, centres.shape[1])
    with torch.no_grad():
        far, near = _distance(points, centres).topk(few, largest=False)
        weight = 1.0 / far.square().clamp(min=1e-10)
        weight = weight / weight.sum(2, keepdim=True)
    return (weight[..., None] * gather_points(features, near)).sum(2)


def _distance(points: Tensor, others: Tensor) -> Tensor:
    """Return (B, n, m), exactly 0 of a point from itself."""
    return torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")
