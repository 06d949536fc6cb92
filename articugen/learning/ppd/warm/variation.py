"""Training objects varied: stretched, mirrored, smaller, elsewhere in the cube.

The paper does not do this. A few dozen objects are all alike in ways that others are not: real
laptops are wider than the bundled ones and stand elsewhere in the cube. What is asked of a sample,
whose each point is among it, is computed for the object as it is, and varied with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from articugen.learning.data.batch import Batch
from articugen.learning.ppd.network import rest_states
from articugen.learning.ppd.settings import VarySettings
from articugen.learning.ppd.warm.targets import LEFT_RIGHT, Targets, in_range

CHANCES = 20
"""Random numbers that are drawn for each sample. Eight are used; with fewer all that is drawn after
them would be other numbers, and so every curve."""


@dataclass(frozen=True, eq=False)
class Variation:
    """x becomes scale x + shift; B samples.

    Attributes:
        scale: (B, 3), below 0 along the axis that is mirrored.
        shift: (B, 3).
    """

    scale: Tensor
    shift: Tensor

    @staticmethod
    def of(chance: Tensor, mirrored: Tensor, aim: Targets, vary: VarySettings) -> Variation:
        """Stretched by the same along axes that a joint turns into each other, as large as it was
        along its longest axis or a little smaller, and somewhere in the cube that it fits in then.

        Args:
            chance: (B, CHANCES) numbers in [0, 1).
            mirrored: (B,).
            aim: of these samples.
        """
        growth = vary.stretch * (2.0 * chance[:, 1:4] - 1.0)
        size = torch.einsum("bij,bj->bi", aim.alike, growth).exp()
        room = aim.extent.amax(1, keepdim=True)
        size = size * room / (size * aim.extent).amax(1, keepdim=True)
        size = size * (1.0 - vary.shrink * chance[:, 4:5])
        side = torch.ones_like(size)
        side[:, LEFT_RIGHT] = 1.0 - 2.0 * mirrored.to(size.dtype)
        scale = size * side
        free = 0.5 * (room - size * aim.extent)
        somewhere = free * (2.0 * chance[:, 5:8] - 1.0)
        centre = somewhere if vary.shift else aim.centre * side
        return Variation(scale, centre - scale * aim.centre)

    def moved(self, points: Tensor) -> Tensor:
        """Return (B, n, 3) where points go."""
        return points * self.scale[:, None] + self.shift[:, None]

    def batch(self, batch: Batch) -> tuple[Batch, Tensor]:
        """Return the batch varied, and (B, m) which of its query points are others now: points
        spread over the cube go into the place that an object became smaller leaves free, so that
        they are spread over the cube again."""
        even, points = batch.points[:, : batch.spread].roll(1, 1), self.moved(batch.points)
        beyond = ((even - self.shift[:, None]) / self.scale[:, None]).abs().amax(2) > 0.5
        spread = points[:, : batch.spread]
        spread[:] = torch.where(beyond[..., None], even, spread)
        freed = torch.cat([beyond, torch.zeros_like(batch.occupied[:, batch.spread :])], 1)
        normals = batch.normals
        if normals is not None:
            normals = normalize(normals / self.scale[:, None], dim=2)
        cloud, occupied = self.moved(batch.cloud), batch.occupied & ~freed
        varied = replace(batch, cloud=cloud, points=points, occupied=occupied, normals=normals)
        return varied, freed

    def targets(self, aim: Targets, revolute: int) -> Targets:
        """Return the targets of the varied samples; not for `Targets.owner`, which knows objects as
        they are. Axes of parts that turn go the other way in a mirror."""
        turns = torch.arange(aim.state.shape[1], device=aim.state.device) < revolute
        side = torch.where(turns, self.scale.prod(1).sign()[:, None], 1.0)
        axis = aim.axis * self.scale[:, None]
        length = axis.norm(dim=2)
        rest = rest_states(aim.state, revolute)
        slid = rest + (aim.state - rest) * torch.where(turns | (aim.there == 0), 1.0, length)
        low, high = self.moved(aim.middle - aim.size), self.moved(aim.middle + aim.size)
        return replace(
            aim,
            state=in_range(slid, revolute),
            axis=side[..., None] * axis / length.clamp(min=1e-6)[..., None],
            pivot=self.moved(aim.pivot),
            middle=0.5 * (low + high),
            size=0.5 * (high - low).abs(),
        )
