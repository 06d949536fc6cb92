"""Neural Star Domain, shapes as unions of stars (Kawana, Mukuta, Harada 2020), fed by shards.

A star is all that can be seen from its centre: a radius for each direction. As the authors' code
has it, a radius is a network of direction and code, not a sum of spherical harmonics.
"""

from articugen.learning.method import PlainMethod
from articugen.learning.nsd.settings import NSDRecipe

METHOD = PlainMethod("nsd", "nsd", NSDRecipe, "articugen.learning.nsd.learner:NSDLearner")
