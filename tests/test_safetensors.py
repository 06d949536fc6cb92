"""Weights as other programs read them, against a literal reading of the format."""

import json
import struct

import numpy as np
import pytest

from articugen.core.errors import InvalidCheckpoint

torch = pytest.importorskip("torch", reason="PPD needs torch")

from articugen.learning.safetensors import read_safetensors, write_safetensors

TENSORS = {
    "b.weight": torch.arange(6, dtype=torch.float32).view(2, 3).T,  # not contiguous
    "a": torch.tensor([True, False, True]),
    "c": torch.tensor(-7, dtype=torch.int64),
    "empty": torch.zeros(0, 4),
    "half": torch.tensor([1.5, -2.0], dtype=torch.float16),
    "small": torch.tensor([-1, 2], dtype=torch.int8),
}


def test_a_literal_reading_finds_every_number(tmp_path):
    """As a reader would be written that knows but the page of the format."""
    path = tmp_path / "weights.safetensors"
    write_safetensors(path, TENSORS, {"what": "some weights", "more": "äöü"})
    image = path.read_bytes()
    (length,) = struct.unpack("<Q", image[:8])
    header = json.loads(image[8 : 8 + length].decode("utf-8"))
    assert image[8:9] == b"{"
    assert (8 + length) % 8 == 0
    assert header.pop("__metadata__") == {"what": "some weights", "more": "äöü"}
    assert header.keys() == TENSORS.keys()
    types = {"F32": "<f4", "BOOL": "?", "I64": "<i8", "F16": "<f2", "I8": "i1"}
    covered = []
    for name, told in header.items():
        start, end = told["data_offsets"]
        found = np.frombuffer(image[8 + length :][start:end], types[told["dtype"]])
        assert start % found.dtype.itemsize == 0
        np.testing.assert_array_equal(found.reshape(told["shape"]), TENSORS[name].numpy())
        covered += range(start, end)
    assert sorted(covered) == list(range(len(image) - 8 - length))


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "weights.safetensors"
    write_safetensors(path, TENSORS, {"what": "some weights"})
    tensors, about = read_safetensors(path)
    assert about == {"what": "some weights"}
    assert tensors.keys() == TENSORS.keys()
    for name, tensor in TENSORS.items():
        assert (tensors[name].dtype, tensors[name].shape) == (tensor.dtype, tensor.shape)
        assert torch.equal(tensors[name], tensor)


def image(header: object, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def one(dtype: str = "F32", shape: object = (1,), offsets: object = (0, 4)) -> dict:
    return {"a": {"dtype": dtype, "shape": shape, "data_offsets": offsets}}


def test_a_file_of_another_writer_is_read(tmp_path):
    """Spaces after the header or none, no texts, tensors in any order."""
    path = tmp_path / "weights.safetensors"
    header = {**one(offsets=(4, 8)), "b": {"dtype": "F32", "shape": [], "data_offsets": [0, 4]}}
    for text in (json.dumps(header).encode(), json.dumps(header, indent=1).encode() + b"   "):
        path.write_bytes(image(text, struct.pack("<ff", 1.0, 2.0)))
        tensors, about = read_safetensors(path)
        assert about == {}
        assert tensors == {"a": torch.tensor([2.0]), "b": torch.tensor(1.0)}


BAD = {
    "nothing": b"",
    "cut header": image(one(), b"1234")[:30],
    "cut numbers": image(one(), b"123"),
    "more": image(one(), b"12345"),
    "huge header": struct.pack("<Q", 1 << 62) + b"{}",
    "no JSON": image(b"{nothing}"),
    "no mapping": image([1]),
    "unknown type": image(one("F8"), b"1234"),
    "another size": image(one(shape=(2,)), b"1234"),
    "negative": image(one(shape=(-1, -1)), b"1234"),
    "fraction": image(one(shape=(1.0,)), b"1234"),
    "gap": image(one(offsets=(4, 8)), b"12341234"),
    "overlap": image(one() | {"b": one()["a"]}, b"1234"),
    "no text": image(one() | {"__metadata__": {"a": 1}}, b"1234"),
    "beyond 64 bits": image(one(shape=(0, 1 << 64), offsets=(0, 0))),
    "offsets of one": image(one(offsets=(4,)), b"1234"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_none_is_refused(tmp_path, name):
    path = tmp_path / "weights.safetensors"
    path.write_bytes(BAD[name])
    with pytest.raises(InvalidCheckpoint, match=r"weights\.safetensors: not a safetensors file"):
        read_safetensors(path)


def test_what_is_not_there_is_said_so(tmp_path):
    with pytest.raises(InvalidCheckpoint, match="cannot be read"):
        read_safetensors(tmp_path / "none")
    with pytest.raises(InvalidCheckpoint, match="a folder"):
        read_safetensors(tmp_path)
