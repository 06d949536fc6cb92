"""A manifest in pages is the manifest that it would be in one file, or it is refused."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_ledger import Killed
from test_manifest import keys, names_in, run
from test_pipeline import contents, job, made, planned
from test_ranks import rank
from trouble import unfit

import articugen as ag
from articugen.core import files, place
from articugen.core.errors import CorruptShard, MachineFault
from articugen.core.ledger import LEDGER
from articugen.pipeline.clean import clean
from articugen.pipeline.merge import merge
from articugen.store import manifest, manifest_pages
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.manifest_pages import MOST_BYTES, is_page_name
from articugen.verify.dataset import verify
from articugen.verify.repair import repair


@pytest.fixture(autouse=True)
def small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest, "PAGE_ENTRIES", 2)


def in_pages(folder: Path, **changes: object) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(manifest, "PAGE_ENTRIES", 2)
        made(job(folder / "eyeglasses", **changes))
    return folder / "eyeglasses"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four eyeglasses, two a page. Look, do not touch."""
    return in_pages(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """A copy of it to do harm to."""
    return Path(shutil.copytree(whole, tmp_path / "copy"))


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of another seed."""
    return in_pages(tmp_path_factory.mktemp("other"), seed=1)


def pages(folder: Path) -> list[str]:
    return [name for name in names_in(folder) if is_page_name(name)]


def head(folder: Path) -> dict[str, Any]:
    return json.loads((folder / MANIFEST_NAME).read_text())


def test_pages_and_one_file_say_the_same(whole, tmp_path, monkeypatch):
    told = Manifest.read(whole)
    listed = head(whole)["pages"]
    assert [page["name"] for page in listed] == pages(whole)
    assert [page["entries"] for page in listed] == [4, 4]
    assert not head(whole).keys() & {"objects", "shards", "rejected", "skipped", "failed"}
    monkeypatch.setattr(manifest, "PAGE_ENTRIES", 4)  # as many as there are
    told.write(tmp_path)
    assert names_in(tmp_path) == [MANIFEST_NAME]
    assert (tmp_path / MANIFEST_NAME).read_text() == told.model_dump_json(indent=1) + "\n"
    assert Manifest.read(tmp_path) == told
    rest = {name: value for name, value in head(tmp_path).items() if name != "manifest_sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    assert hashlib.sha256(text.encode()).hexdigest() == told.manifest_sha256


def test_a_data_set_with_pages_is_like_any_other(whole: Path, folder: Path) -> None:
    data = ag.open(whole)
    assert data.manifest == Manifest.read(whole)
    assert dict(data.splits) == {"test": 3, "train": 9}
    assert len(data.split("train").objects) == 3
    assert len(data[-1].surface.points)
    assert verify(whole).findings == ()
    assert planned(job(whole)).tasks == ()
    assert clean(folder) == []
    before = contents(folder)
    made(job(folder))
    assert contents(folder) == before


def test_ranks_are_merged_into_pages(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "ranks"
    assert len(rank(out, "0/2") + rank(out, "1/2")) == 4
    merged = merge(out)
    assert merged.content_sha256 == Manifest.read(whole).content_sha256
    assert Manifest.read(out) == merged
    assert len(pages(out)) == 2
    assert verify(out).findings == ()


@contextmanager
def dying_after(writes: int, error: type[BaseException] = Killed) -> Iterator[None]:
    """Let a manifest's files be written, but only so many."""
    left = iter(range(writes))

    def write(path: Path, data: bytes) -> None:
        is_of_manifest = path.name == MANIFEST_NAME or is_page_name(path.name)
        if is_of_manifest and path.parent.name != LEDGER and next(left, None) is None:
            raise error
        files.write_atomically(path, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(manifest, "write_atomically", write)
        patch.setattr(place, "write_atomically", write)
        yield


@pytest.mark.parametrize("written", [0, 1, 2])
def test_a_run_that_is_killed_between_pages_goes_on(tmp_path: Path, written: int) -> None:
    with dying_after(written), pytest.raises(Killed):
        run(tmp_path, keys())
    assert len(pages(tmp_path)) == written
    assert LEDGER in names_in(tmp_path)
    with pytest.raises(CorruptShard, match="goes on when it is started again"):
        Manifest.read(tmp_path)
    assert clean(tmp_path, dry_run=True) == []  # they are the next run's to remove
    assert run(tmp_path, keys()) == []
    assert len(pages(tmp_path)) == 2
    assert {page["name"] for page in head(tmp_path)["pages"]} == set(pages(tmp_path))


@pytest.mark.parametrize(("written", "error"), [(1, Killed), (2, Killed), (1, MachineFault)])
def test_until_the_last_file_is_there_the_manifest_before_it_is_whole(
    folder: Path, other: Path, written: int, error: type[BaseException]
) -> None:
    before, listed = Manifest.read(folder), pages(folder)
    with dying_after(written, error), pytest.raises(error):
        Manifest.read(other).write(folder)
    assert Manifest.read(folder) == before
    stale = sorted(set(pages(folder)) - set(listed))
    assert len(stale) == written
    assert [(f.check, f.shard) for f in verify(folder).findings] == [("leftover", s) for s in stale]
    assert [item.path.name for item in clean(folder)] == stale
    assert verify(folder).findings == ()


def test_stale_pages_go_with_the_next_manifest(tmp_path: Path) -> None:
    run(tmp_path, keys())
    first = pages(tmp_path)
    run(tmp_path, keys(seed=1))
    assert len(pages(tmp_path)) == 2
    assert not set(first) & set(pages(tmp_path))
    run(tmp_path, keys(seed=1)[:1])
    assert pages(tmp_path) == []
    assert len(Manifest.read(tmp_path).objects) == 1


def test_only_what_is_called_like_a_page_goes(folder: Path) -> None:
    mine = ["manifest-00000.json", "manifest-00000-0123456789abcdeg.json", "manifest-1.json"]
    for name in mine:
        (folder / name).write_text("mine")
    (folder / "manifest-00009-0123456789abcdef.json").mkdir()
    (precious := folder.parent / "precious").write_text("mine")
    link = folder / "manifest-00008-0123456789abcdef.json"
    link.symlink_to(precious)
    assert clean(folder) == []
    found = {f.shard for f in verify(folder).findings if f.check == "surplus"}
    assert found == {*mine, link.name, "manifest-00009-0123456789abcdef.json"}
    assert precious.read_text() == "mine"


def flipped(folder: Path, _: Path) -> str:
    path = folder / pages(folder)[1]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    return path.name


def lengthened(folder: Path, _: Path) -> str:
    path = folder / pages(folder)[0]
    path.write_bytes(path.read_bytes() + b"\n")
    return path.name


def missing(folder: Path, _: Path) -> str:
    name = pages(folder)[0]
    (folder / name).unlink()
    return name


def swapped(folder: Path, _: Path) -> str:
    a, b = ((folder / name) for name in pages(folder))
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)
    return a.name


def of_another_set(folder: Path, other: Path) -> str:
    path = folder / pages(folder)[1]
    shutil.copyfile(other / pages(other)[1], path)
    return path.name


@pytest.mark.parametrize("harm", [flipped, lengthened, missing, swapped, of_another_set])
def test_a_damaged_page_is_found_and_mended(folder, other, harm):
    before = Manifest.read(folder)
    name = harm(folder, other)
    with pytest.raises(CorruptShard, match=name) as caught:
        Manifest.read(folder)
    assert "a page of manifest.json: " in str(caught.value)
    assert "articugen verify --repair" in str(caught.value)
    (finding,) = verify(folder).findings
    assert (finding.check, finding.sentence) == ("manifest", str(caught.value))
    with pytest.raises(CorruptShard, match=name):
        ag.open(folder)
    (done,) = repair(folder, verify(folder), jobs=0)
    assert done.ok
    assert done.wrong.startswith(name)
    assert "made again from 4 shards" in done.done
    after = Manifest.read(folder)
    assert after.content_sha256 == before.content_sha256
    assert after.shards == before.shards
    assert len(pages(folder)) == 2
    assert verify(folder).findings == ()


def test_a_head_that_is_lost_is_made_again_of_the_pages(folder: Path) -> None:
    before = Manifest.read(folder)
    (folder / MANIFEST_NAME).write_bytes((folder / MANIFEST_NAME).read_bytes()[:100])
    (done,) = repair(folder, verify(folder), jobs=0)
    assert done.ok
    assert "proven" not in done.done
    assert Manifest.read(folder).objects == before.objects
    assert verify(folder).findings == ()


def test_a_page_of_another_run_costs_no_shard(folder: Path, other: Path) -> None:
    """All of the other's manifest, pages and head: whose it is the shards tell."""
    shards = {p.name: p.read_bytes() for p in folder.glob("*.h5")}
    for path in (MANIFEST_NAME, *pages(other)):
        shutil.copyfile(other / path, folder / path)
    (done,) = repair(folder, verify(folder), jobs=0)
    assert not done.ok
    assert "bring back the right one" in done.done
    assert {p.name: p.read_bytes() for p in folder.glob("*.h5")} == shards


def listing(change: Callable[[list[Any]], object]) -> Callable[[dict[str, Any]], object]:
    return lambda told: change(told["pages"])


HOSTILE: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (listing(lambda pages: pages[0].update(name="../manifest-00000.json")), "page 0 is not called"),
    (listing(lambda pages: pages[0].update(name="/etc/passwd")), "page 0 is not called by"),
    (listing(lambda pages: pages[0].update(name="train-00000.h5")), "page 0 is not called by"),
    (listing(lambda pages: pages[0].update(name="\0")), "page 0 is not called by"),
    (listing(lambda pages: pages.append(pages[1])), "page 2 is not called by its number"),
    (listing(lambda pages: pages.pop(0)), "page 0 is not called by its number"),
    (listing(lambda pages: pages.reverse()), "page 0 is not called by its number"),
    (listing(lambda pages: pages.pop()), "content_sha256 is not the digest"),
    (listing(lambda pages: pages.clear()), "pages: Tuple should have at least 1 item"),
    (listing(lambda pages: pages.extend(pages * 1000)), "at most 1000 items"),
    (listing(lambda pages: pages[0].update(sha256="0" * 64)), "page 0 is not called by"),
    (listing(lambda pages: pages[0].update(sha256="x")), r"pages\.0\.sha256: "),
    (listing(lambda pages: pages[0].update(entries=5)), "does not hold 5 entries"),
    (listing(lambda pages: pages[0].update(entries=0)), r"pages\.0\.entries: "),
    (listing(lambda pages: pages[0].update(bytes=MOST_BYTES + 1)), r"pages\.0\.bytes: "),
    (listing(lambda pages: pages[0].update(bytes=7)), "more than the 7 that it may have"),
    (listing(lambda pages: pages[0].update(bytes=10**6)), "has other bytes than those listed"),
    (listing(lambda pages: pages[0].update(colour="red")), r"pages\.0\.colour: Extra inputs"),
    (lambda told: told.update(pages={}), "pages: Input should be a valid"),
    (lambda told: told.update(pages=[[]]), r"pages\.0: Input should be"),
    (lambda told: told.update(pages=None), "objects: Field required"),
    (lambda told: told.update(objects=[]), "lists pages, and objects of its own"),
    (lambda told: told.update(colour="red"), "colour: Extra inputs"),
    (lambda told: told.update(seed="0"), "seed: Input should be a valid integer"),
    (lambda told: told.update(seed=7), "manifest_sha256 is not the digest"),
    (lambda told: told["timings"].update(workers=7), "manifest_sha256 is not the digest"),
    (lambda told: told.update(schema_version=99), "schema version 99, this articugen reads"),
]


@pytest.mark.parametrize(("change", "sentence"), HOSTILE)
def test_a_head_may_say_anything(folder, change, sentence):
    told = head(folder)
    change(told)
    (folder / MANIFEST_NAME).write_text(json.dumps(told))
    with pytest.raises(CorruptShard, match=sentence) as caught:
        Manifest.read(folder)
    assert str(caught.value).startswith(f"{folder}/manifest")
    assert str(caught.value).isprintable()


def sealed(folder: Path, number: int, text: str) -> None:
    """Write a page anew, and the head that lists it."""
    data = text.encode()
    page = manifest_pages.page_of(number, data, 4)
    told = head(folder)
    (folder / told["pages"][number]["name"]).unlink()
    (folder / page.name).write_bytes(data)
    told["pages"][number] = page.model_dump()
    (folder / MANIFEST_NAME).write_text(json.dumps(told))


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (lambda _: "[" * 100_000, "Invalid JSON"),
        (lambda _: "{}", "objects: Field required"),
        (lambda text: text.replace('"train-', '"../train-'), r"shards\.0\.name: "),
        (lambda text: text.replace('"seed": 0', '"seed": 7'), "manifest_sha256 is not the digest"),
        (lambda text: text.replace("glasses", "lasses"), "content_sha256 is not the digest"),
        (lambda text: text.replace("{", '{"a": 1,', 1), "a: Extra inputs"),
    ],
)
def test_a_page_may_hold_anything_and_be_listed(folder, edit, sentence):
    text = (folder / pages(folder)[1]).read_text()
    sealed(folder, 1, edit(text))
    with pytest.raises(CorruptShard, match=sentence) as caught:
        Manifest.read(folder)
    assert str(caught.value).isprintable()


def test_the_same_page_twice_lists_objects_twice(folder: Path) -> None:
    sealed(folder, 1, (folder / pages(folder)[0]).read_text())
    with pytest.raises(CorruptShard, match="content_sha256 is not the digest"):
        Manifest.read(folder)


@pytest.mark.parametrize("kind", ["FIFO", "folder", "device", "round link", "too large"])
def test_kind_and_size_of_a_page_are_looked_at_before_reading(folder: Path, kind: str) -> None:
    path = folder / pages(folder)[0]
    path.unlink()
    unfit(path, kind, MOST_BYTES)
    with pytest.raises(CorruptShard, match=path.name) as caught:
        Manifest.read(folder)
    assert str(caught.value).isprintable()
    assert os.path.lexists(path)


def test_instances_are_counted_as_before(whole: Path) -> None:
    """Each row of each shard once, those for training first, and splits as they come."""
    data = ag.open(whole)
    rows = [(row.object_id, row.state_index) for row in data]
    objects = sorted(Manifest.read(whole).objects, key=lambda o: o.key.split != "train")
    assert rows == [(o.key.object_id, n) for o in objects for n in range(3)]
    mixed = data[np.array([5, -1, 4])]
    assert list(mixed.splits.items()) == [("train", 2), ("test", 1)]
    assert mixed.objects == (rows[5][0], rows[-1][0])
