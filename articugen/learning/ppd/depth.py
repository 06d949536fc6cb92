"""The third stage: an encoder for what one depth camera sees (Section 4.4).

A new encoder learns to give, from a partial cloud, the latent vector that the first one gives for
the complete cloud of the same instance; the loss is their mean squared difference. The decoders
stay as they are.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from articugen.learning.blocks import Descent
from articugen.learning.data.batch import Batch
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.method import Terms
from articugen.learning.ppd.learner import PPDLearner, Predictor, validation
from articugen.learning.ppd.network import encoder_of
from articugen.learning.tensors import made


class DepthLearner(Predictor):
    """The second encoder, beside a learner whose first stages are done.

    Args:
        seed: decides its weights.
    """

    def __init__(self, first: PPDLearner, seed: int, device: torch.device) -> None:
        self.settings = first.settings.third_stage()
        kinds = ("grid", "uniform", "near", "band", "varying")
        none = {f"{kind}_points": 0 for kind in kinds}
        self.inputs = replace(
            first.inputs,
            **none,
            joints=None,
            poses=False,
            hidden=False,
            normals=False,
            chances=0,
            partial=True,
        )
        self.points = None
        self.residual_direction = first.residual_direction
        self.teacher = first.model.encoder
        plain = first.settings.model.model_copy(update={"latent_start": "release"})
        with made(seed, device):
            self.student = encoder_of(plain).to(device)
        self.model = copy.deepcopy(first.model)
        self.model.encoder = self.student
        self.descent = Descent(self.student, rate="depth.learning_rate")

    def begin(
        self, training: PackedSplit, beside: Path, tell: Callable[[str], None] = lambda _: None
    ) -> None:
        self.wanted = self._wanted(training)

    def learn(self, batch: Batch, rng: torch.Generator | None, *, iteration: int) -> Terms:
        def differ() -> Terms:
            return {"latent": mse_loss(self.student(batch.cloud), self.wanted[batch.rows])}

        terms = differ()
        self.descent.step(terms, differ, iteration, self.settings.schedule.rate_at(iteration))
        return terms

    def check(self) -> None:
        self.descent.check()

    @torch.no_grad()
    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """`latent`, the loss, over all cameras; `rec` and `iou` from what the first one sees."""
        wanted = self._wanted(held_out)
        each = [mse_loss(self.student(unpacked(c)), wanted) for c in held_out.partial.unbind(1)]
        seen = held_out.partial[:, 0]
        rest = validation(self.model, seen, held_out, self.residual_direction)
        return {"latent": float(torch.stack(each).mean()), **rest}

    def state(self) -> dict[str, Any]:
        return {"encoder": self.student.state_dict(), "adam": self.descent.state()}

    def load(self, state: dict[str, Any]) -> None:
        self.student.load_state_dict(state["encoder"])
        self.descent.load(state["adam"])

    def _wanted(self, split: PackedSplit) -> Tensor:
        return latents(self.teacher, split.surface[:, : self.inputs.surface_points])


@torch.no_grad()
def latents(encoder: nn.Module, clouds: Tensor) -> Tensor:
    """(I, 512) what an encoder makes of clouds (I, n, 3) as they are stored."""
    return torch.cat([encoder(unpacked(block)) for block in clouds.split(64)])
