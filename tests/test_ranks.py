"""A data set by many processes: any number of them, some killed, is what one process makes."""

import hashlib
import json
import shutil
from pathlib import Path

import pytest
from command_line import run
from python_process import printed
from test_pipeline import BOX, TINY, contents, job, made, planned
from trouble import held_by_another_run

from articugen.core.errors import ArticugenError, InvalidArgument, InvalidRecipe
from articugen.core.files import partial_name
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.place import Folder
from articugen.pipeline import plan
from articugen.pipeline.clean import clean
from articugen.pipeline.executors.local import Local
from articugen.pipeline.job import Share
from articugen.pipeline.merge import merge
from articugen.pipeline.records import Records
from articugen.pipeline.run import started
from articugen.sources.splits import TEST_FRACTION
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.verify.dataset import verify

OBJECTS = 9


def share(text: str) -> Share:
    return Share.of_text(text)


def rank(out: Path, text: str, **changes: object) -> list[str]:
    """Let a rank finish here; the objects that it made itself."""
    told: list[str] = []
    with started(job(out, share=share(text), **changes), command="the command") as run:
        run.finish(
            Local(0), lambda report: None if report.reused else told.append(report.object_id)
        )
    return told


def processes(out: Path, *rounds: str) -> list[list[int]]:
    """The exit statuses of so many ranks, of one round after the other, as os.waitpid has them."""
    script = Path(__file__).with_name("rank_processes.py")
    root = script.parents[1]
    lines = printed(script, out, OBJECTS, *rounds, PYTHONPATH=f"{root}:{root}/tests").splitlines()
    return [list(map(int, line.split())) for line in lines]


def test_eight_ranks_of_which_three_are_killed_make_what_one_process_makes(tmp_path: Path) -> None:
    out = tmp_path / "many"
    eight, three = processes(out, "8:0=object,1=shard,2=record", "3:1=shard")
    assert eight == [9, 9, 9, 0, 0, 0, 0, 0]
    assert three == [0, 9, 0]  # by another number of ranks, one killed again
    left = [p.name for p in out.iterdir() if p.name.endswith(".partial")]
    assert len(left) == 2  # nobody removes what may be another's
    with pytest.raises(ArticugenError, match=r"1 of 9 objects are missing .*--shard i/8, i = 1;"):
        merge(out)
    all_of_them = TINY.with_options(objects=OBJECTS, states=0)
    assert len(rank(out, "1/8", recipe=all_of_them)) == 1
    merged = merge(out, jobs=2)

    one, _ = made(job(tmp_path / "one", recipe=all_of_them))
    assert merged.content_sha256 == one.content_sha256
    assert contents(out).keys() == contents(tmp_path / "one").keys()
    for name, data in contents(tmp_path / "one").items():
        assert contents(out)[name] == data, name
    assert verify(out).findings == ()
    assert planned(job(out, recipe=all_of_them)).tasks == ()


def test_a_plain_run_goes_on_with_what_ranks_have_made(tmp_path: Path) -> None:
    first = rank(tmp_path, "0/3")
    assert len(first) == 2
    (tmp_path / partial_name("train-00001.h5")).write_bytes(b"of a rank that was killed")
    assert not planned(job(tmp_path)).conflict
    manifest, reports = made(job(tmp_path))
    assert {r.object_id for r in reports if r.reused} == set(first)
    assert {p.name for p in tmp_path.iterdir()} == {
        MANIFEST_NAME, "croissant.json", *(shard.name for shard in manifest.shards)
    }  # fmt: skip
    assert rank(tmp_path, "1/2") == []  # and ranks with what a plain run has
    assert verify(tmp_path).findings == ()


def test_a_killed_plain_run_and_a_finished_one_are_gone_on_with(tmp_path: Path) -> None:
    few = TINY.with_options(objects=2)
    made(job(tmp_path, recipe=few))
    before = Manifest.read(tmp_path)
    assert rank(tmp_path, "0/2") + rank(tmp_path, "1/2")
    assert Manifest.read(tmp_path) == before  # what was whole is whole until the merge
    assert [left.path.name for left in clean(tmp_path)] == []
    assert len(merge(tmp_path).objects) == 4
    assert verify(tmp_path).findings == ()


def test_ranks_share_a_folder_and_with_nobody_else(tmp_path: Path) -> None:
    with started(job(tmp_path, share=share("0/2"))) as one:
        one.records.begin(["train-00000.h5"])
        with started(job(tmp_path, share=share("1/2"))):
            pass
        with pytest.raises(ArticugenError, match="another run is writing here"):
            Records(Folder(tmp_path))
        with pytest.raises(ArticugenError, match="another run is writing here"):
            merge(tmp_path)
    with held_by_another_run(tmp_path), pytest.raises(ArticugenError, match="another run"):
        rank(tmp_path, "0/2")


def test_ranks_that_want_something_else_are_told(tmp_path: Path) -> None:
    rank(tmp_path, "0/2")
    for changes in ({"seed": 1}, {"recipe": TINY.with_options(objects=5)}, {"exclude": ("x",)}):
        with pytest.raises(ArticugenError):
            rank(tmp_path, "1/2", **changes)
    with pytest.raises(
        ArticugenError, match=r"make another data set here \(another seed\), by: the"
    ):
        rank(tmp_path, "1/2", seed=1)
    whole = tmp_path / "whole"
    made(job(whole))
    with pytest.raises(ArticugenError, match=r"replace nothing"):
        rank(whole, "1/2", seed=1)
    assert Manifest.read(whole).seed == 0


def test_the_same_object_made_twice_is_one(tmp_path: Path) -> None:
    """As where ranks of another number are started while some of the first are still at work."""
    out = tmp_path / "twice"
    with started(job(out, share=share("0/2"))) as slow:  # has seen an empty folder
        assert len(rank(out, "0/1")) == 4
        slow.finish(Local(0))
    assert len(Ledger(Folder(out)).recorded()) == 4
    merge(out)
    assert verify(out).findings == ()


def test_a_merge_names_what_is_altered_and_a_rank_makes_it_again(tmp_path: Path) -> None:
    rank(tmp_path, "0/1")
    shard = tmp_path / "train-00001.h5"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    with pytest.raises(ArticugenError, match=r"1 of 4 .*train-00001.h5 is missing or altered"):
        merge(tmp_path)
    copied = tmp_path.parent / "copied"
    shutil.copytree(tmp_path, copied)
    assert len(merge(copied, sizes_only=True).objects) == 4
    assert {f.shard for f in verify(copied).findings} == {"train-00001.h5"}
    assert len(rank(tmp_path, "1/2")) + len(rank(tmp_path, "0/2")) == 1
    merge(tmp_path)


@pytest.mark.parametrize("text", ["8/8", "3", "-1/2", "1/0", "a/b", "1/2/3", ""])
def test_a_share_is_one_of_so_many(text: str) -> None:
    with pytest.raises(InvalidArgument, match="counted from 0"):
        Share.of_text(text)


def test_the_command_line_makes_shares_and_merges_them(tmp_path: Path) -> None:
    recipe = tmp_path / "tiny.json"
    recipe.write_text(TINY.with_options(objects=3).text())
    command = ["generate", "-c", "eyeglasses", "-r", recipe, "-j", 0, "-o", tmp_path / "data"]

    dry = run(*command, "--shard", "1/2", "--dry-run")
    assert "shard 1/2: 1 of 3 objects" in dry.stdout
    assert not (tmp_path / "data").exists()
    assert run(*command, "--shard", "2/2").exit_code == 1
    assert "replace nothing; give" in run(*command, "--shard", "0/2", "--replace").stderr
    done = run(*command, "--shard", "1/2")
    folder = tmp_path / "data" / "eyeglasses"
    assert done.exit_code == 0, done.output
    assert f"articugen merge {folder}" in done.stdout
    assert (folder / LEDGER / "plan.json").exists()
    refused = run("merge", folder)
    assert refused.exit_code == 1
    assert "2 of 3 objects are missing" in refused.stderr
    assert run(*command, "--shard", "0/2").exit_code == 0
    assert run("merge", tmp_path / "data").exit_code == 0
    assert not (folder / LEDGER).exists()
    again = run("merge", folder)
    assert (again.exit_code, "nothing to merge" in again.stdout) == (0, True)
    (folder / "train-00000.h5").unlink()
    assert "train-00000.h5 is missing or altered; mend it with" in run("merge", folder).stderr
    (folder / "manifest.json").unlink()
    assert "no rank has been at work" in run("merge", folder).stderr


def test_a_plan_of_another_version_is_told_of(tmp_path: Path) -> None:
    rank(tmp_path, "0/2")
    ledger = Ledger(Folder(tmp_path))
    about = json.loads(ledger.agreed() or b"") | {"recipe": '{"name": 5}'}
    ledger.agree(json.dumps(about).encode(), anew=True)
    with pytest.raises(ArticugenError, match="recipe is of another version of articugen"):
        merge(tmp_path)


def test_no_more_objects_than_a_manifest_can_tell_of(tmp_path, monkeypatch):
    """Said before the first is made, not after the last."""
    monkeypatch.setattr(plan, "MOST_OBJECTS", 3)
    with pytest.raises(InvalidRecipe, match="4 objects of eyeglasses: a data set has at most 3"):
        rank(tmp_path, "0/2")


def test_ranks_and_chosen_ids_agree_on_splits_that_no_hash_decides(tmp_path: Path) -> None:
    """All that hashes put into `test` has no joint: it is skipped, and none of the others was."""
    folder = tmp_path / "boxes"
    folder.mkdir()
    for number in range(6):
        is_test = hashlib.sha256(f"box{number}".encode()).digest()[0] < 256 * TEST_FRACTION
        text = BOX.format(size=1 + number / 10)
        (folder / f"box{number}.urdf").write_text(text.replace("revolute", "fixed", is_test))
    few = {"source": str(folder), "category": "box", "recipe": TINY.with_options(objects=99)}
    plain, _ = made(job(tmp_path / "plain", **few))
    splits = {entry.key.object_id: entry.key.split for entry in plain.objects}
    assert (len(splits), list(splits.values()).count("test")) == (6 - len(plain.skipped), 1)
    assert {entry.key.split for entry in plain.skipped} == {"test"}
    many = tmp_path / "many"
    for text in ("2/3", "0/3", "1/3"):
        rank(many, text, **few)
    assert merge(many).content_sha256 == plain.content_sha256
    chosen = next(name for name, split in splits.items() if split == "test")
    alone = planned(job(tmp_path / "alone", ids=(chosen,), jobs=1, **few))
    assert alone.keys == tuple(e.key for e in plain.objects if e.key.split == "test")
