"""Files that mean harm, a few of each kind; `make fuzz` reads as many as one has time for."""

import ctypes
import itertools
import json
import os
import socket
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from articugen.core.errors import CorruptShard
from articugen.store.shards import open_shard
from tests.fuzz import mending
from tests.fuzz import sandbox as sandboxes
from tests.fuzz.engine import inputs
from tests.fuzz.mutations import places_in
from tests.fuzz.sandbox import sandbox
from tests.fuzz.targets import DATA, TARGETS

INPUTS = 25
"""Of each kind, besides those to begin with and what was found before."""

NOBODY_S = {"checkpoint"}
"""What begins there is refused at the very end: its state is too small to be a network's."""


@pytest.mark.parametrize("name", TARGETS)
def test_nothing_escapes(name):
    target = TARGETS[name]
    if target.extra:
        pytest.importorskip(target.extra)
    chosen = itertools.islice(inputs(target, 0), len(target.seeds()) + INPUTS)
    with sandbox() as room:
        assert [escape for data in chosen if (escape := room.run(target, data))] == []
        assert room.accepted or name in NOBODY_S


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=6,
)


@pytest.fixture(scope="module")
def room():
    with sandbox() as made:
        yield made


@pytest.mark.parametrize("name", ["shape2motion", "gltf", "manifest", "evaluation"])
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_value_may_stand_anywhere_in_a_document(room, name, data):
    document = json.loads(TARGETS[name].seeds()[0])
    holder, key = data.draw(st.sampled_from(places_in(document)))
    holder[key] = data.draw(_VALUES)
    text = json.dumps(document).encode()
    assert room.run(TARGETS[name], text) is None


def test_inputs_that_are_kept_are_small_and_of_targets():
    assert {folder.name for folder in DATA.iterdir()} <= TARGETS.keys()
    sizes = [path.stat().st_size for path in DATA.rglob("*") if path.is_file()]
    assert max(sizes) < 5_000


def test_inputs_are_the_same_for_the_same_seed():
    for name in ("urdf", "glb", "journal"):
        one, same, other = (
            list(itertools.islice(inputs(TARGETS[name], seed), 40)) for seed in (1, 1, 2)
        )
        assert one == same
        assert one != other


@pytest.mark.parametrize(("profile", "alike"), [("same", True), ("chance", False)])
def test_tests_of_properties_draw_the_same_each_time_and_make_fuzz_anew(profile, alike):
    drawn = []

    @settings(settings.get_profile(profile))
    @given(st.integers())
    def draw(number):
        drawn.append(number)

    draw()
    first = drawn.copy()
    draw()
    assert (drawn == 2 * first) is alike
    assert settings.get_current_profile_name() in ("same", "chance")


def _opens_outside(path: Path) -> None:
    (path.parents[1] / "outside" / "secret.obj").read_bytes()


def _opens_outside_unseen_by_python(path: Path) -> None:
    libc = ctypes.CDLL(None)
    os.close(libc.open(os.fsencode(path.parents[1] / "outside" / "secret.h5"), os.O_RDONLY))


def _opens_elsewhere(_: Path) -> None:
    Path("/etc/hostname").read_bytes()


def _writes_beside(path: Path) -> None:
    (path.parent / "more").write_bytes(b"")


def _writes_above(path: Path) -> None:
    (path.parents[1] / "more").write_bytes(b"")


def _asks_the_network(_: Path) -> None:
    with socket.socket() as asking:
        asking.connect_ex(("127.0.0.1", 9))


def _takes_memory(_: Path) -> None:
    bytearray(2 * sandboxes.MEMORY)


def _raises(path: Path) -> None:
    {}[path.name]


def _hangs(_: Path) -> None:
    while True:
        pass


def _moves_the_cursor(_: Path) -> None:
    class Plain(Exception):
        pass

    raise Plain("\x1b[2J")


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (_opens_outside, "secret.obj"),
        pytest.param(
            _opens_outside_unseen_by_python,
            "opened secret.h5",
            marks=pytest.mark.skipif(os.uname().sysname != "Linux", reason="needs inotify"),
        ),
        (_opens_elsewhere, "open /etc/hostname"),
        (_writes_beside, "changed more"),
        (_writes_above, "changed more"),
        (_asks_the_network, "socket.connect"),
        (_takes_memory, "MemoryError"),
        (_raises, "KeyError: 'model.urdf'"),
        (_hangs, "TooLong"),
        (_moves_the_cursor, "no sentence"),
    ],
)
def test_an_escape_is_seen(monkeypatch, read, said):
    monkeypatch.setattr(sandboxes, "_BY_THE_CLOCK", 1.0)
    target = replace(TARGETS["urdf"], read=read, refusals=())
    if read is _moves_the_cursor:
        target = replace(target, refusals=(Exception,))
    with sandbox() as room:
        escape = room.run(target, b"")
    assert escape is not None
    assert said in escape.sentence


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="counts what is open")
def test_a_sandbox_leaves_nothing_open():
    with sandbox() as room:
        room.run(TARGETS["urdf"], b"")
    before = len(os.listdir("/proc/self/fd"))
    with sandbox() as room:
        room.run(TARGETS["urdf"], b"")
    assert len(os.listdir("/proc/self/fd")) == before


def test_what_the_first_import_writes_is_no_escape(monkeypatch, tmp_path):
    (tmp_path / "never_before_imported.py").write_text("from pathlib import Path")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path / "kept"))
    target = replace(TARGETS["urdf"], read=lambda _: import_module("never_before_imported"))
    with sandbox() as room:
        assert room.run(target, b"") is None
    assert [path.name.partition(".")[0] for path in tmp_path.glob("kept/**/*.pyc")] == [
        "never_before_imported"
    ]


def test_hdf5_s_checksum_is_known():
    assert mending.lookup3(b"") == 0xDEADBEEF
    assert mending.lookup3(b"Four score and seven years ago") == 0x17770551


@pytest.mark.parametrize("name", ["stl", "glb", "shard"])
def test_what_is_sound_is_left_as_it_is(name):
    target = TARGETS[name]
    assert [target.mended(data) == data for data in target.seeds()] == [True] * len(target.seeds())


def test_a_shard_that_was_changed_is_mended(tmp_path):
    whole = TARGETS["shard"].seeds()[0]
    path = tmp_path / "train-00000.h5"
    path.write_bytes(whole)
    with open_shard(path) as shard:
        place = int(shard.columns["scale"].offset[0])
        before = shard.read("scale")
    other = bytearray(whole)
    other[place] ^= 1
    path.write_bytes(other)
    with open_shard(path) as shard, pytest.raises(CorruptShard):
        shard.read("scale")
    path.write_bytes(TARGETS["shard"].mended(bytes(other)))
    with open_shard(path) as shard:
        assert shard.read("scale") != before
