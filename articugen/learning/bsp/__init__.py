"""BSP-Net, shapes as unions of convexes (Chen, Tagliasacchi, Zhang 2020), fed by shards.

An encoder predicts planes; matrix T, the same for all shapes, says which of them bound each convex,
so a convex of the same number tends to be the same part everywhere. Voxels and query points are
those of `learning/bae`, not those of the authors' program.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from articugen.learning.bsp.settings import BSPRecipe
from articugen.learning.method import Method

if TYPE_CHECKING:
    import torch

    from articugen.learning.bsp.learner import BSPLearner


class BSPMethod(Method):
    name = "bsp"
    recipe = "bsp"
    Settings = BSPRecipe

    def start(self, settings: BSPRecipe, *, seed: int, device: torch.device) -> BSPLearner:
        from articugen.learning.bsp.learner import BSPLearner  # noqa: PLC0415

        return BSPLearner(settings, seed, device)


METHOD = BSPMethod()
