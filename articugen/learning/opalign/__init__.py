"""OP-Align (Che, Furukawa, Kanezaki 2024) with the frame given: parts and joints without labels.

A cloud is aligned with a shape that all objects share, part by part along joints. The authors also
search for the object's rotation, by an equivariant encoder; shards have all objects in one frame,
so here a PointNet takes its place and no rotation is searched for.
"""

from articugen.learning.method import PlainMethod
from articugen.learning.opalign.settings import OPAlignRecipe

METHOD = PlainMethod(
    "opalign", "opalign", OPAlignRecipe, "articugen.learning.opalign.learner:OPAlignLearner"
)
