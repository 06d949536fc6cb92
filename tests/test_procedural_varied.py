"""Bundled objects as various as those of others: one to three drawers, upright hinges."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from articugen.recipe import load_recipe
from articugen.seeding import generator
from articugen.sources import registry
from articugen.sources.procedural import build_model, drawer
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
        assert crossings(obj, truth, q, rng) == set(), q
    assert crossings(obj, truth, 0.0 * upper - 0.03, rng), "pushed in, they are in the back"


def test_hinges_of_glasses_stand_upright_and_folded_temples_cross(tmp_path: Path) -> None:
    name = object_id("eyeglasses", 1)
    assert_sound(build_model("eyeglasses", name, varied=True))
    obj, truth = written("eyeglasses", name, tmp_path / name, varied=True)
    left, right = obj.moving_joints
    np.testing.assert_array_equal(left.axis, (0, 0, 1))
    np.testing.assert_array_equal(right.axis, (0, 0, -1))
    rng = generator(0, name, "varied")
    for q in ((0.0, 0.0), (1.5, 0.0), (0.0, 1.5)):
        assert crossings(obj, truth, np.array(q), rng) == set(), q
    temples = {left.child, right.child}
    assert {frozenset(pair) for pair in crossings(obj, truth, np.full(2, 1.57), rng)} == {
        frozenset(temples)
    }


def test_all_glasses_consist_of_convex_cells() -> None:
    for k in range(42):
        model = build_model("eyeglasses", object_id("eyeglasses", k), varied=True)
        for solid in (s for link in model.links for s in link.solids):
            assert len(solid.half_spaces) == len(solid.cells)


def test_other_categories_are_as_they_were() -> None:
    for category in ("laptop", "oven", "washing_machine"):
        plain, varied = (
            build_model(category, object_id(category, 2), varied=each) for each in (False, True)
        )
        np.testing.assert_array_equal(plain.bounds, varied.bounds)


def test_they_are_a_source_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the plain ones: one id is another object in either."""
    monkeypatch.setenv("ARTICUGEN_SOURCES", str(tmp_path))
    (tmp_path / SOURCE).mkdir()
    (tmp_path / "procedural").mkdir()
    fewer = next(name for name in DRAWERS if len(drawers_of(name)) == 1)
    (plain,) = registry.object_refs("procedural", "drawer", ids=[fewer])
    (varied,) = registry.object_refs(SOURCE, "drawer", ids=[fewer])
    assert [len(registry.load(ref).moving_joints) for ref in (plain, varied)] == [3, 1]
    folder = tmp_path / "one"
    for each in (False, True, False):
        obj, _ = written("drawer", fewer, folder, varied=each)
        assert len(obj.moving_joints) == (1 if each else 3), "what is there is seen to be another"
    recipe = load_recipe(None, "drawer", SOURCE)
    assert (recipe.objects, recipe.articulation.states) == (300, 16)
