"""What holds for every bundled category, and for the one that docs/extending.md adds."""

import re
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from articugen import procedural
from articugen.core.recipe import load_recipe
from articugen.core.records import ArticulatedObject, Floats
from articugen.core.seeding import generator
from articugen.instance.articulation import canonical_state, resolve, sample_joint_state
from articugen.procedural import CATEGORIES, build_model
from articugen.procedural.kit.model import Model, ModelLink
from articugen.sources import readers
from articugen.sources.source import open_source
from tests.benchmarks import objects
from tests.procedural_truth import assert_sound, crossings, model_of, object_id, written
from tests.test_procedural_laptop import OF_ALL_KINDS

SAMPLE = [(c, object_id(c, k)) for c in CATEGORIES for k in (1, 2, 5, 10, 17)]
SAMPLE += [("laptop", name) for name in OF_ALL_KINDS]
DOCS = Path(__file__).parents[1] / "docs"

BEYOND = {"box": -0.5, "drawer": -0.03, "eyeglasses": np.pi}
"""States in which parts would cross, to see that a crossing is seen: drawers pushed in, temples
turned to the front. None where there is no such state, as of a fan."""

LID_PUSHED_IN = -0.1
"""That of any other category."""

CLEARANCE = dict.fromkeys(("oven", "washing_machine", "drawer"), 0.0005)
"""Metres that stay free between parts."""

ENDS = {"eyeglasses": list(product(np.radians((0, 45, 67, 90)), repeat=2))}
"""States that are tried besides."""


def states(obj: ArticulatedObject, rng: np.random.Generator) -> list[Floats]:
    """The canonical state, just open, the ends of all ranges and random ones, as the recipe has
    them."""
    upper = np.array([joint.upper for joint in obj.moving_joints])
    drawn = [sample_joint_state(obj, rng=rng).q for _ in range(8)]
    some = [np.array(q) for q in ENDS.get(obj.category, ())]
    return [canonical_state(obj).q, 0.02 * upper, 0.1 * upper, upper, *some, *drawn]


@pytest.mark.parametrize(("category", "name"), SAMPLE)
def test_no_part_lies_in_another(category: str, name: str, tmp_path: Path) -> None:
    """A point of one part's surface is never inside another's exact solid: not by any depth."""
    obj = assert_parts_keep_clear(category, name, tmp_path)
    if category in ("laptop", "oven", "washing_machine"):
        assert np.degrees(obj.moving_joints[0].upper) == pytest.approx(135.0)


@pytest.mark.parametrize("index", [9, 19, 25])
def test_flaps_keep_clear_at_the_ends_of_their_own_range(index: int, tmp_path: Path) -> None:
    """Beyond what the recipe takes, as who uses the URDF may have them."""
    obj, truth = written("box", object_id("box", index), tmp_path)
    upper = np.array([joint.upper for joint in obj.moving_joints])
    assert not crossings(obj, truth, upper)
    assert index == 9 or crossings(obj, truth, upper + np.radians(15.0))


def assert_parts_keep_clear(category: str, name: str, folder: Path) -> ArticulatedObject:
    """That no link of an object is in another in any state; the object, as its recipe has it."""
    assert_sound(model_of(category, name, varied=False))
    obj, truth = written(category, name, folder / name)
    obj = resolve(obj, load_recipe(None, category).articulation)
    rng = generator(0, name, "crossings")
    for q in states(obj, rng):
        assert not crossings(obj, truth, q, clearance=CLEARANCE.get(category, 0.0)), q
    if BEYOND.get(category, LID_PUSHED_IN) is not None:
        beyond = np.full(len(obj.moving_joints), BEYOND.get(category, LID_PUSHED_IN))
        assert crossings(obj, truth, beyond), "this test must see a crossing; see BEYOND"
    return obj


ONCE_UNSOUND = {
    ("procedural", "drawer"): (35,),  # wheels that hung over the floor
    ("procedural", "eyeglasses"): (186, 498),  # an end piece, a temple that folded over itself
    ("procedural", "laptop"): (535,),  # a screen's corner that stood out of its lid
    ("procedural_varied", "eyeglasses"): (60,),
}


@pytest.mark.parametrize(
    ("source", "category"), [(s, c) for s in objects.SOURCES for c in objects.categories(s)]
)
def test_objects_are_sound_and_stand_on_the_floor(source: str, category: str) -> None:
    """A lap of `make soundness`."""
    for index in ONCE_UNSOUND.get((source, category), (10,)):
        assert objects.faults(source, category, index) == []


def test_what_is_unsound_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    model = build_model("drawer", object_id("drawer", 1))
    body, *drawers = model.links

    def faults_of(*links: ModelLink) -> list[tuple[str, str]]:
        monkeypatch.setattr(objects, "build_model", lambda *_, **__: Model(links, model.joints))
        return objects.faults("procedural", "drawer", 1)

    def moved(link: ModelLink, x: float, z: float) -> ModelLink:
        return replace(link, solids=tuple(s.shifted(x=x, z=z) for s in link.solids))

    assert faults_of(*model.links) == []
    kinds = [kind for kind, _ in faults_of(*(moved(k, 0.0, 2e-4) for k in model.links))]
    assert kinds == ["off the floor"]
    kinds = [kind for kind, _ in faults_of(body, moved(drawers[0], -0.02, 0.0), *drawers[1:])]
    assert set(kinds) == {"collides"}
    (faces,) = body.solids[0].cells
    torn = replace(body.solids[0], cells=(faces[1:],))
    kinds = [k for k, _ in faults_of(replace(body, solids=(torn, *body.solids[1:])), *drawers)]
    assert kinds == ["fails"]


@pytest.fixture
def chest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The category that the docs add, by the very snippets that stand there."""
    (page,) = (p for p in DOCS.glob("extending*.md") if "\n## A category" in f"\n{p.read_text()}")
    section = f"\n{page.read_text()}".partition("\n## A category")[2].partition("\n## ")[0]
    module, look, line = re.findall(r"```python.*?\n(.*?)```", section, re.DOTALL)
    made = ModuleType("articugen.procedural.chest")
    exec(module, made.__dict__)
    monkeypatch.setitem(sys.modules, made.__name__, made)
    monkeypatch.setitem(sys.modules, "chest", made)
    monkeypatch.setitem(procedural.CATEGORIES, "chest", {})  # taken away again after the test
    monkeypatch.chdir(tmp_path)
    exec(look, {})
    assert (tmp_path / "chest_0000" / "model.urdf").is_file()
    exec(line, {})
    return "chest"


def test_the_category_of_the_docs_is_like_any_other(chest: str, tmp_path: Path) -> None:
    for index in range(10):
        assert_sound(build_model(chest, object_id(chest, index)))
    assert_parts_keep_clear(chest, object_id(chest, 1), tmp_path)
    assert open_source("procedural_messy").counts()[chest] == {"train": 8, "test": 2}
    refs = open_source("procedural_messy").objects(chest)
    obj = readers.load(refs[0])
    assert (obj.object_id, obj.category, len(refs)) == ("chest_0000", chest, 10)
    assert [joint.name for joint in obj.moving_joints] == ["hinge"]
