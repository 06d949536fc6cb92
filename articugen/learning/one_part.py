"""One part for everything: learns nothing, and is the floor that methods have to beat.

With as many points on each of K true parts, the one that is named has a label IoU of 1 / K and the
others 0: a mean of 1 / K^2, which is what the PPD paper has for methods that found no parts. The
shape is the box of its cloud.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from articugen.core.geometry import voxel_centres
from articugen.core.records import Floats
from articugen.evaluation.reconstruction import Reconstruction
from articugen.learning.method import Learner, PlainMethod, Terms
from articugen.learning.recipe import TrainRecipe
from articugen.meshes.read import box

if TYPE_CHECKING:  # a recipe is read without torch
    import torch

    from articugen.learning.data.batch import Batch
    from articugen.learning.data.split import PackedSplit


class OnePartRecipe(TrainRecipe):
    method: Literal["one_part"] = "one_part"  # pyright: ignore[reportIncompatibleVariableOverride]


class OnePartLearner(Learner):
    def __init__(self, settings: OnePartRecipe, seed: int, device: torch.device) -> None:
        from articugen.learning.data.batch import BatchSpec  # noqa: PLC0415

        self.settings = settings
        self.inputs = BatchSpec.of(settings.data)

    @property
    def parameters(self) -> int:
        return 0

    def learn(self, batch: Batch, rng: torch.Generator | None, *, iteration: int) -> Terms:
        return {"nothing": batch.cloud.new_zeros(())}

    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        return {"nothing": 0.0}

    def state(self) -> dict[str, Any]:
        return {"nothing": 0}

    def load(self, state: dict[str, Any]) -> None:
        pass

    def reconstruct(self, cloud: Floats, *, resolution: int) -> Reconstruction:
        low, high = cloud.min(0), cloud.max(0)
        mesh = box(np.maximum(high - low, 1e-6))
        surface = (mesh.vertices + (low + high) / 2.0)[mesh.faces]
        centres = voxel_centres(resolution)
        occupied = ((low <= centres) & (centres <= high)).all(1).reshape(3 * [resolution])
        return Reconstruction(surface, np.zeros(len(surface), int), surface, occupied, parts=1)


METHOD = PlainMethod(
    "one_part", "one_part", OnePartRecipe, "articugen.learning.one_part:OnePartLearner"
)
