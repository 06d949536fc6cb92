"""Damaged shards, and files that were made to do harm: none is taken for a shard."""

import json
import os

import h5py
import numpy as np
import pytest
from instances import assert_same, hinged_box
from ppd_data import attributes_of

from articugen.core import schema
from articugen.core.errors import CorruptShard
from articugen.store.shards import open_shard
from tests.fuzz.mending import lookup3

ROWS = hinged_box()
ABOUT = attributes_of()


def test_no_flipped_bit_goes_unnoticed(written, tmp_path):
    path, record = written
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    noticed = 0
    for position in rng.integers(0, len(whole), 150):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(rng.integers(8))
        (tmp_path / "damaged.h5").write_bytes(damaged)
        try:
            with open_shard(tmp_path / "damaged.h5") as shard:
                assert shard.content() == record.content  # a byte that nobody reads
                assert ABOUT.items() <= shard.attributes.items()
        except CorruptShard:
            noticed += 1
    assert noticed > 120


@pytest.mark.parametrize("keep", [0, 7, 1000, -1000])
def test_cut_short(copy, keep):
    copy.write_bytes(copy.read_bytes()[:keep])
    with pytest.raises(CorruptShard, match="not an HDF5 file, or cut short"):
        open_shard(copy)


def test_missing_file(tmp_path):
    with pytest.raises(CorruptShard, match=r"cannot be opened \(No such file"):
        open_shard(tmp_path / "none.h5")


def test_a_fifo_is_no_shard(tmp_path):
    """HDF5 would wait for a writer for ever."""
    os.mkfifo(tmp_path / "train-00000.h5")
    with pytest.raises(CorruptShard, match="it is a FIFO, not a regular file; move it away"):
        open_shard(tmp_path / "train-00000.h5")


def _rewrite(path, name, how) -> None:
    """Replace a data set by one made with the keywords that `how` says of its array."""
    with h5py.File(path, "r+") as file:
        array = file[name][()]
        del file[name]
        file.create_dataset(name, **{"chunks": (1, *array.shape[1:]), **how(array)})


def _edit(change):
    def edit(path):
        with h5py.File(path, "r+") as file:
            change(file)

    return edit


def _soft_link(file):
    del file["near_label"]
    file["near_label"] = h5py.SoftLink("/uniform_label")


def _external_link(file):
    del file["near_label"]
    file["near_label"] = h5py.ExternalLink("/etc/passwd", "/x")


def _external_storage(file):
    del file["scale"]
    file.create_dataset("scale", (4,), "<f8", external=[("/etc/passwd", 0, 32)])


def _virtual(file):
    layout = h5py.VirtualLayout((4,), "<f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4,))
    del file["scale"]
    file.create_virtual_dataset("scale", layout)


def _attributes(change):
    """Change the attributes as articugen reads them."""

    def edit(file):
        text = json.dumps(change(json.loads(file.attrs[schema.CHECKED_ATTRIBUTES]))).encode()
        del file.attrs[schema.CHECKED_ATTRIBUTES]
        dtype = h5py.string_dtype("utf-8", len(text))
        file.attrs.create(schema.CHECKED_ATTRIBUTES, np.array(text, dtype), dtype=dtype)

    return _edit(edit)


def _without_seed(attributes):
    return {name: value for name, value in attributes.items() if name != "seed"}


def _checked_attributes_of_variable_length(file):
    file.attrs[schema.CHECKED_ATTRIBUTES] = file.attrs[schema.CHECKED_ATTRIBUTES].decode()


def _user_elsewhere(file):
    file["user"] = h5py.ExternalLink("/etc/passwd", "/x")


def _group(file):
    del file["scale"]
    file.create_group("scale")


def _bomb(file):
    for name in list(file):
        old = file[name]
        shape, dtype, zipped = (60_000, *old.shape[1:]), old.dtype, old.compression
        del file[name]
        file.create_dataset(
            name, shape, dtype, chunks=(1, *shape[1:]), compression=zipped, fletcher32=True
        )


def _big_chunk(file):
    del file["partial_part"]
    file.create_dataset(
        "partial_part",
        (4, 2, 1 << 26),
        "u1",
        chunks=(1, 2, 1 << 26),
        compression=4,
        fletcher32=True,
    )


def _variable_string(file):
    del file["object_id"]
    file.create_dataset("object_id", data=["a"] * 4, chunks=(1,))


HARM = {
    "a soft link": (_edit(_soft_link), "link to elsewhere"),
    "a link to another file": (_edit(_external_link), "link to elsewhere"),
    "another file's bytes": (_edit(_external_storage), "not stored one instance a chunk"),
    "a virtual data set": (_edit(_virtual), "not stored one instance a chunk"),
    "a group": (_edit(_group), "not a data set"),
    "a user's group elsewhere": (_edit(_user_elsewhere), "'user' is a link to elsewhere"),
    "a user's data set": (_edit(lambda f: f.create_dataset("user", data=1)), "not a group"),
    "an unknown name": (_edit(lambda f: f.create_dataset("x", data=1)), "'x' is not in the schema"),
    "a missing field": (_edit(lambda f: f.pop("scale")), "'scale' is missing"),
    "a shape bomb": (_edit(_bomb), "0 chunks for shape"),
    "a chunk bomb": (_edit(_big_chunk), "bytes an instance"),
    "text of variable length": (_edit(_variable_string), "not of dtype S"),
    "another dtype": (
        lambda p: _rewrite(p, "scale", lambda a: {"data": a.astype("<f4"), "fletcher32": True}),
        "'scale' is not of dtype <f8",
    ),
    "another byte order": (
        lambda p: _rewrite(p, "scale", lambda a: {"data": a.astype(">f8"), "fletcher32": True}),
        "'scale' is not of dtype <f8",
    ),
    "no checksum": (lambda p: _rewrite(p, "scale", lambda a: {"data": a}), "not the schema's"),
    "another filter": (
        lambda p: _rewrite(
            p, "near_label", lambda a: {"data": a, "compression": "lzf", "fletcher32": True}
        ),
        "not the schema's",
    ),
    "no chunks": (
        lambda p: _rewrite(p, "scale", lambda a: {"data": a, "chunks": None}),
        "not stored one instance a chunk",
    ),
    "other chunks": (
        lambda p: _rewrite(p, "scale", lambda a: {"data": a, "chunks": (4,), "fletcher32": True}),
        "not stored one instance a chunk",
    ),
    "other shape": (
        lambda p: _rewrite(p, "scale", lambda a: {"data": a[:3], "fletcher32": True}),
        "'scale' has shape",
    ),
    "other version": (_edit(lambda f: f.attrs.modify("schema_version", 99)), "schema version 99"),
    "no version": (_edit(lambda f: f.attrs.pop("schema_version")), "schema version None"),
    "version 0": (_edit(lambda f: f.attrs.modify("schema_version", 0)), "schema version 0"),
    "two versions": (
        _attributes(lambda a: a | {"schema_version": 1}),
        f"schema version {schema.SCHEMA_VERSION} or 1",
    ),
    "other format": (_attributes(lambda a: a | {"format": "x"}), "not an articugen shard"),
    "attributes of variable length": (
        _edit(_checked_attributes_of_variable_length),
        "'checked_attributes' is neither a number nor a text of a fixed length",
    ),
    "no attributes": (
        _edit(lambda f: f.attrs.pop(schema.CHECKED_ATTRIBUTES)),
        "'checked_attributes' is missing",
    ),
    "many attributes": (
        _edit(lambda f: [f.attrs.create(f"a{i}", i) for i in range(70)]),
        "[0-9]+ attributes",
    ),
    "attributes that are a list": (_attributes(lambda a: [*a]), "does not hold the others"),
    "array attribute": (_attributes(lambda a: a | {"note": [1, 2]}), "'note' is neither"),
    "a split that leads out": (
        _attributes(lambda a: a | {"split": "../../x"}),
        r"no split may be called '\.\./\.\./x'",
    ),
    "an absolute split": (
        _attributes(lambda a: a | {"split": "/x"}),
        "no split may be called '/x'",
    ),
    "a split of two lines": (_attributes(lambda a: a | {"split": "a\n"}), "no split may be called"),
    "missing attribute": (_attributes(_without_seed), "not of its type"),
}


@pytest.mark.parametrize(
    ("chunk", "skipped", "sentence"),
    [
        (bytes(8), 1, "scale: damaged .a chunk without its checksum."),
        (bytes(60_000), 0, "scale: damaged"),  # larger than any chunk of the field can be
        (bytes(11), 0, "scale: damaged .it holds 7 bytes, not 8."),
    ],
)
def test_chunks_of_another_make_are_not_read(copy, chunk, skipped, sentence):
    with h5py.File(copy, "r+") as file:
        dataset = file["scale"]
        assert isinstance(dataset, h5py.Dataset)
        dataset.id.write_direct_chunk((2,), chunk, filter_mask=skipped)
    with open_shard(copy) as shard:
        assert shard.read("scale", 1) == ROWS[1].scale
        with pytest.raises(CorruptShard, match=sentence):
            shard.read("scale", 2)
        with pytest.raises(CorruptShard, match="damaged"):
            shard.content()


@pytest.mark.parametrize("missing", [False, True])
def test_an_index_that_claims_countless_chunks_is_not_gone_through(copy, missing):
    """HDF5 would look for each of 10^15 chunks, of which the file has four."""
    if missing:
        _rewrite(copy, "scale", lambda a: {"shape": a.shape, "dtype": "<f8", "maxshape": (None,)}
                 | {"fletcher32": True})  # fmt: skip
    whole = bytearray(copy.read_bytes())
    at = whole.find(b"EAHD")
    while at >= 0:
        claimed, end = at + 12 + 4 * 8, at + 12 + 7 * 8
        whole[claimed : claimed + 8] = (10**15).to_bytes(8, "little")
        whole[end : end + 4] = lookup3(bytes(whole[at:end])).to_bytes(4, "little")
        at = whole.find(b"EAHD", at + 1)
    copy.write_bytes(whole)
    if missing:
        with pytest.raises(CorruptShard, match=r"'scale' has 0 chunks for shape \(4,\)"):
            open_shard(copy)
        return
    with open_shard(copy) as shard:
        assert shard.columns["scale"].offset.shape == (4,)
        assert_same(shard.instance(3), ROWS[3])


@pytest.mark.parametrize("what", HARM)
def test_refused(copy, what):
    harm, sentence = HARM[what]
    harm(copy)
    with pytest.raises(CorruptShard, match=sentence) as caught:
        open_shard(copy)
    assert str(caught.value).startswith(f"{copy}: ")
    assert "\n" not in str(caught.value)
