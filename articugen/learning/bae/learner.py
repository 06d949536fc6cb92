"""How BAE-Net learns: the mean square of what its output lacks, and an L1 of its last layer."""

import torch
from torch.nn.functional import mse_loss

from articugen.learning.bae.network import BAENet
from articugen.learning.bae.settings import BAERecipe
from articugen.learning.data.batch import Batch
from articugen.learning.fields import FieldLearner
from articugen.learning.method import Terms

BETAS = 0.5, 0.999
"""Of Adam."""


class BAELearner(FieldLearner):
    settings: BAERecipe  # pyright: ignore[reportIncompatibleVariableOverride]
    network: BAENet

    def __init__(self, settings: BAERecipe, seed: int, device: torch.device) -> None:
        super().__init__(settings, lambda: BAENet(settings.model), seed, device, betas=BETAS)

    def loss(self, batch: Batch) -> Terms:
        output = self.network.whole(self.network.encode(batch.cloud), batch.points)
        sparse = self.network.branches.weight.abs().sum()
        return {
            "rec": mse_loss(output, batch.occupied.to(output.dtype)),
            "l1": self.settings.losses.l1 * sparse,
        }
