"""A lint of urdf_sources/: every source is described, and no model is committed."""

import subprocess
from pathlib import Path

import pytest

from articugen import procedural
from articugen.core.content import SOURCES
from articugen.core.recipe import load_recipe
from articugen.sources.source import named_sources
from articugen.sources.source_file import read_source_file

FOLDERS = sorted(path.parent for path in SOURCES.glob("*/source.yaml"))


def test_the_six_sources_are_there():
    assert {folder.name for folder in FOLDERS} >= {
        "partnet_mobility",
        "procedural",
        "procedural_messy",
        "procedural_rough",
        "procedural_varied",
        "shape2motion",
    }
    listed = {source.name: source for source in named_sources()}
    assert listed.keys() == {folder.name for folder in FOLDERS}
    assert any(listed["procedural"].counts().values())


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_source_is_described(folder: Path):
    source = read_source_file(folder / "source.yaml")
    for text in (source.origin, source.licence, source.frame):
        assert len(text) >= 3
    assert len((folder / "README.md").read_text(encoding="utf-8").split()) > 20
    for category, own in source.categories.items():
        assert load_recipe(None, category).articulation.states > 0
        assert source.reader != "partnet_mobility" or own.model_cat


def test_messy_objects_are_the_clean_ones_and_varied_ones_are_some():
    clean, messy, varied, rough = (
        read_source_file(SOURCES / name / "source.yaml")
        for name in ("procedural", "procedural_messy", "procedural_varied", "procedural_rough")
    )
    assert clean.categories == messy.categories
    assert varied.categories == rough.categories
    assert set(clean.categories) == set(procedural.CATEGORIES)
    five = ("drawer", "eyeglasses", "laptop", "oven", "washing_machine")
    assert tuple(varied.categories) == five
    assert varied.categories["oven"].movable == ("door*",)  # racks are locked
    counts = {n: (own.train, own.test) for n, own in varied.categories.items()}
    assert counts == {n: (clean.categories[n].train, clean.categories[n].test) for n in five}
    assert [source.messy for source in (clean, messy, varied, rough)] == [0, 1, 0, 2]
    assert [source.varied for source in (clean, messy, varied, rough)] == [False, False, True, True]


def test_no_model_is_committed():
    listing = subprocess.run(
        ["git", "ls-files", "--", "urdf_sources"],
        cwd=SOURCES.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    if listing.returncode != 0:
        pytest.skip("not a git checkout")
    names = {Path(line).name for line in listing.stdout.splitlines()}
    assert names <= {"source.yaml", "README.md"}
