"""No two parts of a bundled object lie in each other, in any state that its recipe draws."""

from pathlib import Path

import numpy as np
import pytest

from articugen.articulation import canonical_state, resolve, sample_joint_state
from articugen.recipe import load_recipe
from articugen.records import ArticulatedObject, Floats
from articugen.seeding import generator
from articugen.sources.procedural import CATEGORIES
from tests.procedural_truth import crossings, object_id, written

SAMPLE = [(c, object_id(c, k)) for c in CATEGORIES for k in (5, 10, 17)]

BEYOND = {
    "drawer": -0.03,
    "eyeglasses": np.pi,
    "laptop": -0.1,
    "oven": -0.1,
    "washing_machine": -0.1,
}
"""States in which parts would cross: drawers and doors pushed in, temples turned to the front."""


def states(obj: ArticulatedObject, rng: np.random.Generator) -> list[Floats]:
    """The canonical state, the ends of all ranges and random ones, as the recipe has them."""
    upper = np.array([joint.upper for joint in obj.moving_joints])
    drawn = [sample_joint_state(obj, rng=rng).q for _ in range(6)]
    return [canonical_state(obj).q, upper, *drawn]


@pytest.mark.parametrize(("category", "name"), SAMPLE)
def test_no_part_lies_in_another(category: str, name: str, tmp_path: Path) -> None:
    """A point of one part's surface is never inside another's exact solid: not by any depth."""
    obj, truth = written(category, name, tmp_path / name)
    recipe = load_recipe(None, category)
    obj = resolve(obj, recipe.articulation)
    if category not in ("drawer", "eyeglasses"):
        assert np.degrees(obj.moving_joints[0].upper) == pytest.approx(135.0)
    rng = generator(0, name, "crossings")
    for q in states(obj, rng):
        assert crossings(obj, truth, q, rng) == set(), q
    beyond = np.full(len(obj.moving_joints), BEYOND[category])
    assert crossings(obj, truth, beyond, rng), "this test must see a crossing"
