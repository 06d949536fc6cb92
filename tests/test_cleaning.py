"""What killed runs left is removed, and nothing else."""

import shutil
from pathlib import Path

import command_line
import pytest
import test_manifest
from test_manifest import COMPLETE, about, key, keys, make, names_in, run
from trouble import held_by_another_run

from articugen.core.errors import ArticugenError, CorruptShard
from articugen.core.files import partial_name
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.place import Folder
from articugen.pipeline.clean import clean
from articugen.pipeline.folder import data_sets
from articugen.store.manifest import MANIFEST_NAME
from articugen.verify.dataset import verify

complete, folder = test_manifest.complete, test_manifest.folder


def removed(path: Path, **options) -> list[str]:
    return [left.path.name for left in clean(path, **options)]


def test_nothing_is_left_of_a_whole_run(complete):
    before = {p.name: p.stat().st_mtime_ns for p in complete.iterdir()}
    assert clean(complete) == []
    assert {p.name: p.stat().st_mtime_ns for p in complete.iterdir()} == before


def test_temporary_files_of_ours_go_and_others_stay(folder):
    ours = ("train-00001.h5", "gone.h5", MANIFEST_NAME, "croissant.json")
    parts = [partial_name(name) for name in ours]
    others = ["notes.txt", "mine.h5", ".train-00000.h5.partial", partial_name("thesis.tex")]
    for name in (*parts, *others):
        (folder / name).write_bytes(b"half")
    (folder / partial_name("train-00000.h5")).mkdir()  # no run of ours makes folders
    left = clean(folder, dry_run=True)
    assert sorted(item.path.name for item in left) == sorted(parts)
    assert {(item.why, item.bytes) for item in left} == {("a temporary file", 4)}
    assert set(parts) < set(names_in(folder))
    assert sorted(removed(folder)) == sorted(parts)
    assert set(names_in(folder)) > {*COMPLETE, *others}
    assert removed(folder) == []


def test_a_shard_that_was_not_recorded_goes_and_the_run_goes_on(tmp_path):
    run(tmp_path, keys(), stop_after=1)
    make(tmp_path, keys()[1], "train-00001.h5")
    (tmp_path / "mine.h5").write_bytes(b"claimed by nobody")
    assert removed(tmp_path) == ["train-00001.h5"]
    assert names_in(tmp_path) == [LEDGER, "mine.h5", "train-00000.h5"]
    (tmp_path / "mine.h5").unlink()
    assert run(tmp_path, keys()) == ["box-1", "box-2", "box-3"]
    assert names_in(tmp_path) == COMPLETE


def test_killed_between_manifest_and_ledger(folder):
    planned(folder)
    make(folder, key("box-9"), "train-00003.h5")
    assert removed(folder) == ["train-00003.h5", "plan.json"]
    assert names_in(folder) == COMPLETE
    assert verify(folder).ok


def planned(folder: Path, seed: int = 0) -> None:
    """A run for all objects has been cut short here."""
    Ledger(Folder(folder)).agree(about(keys(seed=seed)).model_dump_json().encode())


def test_no_link_is_followed_to_a_ledger(folder, tmp_path):
    run(tmp_path / "other", keys(), stop_after=2)
    (folder / LEDGER).symlink_to(tmp_path / "other" / LEDGER)
    with pytest.raises(ArticugenError, match="is a symbolic link, which nobody follows"):
        clean(folder)
    assert run(tmp_path / "other", keys()) == ["box-2", "box-3"]


@pytest.mark.parametrize("act", ["clean", "generate"])
def test_what_a_plan_names_is_removed_only_where_it_is_what_runs_write(complete, folder, act):
    """Results of one's own, whole shards by a name of one's own, links, files of another split."""
    names = ["results.h5", "train-00003.h5", "kept.h5", "train-00002.h5", "test-00002.h5"]
    names.append("train-00007.h5")
    for name in names[:2]:
        (folder / name).write_bytes(b"of months of work")
    shutil.copyfile(complete / "train-00000.h5", folder / "kept.h5")
    (folder / "train-00002.h5").symlink_to(complete / "train-00000.h5")
    shutil.copyfile(complete / "train-00000.h5", folder / "test-00002.h5")
    shutil.copyfile(complete / "train-00000.h5", folder / "train-00007.h5")
    planned(folder)
    before = {name: (folder / name).read_bytes() for name in names}
    if act == "clean":
        assert removed(folder) == ["plan.json"]
    else:
        run(folder, keys(seed=7))
    assert {name: (folder / name).read_bytes() for name in names} == before
    assert (folder / "train-00002.h5").is_symlink()


def test_a_run_writes_over_no_file_that_only_a_plan_names(folder):
    for name in (MANIFEST_NAME, "train-00000.h5"):
        (folder / name).unlink()
    (folder / "train-00000.h5").write_bytes(b"of months of work")
    planned(folder)
    with pytest.raises(ArticugenError, match=r"train-00000\.h5: exists and was not made by"):
        run(folder, keys())
    assert (folder / "train-00000.h5").read_bytes() == b"of months of work"


def test_links_are_followed_neither_in_a_data_set_nor_to_one(folder, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    folder.rename(elsewhere)
    part = partial_name("train-00001.h5")
    (elsewhere / part).write_bytes(b"half")
    (data := tmp_path / "data").mkdir()
    (data / "box").symlink_to(elsewhere)
    for command in ("clean", "merge"):
        done = command_line.run(command, data)
        assert (done.exit_code, "a link to elsewhere; name that" in done.output) == (1, True)
    assert (elsewhere / part).exists()
    assert data_sets(data) == [data / "box"]  # to read it
    (link := elsewhere / partial_name("train-00000.h5")).symlink_to(elsewhere / "train-00000.h5")
    assert removed(data / "box") == [part]  # it was named
    assert link.is_symlink()


def test_pages_stay_where_the_manifest_is_lost(folder):
    (page := folder / "manifest-00000-0123456789abcdef.json").write_text("all that is left")
    (folder / MANIFEST_NAME).unlink()
    assert removed(folder) == []
    planned(folder, seed=7)
    assert removed(folder) == []
    assert page.exists()


def test_not_while_a_run_is_at_work(tmp_path):
    run(tmp_path, keys(), stop_after=1)
    part = tmp_path / partial_name("train-00001.h5")
    part.write_bytes(b"being written")
    with (
        held_by_another_run(tmp_path),
        pytest.raises(ArticugenError, match="another run is writing here"),
    ):
        clean(tmp_path)
    assert part.exists()
    assert removed(tmp_path) == [part.name]


def test_all_data_sets_of_a_folder(folder):
    other = folder.parent / "new"
    other.mkdir()
    (folder.parent / "empty").mkdir()
    (other / partial_name(MANIFEST_NAME)).write_bytes(b"killed before anything was whole")
    (folder / partial_name("test-00000.h5")).write_bytes(b"half")
    assert len(removed(folder.parent)) == 2
    assert names_in(other) == []
    for nothing in (folder.parent / "empty", folder.parent / "nowhere"):
        with pytest.raises(CorruptShard, match="holds no data set"):
            clean(nothing)


def test_a_folder_that_has_only_a_manifest_or_a_ledger_is_verified_as_well(folder):
    for path in folder.glob("*.h5"):
        path.unlink()
    other = folder.parent / "cut short"
    run(other, keys(), stop_after=0)
    assert data_sets(folder.parent) == [folder, other]
    assert data_sets(other) == [other]


def test_the_command_says_what_it_removed(folder):
    name = partial_name("test-00000.h5")
    (folder / name).write_bytes(b"half")

    def said(*arguments: str) -> str:
        done = command_line.run("clean", folder, *arguments)
        assert done.exit_code == 0, done.output
        return done.output

    assert f"would remove {folder / name}: a temporary file, 4 B" in said("--dry-run")
    assert f"removed {folder / name}: " in said()
    assert "no killed run has left anything here" in said()
