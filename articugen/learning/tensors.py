"""Tensors and plain data in files that are sealed: no pickled code, no flipped bit, no NaN.

A file is what torch.save writes, a zip archive, with the SHA-256 of all that comes before it as the
archive's comment: torch.load(path, weights_only=True) reads it as it is.
"""

import hashlib
import io
import pickletools
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from articugen.core.errors import InvalidCheckpoint
from articugen.core.files import UnfitFile, read_regular, write_atomically

MOST_BYTES = 1 << 31
"""That such a file may have; a checkpoint of PPD has 10 MB."""

CURE = "restore it from a copy, or train again"

_LONGEST_NAME = 200  # of what a pickle asks for

_END_RECORD, _END_BYTES = b"PK\x05\x06", 22
_LABEL = b"sha256:"
_SEAL_BYTES = len(_LABEL) + 64


def write_tensors(path: Path, data: dict[str, Any], form: str) -> None:
    """Write tensors and plain data in one step, sealed.

    Raises:
        MachineFault: the disk is full, or the like.
    """
    buffer = io.BytesIO()
    torch.save({"format": form, **data}, buffer)
    write_atomically(path, sealed(buffer.getvalue()))


def sealed(archive: bytes) -> bytes:
    """A zip archive without a comment, given its digest as one."""
    end = archive[-_END_BYTES:]  # its last two bytes are the comment's length
    if not (end.startswith(_END_RECORD) and end.endswith(b"\0\0")):
        raise ValueError("not a zip archive without a comment")
    body = archive[:-2] + struct.pack("<H", _SEAL_BYTES)
    return body + _LABEL + hashlib.sha256(body).hexdigest().encode()


def read_tensors(path: Path, wanted: str) -> dict[str, Any]:
    """What was written to `path` in the format `wanted`, all of it finite but plain infinities.

    Raises:
        InvalidCheckpoint: there is none, it is damaged, or not one of ours.
    """
    image = _unsealed(path)
    try:
        _check_names(image)
        data = torch.load(io.BytesIO(image), map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception:  # torch's reader raises whatever it stumbles over
        raise InvalidCheckpoint(f"{path}: not a checkpoint, or damaged; {CURE}") from None
    if not isinstance(data, dict) or data.pop("format", None) != wanted:
        raise InvalidCheckpoint(f"{path}: not a checkpoint of this version; {CURE}")
    for value in _values(data):
        if not _is_sound(value):
            raise InvalidCheckpoint(f"{path}: holds numbers that are not finite; {CURE}")
    return data


def _check_names(image: bytes) -> None:
    """Refuse a pickle that asks for something of a long name: torch would look for words in what
    it says of it, for minutes where the name has 100 kB."""
    with zipfile.ZipFile(io.BytesIO(image)) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("/data.pkl"))
        if archive.getinfo(name).file_size > len(image):
            raise ValueError("unpacks to more than the file has")
        for operation, argument, _ in pickletools.genops(archive.read(name)):
            if operation.name == "GLOBAL" and len(str(argument)) > _LONGEST_NAME:
                raise ValueError("a long name")


def _unsealed(path: Path) -> bytes:
    try:
        image = read_regular(path, MOST_BYTES)
    except UnfitFile as error:
        raise InvalidCheckpoint(f"{path}: {error.strerror}; {CURE}") from None
    except OSError as error:
        raise InvalidCheckpoint(f"{path}: cannot be read ({error.strerror}); {CURE}") from None
    body, seal = memoryview(image)[:-_SEAL_BYTES], image[-_SEAL_BYTES:]
    if not seal.startswith(_LABEL):
        raise InvalidCheckpoint(
            f"{path}: not a checkpoint with a digest: damaged, or of an earlier version; {CURE}"
        )
    if seal != _LABEL + hashlib.sha256(body).hexdigest().encode():
        raise InvalidCheckpoint(f"{path}: damaged, not the bytes that were written; {CURE}")
    return image


def _values(data: Any) -> Iterator[Any]:
    """Every tensor and plain value, however deep; what holds itself is looked into once."""
    waiting, seen = [data], set[int]()
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict | list | tuple | set):
            if id(value) not in seen:
                seen.add(id(value))
                waiting += [*value, *value.values()] if isinstance(value, dict) else value
        else:
            yield value


def _is_sound(value: Any) -> bool:
    if not isinstance(value, Tensor):
        return value == value or not isinstance(value, float)  # noqa: PLR0124 - NaN alone differs
    if value.layout != torch.strided or value.is_quantized or value.device.type != "cpu":
        return False
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        return False  # a view of a few numbers that pretends to be many
    return bool(value.isfinite().all())


def check_like(found: Any, wanted: Any, path: Path, name: str = "") -> None:
    """Raise InvalidCheckpoint where keys, shapes or types are not those of `wanted`."""
    if isinstance(wanted, dict):
        fits = isinstance(found, dict) and found.keys() == wanted.keys()
    elif isinstance(wanted, Tensor):
        fits = isinstance(found, Tensor)
        fits = fits and (found.shape, found.dtype) == (wanted.shape, wanted.dtype)
    else:
        fits = type(found) is type(wanted)
    if not fits:
        raise InvalidCheckpoint(
            f"{path}: its {name or 'state'} is that of another recipe or method; train again"
        )
    if isinstance(wanted, dict):
        for key, value in wanted.items():
            check_like(found[key], value, path, f"{name}.{key}" if name else key)


def digest(state: dict[str, Any]) -> str:
    """The SHA-256 of all in nested dicts."""
    hashed = hashlib.sha256()

    def tell(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value):
                tell(f"{name}.{key}", value[key])
        else:
            hashed.update(f"{name}\0".encode())
            if isinstance(value, Tensor):
                hashed.update(
                    value.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
                )
            else:
                hashed.update(repr(value).encode())

    tell("", state)
    return hashed.hexdigest()


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
