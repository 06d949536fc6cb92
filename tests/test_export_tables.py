"""Exports that carry every field, and the metadata beside all, read back by their own readers."""

import json

import exports
import numpy as np
import pytest
from exports import name_of

import articugen as ag

boxes, rows, exported, laptops = exports.boxes, exports.rows, exports.exported, exports.laptops


def test_parquet_in_datasets(exported, rows, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    datasets = pytest.importorskip("datasets", reason="make exporters installs it")
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
    assert dataset.metadata.name == f"box-{to}"
    assert dataset.metadata.license == ["MIT"]
    if to == "parquet":
        ids = [record["instances/object_id"] for record in dataset.records("instances")]
        assert sorted(map(bytes.decode, ids)) == sorted(row.object_id for row in rows)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_data_set_has_its_own_croissant(laptops):
    mlc = pytest.importorskip("mlcroissant", reason="make exporters installs it")
    dataset = mlc.Dataset(jsonld=laptops / "croissant.json")
    assert not dataset.metadata.issues.errors
    assert dataset.metadata.license == ["MIT"]
    shards = {shard.name: shard.sha256 for shard in ag.open(laptops).manifest.shards}
    assert {file.name: file.sha256 for file in dataset.metadata.distribution} == shards
    assert ag.open(laptops).manifest.content_sha256 in dataset.metadata.description
    assert ag.verify(laptops).ok
