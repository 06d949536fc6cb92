"""Weights in the safetensors format, which programs without torch read as well.

Eight bytes with the length of the header, little-endian; the header, JSON: for each tensor its
`dtype`, `shape` and `data_offsets` (first byte, end) in what follows, and texts by name under
`__metadata__`; then the numbers, row-major and little-endian, without gaps
(huggingface.co/docs/safetensors).
"""

import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from articugen.core.errors import InvalidCheckpoint
from articugen.core.files import UnfitFile, read_regular, write_atomically

MOST_BYTES = 1 << 31
"""That such a file may have."""

_TYPES = {
    "F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16,
    "I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8,
    "U8": torch.uint8, "BOOL": torch.bool,
}  # fmt: skip
_NAMES = {dtype: name for name, dtype in _TYPES.items()}
_ALIGNED = 8


def write_safetensors(
    path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, str] | None = None
) -> None:
    """Write tensors by name, and texts about them.

    Raises:
        MachineFault: the disk is full, or the like.
    """
    _check_byte_order()
    header: dict[str, Any] = {"__metadata__": dict(about or {})}
    numbers, end = [], 0
    for name in sorted(tensors, key=lambda n: (-tensors[n].element_size(), n)):  # all aligned so
        tensor = tensors[name].detach().cpu().contiguous()
        data = tensor.reshape(-1).view(torch.uint8).numpy().tobytes()
        start, end = end, end + len(data)
        where = {"shape": list(tensor.shape), "data_offsets": [start, end]}
        header[name] = {"dtype": _NAMES[tensor.dtype], **where}
        numbers.append(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _ALIGNED)
    write_atomically(path, b"".join([len(text).to_bytes(8, "little"), text, *numbers]))


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors by name, and the texts about them.

    Raises:
        InvalidCheckpoint: there is no such file, or it is not one.
    """
    _check_byte_order()
    try:
        image = read_regular(path, MOST_BYTES)
    except UnfitFile as error:
        raise InvalidCheckpoint(f"{path}: {error.strerror}; restore it from a copy") from None
    except OSError as error:
        raise InvalidCheckpoint(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return _parsed(image)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, RuntimeError):
        raise InvalidCheckpoint(
            f"{path}: not a safetensors file, or damaged; restore it from a copy"
        ) from None


def _parsed(image: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    """What is in a file's bytes; raises one of several errors where they are none."""
    start = 8 + int.from_bytes(image[:8], "little")
    if not 8 < start <= len(image):
        raise ValueError("the header is longer than the file")
    header = json.loads(image[8:start])
    about = header.pop("__metadata__", {})
    if not all(isinstance(x, str) for pair in about.items() for x in pair):
        raise TypeError("texts by name")
    tensors, at = {}, 0
    for name, told in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
        dtype, shape = _TYPES[told["dtype"]], told["shape"]
        first, end = told["data_offsets"]
        if not all(type(n) is int and n >= 0 for n in (first, end, *shape)):
            raise TypeError("whole numbers")
        if first != at or end - first != math.prod(shape) * dtype.itemsize:
            raise ValueError("a gap, an overlap, or another size than that of the shape")
        at = end
        piece = bytearray(image[start + first : start + end])
        if len(piece) != end - first:
            raise ValueError("cut short")
        flat = torch.frombuffer(piece, dtype=dtype) if piece else torch.empty(0, dtype=dtype)
        tensors[name] = flat.reshape(shape)
    if start + at != len(image):
        raise ValueError("something follows")
    return tensors, about


def _check_byte_order() -> None:
    if sys.byteorder != "little":
        raise InvalidCheckpoint("safetensors: this machine's numbers are big-endian; use another")
