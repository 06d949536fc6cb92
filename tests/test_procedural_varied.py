"""Bundled objects as various as those of others: one to three drawers, upright hinges."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from articugen.core.errors import InvalidSource
from articugen.core.recipe import load_recipe
from articugen.core.seeding import generator
from articugen.procedural import build_model, drawer
from articugen.sources import readers
from articugen.sources.source import open_source
from tests.procedural_truth import assert_sound, crossings, object_id, random_state, written

DRAWERS = [object_id("drawer", k) for k in range(60)]
SOURCE = "procedural_varied"


def drawers_of(name: str) -> list[str]:
    """The parts of a cabinet that move."""
    model = build_model("drawer", name, varied=True)
    return [joint.child for joint in model.joints]


def test_cabinets_have_one_to_three_drawers() -> None:
    counts = [len(drawers_of(name)) for name in DRAWERS]
    assert all(counts.count(n) >= 6 for n in (1, 2, 3)), counts
    assert sum(counts.count(n) for n in (1, 2, 3)) == len(counts)
    strokes = []
    for name in DRAWERS:
        model = build_model("drawer", name, varied=True)
        links = {link.name: link for link in model.links}
        for joint in model.joints:
            points = np.concatenate([s.vertices for s in links[joint.child].solids])
            strokes.append(joint.upper / np.ptp(points[:, 0]))
    assert 0.5 < min(strokes) < max(strokes) < 1.0
    assert max(strokes) > 0.9, "some slide nearly all the way out"


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
@example(seed=1437)  # on casters
def test_every_seed_builds_a_sound_cabinet_of_sane_size(seed: int) -> None:
    model = drawer.build_varied(np.random.default_rng(seed))
    assert_sound(model)
    size = np.ptp(model.bounds, axis=0)
    assert np.all((size > 0.2) & (size < 2.2))
    assert abs(model.bounds[0, 2]) < 1e-9, "it stands on the floor"


@pytest.mark.parametrize("name", [n for n in DRAWERS if len(drawers_of(n)) < 3][:4])
def test_no_drawer_meets_anything(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    obj, truth = written("drawer", name, folder, varied=True)
    assert len(obj.moving_joints) == len(drawers_of(name))
    rng = generator(0, name, "varied")
    upper = np.array([joint.upper for joint in obj.moving_joints])
    for q in (0.0 * upper, upper, *(random_state(obj, rng) for _ in range(4))):
        assert not crossings(obj, truth, q), q
    assert crossings(obj, truth, 0.0 * upper - 0.03), "pushed in, they are in the back"


def test_no_temple_meets_anything_where_hinges_stand_upright(tmp_path: Path) -> None:
    for k in (1, 3):
        name = object_id("eyeglasses", k)
        obj, truth = written("eyeglasses", name, tmp_path / name, varied=True)
        left, right = obj.moving_joints
        np.testing.assert_array_equal(left.axis, (0, 0, 1))
        np.testing.assert_array_equal(right.axis, (0, 0, -1))
        for q in product(np.radians((0, 30, 60, 90)), repeat=2):
            assert not crossings(obj, truth, np.array(q)), (name, q)
        assert crossings(obj, truth, np.full(2, np.pi)), "turned to the front, they are in it"


def test_what_is_not_varied_is_not_offered() -> None:
    offered = "drawer, eyeglasses"
    with pytest.raises(InvalidSource, match=f"procedural_varied has no .*'oven'; it has {offered}"):
        build_model("oven", object_id("oven", 2), varied=True)
    with pytest.raises(InvalidSource, match=f"has no category 'laptop'; there are: {offered}"):
        open_source(SOURCE).objects("laptop")
    assert ", ".join(open_source(SOURCE).categories(["all"])) == offered


def test_they_are_a_source_of_their_own(tmp_path: Path) -> None:
    """Beside the plain ones: one id is another object in either."""
    fewer = next(name for name in DRAWERS if len(drawers_of(name)) == 1)
    (plain,) = open_source("procedural").objects("drawer", ids=[fewer])
    (varied,) = open_source(SOURCE).objects("drawer", ids=[fewer])
    assert [len(readers.load(ref).moving_joints) for ref in (plain, varied)] == [3, 1]
    folder = tmp_path / "one"
    for each in (False, True, False):
        obj, _ = written("drawer", fewer, folder, varied=each)
        assert len(obj.moving_joints) == (1 if each else 3), "what is there is seen to be another"
    recipe = load_recipe(None, "drawer", SOURCE)
    assert (recipe.objects, recipe.articulation.states) == (300, 16)
