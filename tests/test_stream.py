"""Data without a disk: equal to what `generate` stores, split among workers, resumed."""

import pickle
import warnings
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import articugen as ag
from articugen.core.errors import ArticugenError, InvalidArgument
from articugen.pipeline import stream as module
from articugen.pipeline.stream import Stream
from articugen.procedural import write_object

TINY = {
    "extends": "light",
    "articulation": {"states": 2},
    "views": {"count": 12, "resolution": 32},
    "sampling": {"surface_points": 64, "uniform_points": 32, "near_points": 32, "grids": [8]},
}
EACH = 3
SOURCE = "procedural_varied"


def tiny(**how: object) -> Stream:
    return ag.stream("laptop", TINY, **how)  # type: ignore[arg-type]


def names(rows: Iterable[ag.Row]) -> list[tuple[str, int]]:
    return [(row.object_id, row.state_index) for row in rows]


def assert_same(row: ag.Row, stored: ag.Row) -> None:
    assert row.fields == stored.fields
    assert (row.split, row.category) == (stored.split, stored.category)
    for name in row.fields:
        ours, theirs = row.stored(name), stored.stored(name)
        if not isinstance(theirs, str | tuple):
            assert np.asarray(ours).dtype == np.asarray(theirs).dtype, name
        np.testing.assert_array_equal(ours, theirs, err_msg=name, strict=True)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> ag.DataSet:
    out = tmp_path_factory.mktemp("data")
    return ag.generate("laptop", SOURCE, out, TINY, objects=4, seed=5, jobs=0)


def test_a_stream_is_what_generate_stores(stored: ag.DataSet) -> None:
    there = {(row.object_id, row.state_index): row for row in stored}
    streams = [tiny(seed=5, split=split) for split in ("train", "test")]
    met = {(r.object_id, r.state_index): r for s in streams for r in islice(s, 5 * EACH)}
    assert len(there) == 4 * EACH
    assert there.keys() <= met.keys()
    for key, row in there.items():
        assert_same(met[key], row)
    assert streams[0]._object(3)[0].split == "train"
    assert_same(next(tiny(seed=np.int64(5), split=None, start=6.0)), next(tiny(seed=5, start=6)))


def test_the_recipe_light_has_points_and_labels_alone() -> None:
    row = next(ag.stream("drawer"))
    assert (
        row.surface.points.shape == row.uniform.points.shape == row.near.points.shape == (2048, 3)
    )
    assert set(np.unique(row.near.label)) <= {0, 1, 2, 3, 4, 5}  # no space is enclosed
    assert not len(row.grids)
    assert row.stored("partial_points").size == 0


@pytest.mark.parametrize("category", ["drawer", "oven", "eyeglasses"])
def test_finer_views_than_those_of_light_label_varied_objects_alike(category: str) -> None:
    model = ag.load(SOURCE, f"{category}_0001", category=category)
    finer = {"extends": "light", "views": {"resolution": 256}}
    one, other = (ag.Maker(model, recipe)[2] for recipe in ("light", finer))
    points = np.concatenate([one.near.points, one.uniform.points])
    np.testing.assert_array_equal(one.labels(points), other.labels(points))


def test_objects_are_new_for_ever_each_in_its_split() -> None:
    source = tiny().source
    number = len(tiny().refs)
    assert repr(tiny()).startswith("every laptop of procedural_varied, recipe ")
    ahead = tiny(start=EACH * number)
    assert next(ahead).object_id == f"laptop_{number:04d}"
    assert ahead.position == EACH * number + 1
    far = tiny(split="test")
    assert {far._object(n)[0].split for n in range(50)} == {"test"}
    assert len({far._object(n)[0].object_id for n in range(50)}) == 50
    assert source.made("laptop", 7).split == source.objects("laptop")[7].split


def test_a_stopped_stream_goes_on_with_the_same_rows() -> None:
    one = tiny()
    list(islice(one, 4))
    state = one.state_dict()
    rest = list(islice(one, 4))
    again = pickle.loads(pickle.dumps(tiny()))
    again.load_state_dict(state)
    for row, other in zip(islice(again, 4), rest, strict=True):
        assert_same(row, other)
    assert names(islice(tiny(start=4), 4)) == names(rest)
    for other in (tiny(seed=1), tiny(split="train"), tiny(share="0/2"), tiny(states=1)):
        with pytest.raises(InvalidArgument, match="the state is of every laptop of proc"):
            other.load_state_dict(state)


def test_shares_are_disjoint_and_together_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = names(islice(tiny(), 4 * EACH))
    parts = [
        names(islice(tiny(share=f"{rank}/2").part(worker, 2), EACH))
        for rank in range(2)
        for worker in range(2)
    ]
    assert sorted(name for part in parts for name in part) == sorted(whole)
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "3")
    assert str(tiny().job.share) == "1/3"


def test_objects_of_a_folder_come_again_in_other_states(tmp_path: Path) -> None:
    for name in ("box_0000", "box_0001"):
        write_object("box", name, tmp_path / "boxes" / name)
    (tmp_path / "boxes" / "broken").mkdir()
    (tmp_path / "boxes" / "broken" / "model.urdf").write_text("<robot")
    opened = ag.stream("box", TINY, tmp_path / "boxes", seed=3)
    state = opened.state_dict()
    with pytest.warns(UserWarning, match="broken.*; the stream goes on without it"):
        rows = list(islice(opened, 4 * EACH))
    assert names(rows[: 2 * EACH]) == names(rows[2 * EACH :])
    data = ag.generate("box", tmp_path / "boxes", tmp_path / "later", TINY, seed=4, jobs=0,
                       max_rejected=1.0)  # fmt: skip
    there = {(row.object_id, row.state_index): row for row in data}
    for row in rows[2 * EACH :]:
        assert_same(row, there[row.object_id, row.state_index])
    assert (rows[1].stored("joint_state") != rows[1 + 2 * EACH].stored("joint_state")).any()
    write_object("box", "box_0002", tmp_path / "boxes" / "box_0002")
    with pytest.raises(InvalidArgument, match="the state is of every box"):
        ag.stream("box", TINY, tmp_path / "boxes", seed=3).load_state_dict(state)


def test_a_folder_of_which_nothing_can_be_made_ends_in_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST_REJECTED", 3)
    (tmp_path / "broken.urdf").write_text("<robot")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(ArticugenError, match="3 objects were rejected in a row; the last, bro"):
            next(ag.stream("box", TINY, tmp_path))
    assert len(warned) == 2


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ({"split": "tset"}, r"no split 'tset'; did you mean 'test'\?; there are: test, train"),
        ({"share": "2/2"}, "no share '2/2'; give i/n"),
        ({"start": -1}, "start is -1; give 0 or more"),
        ({"start": 1.5}, "start is 1.5; give a whole number"),
        ({"seed": "3"}, "seed is '3'; give a whole number"),
        ({"seed": 0.5}, "seed is 0.5; give a whole number"),
    ],
)
def test_what_makes_no_sense_is_refused(how: dict[str, object], sentence: str) -> None:
    with pytest.raises(InvalidArgument, match=sentence):
        tiny(**how)


def samples(loader: Iterable[dict[str, object]], count: int) -> list[tuple[str, int]]:
    batches = list(islice(loader, count))
    return [
        (name, int(state))
        for batch in batches
        for name, state in zip(batch["object_id"], batch["state_index"], strict=True)  # type: ignore[arg-type, call-overload]
    ]


def test_a_loader_s_workers_share_out_the_objects() -> None:
    torch = pytest.importorskip("torch", reason="streams of tensors need torch")
    fields = ("object_id", "state_index", "surface_points", "surface_part", "part_name")
    opened = tiny().torch(fields=fields)
    whole = names(islice(tiny(), 4 * EACH))
    alone = torch.utils.data.DataLoader(opened, batch_size=EACH)
    assert samples(alone, 4) == whole
    assert samples(alone, 2) == whole[: 2 * EACH]  # each iteration begins as it was opened
    loader = torch.utils.data.DataLoader(opened, batch_size=EACH, num_workers=2)
    assert sorted(samples(loader, 4)) == sorted(whole)
    ahead = tiny(start=EACH).torch(fields=fields)  # two batches of EACH, one a worker
    later = torch.utils.data.DataLoader(ahead, batch_size=EACH, num_workers=2)
    assert samples(loader, 4)[2 * EACH :] == samples(later, 2)
    sample = next(iter(opened))
    row = next(tiny())
    np.testing.assert_array_equal(sample["surface_points"], row.surface.points)
    assert (sample["surface_part"].dtype, sample["surface_points"].dtype) == (
        torch.uint8, torch.float32,
    )  # fmt: skip
    assert sample["part_name"] == row.stored("part_name")
    with pytest.raises(InvalidArgument, match="no field 'surface_point'; did you mean"):
        tiny().torch(fields=["surface_point"])


@pytest.mark.filterwarnings("ignore:'set_vital'")  # which torchdata calls
def test_a_stateful_loader_goes_on_with_the_same_batches() -> None:
    pytest.importorskip("torch", reason="streams of tensors need torch")
    stateful = pytest.importorskip("torchdata.stateful_dataloader", reason="needs torchdata")

    def loader(workers: int) -> Iterable[dict[str, object]]:
        opened = tiny().torch(fields=("object_id", "state_index"))
        return stateful.StatefulDataLoader(opened, batch_size=2, num_workers=workers)

    for workers in (0, 2):
        whole = samples(loader(workers), 8)
        first = loader(workers)
        running = iter(first)
        begun = samples(running, 3)
        state = first.state_dict()  # type: ignore[attr-defined]
        second = loader(workers)
        second.load_state_dict(state)  # type: ignore[attr-defined]
        assert begun + samples(second, 5) == whole
