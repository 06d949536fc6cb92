"""Checksums and lengths set right after a change, so that readers look at what lies behind them."""

import functools
import gzip
import hashlib
import json
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from articugen.store.chunks import CHECKSUM_BYTES, fletcher32
from articugen.store.manifest import LISTS
from articugen.store.manifest_pages import page_of
from articugen.store.shards import open_shard
from tests.fuzz import making

_STL_HEAD, _STL_FACE = 84, 50


def stl(data: bytes) -> bytes:
    """A binary STL's number of triangles."""
    if len(data) < _STL_HEAD or data[:5] == b"solid":
        return data
    count = (len(data) - _STL_HEAD) // _STL_FACE
    whole = data[: _STL_HEAD + count * _STL_FACE]
    return whole[:80] + struct.pack("<I", count) + whole[84:]


def glb(data: bytes) -> bytes:
    """A GLB's length, and that of its JSON."""
    if len(data) < 28 or data[:4] != b"glTF":
        return data
    end = data.find(b"BIN\0", 20)
    end = len(data) if end < 24 else end - 4
    return b"".join([data[:8], struct.pack("<II", len(data), end - 20), data[16:end], data[end:]])


def pngs(data: bytes) -> bytes:
    """The checksums of all PNGs in it."""
    image, at = bytearray(data), -1
    while (at := image.find(b"\x89PNG\r\n\x1a\n", at + 1)) >= 0:
        chunk = at + 8
        while chunk + 12 <= len(image):
            end = chunk + 8 + int.from_bytes(image[chunk : chunk + 4], "big")
            if end + 4 > len(image):
                break
            image[end : end + 4] = zlib.crc32(image[chunk + 4 : end]).to_bytes(4, "big")
            chunk = end + 4 if image[chunk + 4 : chunk + 8] != b"IEND" else len(image)
    return bytes(image)


def checkpoint(data: bytes) -> bytes:
    """The digest that is in our files of tensors."""
    from articugen.learning.sealed import sealed

    try:
        return sealed(data)
    except ValueError:
        return data


def gzipped(data: bytes) -> bytes:
    """A .tar.gz of a .tar whose headers have the sums of what is in them."""
    image = bytearray(data)
    for at in range(0, len(image) - 511, 512):
        if image[at + 257 : at + 262] == b"ustar":
            image[at + 148 : at + 156] = b" " * 8
            image[at + 148 : at + 156] = b"%06o\0 " % sum(image[at : at + 512])
    return gzip.compress(image, 1, mtime=0)


def manifest(data: bytes) -> bytes:
    """A manifest with the digests of what it says, and of its pages where it has any."""
    try:
        head, *pages = data.split(making.BETWEEN)
        said = json.loads(head)
        whole = said
        if pages:
            said["pages"] = [_page(number, page) for number, page in enumerate(pages)]
            told = [json.loads(page) for page in pages]
            whole = said | {name: [e for page in told for e in page[name]] for name in LISTS}
        recipe, objects = whole["recipe"], whole["objects"]
        lines = sorted(
            "\x1f".join([o["key"]["split"], o["key"]["object_id"], o["content_sha256"]])
            for o in objects
        )
        said["recipe_sha256"] = hashlib.sha256(recipe.encode()).hexdigest()
        said["content_sha256"] = hashlib.sha256("\n".join(lines).encode()).hexdigest()
        rest = {n: v for n, v in (whole | said).items() if n not in ("manifest_sha256", "pages")}
        text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
        said["manifest_sha256"] = hashlib.sha256(text.encode()).hexdigest()
        return making.BETWEEN.join([json.dumps(said).encode(), *pages])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return data


def _page(number: int, data: bytes) -> dict[str, Any]:
    """As a manifest lists it."""
    told = json.loads(data)
    return page_of(number, data, sum(len(told[name]) for name in LISTS)).model_dump()


def shard(data: bytes) -> bytes:
    """A shard of which as many bytes are there as of one that was made: the checksums of rows that
    are not as they were."""
    return _with_checksums(data, fletcher32)


def forged(data: bytes) -> bytes:
    """The same, and the checksums of HDF5's own blocks: nobody's accident."""
    return _with_checksums(_with_checksums(data, fletcher32), lookup3)


def _with_checksums(data: bytes, which: Callable[[bytes], int]) -> bytes:
    made = next((each for each in _shards() if len(each[0]) == len(data)), None)
    if made is None:
        return data
    whole, blocks = made
    mended = bytearray(data)
    for first, end, checksum in blocks:
        if checksum is which and data[first:end] != whole[first:end]:
            mended[end : end + 4] = checksum(bytes(data[first:end])).to_bytes(4, "little")
    return bytes(mended)


_SIGNATURES = (b"\x89HDF\r\n\x1a\n", b"OHDR", b"OCHK", b"FRHP", b"FHIB", b"BTHD", b"BTIN")
_SIGNATURES += (b"BTLF", b"EAHD", b"EAIB", b"EADB", b"EASB", b"FAHD", b"FADB", b"SMTB", b"SMLI")
_LONGEST_BLOCK = 1 << 10


@functools.cache
def _shards() -> list[tuple[bytes, list[tuple[int, int, Any]]]]:
    return [(whole, [*_blocks(whole), *_rows(whole)]) for whole in making.shards()]


def _blocks(whole: bytes) -> list[tuple[int, int, Any]]:
    """Where HDF5's own blocks begin and end before their checksum, found by that."""
    found: list[tuple[int, int, Any]] = []
    for signature in _SIGNATURES:
        at, known = whole.find(signature), 0
        while at >= 0:
            likely = _header_bytes(whole, at) if signature == b"OHDR" else known
            for size in (likely, *range(len(signature) + 1, _LONGEST_BLOCK)):
                stored = whole[at + size : at + size + 4]
                if len(stored) < 4:
                    break
                if lookup3(whole[at : at + size]) == int.from_bytes(stored, "little"):
                    found.append((at, at + size, lookup3))
                    known = size
                    break
            at = whole.find(signature, at + 1)
    return found


def _header_bytes(whole: bytes, at: int) -> int:
    """Of an object header, without its checksum."""
    flags = whole[at + 5]
    head = 6 + (16 if flags & 0x20 else 0) + (4 if flags & 0x10 else 0)
    width = 1 << (flags & 3)
    return head + width + int.from_bytes(whole[at + head : at + head + width], "little")


def _rows(whole: bytes) -> list[tuple[int, int, Any]]:
    """Where rows begin and end before their checksum."""
    found: list[tuple[int, int, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "train-00000.h5"
        path.write_bytes(whole)
        with open_shard(path) as opened:
            for name in opened.fields:
                stored = opened.columns[name]
                for first, size in zip(stored.offset.tolist(), stored.size.tolist(), strict=True):
                    found.append((first, first + size - CHECKSUM_BYTES, fletcher32))
    return found


_MIX = ((0, 2, 1, 4), (1, 0, 2, 6), (2, 1, 0, 8), (0, 2, 1, 16), (1, 0, 2, 19), (2, 1, 0, 4))


def lookup3(data: bytes) -> int:
    """Bob Jenkins' hash of 2006, which HDF5 guards its blocks with (H5checksum.c)."""
    most = 0xFFFFFFFF
    a = b = c = (0xDEADBEEF + len(data)) & most

    def turned(x: int, by: int) -> int:
        return (x << by | x >> (32 - by)) & most

    words = struct.unpack(f"<{-(-len(data) // 12) * 3}I", data + bytes(-len(data) % 12))
    for at in range(0, len(words) - 3, 3):
        a, b, c = (a + words[at]) & most, (b + words[at + 1]) & most, (c + words[at + 2]) & most
        for x, y, z, by in _MIX:
            three = [a, b, c]
            three[x] = ((three[x] - three[y]) & most) ^ turned(three[y], by)
            three[y] = (three[y] + three[z]) & most
            a, b, c = three
    if not data:
        return c
    a, b, c = (a + words[-3]) & most, (b + words[-2]) & most, (c + words[-1]) & most
    c = ((c ^ b) - turned(b, 14)) & most
    a = ((a ^ c) - turned(c, 11)) & most
    b = ((b ^ a) - turned(a, 25)) & most
    c = ((c ^ b) - turned(b, 16)) & most
    a = ((a ^ c) - turned(c, 4)) & most
    b = ((b ^ a) - turned(a, 14)) & most
    return ((c ^ b) - turned(b, 24)) & most
