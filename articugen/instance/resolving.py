"""A model of a source, with the parts and joints that its category and a recipe make of it."""

from articugen.core.recipe import Recipe
from articugen.core.records import ResolvedObject
from articugen.instance import articulation
from articugen.sources import registry


def resolved(ref: registry.ObjectRef, recipe: Recipe) -> ResolvedObject:
    """Read a model and settle which of its joints move, how far, and from which pose on.

    Raises:
        InvalidSource: it cannot be read; the sentence says why.
        NotOfCategory: nothing of it moves in the recipe's sense.
    """
    settings = registry.settings(ref)
    return articulation.resolve(
        registry.load(ref),
        recipe.articulation,
        canonical=settings.canonical,
        movable=settings.movable,
    )
