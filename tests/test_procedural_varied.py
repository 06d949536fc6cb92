"""Bundled objects as various as those of others: tables, towers, top loaders, upright hinges."""

from itertools import islice, product
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
from tests.procedural_truth import (
    assert_sound,
    crossings,
    model_of,
    object_id,
    random_state,
    written,
)

DRAWERS = [object_id("drawer", k) for k in range(60)]
SOURCE = "procedural_varied"


def drawers_of(name: str) -> list[str]:
    """The parts of a cabinet that move."""
    return [joint.child for joint in model_of("drawer", name, varied=True).joints]


def with_few(count: int) -> list[str]:
    """Some cabinets of one or two drawers."""
    return list(islice((name for name in DRAWERS if len(drawers_of(name)) < 3), count))


def test_cabinets_have_one_to_four_drawers() -> None:
    counts = [len(drawers_of(name)) for name in DRAWERS]
    assert all(counts.count(n) >= 6 for n in (1, 2, 3)), counts
    assert max(counts) == 4, "as many as PPD has sliding parts"
    strokes = []
    for name in DRAWERS:
        model = model_of("drawer", name, varied=True)
        links = {link.name: link for link in model.links}
        for joint in model.joints:
            points = np.concatenate([s.vertices for s in links[joint.child].solids])
            strokes.append(joint.upper / np.ptp(points[:, 0]))
    boxes = [s for s in strokes if s < 1.0]  # a front alone slides farther than it is deep
    assert len(boxes) > 0.8 * len(strokes)
    assert 0.5 < min(boxes) < 0.9 < max(boxes), "some slide nearly all the way out"


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
@example(seed=1437)  # on casters
def test_every_seed_builds_a_sound_cabinet_of_sane_size(seed: int) -> None:
    model = drawer.build_varied(np.random.default_rng(seed))
    assert_sound(model)
    size = np.ptp(model.bounds, axis=0)
    assert np.all((size > 0.2) & (size < 2.2))
    assert abs(model.bounds[0, 2]) < 1e-9, "it stands on the floor"


@pytest.mark.parametrize("name", with_few(4))
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
    upright = []
    for k in range(8):
        name = object_id("eyeglasses", k)
        obj, truth = written("eyeglasses", name, tmp_path / name, varied=True)
        left, right = obj.moving_joints
        if abs(left.axis[2]) < 1.0:
            continue
        np.testing.assert_array_equal(right.axis, (0, 0, -1))
        for q in product(np.linspace(0.0, left.upper, 4), repeat=2):
            assert not crossings(obj, truth, np.array(q)), (name, q)
        assert crossings(obj, truth, np.full(2, np.pi)), "turned to the front, they are in it"
        upright.append(name)
    assert len(upright) >= 2


@pytest.mark.parametrize("category", ["oven", "laptop", "washing_machine"])
def test_others_keep_clear_over_their_ranges(category: str, tmp_path: Path) -> None:
    for k in range(12):
        name = object_id(category, k)
        assert_sound(model_of(category, name, varied=True))
        obj, truth = written(category, name, tmp_path / name, varied=True)
        rng = generator(0, name, "varied")
        locked = np.array([joint.name.startswith("rack") for joint in obj.moving_joints])
        upper = np.where(locked, 0.0, [joint.upper for joint in obj.moving_joints])
        for q in (0.0 * upper, upper, *(rng.uniform(0.0, upper) for _ in range(4))):
            assert not crossings(obj, truth, q), (name, q)
        doors = [joint for joint in obj.moving_joints if not joint.name.startswith("rack")]
        assert all(np.radians(65) < joint.upper <= np.radians(135) for joint in doors)
    along_y, along_z = (1, 0, 1, 0), (1, 0, 0, 1)
    wanted = {"oven": {along_y, along_z, (2, 0, 1, 0)}, "laptop": {along_y}}
    missing = wanted.get(category, {along_y, along_z})
    for k in range(40):
        if missing:
            model = build_model(category, object_id(category, k), varied=True)
            hinges = [joint for joint in model.joints if joint.kind == "revolute"]
            missing -= {(len(hinges), *np.abs(hinges[0].axis).tolist())}
    assert not missing


def test_a_category_that_is_not_there_is_refused() -> None:
    offered = "drawer, eyeglasses, laptop, oven, washing_machine"
    with pytest.raises(InvalidSource, match=f"procedural_varied has no .*'sofa'; it has {offered}"):
        build_model("sofa", object_id("sofa", 2), varied=True)
    with pytest.raises(InvalidSource, match=f"has no category 'sofa'; there are: {offered}"):
        open_source(SOURCE).objects("sofa")
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
    for source in (SOURCE, "procedural_rough"):
        recipe = load_recipe(None, "drawer", source)
        assert (recipe.objects, recipe.articulation.states) == (300, 16)
    (rough,) = open_source("procedural_rough").objects("drawer", ids=[fewer])
    assert len(readers.load(rough).moving_joints) == 1
