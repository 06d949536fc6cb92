"""Arrays and plain data in safetensors files that are sealed: no code, no flipped bit, no NaN.

Any reader of safetensors opens a file: arrays have the path of their keys for a name, and the
metadata's one entry is the SHA-256 of the file (in which that digest is zeros) and, as JSON, all
that is no array. Nothing here imports torch.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy as safetensors
from numpy.typing import NDArray

from articugen.core.errors import InvalidCheckpoint
from articugen.core.files import read_or_refuse, write_atomically

MOST_BYTES = 1 << 31
"""That such a file may have; a checkpoint of PPD has 10 MB."""

CURE = "restore it from a copy, or train again"

_ENTRY = "articugen"
_LABEL = f'{{"__metadata__":{{"{_ENTRY}":"'.encode()
_AT = slice(8 + len(_LABEL), 8 + len(_LABEL) + 64)
"""Where the digest stands: a file begins with its header's length in 8 bytes, and the metadata."""

_UNSEALED = b"0" * 64


def write_arrays(path: Path, data: dict[str, Any], form: str) -> None:
    """Write nested dicts of arrays and plain data in one step, sealed.

    Raises:
        MachineFault: the disk is full, or the like.
    """
    write_atomically(path, sealed(image_of({"format": form, **data})))


def image_of(data: dict[str, Any]) -> bytes:
    """Pack nested dicts into a file that is not sealed yet; their keys are texts without a `/`."""
    arrays: dict[str, NDArray[Any]] = {}
    rest = json.dumps(_without_arrays(data, "", arrays))
    return safetensors.save(arrays, {_ENTRY: _UNSEALED.decode() + rest})


def _without_arrays(
    data: dict[str, Any], above: str, arrays: dict[str, NDArray[Any]]
) -> dict[str, Any]:
    """Give what is no array; the arrays go into `arrays`, by the path of their keys."""
    rest: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, np.ndarray):
            arrays[f"{above}{key}"] = np.ascontiguousarray(value).reshape(value.shape)
        elif isinstance(value, dict):
            rest[key] = _without_arrays(value, f"{above}{key}/", arrays)
        else:
            rest[key] = value
    return rest


def sealed(image: bytes) -> bytes:
    """Give the image of a file its digest."""
    if image[8 : _AT.start] != _LABEL or len(image) < _AT.stop:
        raise ValueError("not a file of ours")
    digest = hashlib.sha256(image[: _AT.start] + _UNSEALED + image[_AT.stop :]).hexdigest()
    return image[: _AT.start] + digest.encode() + image[_AT.stop :]


def read_arrays(path: Path, wanted: str) -> dict[str, Any]:
    """Read what was written to `path` in the format `wanted`: finite but for plain infinities.

    Raises:
        InvalidCheckpoint: there is none, it is damaged, or not one of ours.
    """
    image = read_or_refuse(path, MOST_BYTES, InvalidCheckpoint, CURE)
    try:
        if sealed(image) != image:
            raise ValueError("not the bytes that were written")
        header = json.loads(image[8 : 8 + int.from_bytes(image[:8], "little")])
        rest = header["__metadata__"][_ENTRY][len(_UNSEALED) :]
        data = json.loads(rest, parse_constant=_infinity)
        arrays = safetensors.load(image)
        finite = all(bool(np.isfinite(array).all()) for array in arrays.values())
        for name, array in arrays.items():
            _put(data, name.split("/"), array)
    except MemoryError:
        raise
    except Exception:  # the library raises whatever it stumbles over
        raise InvalidCheckpoint(f"{path}: not a checkpoint, or damaged; {CURE}") from None
    if not isinstance(data, dict) or data.pop("format", None) != wanted:
        raise InvalidCheckpoint(f"{path}: not a checkpoint of this version; {CURE}")
    if not finite:
        raise InvalidCheckpoint(f"{path}: holds numbers that are not finite; {CURE}")
    return data


def _infinity(text: str) -> float:
    if text == "NaN":
        raise ValueError(text)
    return float(text)


def _put(data: dict[str, Any], keys: list[str], array: NDArray[Any]) -> None:
    """Put an array where it was among nested dicts, and nothing was left in its place."""
    *above, last = keys
    for key in above:
        data = data[key]
    if last in data:
        raise KeyError(last)
    data[last] = array
