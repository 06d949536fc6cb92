"""BSP-Net, shapes as unions of convexes (Chen, Tagliasacchi, Zhang 2020), fed by shards.

An encoder predicts planes; matrix T, the same for all shapes, says which of them bound each convex,
so a convex of the same number tends to be the same part everywhere. Voxels and query points are
those of `learning/bae`, not those of the authors' program.
"""

from articugen.learning.bsp.settings import BSPRecipe
from articugen.learning.method import PlainMethod

METHOD = PlainMethod("bsp", "bsp", BSPRecipe, "articugen.learning.bsp.learner:BSPLearner")
