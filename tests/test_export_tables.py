"""Exports that carry every field, and the metadata beside all, read back by their own readers."""

import json
from dataclasses import replace

import exports
import numpy as np
import pytest
import yaml
from exports import name_of
from instances import hinged_box, without_knob
from ppd_data import shard
from python_process import printed
from test_html_report import named
from trouble import small_disk

import articugen as ag
from articugen.core.errors import MachineFault

BOXES, rows, exported = exports.BOXES, exports.rows, exports.exported


@pytest.fixture
def datasets(monkeypatch):
    """Without a network; not by the environment, which would be read once for all other tests."""
    library = pytest.importorskip("datasets", reason="make exporters installs it")
    for module in ("datasets.config", "huggingface_hub.constants"):
        monkeypatch.setattr(f"{module}.HF_HUB_OFFLINE", True)
    return library


def test_parquet_in_datasets(exported, rows, tmp_path, datasets):
    folder = str(exported("parquet"))
    for split in ("train", "test"):
        loaded = datasets.load_dataset(folder, split=split, cache_dir=str(tmp_path / "cache"))
        mine = rows.split(split)
        assert len(loaded) == len(mine)
        for sample, row in zip(loaded, mine, strict=True):
            assert (sample["split"], sample["category"]) == (split, "box")
            for name in row.fields:
                stored = np.asarray(row.stored(name))
                value = np.array(sample[name], dtype=stored.dtype)
                np.testing.assert_array_equal(value, stored, err_msg=name)


def test_the_hub_s_folder_streams_and_shows_pictures(exported, rows, datasets):
    """As `hf upload` takes it: a picture first, a card that names splits and counts."""
    folder = exported("parquet")
    stream = datasets.load_dataset(str(folder), split="train", streaming=True)
    assert next(iter(stream.features)) == "image"
    assert stream.features["image"] == datasets.Image()
    train = rows.split("train")
    for sample, row in zip(stream, train, strict=True):
        assert sample["image"].size == (96, 96)
        drawn = np.asarray(sample["image"])
        shown = {int(part) for part in np.unique(row.surface.part)}
        assert len(np.unique((drawn < 250).any(axis=2))) == 2  # an object on white
        assert shown == {0, 1, 2}
        np.testing.assert_array_equal(sample["near_label"], row.near.label)
    card = (folder / "README.md").read_text()
    about = yaml.safe_load(card.split("---\n")[1])
    assert (about["license"], about["size_categories"]) == ("mit", ["n<1K"])
    (config,) = about["configs"]
    assert [files["split"] for files in config["data_files"]] == ["train", "test"]
    assert f"| train | {len(train.objects)} | {len(train)} |" in card


def test_parquet_without_a_surface_has_no_picture(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="make exporters installs it")
    folder = tmp_path / "bare"
    folder.mkdir()
    none = {f"surface_{name}": slice(0) for name in ("points", "normals", "part")}
    bare = [
        replace(one, **{name: getattr(one, name)[cut] for name, cut in none.items()})
        for one in hinged_box()
    ]
    shard(folder / "train-00000.h5", bare)
    ag.export(folder, "parquet", tmp_path / "out")
    (file,) = (tmp_path / "out").glob("data/*.parquet")
    assert parquet.read_table(file)["image"].null_count == len(bare)


def test_parquet_of_objects_with_unlike_numbers_of_joints_in_datasets(tmp_path, datasets):
    """As real categories are: one file's columns are those of all."""
    folder = tmp_path / "boxes"
    folder.mkdir()
    shard(folder / "train-00000.h5", [named(i) for i in hinged_box(object_id="two")])
    shard(folder / "train-00001.h5", [without_knob(i) for i in hinged_box(object_id="one")])
    ag.export(folder, "parquet", tmp_path / "out")
    loaded = datasets.load_dataset(
        str(tmp_path / "out"), split="train", cache_dir=str(tmp_path / "cache")
    )
    arrays = loaded.with_format("numpy")
    assert sorted({len(sample["joint_state"]) for sample in arrays}) == [1, 2]
    for sample, row in zip(arrays, ag.open(folder), strict=True):
        assert sample["object_id"] == row.object_id
        assert (sample["joint_name"] is None) == (row.object_id == "one")
        for name in row.fields:
            stored = np.asarray(row.stored(name))
            if stored.dtype.kind not in "OU":
                value = sample[name]  # an array at once, no array of arrays
                assert np.shape(value) == stored.shape, name
                np.testing.assert_array_equal(value, stored.astype(value.dtype), err_msg=name)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # files left open
def test_webdataset_in_webdataset(exported, rows):
    wds = pytest.importorskip("webdataset", reason="make exporters installs it")
    for split in ("train", "test"):
        tars = sorted(map(str, exported("webdataset").glob(f"{split}-*.tar")))
        samples = wds.WebDataset(tars, shardshuffle=False).decode()
        for sample, row in zip(samples, rows.split(split), strict=True):
            assert sample["__key__"] == name_of(row)
            assert sample["json"]["state_index"] == row.state_index
            assert sample["json"]["joint_kind"] == [joint.kind for joint in row.joints]
            np.testing.assert_array_equal(sample["npz"]["near_points"], row.near.points)
            np.testing.assert_array_equal(sample["npz"]["near_label"], row.near.label)
            np.testing.assert_array_equal(sample["npz"]["joint_state"], row.stored("joint_state"))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of rdflib, in mlcroissant
@pytest.mark.parametrize("to", ["ply", "parquet", "onet", "webdataset"])
def test_croissant_in_mlcroissant(exported, rows, to):
    mlc = pytest.importorskip("mlcroissant", reason="make exporters installs it")
    folder = exported(to)
    told = json.loads((folder / "croissant.json").read_text())
    assert told["conformsTo"].endswith("/1.1")
    dataset = mlc.Dataset(jsonld=folder / "croissant.json")
    assert not dataset.metadata.issues.errors
    (warning,) = dataset.metadata.issues.warnings
    assert "datePublished" in warning  # which no two runs would have alike
    assert dataset.metadata.cite_as.startswith("@misc{articugen,")
    assert f"title = {{box-{to}}}" in dataset.metadata.cite_as
    assert dataset.metadata.name == f"box-{to}"
    assert dataset.metadata.license == ["MIT"]


READ = """
import mlcroissant
records = mlcroissant.Dataset(jsonld="croissant.json").records("instances")
print(*sorted(record["instances/object_id"].decode() for record in records))
"""


@pytest.mark.parametrize("to", ["imnet", "onet", "parquet"])  # HDF5, numpy's and pyarrow's files
def test_a_full_disk_ends_an_export_with_a_sentence_and_leaves_nothing_half_done(
    boxes, tmp_path, to
):
    if to == "parquet":
        pytest.importorskip("pyarrow", reason="make exporters installs it")
    with small_disk(tmp_path / "disk", "300k") as disk:
        with pytest.raises(MachineFault, match="the disk is full"):
            ag.export(boxes, to, disk / "out")
        assert list(disk.rglob("*.partial")) == []


def test_records_of_parquet_in_mlcroissant(exported, rows):
    """In a process of its own: pandas cannot hash arrays of `datasets` where that is imported."""
    pytest.importorskip("mlcroissant", reason="make exporters installs it")
    assert printed("-c", READ, folder=exported("parquet")).split() == sorted(
        row.object_id for row in rows
    )


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_data_set_has_its_own_croissant(laptops):
    mlc = pytest.importorskip("mlcroissant", reason="make exporters installs it")
    dataset = mlc.Dataset(jsonld=laptops / "croissant.json")
    assert not dataset.metadata.issues.errors
    assert dataset.metadata.license == ["MIT"]
    shards = {shard.name: shard.sha256 for shard in ag.open(laptops).manifest.shards}
    assert {file.name: file.sha256 for file in dataset.metadata.distribution} == shards
    assert ag.open(laptops).manifest.content_sha256 in dataset.metadata.description
    assert ag.verify(laptops, jobs=1).ok
