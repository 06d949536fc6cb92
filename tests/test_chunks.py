"""Rows as shards store them: HDF5's own bytes, and nothing that is damaged or a bomb."""

import io
import tracemalloc
import zlib

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from articugen.store import chunks


def naive_fletcher32(data: bytes) -> int:
    """As HDF5 defines it, word by word; a carry comes round again."""
    first = second = 0
    padded = data + b"\0" * (len(data) % 2)
    for at in range(0, len(padded), 2):
        first += int.from_bytes(padded[at : at + 2], "big")
        first = (first & 0xFFFF) + (first >> 16)
        second += first
        second = (second & 0xFFFF) + (second >> 16)
    return second << 16 | first


@given(st.binary(max_size=400))
def test_checksum_is_the_one_of_hdf5(data):
    assert chunks.fletcher32(data) == naive_fletcher32(data)


@pytest.mark.parametrize("size", [127, 128, 129, 131_072, 131_073, 400_001])
@pytest.mark.parametrize("fill", [0, 255, None])
def test_checksum_of_long_rows(size, fill):
    rng = np.random.default_rng(size)
    data = rng.bytes(size) if fill is None else bytes([fill]) * size
    assert chunks.fletcher32(data) == naive_fletcher32(data)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("size", [1, 7, 5000])
def test_a_chunk_is_hdf5s_own_to_the_byte(size, compressed):
    row = np.random.default_rng(size).integers(0, 3, size).astype(np.uint8)
    with h5py.File(io.BytesIO(), "w") as file:
        dataset = file.create_dataset(
            "row",
            data=row[None],
            chunks=(1, size),
            compression=chunks.GZIP_LEVEL if compressed else None,
            fletcher32=True,
        )
        file.flush()
        skipped, stored = dataset.id.read_direct_chunk((0, 0))
    assert skipped == 0
    chunk = memoryview(stored)
    assert chunks.decoded(chunk, size, compressed=compressed) == row.tobytes()
    assert len(chunk) <= chunks.most_bytes(size)
    if not compressed:  # the two may come with different versions of zlib
        assert chunks.encoded(row.tobytes(), compressed=False) == chunk


@given(st.binary(min_size=1, max_size=300), st.booleans(), st.data())
def test_what_is_written_is_read_and_no_bit_of_it_may_change(row, compressed, data):
    chunk = bytearray(chunks.encoded(row, compressed=compressed))
    assert chunks.decoded(memoryview(chunk), len(row), compressed=compressed) == row
    assert len(chunk) <= chunks.most_bytes(len(row))
    chunk[data.draw(st.integers(0, len(chunk) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(ValueError, match="checksum"):
        chunks.decoded(memoryview(chunk), len(row), compressed=compressed)


@pytest.mark.parametrize("keep", [0, 1, 3, 4, 5])
@pytest.mark.parametrize("compressed", [False, True])
def test_cut_short(keep, compressed):
    chunk = chunks.encoded(bytes(range(50)), compressed=compressed)[:keep]
    with pytest.raises(ValueError, match=r"checksum|bytes|incomplete"):
        chunks.decoded(memoryview(chunk), 50, compressed=compressed)


@pytest.mark.parametrize("megabytes", [10, 200])
def test_a_bomb_is_not_let_off(megabytes):
    packed = zlib.compress(bytes(megabytes << 20), 9)
    bomb = packed + chunks.fletcher32(packed).to_bytes(4, "little")
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="bytes, not 1000"):
            chunks.decoded(memoryview(bomb), 1000, compressed=True)
        assert tracemalloc.get_traced_memory()[1] < 3 << 24  # a growing buffer is copied
    finally:
        tracemalloc.stop()
