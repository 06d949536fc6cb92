"""BAE-Net, branched autoencoders (Chen, Yin, Fisher, Chaudhuri, Zhang 2019), fed by shards.

Without labels each branch comes to be a part, or one branch everything. Two things are not as in
the authors' program, since every method here is given the same: the encoder sees the voxels that
the points of a cloud fill, and query points are centres of cells, half of them near the surface.
"""

from articugen.learning.bae.settings import BAERecipe
from articugen.learning.method import PlainMethod

METHOD = PlainMethod("bae", "bae", BAERecipe, "articugen.learning.bae.learner:BAELearner")
