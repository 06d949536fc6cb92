"""NPCS, normalised part coordinates (Li, Wang, Yi, Guibas, Abbott, Song 2020), fed by shards.

It is supervised: of each point it learns the part and the place in that part's own frame at rest.
A rigid fit of these places to the points is a part's pose. It predicts neither joints nor surfaces:
joint states and directions follow from how poses differ, pivots are not known.
"""

from articugen.learning.method import PlainMethod
from articugen.learning.npcs.settings import NPCSRecipe

METHOD = PlainMethod("npcs", "npcs", NPCSRecipe, "articugen.learning.npcs.learner:NPCSLearner")
