"""What `learning.method` asks of PPD; torch is imported where it is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from articugen.learning.method import Method, Yardstick
from articugen.learning.ppd.settings import DepthRecipe, PPDRecipe

if TYPE_CHECKING:
    import torch

    from articugen.learning.ppd.depth import DepthLearner
    from articugen.learning.ppd.learner import PPDLearner


class _Measured(Method):
    def yardsticks(self) -> Mapping[str, Yardstick]:
        from articugen.learning.ppd import release  # noqa: PLC0415

        return {"release": Yardstick(release.RESOLUTION, release.reconstruct, release.evaluate)}


class PPDMethod(_Measured):
    name = "ppd"
    recipe = "ppd_quick"
    Settings = PPDRecipe

    def start(self, settings: PPDRecipe, *, seed: int, device: torch.device) -> PPDLearner:
        from articugen.learning.ppd.learner import PPDLearner  # noqa: PLC0415

        return PPDLearner(settings, seed, device)


class DepthMethod(_Measured):
    name = "ppd_depth"
    recipe = "ppd_depth_quick"
    Settings = DepthRecipe

    def start(self, settings: DepthRecipe, *, seed: int, device: torch.device) -> DepthLearner:
        from articugen.learning.ppd.depth import DepthLearner  # noqa: PLC0415

        return DepthLearner(settings, seed, device)


PPD_METHOD, DEPTH_METHOD = PPDMethod(), DepthMethod()
