"""Which objects are for training and which for tests."""

from collections import Counter
from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st
from source_models import add

from articugen.sources.refs import CategorySettings
from articugen.sources.source import open_source
from articugen.sources.splits import assign_splits, split_sizes

# --- splits

names = st.sets(st.text("abc123", min_size=1, max_size=6), min_size=2, max_size=60)


@given(names, names)
def test_hash_split_is_stable_and_never_one_sided(some, more):
    splits = assign_splits({name: name for name in some}, None, None)
    assert set(splits.values()) == {"train", "test"}
    larger = assign_splits({name: name for name in some | more}, None, None)
    changed = [name for name in some if splits[name] != larger[name]]
    assert len(changed) <= 1  # the one that was taken because a split was empty


@given(names, st.sets(st.text("abc123", min_size=1, max_size=2)))
def test_neither_split_is_without_an_object_that_counts(some, others):
    """Objects of other categories lie in the same folder, and hashes may put all of those into one
    split that are of this."""
    every = some | {f"other {name}" for name in others}
    asked = []

    def counts(name):
        asked.append(name)
        return name in some

    splits = assign_splits({name: name for name in every}, None, None, counts)
    assert {splits[name] for name in some} == {"train", "test"}
    by_hash = {
        n: "test" if int(sha256(n.encode()).hexdigest(), 16) < 0.2 * 2**256 else "train"
        for n in every
    }
    if {by_hash[name] for name in some} == {"train", "test"}:
        assert splits == by_hash
        if not others:
            assert len(asked) == 2
    alone = assign_splits(dict.fromkeys(every, "one mesh"), None, None, counts)
    assert set(alone.values()) == {"train"}


def test_an_object_alone_is_for_training():
    for number in range(30):
        assert assign_splits({str(number): str(number)}, None, None) == {str(number): "train"}
        two = {str(number): str(number), "b": "b"}
        splits = assign_splits(two, None, None, lambda name: name == "b")
        assert splits["b"] == "train"


def test_hash_split_is_about_eight_to_two():
    splits = assign_splits({str(i): str(i) for i in range(2000)}, None, None)
    assert Counter(splits.values())["test"] == pytest.approx(400, abs=60)
    halves = assign_splits({str(i): str(i) for i in range(2000)}, 5, 5)
    assert Counter(halves.values())["test"] == pytest.approx(1000, abs=70)


@given(names)
def test_groups_stay_together(groups):
    splits = assign_splits({f"{g}.{k}": g for g in groups for k in range(3)}, None, None)
    assert all(len({splits[f"{g}.{k}"] for k in range(3)}) == 1 for g in groups)


@pytest.mark.parametrize(
    ("train", "test", "wanted"),
    [
        (None, ("b",), "train test train train"),
        (("b",), None, "test train test test"),
        (("a",), ("b", "z"), "train test - -"),
        (None, (), "train train train train"),
    ],
)
def test_listed_splits(train, test, wanted):
    splits = assign_splits({name: name for name in "abcd"}, train, test)
    assert " ".join(splits.get(name, "-") for name in "abcd") == wanted


@given(st.integers(1, 500), st.integers(0, 50), st.integers(0, 50))
def test_split_sizes(objects, train, test):
    if train + test == 0:
        return
    sizes = split_sizes(objects, train, test)
    assert sum(sizes.values()) == objects
    assert abs(sizes["test"] - objects * test / (train + test)) <= 1
    for split, weight in (("train", train), ("test", test)):
        assert (sizes[split] > 0) == (weight > 0) or objects == 1 or not (train and test)


def test_settings_defaults(tmp_path):
    ref = open_source(add(tmp_path / "a.urdf")).objects("laptop")[0]
    assert ref.settings == CategorySettings()
