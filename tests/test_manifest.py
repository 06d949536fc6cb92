"""The manifest is read strictly; a run resumes, replaces only its own, trusts nothing."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from instances import SMALL, hinged_box
from trouble import held_by_another_run, unfit

from articugen.core.errors import ArticugenError, CorruptShard
from articugen.core.files import partial_name, sha256_of
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.place import Folder
from articugen.pipeline.common import CommonPlan
from articugen.pipeline.records import Records
from articugen.store.manifest import MANIFEST_NAME, MOST_BYTES, Manifest, Timings, content_of
from articugen.store.outcome import Key, Outcome, Rejection
from articugen.store.provenance import library_versions, this_commit, this_machine
from articugen.store.writer import write_shard

TIMINGS = Timings(seconds=1.7, instances_per_second=3 / 1.7, peak_memory_bytes=10, workers=1)
STATES = ((0.0, 0.0), (0.9, 0.1))
ONE = SMALL.for_one_object()
GENERATOR = "fusion 1"
LAST = "box-3"
"""The object that is always rejected."""


def key(object_id="box-0", split="train", **other) -> Key:
    values = {"ref": "f" * 64, "recipe_sha256": ONE.sha256(), "seed": 0, "generator": GENERATOR}
    values |= other
    return Key(split=split, object_id=object_id, **values)


def keys(**other) -> list[Key]:
    splits = {"box-0": "train", "box-1": "train", "box-2": "test", LAST: "test"}
    return [key(name, split, **other) for name, split in splits.items()]


def make(folder: Path, k: Key, name: str) -> Outcome:
    """What a worker does."""
    if k.object_id == LAST:
        return Outcome(rejected=Rejection(key=k, reason="it has no lid"))
    rows = hinged_box(STATES, object_id=k.object_id, seed=k.seed)
    record = write_shard(folder / name, rows, attributes(k))
    return Outcome.of_shard(k, record, input_sha256="f" * 64, notes=("a note",), seconds=0.5)


def attributes(k: Key) -> dict[str, str | int]:
    """What a shard says of itself."""
    about = {"category": "box", "source": "tests", "licence": "MIT", "split": k.split}
    about |= {"recipe": ONE.text(), "recipe_sha256": ONE.sha256(), "articugen_version": "0"}
    return {**about, "generator": k.generator, "seed": k.seed}


def about(wanted: list[Key]) -> CommonPlan:
    return CommonPlan(
        source="tests", category="box", recipe=SMALL.text(), seed=wanted[0].seed, ids=(),
        exclude=(), joints=(), objects=len(wanted), listing="0" * 64, generator=GENERATOR,
        command="the command",
    )  # fmt: skip


def records_in(folder: Path, wanted: list[Key] | None = None) -> Records:
    records = Records(Folder(folder))
    records.expect(about(wanted or keys()), [], [], "MIT")
    return records


def run(folder: Path, wanted: list[Key], *, stop_after: int | None = None) -> list[str]:
    """What the pipeline does, in one process; returns the objects it made."""
    made = []
    with records_in(folder, wanted) as records:
        todo = [k for k in wanted if records.finished(k) is None]
        names = records.shard_names(wanted)
        if todo:
            records.begin(names[k] for k in todo)
        for k in todo:
            if stop_after == len(made):
                return made
            records.record(make(folder, k, names[k]))
            made.append(k.object_id)
        if not records.is_complete(wanted):
            outcomes = [done for k in wanted if (done := records.finished(k))]
            assert len(outcomes) == len(wanted)
            records.finish(manifest_of(outcomes))
    return made


def manifest_of(outcomes) -> Manifest:
    return Manifest.of(
        outcomes,
        category="box",
        source="tests",
        licence="MIT",
        recipe=SMALL.text(),
        seed=0,
        timings=TIMINGS,
    )


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


COMPLETE = ["manifest.json", "test-00000.h5", "train-00000.h5", "train-00001.h5"]


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "box"
    assert run(folder, keys()) == ["box-0", "box-1", "box-2", LAST]
    return folder


@pytest.fixture
def folder(complete, tmp_path):
    return Path(shutil.copytree(complete, tmp_path / "box"))


def test_manifest_tells_what_was_made(complete):
    manifest = Manifest.read(complete)
    assert names_in(complete) == COMPLETE
    assert [o.key.object_id for o in manifest.objects] == ["box-2", "box-0", "box-1"]
    assert [s.name for s in manifest.shards] == COMPLETE[1:]
    assert all(sha256_of(complete / s.name) == s.sha256 for s in manifest.shards)
    assert [(r.key.object_id, r.reason) for r in manifest.rejected] == [(LAST, "it has no lid")]
    assert manifest.content_sha256 == content_of(reversed(manifest.objects))
    assert manifest.versions == library_versions()
    assert manifest.machine == this_machine()
    assert manifest.objects[0].notes == ("a note",)


def test_manifest_comes_back_as_it_was(complete, tmp_path):
    manifest = Manifest.read(complete)
    manifest.write(tmp_path)
    assert Manifest.read(tmp_path) == manifest
    assert (tmp_path / MANIFEST_NAME).read_bytes() == (complete / MANIFEST_NAME).read_bytes()


def test_content_hash_depends_on_content_alone(complete, tmp_path):
    assert run(tmp_path, list(reversed(keys()))) == [LAST, "box-2", "box-1", "box-0"]
    assert Manifest.read(tmp_path).content_sha256 == Manifest.read(complete).content_sha256
    run(tmp_path, keys(seed=1))
    assert Manifest.read(tmp_path).content_sha256 != Manifest.read(complete).content_sha256


NONSENSE = (
    "[" * 100_000, '{"a":' * 10_000, '{"schema_version": ' + "9" * 5_000 + "}",
    '{"schema_version": NaN}', '{"category": "\\ud800"}', "\0", "null",
)  # fmt: skip


def _edited(change):
    def edit(text: str) -> str:
        data = json.loads(text)
        change(data)
        return json.dumps(data)

    return edit


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (lambda text: text[:-20], "JSON"),
        (lambda _: "", "JSON"),
        (lambda _: "[]", "should be an object"),
        (_edited(lambda m: m.update(colour="red")), "colour: Extra inputs"),
        (_edited(lambda m: m["objects"][0].update(colour="red")), "objects.0.colour: Extra inputs"),
        (_edited(lambda m: m.pop("seed")), "seed: Field required"),
        (_edited(lambda m: m.update(seed="0")), "seed: Input should be a valid integer"),
        (_edited(lambda m: m.update(schema_version=99)), "schema version 99, this articugen reads"),
        (_edited(lambda m: m["shards"][0].update(name="../x.h5")), r"shards\.0\.name"),
        (_edited(lambda m: m["objects"][0]["key"].update(split="../x")), r"objects\.0\.key\.split"),
        (_edited(lambda m: m["shards"][0].update(sha256="0")), r"shards\.0\.sha256"),
        (_edited(lambda m: m["shards"].pop()), "same instances"),
        (_edited(lambda m: m["objects"].pop()), "content_sha256"),
        (_edited(lambda m: m["rejected"].append(m["rejected"][0])), "box-3 is listed twice"),
        (_edited(lambda m: m["timings"].update(workers=2)), "manifest_sha256 is not the digest"),
        (_edited(lambda m: m.update(recipe="{}")), "recipe_sha256"),
        *((lambda _, text=text: text, r"manifest\.json: ") for text in NONSENSE),
    ],
)
def test_damaged_manifest(folder, edit, sentence):
    path = folder / MANIFEST_NAME
    path.write_text(edit(path.read_text()))
    with pytest.raises(CorruptShard, match=sentence) as caught:
        Manifest.read(folder)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_no_manifest(tmp_path):
    with pytest.raises(CorruptShard, match="cut short goes on when it is started again"):
        Manifest.read(tmp_path)


def test_commit_is_the_one_checked_out():
    root = Path(__file__).parents[1]
    done = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    commit = this_commit()
    if done.returncode:
        assert commit is None
    else:
        assert commit is not None
        assert commit.removesuffix("+changes") == done.stdout.strip()


@pytest.mark.parametrize("stop_after", [0, 1, 2, 3])
def test_stopped_run_goes_on(complete, tmp_path, stop_after):
    first = run(tmp_path, keys(), stop_after=stop_after)
    assert len(first) == stop_after
    assert MANIFEST_NAME not in names_in(tmp_path)
    assert first + run(tmp_path, keys()) == ["box-0", "box-1", "box-2", LAST]
    assert names_in(tmp_path) == COMPLETE
    assert Manifest.read(tmp_path).objects == Manifest.read(complete).objects
    assert Manifest.read(tmp_path).shards == Manifest.read(complete).shards


@pytest.mark.parametrize("moment", ["before its record", "a torn record", "in its shard"])
def test_killed_run_goes_on(complete, tmp_path, moment):
    run(tmp_path, keys(), stop_after=1)
    if moment == "in its shard":
        (tmp_path / partial_name("train-00001.h5")).write_bytes(b"half")
    else:
        make(tmp_path, keys()[1], "train-00001.h5")
    if moment == "a torn record":
        Ledger(Folder(tmp_path)).record("train/box-1", b"{}")
        (done,) = (tmp_path / LEDGER / "done").glob("*box-1*")
        done.write_bytes(done.read_bytes()[:-9])
        with records_in(tmp_path) as records:
            assert records.why(keys()[1]) == "its record is damaged"
    assert run(tmp_path, keys()) == ["box-1", "box-2", LAST]
    assert names_in(tmp_path) == COMPLETE
    assert Manifest.read(tmp_path).content_sha256 == Manifest.read(complete).content_sha256


def test_killed_between_manifest_and_ledger(folder):
    run(folder.parent / "other", keys(), stop_after=2)
    (folder.parent / "other" / LEDGER).rename(folder / LEDGER)
    make(folder, key("box-9"), "train-00003.h5")
    assert run(folder, keys()) == []
    assert names_in(folder) == COMPLETE


def test_killed_where_the_manifest_is_taken_away(complete, folder, monkeypatch):
    """What was finished before is known still, and goes once the next manifest is written."""
    fewer = keys(seed=7)[1:]
    delete = Folder.delete
    for steps in range(3):
        left = iter(range(steps))

        def die(place, names, left=left):
            if next(left, None) is None:
                raise KeyboardInterrupt
            delete(place, names)

        monkeypatch.setattr(Folder, "delete", die)
        with pytest.raises(KeyboardInterrupt):
            run(folder, fewer)
        with records_in(folder) as records:
            assert (records.finished(keys()[0]) is None) == (steps == 2)
    monkeypatch.undo()
    run(folder, fewer)
    assert names_in(folder) == ["manifest.json", "test-00000.h5", "train-00000.h5"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"recipe_sha256": "0" * 64}, "the recipe has changed"),
        ({"seed": 1}, "the seed was 0, is 1"),
        ({"generator": "2"}, f"the code makes other data: it was {GENERATOR}, is 2"),
        ({"ref": "other"}, "its source has changed"),
    ],
)
def test_stale_data_are_named_and_replaced(folder, change, why):
    (folder / "mine.h5").write_bytes(b"not of ours")
    with records_in(folder) as records:
        assert [records.why(k) for k in keys(**change)] == [why] * 4
        assert [records.finished(k) for k in keys(**change)] == [None] * 4
        told = records.conflict(keys(**change))
        assert told is not None
        assert f"3 shards of an earlier run will be replaced or removed (3 since {why})" in told
        assert records.conflict(keys()) is None
    assert len(run(folder, keys(**change))) == 4
    assert names_in(folder) == sorted([*COMPLETE, "mine.h5"])
    assert all(
        o.key == key(o.key.object_id, o.key.split, **change) for o in Manifest.read(folder).objects
    )


@pytest.mark.parametrize("harm", ["missing", "altered", "other size"])
def test_damaged_shard_is_made_again(complete, folder, harm):
    path = folder / "train-00001.h5"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.unlink()
    if harm != "missing":
        path.write_bytes(data if harm == "altered" else data + b"x")
    with records_in(folder) as records:
        assert records.why(key("box-1")) == "its shard train-00001.h5 is missing or altered"
    assert run(folder, keys()) == ["box-1"]
    assert sha256_of(path) == sha256_of(complete / path.name)


def test_fewer_and_more_objects(complete, folder):
    few = [k for k in keys() if k.object_id in ("box-1", "box-2")]
    with records_in(folder) as records:
        assert "1 since this run does not ask for it" in (records.conflict(few) or "")
    run(folder, [*few, key("box-9")])
    assert run(folder, few) == []
    assert names_in(folder) == ["manifest.json", "test-00000.h5", "train-00001.h5"]
    run(folder, [*few, key("box-9")])
    assert [(o.key.object_id, o.shard) for o in Manifest.read(folder).objects] == [
        ("box-2", "test-00000.h5"),
        ("box-1", "train-00001.h5"),  # finished, so it stays where it is
        ("box-9", "train-00000.h5"),
    ]
    assert run(folder, keys()) == ["box-0", LAST]
    assert Manifest.read(folder).content_sha256 == Manifest.read(complete).content_sha256


def test_dead_run_does_not_keep_the_folder(tmp_path):
    with held_by_another_run(tmp_path), pytest.raises(ArticugenError, match="another run"):
        records_in(tmp_path)
    records_in(tmp_path).close()


@pytest.mark.parametrize(
    "name",
    ["../x.txt", "{tmp}/x.txt", "sub/x.h5", "..", "", ".hidden.h5", "x.txt", "x.h5\n", "x.h5\0",
     "a" * 198 + ".h5", None, 7, ["x.h5"], {}],
)  # fmt: skip
def test_a_record_removes_nothing_outside_its_folder(tmp_path, name):
    """Names in our own files are as hostile as anyone's: these once deleted any file."""
    folder = tmp_path / "out" / "box"
    (folder / "sub").mkdir(parents=True)
    precious = [tmp_path / "x.txt", folder / "sub" / "x.h5", folder / "x.txt", tmp_path / "x.h5"]
    for path in precious:
        path.write_text("precious")
    name = name.format(tmp=tmp_path) if isinstance(name, str) else name
    outcome = make(tmp_path, key(), "train-00000.h5").model_dump(mode="json")
    outcome["made"]["shard"] = outcome["shard"]["name"] = name
    Ledger(Folder(folder)).record("train/box-0", json.dumps(outcome).encode())
    assert run(folder, keys()) == ["box-0", "box-1", "box-2", LAST]
    assert [path.read_text() for path in precious] == ["precious"] * 4


@pytest.mark.parametrize(
    "line",
    [
        b"null", b"5", b"[]", b"{}", b'"x"', b"\0", b"", b"\xff\xfe", b"[" * 100_000,
        b'{"made": null}', b"9" * 5_000, b"NaN", b'{"rejected": {"reason": "\\ud800"}}',
    ],
)  # fmt: skip
def test_a_record_and_a_plan_may_hold_anything(tmp_path, line, monkeypatch):
    monkeypatch.setattr("articugen.core.ledger._PAUSES", (0.0,))
    ledger = Ledger(Folder(tmp_path))
    ledger.record("train/box-0", line)
    with records_in(tmp_path) as records:
        assert records.finished(key()) is None
    ledger.agree(line)
    with pytest.raises(ArticugenError, match="its run is of another version") as caught:
        records_in(tmp_path)
    assert "\n" not in str(caught.value)
    (tmp_path / LEDGER / "plan.json").write_bytes(line)
    with pytest.raises(ArticugenError, match=r"plan\.json: damaged; delete it"):
        records_in(tmp_path)
    (tmp_path / LEDGER / "plan.json").unlink()
    assert run(tmp_path, keys()) == ["box-0", "box-1", "box-2", LAST]


@pytest.mark.parametrize("kind", ["FIFO", "folder", "device", "link", "round link", "too large"])
def test_kind_and_size_are_looked_at_before_reading(tmp_path, kind):
    path = tmp_path / "box" / MANIFEST_NAME
    path.parent.mkdir()
    if kind == "link":
        (tmp_path / "elsewhere").write_text('{"objects": []}\n')
        path.symlink_to(tmp_path / "elsewhere")
    else:
        unfit(path, kind, MOST_BYTES)
    with pytest.raises(CorruptShard, match=f"{MANIFEST_NAME}: ") as caught:
        records_in(path.parent)
    assert "\n" not in str(caught.value)
    with pytest.raises(CorruptShard):
        Manifest.read(path.parent)


def test_a_shard_s_name_may_be_a_link_or_a_folder(folder):
    """Links are replaced themselves, not what they lead to, and never removed; folders stay."""
    outside = folder.parent / "mine.h5"
    outside.write_text("precious")
    for name in ("train-00000.h5", "test-00000.h5"):
        (folder / name).unlink()
        (folder / name).symlink_to(outside)
    few = [k for k in keys() if k.split == "train"]
    assert run(folder, few) == ["box-0"]
    assert names_in(folder) == COMPLETE
    assert not (folder / "train-00000.h5").is_symlink()
    assert (folder / "test-00000.h5").is_symlink()
    assert outside.read_text() == "precious"
    (folder / "train-00001.h5").unlink()
    (folder / "train-00001.h5").mkdir()
    with pytest.raises(ArticugenError, match="was not made by an earlier run here; move it away"):
        run(folder, few)
    assert run(folder, few[:1]) == []
    assert (folder / "train-00001.h5").is_dir()


def test_a_smaller_run_removes_what_a_killed_larger_one_left(folder):
    left = [partial_name(n) for n in ("train-00001.h5", "test-00000.h5", MANIFEST_NAME)]
    left += [partial_name("train-00001.h5"), partial_name("croissant.json")]
    for name in left:
        (folder / name).write_bytes(b"half")
    others = [partial_name("thesis.tex"), ".train-00000.h5.partial"]
    for name in others:
        (folder / name).write_bytes(b"mine")
    run(folder, keys()[:1])
    assert names_in(folder) == sorted([*others, "manifest.json", "train-00000.h5"])


def test_a_record_needs_a_begin(tmp_path):
    with records_in(tmp_path) as records, pytest.raises(ValueError, match="begin"):
        records.record(Outcome(rejected=Rejection(key=key(), reason="x")))


def test_unwritable_folder(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(ArticugenError, match="file/box: not written: "),
        records_in(tmp_path / "file" / "box") as records,
    ):
        records.begin(["train-00000.h5"])


def test_shards_that_another_process_has_recorded_are_no_orphans(complete, tmp_path):
    """As with an array of SLURM, whose tasks record what the run that ends it has not made."""
    with Records(Folder(tmp_path), is_shared=True) as records:
        names = [(k.split, k.object_id) for k in keys()]
        records.expect(about(keys()), names, names, "MIT")
        shards = records.shard_names(keys())
        records.begin(shards.values())
        outcomes = [make(tmp_path, k, shards[k]) for k in keys()]
        records.finish(manifest_of(outcomes))
    assert names_in(tmp_path) == COMPLETE
    assert Manifest.read(tmp_path).content_sha256 == Manifest.read(complete).content_sha256
