"""How NPCS learns: from the true parts of points, and where these lie when nothing has moved."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from articugen.core.errors import UnfitData
from articugen.core.records import Floats
from articugen.core.seeding import generator
from articugen.evaluation.reconstruction import Reconstruction, labelled_points
from articugen.learning.blocks import NetworkLearner
from articugen.learning.data.batch import Batch, BatchSpec
from articugen.learning.data.split import PackedSplit, at_rest, unpacked
from articugen.learning.method import Terms
from articugen.learning.npcs.fit import pose
from articugen.learning.npcs.network import KEPT, WIDTH, NPCSNet
from articugen.learning.npcs.settings import NPCSRecipe

MOMENTUM, LEAST_MOMENTUM = 0.5, 0.01
"""Of batch norms at first, halved where the rate falls, and at the least."""

COORDINATE = 10.0
"""The weight of the coordinates; that of the labels is 1."""

Boxes = tuple[Tensor, Tensor]
"""Middles (I, K, 3) and diagonals (I, K, 1) of the boxes of parts at rest."""


class NPCSLearner(NetworkLearner):
    settings: NPCSRecipe  # pyright: ignore[reportIncompatibleVariableOverride]
    network: NPCSNet

    def __init__(self, settings: NPCSRecipe, seed: int, device: torch.device) -> None:
        chances = settings.data.surface_points * WIDTH
        self.inputs = BatchSpec.of(settings.data, parts=True, motions=True, chances=chances)
        super().__init__(settings, lambda: NPCSNet(settings.model), seed, device)

    def begin(
        self, training: PackedSplit, beside: Path, notify: Callable[[str], None] = lambda _: None
    ) -> None:
        """Measure the boxes of parts.

        Raises:
            UnfitData: nothing moves, or an object has more parts than the network.
        """
        kind, parts = training.joints["kind"], self.settings.model.parts
        if not kind.any() or not training.state_index.any():
            raise UnfitData(
                "the training objects are in one pose each or have no joint, and npcs learns how "
                "parts have moved; make the data set with articulation.states above 0, of objects "
                "with joints"
            )
        if kind.shape[1] + 1 > parts:
            raise UnfitData(
                f"an object has {kind.shape[1] + 1} parts, the recipe's network {parts}; set "
                f"model.parts to {kind.shape[1] + 1}"
            )
        self.boxes = boxes_of(training, parts)

    def loss(self, batch: Batch) -> Terms:
        steps = self.settings.schedule.steps_at(self.iteration)
        self.network.set_momentum(max(MOMENTUM * 0.5**steps, LEAST_MOMENTUM))
        kept = batch.chance.view(*batch.cloud.shape[:2], WIDTH) < KEPT
        coordinate, label = errors(self.network(batch.cloud, kept), batch, self.boxes)
        return {"coordinate": COORDINATE * coordinate, "label": label}

    @torch.no_grad()
    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """Return the weighted sum of both losses, and each."""
        rng = torch.Generator(self.device).manual_seed(0)
        resolution = self.settings.schedule.stages[0].resolution
        batch = held_out.batch(held_out.evenly().tolist(), self.inputs, resolution, rng)
        boxes = boxes_of(held_out, self.network.parts)
        self.network.eval()
        coordinate, label = map(float, errors(self.network(batch.cloud), batch, boxes))
        self.network.train()
        loss = COORDINATE * coordinate + label
        return {"loss": loss, "coordinate": coordinate, "label": label}

    @torch.no_grad()
    def reconstruct(self, cloud: Floats, *, resolution: int) -> Reconstruction:
        """Return the points that the network sees with their parts, and the parts' poses."""
        points = cloud[: self.inputs.surface_points]
        seen_by_network = torch.as_tensor(points, dtype=torch.float32)[None].to(self.device)
        self.network.eval()
        label, coordinate = (x[0].double().cpu().numpy() for x in self.network(seen_by_network))
        self.network.train()
        part, rng, parts = label.argmax(1), generator(0, "npcs"), self.network.parts
        on = [part == k for k in range(parts)]
        T = [pose(coordinate[on[k], k] - 0.5, points[on[k]], rng) for k in range(parts)]
        return labelled_points(points, part, parts, T_part=np.stack(T))


def errors(output: tuple[Tensor, Tensor], batch: Batch, boxes: Boxes) -> tuple[Tensor, Tensor]:
    """Return the mean distance of the true parts' coordinates from the true ones, and one minus the
    mean relaxed IoU of the parts that are there.

    Args:
        output: as `NPCSNet` returns it.
        boxes: of all instances that the batch's `rows` count.
    """
    label, coordinate = output
    assert batch.rest is not None
    part, row = batch.part.long(), batch.rows[:, None]
    middle, diagonal = (values[row, part] for values in boxes)
    wanted = (batch.rest - middle) / diagonal + 0.5
    of_part = coordinate.gather(2, part[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
    true = torch.nn.functional.one_hot(part, label.shape[2]).to(label.dtype)
    both, there = (label * true).sum(1), true.sum(1)
    iou = both / (label.sum(1) + there - both)
    is_there = there > 0
    lacks = ((1.0 - iou) * is_there).sum(1) / is_there.sum(1)
    return (of_part - wanted).norm(dim=2).mean(), lacks.mean()


def boxes_of(split: PackedSplit, parts: int) -> Boxes:
    """Return the boxes of an object's parts at rest for each of its poses, around the points of all
    of these; a part that is not there has the diagonal 1."""
    middle = split.motion.new_zeros(len(split), parts, 3)
    diagonal = split.motion.new_ones(len(split), parts, 1)
    for name in np.unique(split.object_id):
        rows = torch.from_numpy(split.poses_of(name)).to(middle.device)
        part = split.part[rows].long()
        rest = at_rest(unpacked(split.surface[rows]), part, split.motion[rows])
        for k in part.unique():
            low, high = rest[part == k].aminmax(dim=0)
            middle[rows, k] = (low + high) / 2.0
            diagonal[rows, k] = (high - low).norm().clamp(min=1e-6)
    return middle, diagonal
