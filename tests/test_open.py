"""Data sets as people read them: rows, slices, batches, loaders."""

import inspect
import os
import pickle
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import SMALL, hinged_box, without_knob
from ppd_data import shard, write_boxes

import articugen as ag
from articugen.core.errors import CorruptShard, InvalidArgument, MissingExtra
from articugen.core.geometry import apply, invert_rigid
from articugen.core.records import dequantize
from articugen.store import dataset as data_sets
from articugen.store import shelf
from articugen.store.rows import Row, in_units
from articugen.store.shards import open_shard

POINTS = ("surface_points", "surface_normals", "surface_part")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_boxes(tmp_path_factory.mktemp("data") / "box")


@pytest.fixture(scope="module")
def data(folder: Path) -> ag.DataSet:
    return ag.open(folder)


def all_instances(folder: Path):
    """Every instance as the checked reader gives it, in the order of a data set."""
    for path in sorted(folder.glob("*.h5"), key=lambda p: (p.name[:5] != "train", p.name)):
        with open_shard(path) as shard:
            yield from (shard.instance(row) for row in range(len(shard)))


def test_rows_are_what_is_stored(folder, data):
    instances = list(all_instances(folder))
    assert len(data) == len(instances) == 24
    for row, instance in zip(data[::5], instances[::5], strict=True):
        assert (row.object_id, row.state_index) == (instance.object_id, instance.state_index)
        for name, value in instance.arrays().items():
            np.testing.assert_array_equal(row.stored(name), value, err_msg=name)


def test_normals_of_nothing_stay_nothing():
    stored = np.array([[[0, 0, 0], [0, 0, -126]], [[89, 90, 1], [-128, 0, 5]]], np.int8)
    normal = in_units("image_normal", stored)
    assert normal.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), [[0, 1], [1, 1]], atol=1e-6)
    np.testing.assert_array_equal(normal[0], [[0, 0, 0], [0, 0, -1]])


def test_a_row_is_in_units(data):
    row = data[7]
    with open_shard(data.shards[1]) as shard:
        instance = shard.instance(3)
    clouds = {"surface": row.surface, "uniform": row.uniform, "near": row.near}
    for name, cloud in clouds.items():
        stored = getattr(instance, f"{name}_points")
        assert cloud.points.dtype == np.float32
        np.testing.assert_allclose(cloud.points, dequantize(stored), atol=6e-8)
        assert len(cloud) == len(stored)
    normals = row.surface.normals
    length = np.linalg.norm(instance.surface_normals, axis=1, keepdims=True)
    assert np.abs(length - 127.0).max() > 0.05  # what is stored is not of unit length
    np.testing.assert_allclose(normals, instance.surface_normals / length, atol=1e-6)
    np.testing.assert_array_equal(row.near.label, instance.near_label)
    np.testing.assert_array_equal(row.partial.part, instance.partial_part)
    assert row.partial.points.shape == instance.partial_points.shape
    assert row.partial.T_camera_world.shape == (2, 4, 4)
    assert row.partial.intrinsics.shape == (2, 4)
    assert list(row.grids) == [8, 16, 32]
    np.testing.assert_array_equal(row.grids[16], instance.occupancy[16])
    with pytest.raises(KeyError, match="there are: 8, 16, 32"):
        row.grids[64]
    assert not row.coverage
    assert (row.split, row.category, data[-1].split) == ("train", "box", "test")
    metres = row.to_metres(row.surface.points)
    assert np.ptp(metres, axis=0).max() < row.scale
    np.testing.assert_allclose((metres - row.center) / row.scale, row.surface.points, atol=1e-7)


def test_joints_and_parts(data):
    row = data[1]
    hinge, knob = row.joints
    assert (hinge.kind, knob.kind) == ("revolute", "prismatic")
    assert (hinge.parent, hinge.part, knob.parent, knob.part) == (0, 1, 1, 2)
    assert hinge.name == ""
    assert 0.0 < hinge.state < hinge.upper == pytest.approx(np.radians(100))
    assert "revolute" in repr(hinge)
    np.testing.assert_allclose(hinge.axis, (0, -1, 0))
    on_axis = hinge.pivot + 0.1 * hinge.axis
    np.testing.assert_allclose(apply(row.parts[1].motion, on_axis), on_axis, atol=1e-12)
    assert [part.name for part in row.parts] == ["", "", ""]


def test_a_row_reads_a_field_when_it_is_asked_for_and_once(data, monkeypatch):
    asked: list[str] = []
    read = shelf.Shelf.read

    def noted(shelf, shard, row, names):
        asked.extend(names)
        return read(shelf, shard, row, names)

    monkeypatch.setattr(shelf.Shelf, "read", noted)
    row = data[3]
    assert asked == []
    for _ in range(2):
        assert row.surface.points.shape == (2048, 3)
    assert asked == ["surface_points"]
    assert len(row.joints) == 2
    names = ("kind", "state", "lower", "upper", "axis", "pivot", "parent")
    assert set(asked[1:]) == {"scale", *(f"joint_{name}" for name in names)}


def test_what_is_not_stored_is_said_with_the_recipes_key(data):
    row = data[0]
    for read, sentence in (
        (
            lambda: row.images.depth,
            "box-0: image_depth is not stored; ask for it with images.views",
        ),
        (lambda: row.sharp.points, "sharp_points is not stored; ask for it with sampling.sharp_p"),
        (lambda: row.near.distance, "near_distance is not .* with sampling.signed_distance in the"),
        (lambda: row.collision_depth, "with articulation.collision in the recipe, and make the"),
        (lambda: row.stored("occupancy_64"), "occupancy_64 .* ask for it with sampling.grids"),
        (lambda: row.stored("normals"), "no field 'normals' is stored; there are: center, "),
    ):
        with pytest.raises(InvalidArgument, match=sentence):
            read()
    some = Row(lambda names: [["box"] for _ in names], ["object_id", "image_intrinsics"])
    with pytest.raises(InvalidArgument, match=r"image_depth is not .* with images.fields in the"):
        _ = some.images.depth


def test_hover_texts_give_shapes_units_and_frames():
    for text, words in (
        (Row.surface.__doc__, ("(S, 3)", "unit frame", "unit length")),
        (Row.uniform.__doc__, ("(U, 3)", "unit frame", "255 enclosed")),
        (Row.partial.__doc__, ("(C, M, 3)", "unit frame", "pixels")),
        (Row.center.__doc__, ("(3,)", "metres")),
        (ag.DataSet.category.__doc__, ("laptop",)),
        (ag.export.__doc__, ("resolution", "from_grids", "on_item")),
        (ag.verify.__doc__, ("replay", "drop_user", "findings")),
    ):
        for word in words:
            assert word in (text or ""), (word, text)
    for function, words in (
        (ag.generate, "category source out recipe seed jobs"),
        (ag.open, "path"),
        (ag.load, "source object_id category"),
        (ag.Maker, "obj recipe seed"),
        (ag.export, "split occupancy"),
        (ag.verify, "repair"),
    ):
        assert set(words.split()) <= set(inspect.signature(function).parameters)
        assert inspect.getdoc(function)


def test_flow_is_what_the_parts_motions_say(data):
    one, other = data[1], data[3]
    flow = one.flow_to(other)
    for i in range(0, 2048, 97):  # the naive oracle
        part = one.surface.part[i]
        canonical = apply(invert_rigid(one.parts[part].motion), one.surface.points[i])
        there = apply(other.parts[part].motion, canonical)
        np.testing.assert_allclose(one.surface.points[i] + flow[i], there, atol=1e-6)
    assert not flow[one.surface.part == 0].any()
    assert np.abs(flow[one.surface.part == 1]).max() > 0.01
    assert np.abs(one.flow_to(one)).max() < 1e-7
    with pytest.raises(InvalidArgument, match="box-0 does not flow to box-1"):
        one.flow_to(data[5])


def test_slices_splits_and_objects(data):
    assert list(data.splits.items()) == [("train", 16), ("test", 8)]
    assert data.objects == ("box-0", "box-1", "box-2", "box-3", "box-4", "box-5")
    train = data.split("train")
    assert (len(train), train.objects) == (16, data.objects[:4])
    assert [row.object_id for row in train[::5]] == ["box-0", "box-1", "box-2", "box-3"]
    assert train[-1].state_index == 3
    assert [r.state_index for r in data[[5, 0, 5]]] == [1, 0, 1]
    assert len(data[np.arange(24) % 2 == 0]) == 12
    assert len(data[[]]) == 0
    assert len(data.of("box-1", "box-4")) == 8
    assert data.fields["surface_points"] == (2048, 3)
    assert data.recipe == SMALL
    assert data.category == train.category == "box"
    for wrong, sentence in (
        (lambda: data.split("trian"), "did you mean 'train'"),
        (lambda: data.of("bos-1"), "did you mean 'box-1'"),
        (lambda: data.batch(25), "25 different instances out of 24"),
        (lambda: data.batch([]), "a batch of no instances"),
        (lambda: data.batch(1, ["surface_point"]), "did you mean 'surface_points'"),
        (lambda: data.batch(1, POINTS, points=2049), "2049 points of surface_points, which has 20"),
        (lambda: data[0].stored("normals"), "box-0: no field 'normals'"),
        (lambda: os.fspath(train), "these are 16 of 24 instances; give the whole data set"),
        (lambda: data[[]].category, "these are no instances"),
    ):
        with pytest.raises(InvalidArgument, match=sentence):
            wrong()
    for index in (24, -25, [24]):
        with pytest.raises(IndexError):
            data[index]
    with pytest.raises(TypeError, match="whole numbers"):
        data["box-1"]  # type: ignore[call-overload]
    assert os.fspath(data) == str(data.path)


def test_a_shard_alone_and_a_folder_without_a_manifest(folder, tmp_path):
    shard = ag.open(folder / "train-00002.h5")
    assert (len(shard), shard.objects, shard.splits) == (4, ("box-2",), {"train": 4})
    assert shard.manifest is None
    assert shard.recipe == SMALL
    for path in folder.glob("t*-0000[04].h5"):
        shutil.copy(path, tmp_path)
    assert ag.open(tmp_path).objects == ("box-0", "box-4")
    for path, sentence in (
        (tmp_path / "none", "there is no such shard or folder; correct its path"),
        (folder.parent, "holds no shard; open one of: box"),
    ):
        with pytest.raises(InvalidArgument, match=sentence):
            ag.open(path)


def test_batches_hold_the_same_as_rows(data):
    numbers = [5, 17, 5, 0]
    batch = data.batch(numbers, [*POINTS, "occupancy_8", "joint_state", "object_id", "scale"])
    for i, number in enumerate(numbers):
        row = data[number]
        np.testing.assert_array_equal(batch["surface_points"][i], row.surface.points)
        np.testing.assert_array_equal(batch["surface_normals"][i], row.surface.normals)
        np.testing.assert_array_equal(batch["surface_part"][i], row.surface.part)
        np.testing.assert_array_equal(batch["occupancy_8"][i], row.grids[8])
        assert batch["joint_state"][i].tolist() == [joint.state_unit for joint in row.joints]
        assert (batch["object_id"][i], batch["scale"][i]) == (row.object_id, row.scale)
    raw = data.batch(numbers, POINTS, raw=True)
    assert [raw[name].dtype for name in POINTS] == [np.uint16, np.int8, np.uint8]
    for name in POINTS[:2]:
        np.testing.assert_array_equal(in_units(name, raw[name]), batch[name])


def test_a_seed_draws_the_same_batch_and_no_instance_twice(data):
    batches = [data.batch(16, ["object_id", "state_index"], rng=rng) for rng in (0, 0, 1)]
    names = [list(zip(*(b[k] for k in b), strict=True)) for b in batches]
    assert names[0] == names[1] != names[2]
    assert len(set(names[0])) == 16
    generator = np.random.default_rng(0)
    same = data.batch(16, ["object_id", "state_index"], rng=generator)
    assert list(zip(*(same[k] for k in same), strict=True)) == names[0]
    files = list(range(16, 24)) + list(range(16))  # a seed counts them as the files are sorted
    by_hand = [files[n] for n in np.random.default_rng(0).choice(24, 16, replace=False)]
    same = data.batch(by_hand, ["object_id", "state_index"])
    assert list(zip(*(same[k] for k in same), strict=True)) == names[0]


@given(points=st.integers(0, 2048), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_drawn_points_keep_what_belongs_to_them(data, points, seed):
    fields = [*POINTS, "near_points", "near_label", "partial_points", "joint_state"]
    if points > 256:
        fields.remove("partial_points")
    batch = data.batch([3, 9], fields, points=points, rng=seed, raw=True)
    assert batch["joint_state"].shape == (2, 2)
    for i, row in enumerate((data[3], data[9])):
        for names in (POINTS, ("near_points", "near_label")):
            stored = np.column_stack(
                [row.stored(name).reshape(2048, _width(name)) for name in names]
            )
            drawn = np.column_stack(
                [batch[name][i].reshape(points, _width(name)) for name in names]
            )
            left = {tuple(line) for line in stored.tolist()}
            assert {tuple(line) for line in drawn.tolist()} <= left
            if len(left) == 2048:  # no two points are the same, nor are any of those drawn
                assert len({tuple(line) for line in drawn.tolist()}) == points


def _width(name: str) -> int:
    return 1 if name.endswith(("_part", "_label")) else 3


@pytest.mark.parametrize("points", [512, 700, 8, 2])
def test_each_point_is_as_likely_as_any_other(points):
    counts = np.zeros(2048)
    rng = np.random.default_rng(0)
    for _ in range(400):
        counts[data_sets._some(2048, points, rng)] += 1
    share = points / 2048
    sigma = np.sqrt(400 * share * (1 - share))
    assert counts.sum() == 400 * points
    assert np.abs(counts - 400 * share).max() < max(5 * sigma, 9)


def test_unlike_numbers_of_joints_do_not_stack(tmp_path):
    rows = hinged_box([(0.0, 0.0), (0.5, 0.1)])
    shard(tmp_path / "train-00000.h5", rows)
    fewer = [without_knob(row, object_id="lid-only") for row in rows]
    shard(tmp_path / "train-00001.h5", fewer)
    data = ag.open(tmp_path)
    assert data.batch(4, POINTS, rng=0)["surface_part"].shape == (4, 2048)
    with pytest.raises(
        InvalidArgument, match=r"joint_axis is \(2, 3\) in box-0 and \(1, 3\) in lid-only, which"
    ):
        data.batch([0, 2], ["joint_axis"])
    assert data.of("lid-only").batch(2, ["joint_axis"])["joint_axis"].shape == (2, 1, 3)


def test_damage_and_other_files_are_noticed(folder, tmp_path):
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    data = ag.open(copy)
    path = data.shards[0]
    with open_shard(path) as shard:
        place = int(shard.columns["surface_points"].offset[2])
    content = bytearray(path.read_bytes())
    content[place + 100] ^= 1
    path.write_bytes(content)
    assert data[1].surface.points.shape == (2048, 3)
    with pytest.raises(CorruptShard, match=r"train-00000.h5: damaged \(its checksum is wrong\)"):
        _ = data[2].surface.points
    path.unlink()
    assert data[1].surface.points.shape == (2048, 3)  # the file that is open stays
    data = pickle.loads(pickle.dumps(data))
    with pytest.raises(CorruptShard, match="cannot be opened"):
        _ = data[1].surface.points
    shard = data.shards[1]
    assert len(data[4].surface) == 2048
    data._shelf._handles.clear()  # as others do that were read since
    content = shard.read_bytes()
    shard.unlink()
    shard.write_bytes(content)
    with pytest.raises(CorruptShard, match="was made again since; open the data set again"):
        _ = data[4].near.points


def test_few_files_are_open_and_threads_share_them(folder, monkeypatch):
    monkeypatch.setattr(shelf, "_OPEN_FILES", 2)
    data = ag.open(folder)
    data.batch(24, rng=0)  # where rows lie is known from here on
    before = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
    expected = [row.stored("surface_points") for row in data]
    wrong: list[int] = []

    def read(seed: int) -> None:
        for i in np.random.default_rng(seed).permutation(24):
            if not np.array_equal(data[int(i)].stored("surface_points"), expected[i]):
                wrong.append(int(i))

    threads = [threading.Thread(target=read, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert len(data._shelf._handles) <= 2 + len(threads)
    if before:
        assert len(os.listdir("/proc/self/fd")) <= before + len(threads)


def test_short_reprs_and_pictures(data, monkeypatch):
    monkeypatch.setattr("articugen.inspection.notebook.OBJECTS", 1)
    monkeypatch.setattr("articugen.inspection.notebook.STATES", 1)
    assert repr(data) == (
        f"DataSet({data.path}: box, 24 instances (16 train, 8 test) of 6 objects\n"
        "  points: surface 2048, uniform 1024, near 2048, partial 2 x 256, grids 8, 16, 32)"
    )
    lines = repr(data[1]).splitlines()
    assert lines[0] == "Row(box-0 [1], train)"
    assert "prismatic, " in repr(data[1].joints[1])
    manifest = data.manifest
    assert (
        repr(manifest)
        == str(manifest)
        == (
            "Manifest(box from tests: 6 objects, 24 instances; content "
            f"{manifest.content_sha256[:16]})"
        )
    )
    assert "(2048, 3) in [-0.4" in lines[3]
    for shown, words in ((data, "24 instances"), (data[1], "box-0 [1]")):
        page = shown._repr_html_()
        assert '<img src="data:image/png;base64,' in page
        assert words in page
    assert data[[]]._repr_html_() is None
    assert "no instances" in repr(data[[]])


class TestTorch:
    @pytest.fixture
    def loader(self, data):
        pytest.importorskip("torch", reason="torch is not installed")
        return data.split("train").torch(points=512, fields=[*POINTS, "object_id", "state_index"])

    def test_items_are_tensors_of_some_points(self, loader, data):
        torch = pytest.importorskip("torch")
        torch.manual_seed(0)
        item, again = loader[3], loader[3]
        assert (len(loader), item["object_id"], int(item["state_index"])) == (16, "box-0", 3)
        assert item["surface_points"].dtype == torch.float32
        assert item["surface_points"].shape == (512, 3)
        assert not torch.equal(item["surface_points"], again["surface_points"])
        torch.manual_seed(0)
        assert torch.equal(loader[3]["surface_points"], item["surface_points"])
        stored = {tuple(p) for p in data.split("train")[3].surface.points.tolist()}
        assert {tuple(p) for p in item["surface_points"].tolist()} <= stored
        with pytest.raises(IndexError):
            loader[16]
        assert "16 instances" in repr(loader)

    def test_workers_load_it(self, loader, data):
        from torch.utils.data import DataLoader  # noqa: PLC0415

        _ = data[0].surface.points  # a file is open
        batches = list(DataLoader(loader, batch_size=8, num_workers=1))
        assert [b["surface_points"].shape for b in batches] == [(8, 512, 3)] * 2
        names = [name for b in batches for name in b["object_id"]]
        assert names == [row.object_id for row in data.split("train")]

    def test_it_can_be_sent_to_workers_that_are_spawned(self, loader):
        torch = pytest.importorskip("torch")
        _ = loader[0]  # a file is open
        sent = pickle.loads(pickle.dumps(loader))
        assert not sent.data._shelf._handles
        torch.manual_seed(0)
        points = loader[3]["surface_points"]
        torch.manual_seed(0)
        assert torch.equal(sent[3]["surface_points"], points)

    def test_without_torch_it_says_how_to_get_it(self, data, monkeypatch):
        import sys  # noqa: PLC0415

        monkeypatch.delitem(sys.modules, "articugen.store.torch_dataset", raising=False)
        monkeypatch.setitem(sys.modules, "torch", None)
        with pytest.raises(MissingExtra, match=r"pip install 'articugen\[ppd\]'"):
            data.torch()
