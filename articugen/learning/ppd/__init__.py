"""PPD, unsupervised pose-aware part decomposition (Kawana, Mukuta, Harada 2021), fed by shards.

Numbers of equations are those of the paper; docs/ppd.md lists every choice the paper leaves open.
Its third stage, an encoder for what one depth camera sees, is a method of its own.
"""

from collections.abc import Mapping

from articugen.learning.method import Method, Yardstick
from articugen.learning.ppd.settings import DepthRecipe, PPDRecipe


class PPDMethod(Method):
    name = "ppd"
    recipe = "ppd_quick"
    Settings = PPDRecipe
    learner = "articugen.learning.ppd.learner:PPDLearner"

    def yardsticks(self) -> Mapping[str, Yardstick]:
        from articugen.learning.ppd import release  # noqa: PLC0415 - imports torch

        return {"release": Yardstick(release.RESOLUTION, release.reconstruct, release.evaluate)}


class DepthMethod(PPDMethod):
    name = "ppd_depth"
    recipe = "ppd_depth_quick"
    Settings = DepthRecipe
    learner = "articugen.learning.ppd.depth:DepthLearner"


METHOD, DEPTH_METHOD = PPDMethod(), DepthMethod()
