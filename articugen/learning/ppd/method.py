"""What `learning.method` asks of PPD; torch is imported where it is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from articugen.learning.method import Method, Yardstick
from articugen.learning.ppd.settings import PPDRecipe

if TYPE_CHECKING:
    import torch

    from articugen.learning.ppd.depth import DepthLearner
    from articugen.learning.ppd.learner import PPDLearner


class PPDMethod(Method):
    name = "ppd"
    recipe = "ppd_quick"
    Settings = PPDRecipe

    def start(self, settings: PPDRecipe, *, seed: int, device: torch.device) -> PPDLearner:
        from articugen.learning.ppd.learner import PPDLearner  # noqa: PLC0415

        return PPDLearner(settings, seed, device)

    def start_depth(self, first: PPDLearner, *, seed: int, device: torch.device) -> DepthLearner:
        from articugen.learning.ppd.depth import DepthLearner  # noqa: PLC0415

        return DepthLearner(first, seed, device)

    def yardsticks(self) -> Mapping[str, Yardstick]:
        from articugen.learning.ppd import release  # noqa: PLC0415

        return {"release": Yardstick(release.RESOLUTION, release.reconstruct, release.evaluate)}


PPD_METHOD = PPDMethod()
