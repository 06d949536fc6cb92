"""The third stage: an encoder for what one depth camera sees (Section 4.4).

A new encoder learns to give, from a partial cloud, the latent vector that the first one gives for
the complete cloud of the same instance; the loss is their mean squared difference. The decoders
stay as they are.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from articugen.core.errors import InvalidCheckpoint, InvalidRecipe
from articugen.learning.blocks import Descent
from articugen.learning.data.batch import Batch, BatchSpec
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.method import Terms
from articugen.learning.ppd.learner import VALIDATION_GRID, PPDLearner, Predictor, validation
from articugen.learning.ppd.network import PPD, encoder_of
from articugen.learning.ppd.settings import DepthRecipe
from articugen.learning.run_folder import LATEST, read_checkpoint
from articugen.learning.tensors import made


class DepthLearner(Predictor):
    """The second encoder, beside the decoders of a run whose first stages are done.

    Args:
        seed: decides its weights.
    """

    def __init__(self, settings: DepthRecipe, seed: int, device: torch.device) -> None:
        taught = settings.taught
        if taught is None:
            raise InvalidRecipe(f"{settings.name}: names no teacher; set teacher to a run's folder")
        self.settings: DepthRecipe = settings  # pyright: ignore[reportIncompatibleVariableOverride]
        self.taught = taught
        self.inputs = BatchSpec(
            taught.data.surface_points,
            occupancy=taught.data.occupancy,
            grids=(VALIDATION_GRID,) if taught.data.validation_objects else (),
            partial=True,
        )
        self.points = None
        self.residual_direction = False
        plain = taught.model.model_copy(update={"latent_start": "release"})
        with made(seed, device):
            self.student = encoder_of(plain).to(device)
            self.model, self.teacher = PPD(taught.model), encoder_of(taught.model).to(device)
        self.model.encoder = self.student
        self.model.to(device)
        self.descent = Descent(self.student)
        self.is_taught = False

    def begin(
        self, training: PackedSplit, beside: Path, notify: Callable[[str], None] = lambda _: None
    ) -> None:
        """Take over the teacher's weights, if nothing was learned from it yet."""
        if not self.is_taught:
            path = Path(self.settings.teacher) / LATEST
            point = read_checkpoint(path)
            if point.recipe.sha256() != self.taught.sha256():
                raise InvalidCheckpoint(
                    f"{path}: is of another recipe than `taught`; leave that out"
                )
            if next(self.student.parameters()).is_meta:
                return  # it is only asked whether it could begin
            first = point.learner()
            assert isinstance(first, PPDLearner)
            self.residual_direction = first.residual_direction
            encoder = {
                f"encoder.{name}": value for name, value in self.student.state_dict().items()
            }
            self.model.load_state_dict(first.model.state_dict() | encoder)
            self.teacher.load_state_dict(first.model.encoder.state_dict())
            self.is_taught = True
        self.wanted = self._wanted(training)

    def learn(self, batch: Batch, rng: torch.Generator | None, *, iteration: int) -> Terms:
        def differ() -> Terms:
            return {"latent": mse_loss(self.student(batch.cloud), self.wanted[batch.rows])}

        return self.descent.lower(differ, iteration, self.settings.schedule.rate_at(iteration))

    def check(self) -> None:
        self.descent.check()

    @torch.no_grad()
    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """`latent`, the loss, over all cameras; `rec` and `iou` from what the first one sees."""
        wanted = self._wanted(held_out)
        losses = [mse_loss(self.student(unpacked(c)), wanted) for c in held_out.partial.unbind(1)]
        partial = held_out.partial[:, 0]
        rest = validation(self.model, partial, held_out, self.residual_direction)
        return {"latent": float(torch.stack(losses).mean()), **rest}

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

    def _wanted(self, split: PackedSplit) -> Tensor:
        return latents(self.teacher, split.surface[:, : self.inputs.surface_points])


@torch.no_grad()
def latents(encoder: nn.Module, clouds: Tensor) -> Tensor:
    """Return (I, 512) what an encoder makes of clouds (I, n, 3) as they are stored."""
    return torch.cat([encoder(unpacked(block)) for block in clouds.split(64)])
