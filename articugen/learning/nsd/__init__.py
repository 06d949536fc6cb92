"""Neural Star Domain, shapes as unions of stars (Kawana, Mukuta, Harada 2020), fed by shards.

A star is all that can be seen from its centre: a radius for each direction. As the authors' code
has it, a radius is a network of direction and code, not a sum of spherical harmonics.
"""

from articugen.learning.method import Method
from articugen.learning.nsd.settings import NSDRecipe


class NSDMethod(Method):
    name = "nsd"
    recipe = "nsd"
    Settings = NSDRecipe
    learner = "articugen.learning.nsd.learner:NSDLearner"


METHOD = NSDMethod()
