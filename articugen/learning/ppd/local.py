"""Where matter is, from the points of the cloud around each place; the paper does not have it.

A part's own field knows its shape by six numbers of a box and a code, which leaves outlines melted.
This one sees the cloud itself: for each place the nearest points of all, of the first eighth and
of the first 32, so that few neighbours show what is near and what is far (POCO, Boulch and Marlet
2022, has one scale). It decides what is inside of the object, and the parts whose that is.

On which side of a wall matter is follows from points farther off. So the outward normals of the
cloud are predicted first, in the same way, and the field knows those of the neighbours.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from articugen.core.records import Floats
from articugen.discovery.clouds import widened
from articugen.learning.blocks import Beside, occupied_voxels
from articugen.learning.cpu.batches import gather_points, spares, takes_kernels
from articugen.learning.cpu.kernels import nearest_of_firsts
from articugen.learning.data.batch import Batch
from articugen.learning.fields import beside_surfaces, doubled, grid_centres, renewed
from articugen.learning.method import Terms
from articugen.learning.ppd.settings import NEIGHBOURS

FEWEST, EIGHTH = 32, 8
SCALES = (0.25, 0.1, 0.04)
"""Lengths by which offsets to neighbours are divided: of the coarsest cloud first."""

SAMPLES = 2
"""Of a batch, whose points' normals are all predicted: as many as there is time for."""

NORMALS = 128
"""Points of each cloud, about, at which normals are learned in an iteration."""

_COARSEST = 8  # the grid that is evaluated everywhere
_BLOCK = 512  # places at a time, whose activations stay in the cache


class Around(nn.Module):
    """Function (B, m, outputs) of places (B, m, 3) and the points of clouds around them, unit
    frame; clouds (B, n, 3 + inputs) have `inputs` numbers more at each point."""

    def __init__(self, width: int, head: int, *, inputs: int = 0, outputs: int = 1) -> None:
        super().__init__()
        self.near = nn.ModuleList([
            nn.Sequential(
                nn.Linear(7 + inputs, width), nn.ReLU(),
                nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width),
            )
            for _ in SCALES
        ])  # fmt: skip
        self.weight = nn.ModuleList([nn.Linear(width, 1) for _ in SCALES])
        self.head = nn.Sequential(
            nn.Linear(3 + 2 * width * len(SCALES), head), nn.ReLU(),
            nn.Linear(head, head), nn.ReLU(), nn.Linear(head, outputs),
        )  # fmt: skip

    def forward(self, cloud: Tensor, places: Tensor) -> Tensor:
        B, m, _ = places.shape
        near = nearest_points(cloud[..., :3], places)
        at = (2.0 * places).reshape(B * m, 3)
        features = [at]
        for some, scale, layers, weight in zip(
            near.unbind(2), SCALES, self.near, self.weight, strict=True
        ):
            points = gather_points(cloud, some)
            offset = ((points[..., :3] - places[:, :, None]) / scale).reshape(B * m, NEIGHBOURS, 3)
            far = torch.linalg.vector_norm(offset, dim=2, keepdim=True)
            where = at[:, None].expand(-1, NEIGHBOURS, -1)
            besides = points[..., 3:].reshape(B * m, NEIGHBOURS, -1)
            around = layers(torch.cat([offset, far, where, besides], 2))
            pooled = (around * weight(around).softmax(1)).sum(1)
            features += [around.amax(1), pooled]
        return self.head(torch.cat(features, 1)).view(B, m, -1)


class LocalField(nn.Module):
    """Field of the whole object, above 0 inside, at places (B, m, 3) beside clouds of the unit
    frame with their predicted normals (B, n, 6)."""

    def __init__(self) -> None:
        super().__init__()
        self.normals = Around(16, 64, outputs=3)
        self.matter = Around(32, 128, inputs=3)

    def forward(self, sided: Tensor, places: Tensor) -> Tensor:
        """Return (B, m)."""
        return self.matter(sided, places)[..., 0]

    @torch.no_grad()
    def sided(self, cloud: Tensor) -> Tensor:
        """Return clouds (B, n, 3) with their predicted normals, the shorter the less sure, (B, n,
        6); no gradient goes through it."""
        cell = ((cloud + 0.5) * 16.0).long() * torch.tensor([256, 16, 1], device=cloud.device)
        order = cell.sum(2).argsort(dim=1)  # one beside the other, for the sake of the kernel
        normals = in_blocks(self.normals, cloud, gather_points(cloud, order))
        return torch.cat([cloud, gather_points(normals, order.argsort(dim=1))], 2)


class LocalLearning(Beside):
    """Learning of a local field.

    Args:
        points: how many query points of each of SAMPLES are learned from in an iteration.
    """

    def __init__(self, points: int, device: torch.device) -> None:
        self.points, self.field = points, LocalField().to(device)
        super().__init__("local", self.field)

    def learn(self, batch: Batch, iteration: int, rate: float) -> Terms:
        """Return the cross-entropy at some of the batch's query points, and the mean square by
        which some normals are wrong, others in each iteration; one step was made to lower both."""
        places, points = batch.points.shape[1], batch.cloud.shape[1]
        steps = max(places // self.points, 1), max(points // NORMALS, 1)
        some, turned = (slice(iteration % every, None, every) for every in steps)
        assert batch.normals is not None  # asked for by the learner
        normals = batch.normals[:, turned]
        sided = self.field.sided(batch.cloud[:SAMPLES])

        def differ() -> Terms:
            logits = self.field(sided, batch.points[:SAMPLES, some])
            wanted = batch.occupied[:SAMPLES, some].to(logits)
            wrong = self.field.normals(batch.cloud, batch.cloud[:, turned])
            wrong = wrong - normals.to(wrong)
            return {
                "local": binary_cross_entropy_with_logits(logits, wanted),
                "local_normals": wrong.square().sum(2).mean(),
            }

        return self.descent.lower(differ, iteration, rate)


class Outline:
    """Grids of where the matter of one cloud (n, 3) is, each evaluated once.

    Grids finer than `_COARSEST` are evaluated at the voxels that are near points or beside the
    surface; others have their value of the grid half as fine.
    """

    def __init__(self, field: LocalField, cloud: Tensor) -> None:
        self.field, self.sided = field, field.sided(cloud[None])
        self.on_grid = cache(self._on_grid)

    def _on_grid(self, resolution: int) -> Floats:
        """Return (R, R, R), the field at voxel centres."""
        R = resolution
        if R <= _COARSEST or R % 2:
            return self._at(grid_centres(R)).reshape(R, R, R)
        grid = doubled(self.on_grid(R // 2)[None])
        holds = occupied_voxels(self.sided[..., :3], R)[0].cpu().numpy() > 0
        near = widened(holds, 1, (0, 1, 2)) | beside_surfaces(grid)
        return renewed(grid, near, lambda centres: self._at(centres)[None])[0]

    @torch.no_grad()
    def _at(self, places: Tensor) -> Floats:
        """Return (m,), the field at places (m, 3)."""
        values = in_blocks(self.field, self.sided, places[None].to(self.sided))
        return values[0].double().cpu().numpy()


def in_blocks(
    function: Callable[[Tensor, Tensor], Tensor], cloud: Tensor, places: Tensor
) -> Tensor:
    """Return a function of clouds and places (B, m, 3), of not too many places at a time."""
    blocks = places.split(_BLOCK if spares(cloud) else 64 * _BLOCK, dim=1)
    return torch.cat([function(cloud, block) for block in blocks], 1)


def nearest_points(cloud: Tensor, places: Tensor) -> Tensor:
    """Return (B, m, 3, NEIGHBOURS) the points of clouds (B, n, 3) that are nearest to places (B, m,
    3): of the first `FEWEST`, of the first eighth, and of all."""
    n = cloud.shape[1]
    few = min(FEWEST, n)
    firsts = few, max(n // EIGHTH, few), n
    if takes_kernels(cloud):
        out = torch.empty(*places.shape[:2], len(firsts), NEIGHBOURS, dtype=torch.int64)
        clouds, at = cloud.contiguous().numpy(), places.contiguous().numpy()
        nearest_of_firsts(clouds, at, np.array(firsts), out.numpy())
        return out
    far = torch.cdist(places, cloud)
    some = [far[..., :first].topk(NEIGHBOURS, largest=False).indices for first in firsts]
    return torch.stack(some, 2)
