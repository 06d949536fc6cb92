"""A little of `make chaos`: disks that fail, processes that die, stories of both."""

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest
from chaos.commands import TRAINING, commands
from chaos.disk import Disk, failing_disk
from chaos.failures import FAULTS, Failures
from chaos.kills import Kills, Strike
from chaos.machine import told


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("chaos")


@pytest.fixture(scope="module")
def disk(folder: Path) -> Iterator[Disk]:
    with failing_disk(folder) as disk:
        yield disk


@pytest.fixture(scope="module")
def failures(folder: Path, disk: Disk) -> Callable[[str], Failures]:
    """A command on that disk, prepared once."""
    work = folder / "work"
    all_commands = commands(folder / "inputs", work, jobs=0)
    return cache(lambda name: Failures(all_commands[name], disk, work))


def test_the_recipe_of_the_training_that_is_struck_makes_sense(tmp_path: Path) -> None:
    """It extends one that changes; trainings are too slow to be struck here."""
    pytest.importorskip("torch")
    from articugen.learning.method import load_recipe  # noqa: PLC0415

    (tmp_path / "train.yaml").write_text(TRAINING)
    assert load_recipe(str(tmp_path / "train.yaml")).name == "train"


@pytest.mark.parametrize("name", ["generate", "export", "fetch"])
def test_what_fails_or_is_torn_on_the_disk_costs_nothing(name, failures):
    struck = failures(name)
    points = struck.telling()
    for first, mode in enumerate(FAULTS):
        row = struck.tried(mode, points[20 * first + 3 :: 90], lambda _: None)
        assert row.tried > 0
        assert row.holds, row.wrong


@pytest.mark.parametrize("name", ["generate", "export"])
def test_a_power_cut_finds_no_name_without_its_bytes(name, failures):
    assert_named_when_whole(failures(name).changes)


def assert_named_when_whole(changes: list[tuple[str, ...]]) -> None:
    """A file gets its name when its bytes are on the disk, and then the name is brought there."""
    unsynced: set[str] = set()
    for number, (what, path, *to) in enumerate(changes):
        if what in ("write", "ftruncate", "create"):
            unsynced.add(path)
        elif what == "fsync":
            unsynced.discard(path)
        elif what == "rename":
            assert path not in unsynced, f"{path} is named before it is written"
            assert changes[number + 1] == ("fsync", str(Path(to[0]).parent))


def test_a_sigterm_keeps_what_was_made_and_no_worker(folder, failures):
    command = commands(folder / "inputs", folder / "work", jobs=2)["generate"]
    kills = Kills(command, folder / "work", failures("generate").whole, 3.0)
    row = kills.tried(Strike.TERM, [1.0], lambda _: None)
    assert row.holds, row.wrong


def test_stories_of_runs_kills_faults_and_corruptions_end_well(folder: Path, disk: Disk) -> None:
    told(folder, disk, stories=2, steps=5)
