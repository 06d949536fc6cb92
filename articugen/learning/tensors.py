"""Tensors in sealed files, and networks whose weights a seed decides."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from articugen.core.errors import InvalidCheckpoint
from articugen.learning.sealed import read_arrays


def read_tensors(path: Path, wanted: str) -> dict[str, Any]:
    """Read as `read_arrays` does."""
    return changed(read_arrays(path, wanted), np.ndarray, lambda x: torch.from_numpy(x.copy()))


def in_numpy(data: Any) -> Any:
    """Return nested dicts with arrays where there were tensors."""
    return changed(data, Tensor, lambda tensor: tensor.detach().cpu().numpy())


def changed(value: Any, kind: type, change: Callable[[Any], Any]) -> Any:
    """Return the same with everything of a kind in it changed: in tuples, dicts and records."""
    if isinstance(value, kind):
        return change(value)
    if isinstance(value, tuple):
        return tuple(changed(item, kind, change) for item in value)
    if isinstance(value, dict):
        return {key: changed(item, kind, change) for key, item in value.items()}
    if is_dataclass(value):
        some = {f.name: changed(getattr(value, f.name), kind, change) for f in fields(value)}
        return replace(value, **some)  # pyright: ignore[reportArgumentType]
    return value


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


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums of floats depend on how many threads share them: within it is one."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


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
