"""Tensors and plain data in safetensors files that are sealed: no code, no flipped bit, no NaN.

Any reader of safetensors opens a file: tensors have the path of their keys for a name, and the
metadata's one entry is the SHA-256 of the file (in which that digest is zeros) and, as JSON, all
that is no tensor.
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors.torch as safetensors
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from articugen.core.errors import InvalidCheckpoint
from articugen.core.files import UnfitFile, read_regular, write_atomically

MOST_BYTES = 1 << 31
"""That such a file may have; a checkpoint of PPD has 10 MB."""

CURE = "restore it from a copy, or train again"

_ENTRY = "articugen"
_LABEL = f'{{"__metadata__":{{"{_ENTRY}":"'.encode()
_AT = slice(8 + len(_LABEL), 8 + len(_LABEL) + 64)
"""Where the digest stands: a file begins with its header's length in 8 bytes, and the metadata."""

_UNSEALED = b"0" * 64


def write_tensors(path: Path, data: dict[str, Any], form: str) -> None:
    """Write nested dicts of tensors and plain data in one step, sealed.

    Raises:
        MachineFault: the disk is full, or the like.
    """
    write_atomically(path, sealed(image_of({"format": form, **data})))


def image_of(data: dict[str, Any]) -> bytes:
    """Pack nested dicts into a file that is not sealed yet; their keys are texts without a `/`."""
    tensors: dict[str, Tensor] = {}
    rest = json.dumps(_without_tensors(data, "", tensors))
    return safetensors.save(tensors, {_ENTRY: _UNSEALED.decode() + rest})


def _without_tensors(
    data: dict[str, Any], above: str, tensors: dict[str, Tensor]
) -> dict[str, Any]:
    """Give what is no tensor; the tensors go into `tensors`, by the path of their keys."""
    rest: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Tensor):
            tensors[f"{above}{key}"] = value.cpu().clone(memory_format=torch.contiguous_format)
        elif isinstance(value, dict):
            rest[key] = _without_tensors(value, f"{above}{key}/", tensors)
        else:
            rest[key] = value
    return rest


def sealed(image: bytes) -> bytes:
    """Give the image of a file its digest."""
    if image[8 : _AT.start] != _LABEL or len(image) < _AT.stop:
        raise ValueError("not a file of ours")
    digest = hashlib.sha256(image[: _AT.start] + _UNSEALED + image[_AT.stop :]).hexdigest()
    return image[: _AT.start] + digest.encode() + image[_AT.stop :]


def read_tensors(path: Path, wanted: str) -> dict[str, Any]:
    """Read what was written to `path` in the format `wanted`: finite but for plain infinities.

    Raises:
        InvalidCheckpoint: there is none, it is damaged, or not one of ours.
    """
    image = _unsealed(path)
    try:
        header = json.loads(image[8 : 8 + int.from_bytes(image[:8], "little")])
        rest = header["__metadata__"][_ENTRY][len(_UNSEALED) :]
        data = json.loads(rest, parse_constant=_infinity)
        tensors = safetensors.load(image)
        finite = all(bool(tensor.isfinite().all()) for tensor in tensors.values())
        for name, tensor in tensors.items():
            _put(data, name.split("/"), tensor)
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


def _put(data: dict[str, Any], keys: list[str], tensor: Tensor) -> None:
    """Put a tensor where it was among nested dicts, and nothing was left in its place."""
    *above, last = keys
    for key in above:
        data = data[key]
    if last in data:
        raise KeyError(last)
    data[last] = tensor


def _unsealed(path: Path) -> bytes:
    try:
        image = read_regular(path, MOST_BYTES)
    except UnfitFile as error:
        raise InvalidCheckpoint(f"{path}: {error.strerror}; {CURE}") from None
    except OSError as error:
        raise InvalidCheckpoint(f"{path}: cannot be read ({error.strerror}); {CURE}") from None
    try:
        is_whole = sealed(image) == image
    except ValueError:
        raise InvalidCheckpoint(f"{path}: not a checkpoint of ours, or damaged; {CURE}") from None
    if not is_whole:
        raise InvalidCheckpoint(f"{path}: damaged, not the bytes that were written; {CURE}")
    return image


def check_like(actual: Any, wanted: Any, path: Path, name: str = "") -> None:
    """Raise InvalidCheckpoint where keys, shapes or types are not those of `wanted`."""
    if isinstance(wanted, dict):
        fits = isinstance(actual, dict) and actual.keys() == wanted.keys()
    elif isinstance(wanted, Tensor):
        fits = isinstance(actual, Tensor)
        fits = fits and (actual.shape, actual.dtype) == (wanted.shape, wanted.dtype)
    else:
        fits = type(actual) is type(wanted)
    if not fits:
        raise InvalidCheckpoint(
            f"{path}: its {name or 'state'} is that of another recipe or method; train again"
        )
    if isinstance(wanted, dict):
        for key, value in wanted.items():
            check_like(actual[key], value, path, f"{name}.{key}" if name else key)


@contextmanager
def made(seed: int, device: torch.device) -> Iterator[None]:
    """Networks that are made within get weights that the seed alone decides, whatever the device
    that they go to then; on `meta` they cost nothing."""
    if device.type == "meta":
        with device, _Unfilled():
            yield
        return
    with torch.random.fork_rng(devices=[]), torch.device("cpu"):
        torch.manual_seed(seed)
        yield


class _Unfilled(TorchFunctionMode):
    """Leaves out what fills tensors with random numbers: on `meta` there are none, and torch would
    import its compiler for it, which takes a second. So it would for arithmetic there: what
    networks compute of constants while they are made they compute on the CPU."""

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        named = kwargs or {}
        within = getattr(func, "__module__", None)
        if func in (Tensor.normal_, Tensor.uniform_) or within == "torch.nn.init":
            return args[0] if args else named["tensor"]
        return func(*args, **named)
