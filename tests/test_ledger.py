"""A ledger is what a dict would be, whoever is killed and wherever it lies."""

import errno
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from bucket_server import BUCKET, bucket_server
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from trouble import unfit

from articugen.core import files, place
from articugen.core.errors import ArticugenError, MachineFault
from articugen.core.files import UnfitFile, partial_name
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.place import Folder, Listed, Place
from articugen.store.bucket import Bucket

HOSTILE = ("../up", "a/b", "A", "a", ".", "..", "", "x" * 300, "two\nlines", "\udcff", "é", "a\0b")
KEYS = st.sampled_from(HOSTILE)
VALUES = st.binary(max_size=20)


class Memory:
    """A place as plain as can be."""

    at_once = 4

    def __init__(self) -> None:
        self.files: dict[str, tuple[bytes, float]] = {}
        self.ahead = 1000.0

    def __str__(self) -> str:
        return "memory"

    def read(self, name: str) -> bytes | None:
        data, _ = self.files.get(name, (None, 0.0))
        return data

    def write(self, name: str, data: bytes) -> None:
        self.files[name] = data, time.time() + self.ahead

    def write_new(self, name: str, data: bytes) -> bool:
        if name not in self.files:
            self.write(name, data)
        return self.read(name) == data

    def list(self, under: str = "") -> Mapping[str, Listed]:
        before = f"{under}/" if under else ""
        return {
            name.removeprefix(before): Listed(len(data), at)
            for name, (data, at) in self.files.items()
            if name.startswith(before)
        }

    def delete(self, names: Iterable[str]) -> None:
        for name in names:
            self.files.pop(name, None)


class Killed(BaseException):
    pass


class Dying:
    """A place whose process is killed before one of its changes, or told that one has failed."""

    def __init__(self, inner: Place, changes: int, error: type[BaseException]) -> None:
        self._inner, self._left, self._error = inner, changes, error
        self.at_once, self.read, self.list = inner.at_once, inner.read, inner.list

    def _change(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise self._error

    def write(self, name: str, data: bytes) -> None:
        self._change()
        self._inner.write(name, data)

    def write_new(self, name: str, data: bytes) -> bool:
        self._change()
        return self._inner.write_new(name, data)

    def delete(self, names: Iterable[str]) -> None:
        for name in names:
            self._change()
            self._inner.delete([name])


class Ledgers(RuleBasedStateMachine):
    """Two processes at one place, beside a dict that knows what both have done."""

    new_place: Iterator[Place]

    @initialize()
    def begin(self) -> None:
        self.place = next(type(self).new_place)
        self.runs = {who: Ledger(self.place, who=who) for who in ("one", "two")}
        self.about: bytes | None = None
        self.values: dict[str, bytes] = {}
        self.claims: dict[str, str] = {}
        self.torn: set[str] = set()

    who = st.sampled_from(["one", "two"])

    @rule(who=who, about=VALUES)
    def agree(self, who: str, about: bytes) -> None:
        self.about = about if self.about is None else self.about
        assert self.runs[who].agree(about) == self.about

    @rule(who=who, about=VALUES)
    def agree_anew(self, who: str, about: bytes) -> None:
        self.about = about
        assert self.runs[who].agree(about, anew=True) == about

    @rule(who=who, key=KEYS, value=VALUES)
    def record(self, who: str, key: str, value: bytes) -> None:
        self.runs[who].record(key, value)
        self.values[key] = value
        self.torn.discard(key)

    @rule(who=who, key=KEYS, value=VALUES, error=st.sampled_from([Killed, MachineFault]))
    def record_and_die(self, who: str, key: str, value: bytes, error: type[BaseException]) -> None:
        with pytest.raises(error):
            Ledger(Dying(self.place, 0, error), who=who).record(key, value)

    @precondition(lambda self: self.values)
    @rule(data=st.data(), cut=st.integers(0, 10))
    def tear(self, data: st.DataObject, cut: int) -> None:
        """A record is cut short, or copied over by another thing's."""
        key, *others = data.draw(st.permutations(sorted(self.values)))
        ours, theirs = (self._file(k) for k in (key, others[0] if others else key))
        text = self.place.read(theirs) or b""
        self.place.write(ours, text if others else text[: len(text) - 1 - cut])
        del self.values[key]
        self.torn.add(key)

    def _file(self, key: str) -> str:
        alone = Memory()
        Ledger(alone).record(key, b"")
        return next(iter(alone.files))

    @rule(who=who, key=KEYS)
    def claim(self, who: str, key: str) -> None:
        assert self.runs[who].claim(key) == (self.claims.setdefault(key, who) == who)

    @rule(key=KEYS)
    def free(self, key: str) -> None:
        self.runs[self.claims.pop(key, "one")].free(key)

    @rule(who=who)
    def free_all(self, who: str) -> None:
        self.runs[who].free_all()
        self.claims = {key: other for key, other in self.claims.items() if other != who}

    @rule(changes=st.integers(0, 4), report=VALUES)
    def seal(self, changes: int, report: bytes) -> None:
        """Killed at any moment of it, the next one goes on."""
        many = len(Ledger(self.place).files()) + 1
        try:
            Ledger(Dying(self.place, changes, Killed)).seal([("report", report)])
        except Killed:
            assert changes < many
            if changes:
                assert self.place.read("report") == report
        Ledger(self.place).seal([("report", report)])
        assert dict(self.place.list()).keys() == {"report"}
        self.about, self.values, self.claims, self.torn = None, {}, {}, set()

    @invariant()
    def is_what_the_dict_is(self) -> None:
        ledger = Ledger(self.place)
        assert ledger.agreed() == self.about
        assert ledger.known() == self.values
        some = sorted([*HOSTILE[:6], *self.torn])
        assert ledger.known(some) == {k: v for k, v in self.values.items() if k in some}
        assert {key for key in HOSTILE if ledger.is_damaged(key)} == self.torn
        assert len(ledger.recorded()) == len(self.values) + len(self.torn)
        assert all(ledger.is_free(key) == (key not in self.claims) for key in HOSTILE[:3])
        assert ledger.leftovers() == []


def run_machine(places: Iterator[Place], examples: int) -> None:
    machine = type("Machine", (Ledgers,), {"new_place": places}).TestCase
    machine.settings = settings(max_examples=examples, stateful_step_count=15, deadline=None)
    machine().runTest()


def folders(root: Path) -> Iterator[Place]:
    return (Folder(root / f"{number}") for number in count())


def test_in_memory() -> None:
    run_machine((Memory() for _ in count()), 100)


def test_in_a_folder(tmp_path: Path) -> None:
    run_machine(folders(tmp_path), 20)


def test_in_a_store() -> None:
    pytest.importorskip("obstore", reason="obstore is not installed")
    pytest.importorskip("flask_cors", reason="moto's server is not installed")
    with pytest.MonkeyPatch.context() as patch, bucket_server(patch):
        run_machine((Bucket(f"s3://{BUCKET}/ledgers/{number}") for number in count()), 4)


def test_the_claim_of_a_killed_run_runs_out_by_the_places_clock() -> None:
    memory = Memory()
    ours, theirs = (Ledger(memory, who=who, lease=50.0) for who in ("ours", "theirs"))
    assert theirs.claim("a")
    assert not ours.claim("a")
    assert theirs.claim("a")  # another worker of the same run
    memory.ahead += 60.0
    ours = Ledger(memory, who="ours", lease=50.0)
    assert ours.is_free("a")
    assert ours.claim("a")
    assert not Ledger(memory, who="others", lease=50.0).claim("a")
    ours.free("a")
    assert memory.list(f"{LEDGER}/claims") == {}


def test_one_of_many_threads_wins(tmp_path: Path) -> None:
    ledgers = [Ledger(Folder(tmp_path), who=f"{number}") for number in range(8)]
    with ThreadPoolExecutor(8) as pool:
        for key in map(str, range(20)):
            assert sum(pool.map(lambda ledger, key=key: ledger.claim(key), ledgers)) == 1
        won = set(pool.map(lambda n: ledgers[n].agree(b"%d" % n), range(8)))
    assert len(won) == 1


def test_a_file_system_without_links_serves_as_well(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(place.os, "link", refuse)
    test_one_of_many_threads_wins(tmp_path)


@pytest.mark.parametrize(
    ("write", "inner"),
    [(Folder.write, "write_atomically"), (Folder.write_new, "_write_exclusively")],
)
def test_a_folder_that_others_empty_and_make_again_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Any, inner: str
) -> None:
    real, calls = getattr(place, inner), list[Path]()

    def beside_others(path: Path, data: bytes) -> None:
        calls.append(path)
        if len(calls) > 1:
            return real(path, data)
        path.parent.rmdir()
        try:
            real(path, data)
        finally:
            path.parent.mkdir()

    monkeypatch.setattr(place, inner, beside_others)
    write(Folder(tmp_path), "clocks/1", b"now")
    assert (tmp_path / "clocks" / "1").read_bytes() == b"now"


def test_a_plan_that_is_being_written_is_waited_for(tmp_path: Path) -> None:
    assert Ledger(Folder(tmp_path / "whole")).agree(b"theirs") == b"theirs"
    whole = (tmp_path / "whole" / LEDGER / "plan.json").read_bytes()
    path = tmp_path / LEDGER / "plan.json"
    path.parent.mkdir()
    path.write_bytes(whole[:10])  # as it stands there without links, for a moment
    with ThreadPoolExecutor(1) as pool:
        ours = pool.submit(Ledger(Folder(tmp_path)).agree, b"ours")
        time.sleep(0.05)
        path.write_bytes(whole)
        assert ours.result() == b"theirs"
    path.write_bytes(whole[:10])
    with pytest.raises(ArticugenError, match=r"plan\.json: damaged; delete it"):
        Ledger(Folder(tmp_path)).agree(b"ours")


@pytest.mark.parametrize("kind", ["FIFO", "folder", "device", "round link", "too large"])
def test_what_is_no_file_is_no_record(tmp_path: Path, kind: str) -> None:
    ledger = Ledger(Folder(tmp_path))
    ledger.record("a", b"1")
    (name,) = ledger.recorded()
    path = tmp_path / LEDGER / "done" / name
    path.unlink()
    unfit(path, kind, 1 << 28)
    assert ledger.known(["a"]) == {}
    assert ledger.is_damaged("a")
    (tmp_path / LEDGER / "plan.json").mkdir()
    with pytest.raises(ArticugenError, match=r"plan\.json: damaged \(it is a folder.*delete it"):
        ledger.agreed()


@pytest.mark.parametrize("step", [LEDGER, f"{LEDGER}/done"])
def test_no_link_is_followed(tmp_path: Path, step: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    Ledger(Folder(elsewhere)).record("a", b"precious")
    before = {p.name: p.read_bytes() for p in elsewhere.rglob("*") if p.is_file()}
    folder = tmp_path / "folder"
    (folder / step).parent.mkdir(parents=True)
    (folder / step).symlink_to(elsewhere / step)
    ledger = Ledger(Folder(folder))
    assert ledger.known(["a"]) == {}
    with pytest.raises(MachineFault, match="is a symbolic link, which nobody follows"):
        ledger.record("a", b"2")
    with pytest.raises(MachineFault, match="is a symbolic link, which nobody follows"):
        ledger.known()
    with suppress(MachineFault):
        ledger.seal([])
    assert {p.name: p.read_bytes() for p in elsewhere.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("name", ["../up", "/etc/x", "a//b", "", ".", "a/../b", "a\0b"])
def test_a_folder_has_no_names_outside(tmp_path: Path, name: str) -> None:
    folder = Folder(tmp_path / "folder")
    with pytest.raises(UnfitFile, match="is no name of a file in it"):
        folder.read(name)
    for act in (folder.write, folder.write_new):
        with pytest.raises(MachineFault, match="is no name of a file in it"):
            act(name, b"x")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_tears_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = Ledger(Folder(tmp_path))
    ledger.record("a", b"1")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        for act in (lambda: ledger.record("a", b"2"), lambda: ledger.agree(b"x")):
            with pytest.raises(MachineFault, match="the disk is full"):
                act()
        with pytest.raises(MachineFault, match="the disk is full"):
            ledger.claim("a")
    assert ledger.known() == {"a": b"1"}
    assert ledger.agreed() is None
    assert ledger.leftovers() == []


def test_what_a_killed_process_was_writing_is_left_over(tmp_path: Path) -> None:
    ledger = Ledger(Folder(tmp_path))
    ledger.record("a", b"1")
    (name,) = ledger.recorded()
    part = f"{LEDGER}/done/{partial_name(name)}"
    (tmp_path / part).write_bytes(b"half")
    assert ledger.known() == {"a": b"1"}
    assert ledger.leftovers() == [part]
    ledger.seal([("report", b"all")])
    assert os.listdir(tmp_path) == ["report"]


def test_a_place_that_is_emptied_meanwhile_is_written_to(tmp_path, monkeypatch):
    write, struck = place.write_atomically, []

    def struck_once(path: Path, data: bytes) -> None:
        if not struck:
            struck.append(shutil.rmtree(path.parent))
        write(path, data)

    monkeypatch.setattr(place, "write_atomically", struck_once)
    Folder(tmp_path).write("a/b", b"x")
    assert Folder(tmp_path).read("a/b") == b"x"
