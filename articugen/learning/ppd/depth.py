"""The third stage: an encoder for what one depth camera sees (Section 4.4).

A new encoder learns to give, from a partial cloud, the latent vector that the first one gives for
the complete cloud of the same instance; the loss is their mean squared difference. The decoders
stay as they are. Where the teacher's objects were varied, which the paper does not do, so are both
clouds, alike.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from shutil import copytree
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from articugen.core.errors import InvalidCheckpoint, InvalidRecipe
from articugen.learning.blocks import Descent
from articugen.learning.data.batch import Batch, BatchSpec
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.method import Terms
from articugen.learning.ppd.learner import PPDLearner, Predictor
from articugen.learning.ppd.network import encoder_of
from articugen.learning.ppd.settings import DepthRecipe
from articugen.learning.ppd.warm.found import FOLDER
from articugen.learning.run_folder import LATEST, read_checkpoint
from articugen.learning.tensors import made


class DepthLearner(Predictor):
    """The second encoder, beside the decoders of a run whose first stages are done."""

    def __init__(self, settings: DepthRecipe, seed: int, device: torch.device) -> None:
        taught = settings.taught
        if taught is None:
            raise InvalidRecipe(f"{settings.name}: names no teacher; set teacher to a run's folder")
        self.settings: DepthRecipe = settings  # pyright: ignore[reportIncompatibleVariableOverride]
        self.taught = taught
        self.first = PPDLearner(taught, seed, device)
        needs, also = self.first.inputs, ("joints", "poses", "groups", "normals", "chances")
        self.inputs = BatchSpec(
            needs.surface_points, occupancy=needs.occupancy, grids=needs.grids, partial=True,
            **{name: getattr(needs, name) for name in also if taught.vary},
        )  # fmt: skip
        self.points = None
        self.residual_direction = False
        self.model, self.teacher = self.first.model, self.first.model.encoder
        plain = taught.model.model_copy(update={"latent_start": "release"})
        with made(seed, device):
            self.student = encoder_of(plain).to(device)
        self.model.encoder = self.student
        self.descent = Descent(self.student)
        self.is_taught = False

    def begin(
        self, training: PackedSplit, beside: Path, notify: Callable[[str], None] = lambda _: None
    ) -> None:
        """Take over the teacher's weights, if nothing was learned from it yet; where its objects
        were varied, look for their joints, unless the teacher's folder has them."""
        if not self.is_taught:
            self._take_over()
        self.whole = training.surface[:, : self.inputs.surface_points]
        if self.taught.vary:
            with suppress(OSError):  # none are there, or they are there
                there = Path(self.settings.teacher).parent / FOLDER
                copytree(there, beside / FOLDER, dirs_exist_ok=True)
            self.first.begin(training, beside, notify)
        elif self.is_taught:
            self.wanted = latents(self.teacher, self.whole)

    def _take_over(self) -> None:
        path = Path(self.settings.teacher) / LATEST
        point = read_checkpoint(path)
        if point.recipe.sha256() != self.taught.sha256():
            raise InvalidCheckpoint(f"{path}: is of another recipe than `taught`; leave that out")
        if next(self.student.parameters()).is_meta:
            return  # it is only asked whether it could begin
        first = point.learner()
        assert isinstance(first, PPDLearner)
        self.residual_direction = first.residual_direction
        self.teacher.load_state_dict(first.model.encoder.state_dict())
        first.model.encoder = self.student
        self.model.load_state_dict(first.model.state_dict())
        self.is_taught = True

    def learn(self, batch: Batch, rng: torch.Generator | None, *, iteration: int) -> Terms:
        cloud, wanted = self._pairs(batch)

        def differ() -> Terms:
            return {"latent": mse_loss(self.student(cloud), wanted)}

        return self.descent.lower(differ, iteration, self.settings.schedule.rate_at(iteration))

    def check(self) -> None:
        self.descent.check()

    @torch.no_grad()
    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """`latent`, the loss, over all cameras; `rec` and `iou` from what the first one sees."""
        wanted = latents(self.teacher, held_out.surface[:, : self.inputs.surface_points])
        losses = [mse_loss(self.student(unpacked(c)), wanted) for c in held_out.partial.unbind(1)]
        latent = float(torch.stack(losses).mean())
        return {"latent": latent, **self.fit(held_out.partial[:, 0], held_out)}

    def state(self) -> dict[str, Any]:
        return {
            "residual_direction": self.residual_direction,
            "model": self.model.state_dict(),
            "teacher": self.teacher.state_dict(),
            "adam": self.descent.optimiser.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        self.residual_direction = state["residual_direction"]
        self.model.load_state_dict(state["model"])
        self.teacher.load_state_dict(state["teacher"])
        self.descent.optimiser.load(state["adam"])
        self.is_taught = True

    @torch.no_grad()
    def _pairs(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the clouds of a batch, and the latents that they are to have."""
        if not self.taught.vary:
            return batch.cloud, self.wanted[batch.rows]
        _, variation = self.first.varied(batch)
        assert variation
        whole = variation.moved(unpacked(self.whole[batch.rows]))
        return variation.moved(batch.cloud), self.teacher(whole)


@torch.no_grad()
def latents(encoder: nn.Module, clouds: Tensor) -> Tensor:
    """Return (I, 512) what an encoder makes of clouds (I, n, 3) as they are stored."""
    return torch.cat([encoder(unpacked(block)) for block in clouds.split(64)])
