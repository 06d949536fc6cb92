"""One row of a field as a shard stores it: gzip where that helps, then a Fletcher32 checksum.

These are HDF5's own filters 1 and 3, to the byte: any HDF5 reads what is written here. Done here
they take a fraction of the time, and damage or a compressed bomb is found before it is believed.
"""

import zlib

import numpy as np

GZIP_LEVEL = 4
CHECKSUM_BYTES = 4

_BLOCK = 1 << 16
_FALLING = np.arange(_BLOCK, 0, -1, dtype=np.float64)
_FEW = 64
"""Words that Python adds up faster than numpy."""
_EXPANDS = 1032
"""Bytes that one byte of a deflate stream stands for, at most."""
_HARMLESS = (1 << 26) // _EXPANDS
"""Bytes that cannot expand to more than 64 MiB."""


def encoded(row: bytes, *, compressed: bool) -> bytes:
    """Return the chunk that holds `row`."""
    stored = zlib.compress(row, GZIP_LEVEL) if compressed else row
    return stored + fletcher32(stored).to_bytes(CHECKSUM_BYTES, "little")


def most_bytes(row_bytes: int) -> int:
    """Return the most that a chunk may take: what deflate makes of the least compressible row, and
    the checksum."""
    return row_bytes + (row_bytes >> 10) + 64


def decoded(chunk: memoryview, row_bytes: int, *, compressed: bool) -> memoryview | bytes:
    """Return the row that a chunk holds, of which no more than about `row_bytes` are ever made;
    ValueError if it does not hold exactly that many, or its checksum is wrong."""
    stored, checksum = chunk[:-CHECKSUM_BYTES], chunk[-CHECKSUM_BYTES:]
    if fletcher32(stored) != int.from_bytes(checksum, "little"):
        raise ValueError("its checksum is wrong")
    row = _inflated(stored, row_bytes) if compressed else stored
    if len(row) != row_bytes:
        raise ValueError(f"it holds {len(row)} bytes, not {row_bytes}")
    return row


def _inflated(stored: memoryview, row_bytes: int) -> bytes:
    try:
        if len(stored) <= _HARMLESS:
            return zlib.decompress(stored, bufsize=max(row_bytes, 1))
        return zlib.decompressobj().decompress(stored, row_bytes + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from None


def fletcher32(data: bytes | memoryview) -> int:
    """HDF5's Fletcher32: sums of big-endian 16-bit words, and of those sums, modulo 65535.

    All numbers are whole and below 2^53, so floating-point sums of them are exact in any order.
    Turning the bytes of a word around multiplies it by 256 modulo 65535.
    """
    if len(data) % 2:
        data = bytes(data) + b"\0"
    words = np.frombuffer(data, "<u2")
    first = second = 0
    if len(words) <= _FEW:
        for word in words.tolist():
            first += word
            second += first
        words = words[:0]
    for start in range(0, len(words), _BLOCK):
        block = words[start : start + _BLOCK].astype(np.float64)
        falling = _FALLING[_BLOCK - len(block) :]
        second += first * len(block) + int(np.einsum("i,i", block, falling))
        first += int(block.sum())
    return _folded(second * 256) << 16 | _folded(first * 256)


def _folded(total: int) -> int:
    """Modulo 65535 as carries that come round again leave it: 0 for 0 alone."""
    return (total - 1) % 65535 + 1 if total else 0


def shape_of(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of the chunks of a data set (N, ...): a row each."""
    return (1, *(max(size, 1) for size in shape[1:]))
