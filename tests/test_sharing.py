"""One object's instances made by several workers: all of them, once, in order, whoever is lost."""

import os
import pickle
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from test_pipeline import TINY, job

from articugen.core.processes import Crew, each
from articugen.core.recipe import Articulation
from articugen.pipeline import door, sharing
from articugen.pipeline.making import help_make
from articugen.pipeline.run import started
from articugen.store.manifest import Manifest
from articugen.store.shards import open_shard

COUNT = 40

NINE = replace(
    job(Path()),
    recipe=TINY.model_copy(
        update={"objects": 1, "articulation": Articulation(states=9, revolute_degrees=(0, 90))}
    ),
)
"""One object, and more instances than a worker keeps for itself."""

Thing = tuple[int, int]
"""Its number, and the process that made it."""


def thing(folder: Path, number: int) -> Thing:
    time.sleep(0.005)
    with (folder / "made").open("a") as log:
        log.write(f"{number}\n")
    return number, os.getpid()


def wait_for_help(folder: Path) -> None:
    until = time.monotonic() + 30
    while not (folder / "ready").exists() and time.monotonic() < until:
        time.sleep(0.01)


def own(folder: Path) -> list[Thing]:
    with sharing.owned(folder / "common") as owner:
        wait_for_help(folder)
        return list(owner.in_order(COUNT, partial(thing, folder)))


def own_at_leisure(folder: Path) -> int:
    """The most things that have ever waited in the folder."""
    with sharing.owned(folder / "common") as owner:
        most = 0
        wait_for_help(folder)
        for _ in owner.in_order(COUNT, partial(thing, folder)):
            time.sleep(0.05)
            most = max(most, len(list((folder / "common").iterdir())))
        return most


def own_impatiently(folder: Path) -> list[Thing]:
    sharing.PATIENCE = 0.3
    return own(folder)


def helped(folder: Path) -> int:
    (folder / "ready").touch()
    return sharing.help_with(folder / "common", COUNT, partial(thing, folder))


def helped_to(trouble: str, folder: Path) -> int:
    """A helper that does harm at its third thing."""
    begun = []

    def make(number: int) -> Thing:
        begun.append(number)
        if len(begun) == 3 and trouble == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if len(begun) == 3 and trouble == "hangs":
            time.sleep(60)
        if len(begun) == 3:
            raise ValueError(trouble)
        return thing(folder, number)

    (folder / "ready").touch()
    return sharing.help_with(folder / "common", COUNT, make)


def test_all_is_made_once_and_given_in_order(tmp_path: Path) -> None:
    (ended,) = each(own, [tmp_path], workers=3, help=helped)
    assert ended.value is not None
    assert [number for number, _ in ended.value] == list(range(COUNT))
    by = Counter(process for _, process in ended.value)
    assert len(by) > 1, "nobody helped"
    assert sorted(map(int, (tmp_path / "made").read_text().split())) == list(range(COUNT))
    assert {p.name for p in tmp_path.iterdir()} == {"made", "ready"}


@pytest.mark.parametrize("trouble", ["killed", "raises", "hangs"])
def test_a_helper_that_is_lost_costs_nothing(tmp_path: Path, trouble: str) -> None:
    said: list[str] = []
    task = own_impatiently if trouble == "hangs" else own
    lost = partial(helped_to, trouble)
    (ended,) = each(task, [tmp_path], workers=2, help=lost, notice=said.append)
    assert ended.value is not None
    assert [number for number, _ in ended.value] == list(range(COUNT))
    assert len({process for _, process in ended.value}) == 2
    assert said == []


def test_helpers_go_where_fewest_are_and_a_crew_is_ready_for_more(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
    with Crew(own, workers=4, help=helped) as crew:
        for _ in range(2):
            for folder in folders:
                (folder / "ready").unlink(missing_ok=True)
            for things in crew.in_order(folders):
                assert [number for number, _ in things] == list(range(COUNT))
                assert len({process for _, process in things}) > 1


def test_little_waits_for_an_owner_that_is_slow(tmp_path: Path) -> None:
    (ended,) = each(own_at_leisure, [tmp_path], workers=3, help=helped)
    assert ended.value is not None
    assert 2 < ended.value <= 16 + 2 + 2  # and the claims; each helper may be at one more


def test_without_a_folder_the_owner_makes_all(tmp_path: Path) -> None:
    for folder in (None, tmp_path / "no such" / "folder"):
        with sharing.owned(folder) as owner:
            assert list(owner.in_order(5, str)) == list("01234")


def test_what_cannot_be_read_is_made_again(tmp_path: Path) -> None:
    with sharing.owned(tmp_path / "common") as owner:
        things = owner.in_order(4, str)
        assert next(things) == "0"
        for number in (1, 2):  # as a helper would leave them; the second one is gone
            with (tmp_path / "common" / "claims").open("r+b") as claims:
                claims.seek(1 + number)
                claims.write(b"\1")
        (tmp_path / "common" / "1").write_bytes(b"\x80\x05 is no pickle")
        assert list(things) == ["1", "2", "3"]


def test_nobody_helps_without_an_owner(tmp_path: Path) -> None:
    (tmp_path / "common").mkdir()
    for folder in (tmp_path / "common", tmp_path / "no such folder"):
        assert sharing.help_with(folder, 5, str) == 0


def test_a_shared_object_has_the_same_bytes(tmp_path: Path) -> None:
    alone = door.make(replace(NINE, out=tmp_path / "alone"))
    shared = door.make(replace(NINE, out=tmp_path / "shared", jobs=3))
    (name,) = (entry.name for entry in alone.shards)
    assert (tmp_path / "alone" / name).read_bytes() == (tmp_path / "shared" / name).read_bytes()
    assert shared.content_sha256 == alone.content_sha256


MAKE = """
import pickle, sys
from pathlib import Path
from articugen.pipeline.making import make_object
job, task, common = pickle.loads(Path(sys.argv[1]).read_bytes())
print(make_object(job, job.folder, task, common=common).made.content_sha256)
"""


def test_instances_that_a_helper_made_are_stored_as_they_are(tmp_path: Path) -> None:
    whole = door.make(replace(NINE, out=tmp_path / "alone"))
    ours = replace(NINE, out=tmp_path / "ours")
    common = tmp_path / "common"
    common.mkdir()
    ours.out.mkdir()
    with started(ours) as run:
        (task,) = run.plan.tasks
        (tmp_path / "task").write_bytes(pickle.dumps((ours, task, common)))
        make = [sys.executable, "-c", MAKE, str(tmp_path / "task")]
        with subprocess.Popen(make, stdout=subprocess.PIPE, text=True) as owner:
            made = 0
            while made == 0 and owner.poll() is None:
                made = help_make(ours, common, task)
            said, _ = owner.communicate()
    assert made > 0
    assert said.strip() == whole.objects[0].content_sha256
    with open_shard(tmp_path / "ours" / task.shard) as shard:
        assert len(shard) == 10
    assert Manifest.read(tmp_path / "alone").content_sha256 == whole.content_sha256
