"""What our code makes is what it declares: see golden.py."""

import copy
import json
import platform
import sys

import pytest

from articugen import procedural
from articugen.core import content
from articugen.core.seeding import generator
from articugen.instance import make
from tests import golden

pytestmark = [
    pytest.mark.extras,
    pytest.mark.skipif(
        platform.machine() != "x86_64", reason="other processors may fuse, see docs/conventions.md"
    ),
]


@pytest.fixture(scope="module")
def new(tmp_path_factory):
    """What this code makes."""
    return golden.made(tmp_path_factory.mktemp("golden"))


def with_changes(old, **tables):
    """A copy with other entries in some tables."""
    changed = copy.deepcopy(old)
    for table, entries in tables.items():
        changed[table].update(entries)
    return changed


def test_what_our_code_makes_is_written_down(new):
    told = golden.advice(golden.read(), new)
    assert not told, told


def test_all_that_may_be_declared_is_guarded():
    told = (
        "give each category a number in MODELS of articugen/core/content.py, then renew the digests"
    )
    assert set(content.MODELS) == set(procedural.CATEGORIES) == set(golden.read()["shapes"]), told
    assert set(golden.SETS) == set(golden.read()["data"])


def test_a_changed_number_in_a_stage_shows(tmp_path, monkeypatch):
    old = golden.read()
    assert golden.data("boxes", tmp_path / "same") == old["data"]["boxes"]
    monkeypatch.setattr(make, "FEWEST_SURFACE_POINTS", make.FEWEST_SURFACE_POINTS + 1)
    other = with_changes(old, data={"boxes": golden.data("boxes", tmp_path / "other")})
    (sentence,) = golden.undeclared(old, other)
    assert sentence.startswith("the data of boxes changed: raise the number of the stage")
    assert "python -m tests.golden --write" in golden.advice(old, other)
    assert "mend the code instead" in golden.advice(old, other)

    declared = with_changes(other, stages={"instance": old["stages"]["instance"] + 1})
    assert golden.undeclared(old, declared) == []
    assert golden.advice(old, declared).startswith("run python -m tests.golden --write")


def test_changed_shapes_show(tmp_path, monkeypatch):
    def other(_seed, *path):
        return generator(1, *path)

    monkeypatch.setattr(procedural, "generator", other)
    monkeypatch.setattr(golden, "SHAPES", 1)
    old = golden.read()
    changed = {"drawer": golden.shapes("drawer", tmp_path)}
    (sentence,) = golden.undeclared(old, with_changes(old, shapes=changed))
    assert (
        sentence
        == "the shapes of drawer changed: raise MODELS['drawer'] in articugen/core/content.py"
    )
    both = with_changes(old, shapes=changed, data={"drawer": "other"})
    assert len(golden.undeclared(old, both)) == 2
    for raised, left in (("drawer", 0), ("oven", 2)):
        versions = {raised: old["models"][raised] + 1}
        assert len(golden.undeclared(old, with_changes(both, models=versions))) == left


def test_what_is_not_declared_is_not_written_down(new, tmp_path, monkeypatch):
    path = tmp_path / "golden.json"
    old = with_changes(new, data={"boxes": "other"}, libraries={"numpy": "1.0"})
    path.write_text(json.dumps(old))
    monkeypatch.setattr(golden, "GOLDEN", path)
    monkeypatch.setattr(golden, "made", lambda _: new)
    monkeypatch.setattr(sys, "argv", ["golden", "--write"])
    told = golden.main()
    assert told
    assert "the data of boxes changed" in told
    assert "numpy" in told
    assert golden.read() == old

    raised = with_changes(new, stages={"sampling": new["stages"]["sampling"] + 1})
    monkeypatch.setattr(golden, "made", lambda _: raised)
    monkeypatch.setattr(sys, "argv", ["golden"])
    assert "run python -m tests.golden" in (golden.main() or "")
    assert golden.read() == old
    monkeypatch.setattr(sys, "argv", ["golden", "--write"])
    assert golden.main() is None
    assert golden.read() == raised
