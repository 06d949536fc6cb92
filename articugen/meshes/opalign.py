"""OP-Align's views: the one dict that an .npz pickles, read without running what a pickle asks for.

What a view holds is in docs/exports/opalign.md, by the loader of its authors.
"""

import io
import pickle
import re
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from articugen.core.arrays import Floats, Ints
from articugen.core.geometry import transform

_MADE_BY_NUMPY = ("_reconstruct", "ndarray", "dtype")
_SKEW = 0.01  # of the product of a rotation and its inverse


@dataclass(frozen=True, eq=False)
class View:
    """One depth camera's view.

    Attributes:
        points: (n, 3) of the detected object, camera axes x right, y down, z forward.
        part: (n,) whose each is, -1 for the background.
        T_camera_part: (P, 4, 4) from the frames of the parts' boxes.
    """

    points: Floats
    part: Ints
    T_camera_part: Floats


class _Call:
    """Call that a pickle asks for, not made: its arguments, and the state of its outcome."""

    def __init__(self, *args: Any) -> None:
        self.args: Any = args
        self.state: Any = ()

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Reader(pickle._Unpickler):  # the one in C makes room for any number that a file claims
    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    del dispatch[pickle.BYTEARRAY8[0]]  # as this would

    def find_class(self, module: str, name: str) -> type[_Call]:
        if module.partition(".")[0] != "numpy" or name not in _MADE_BY_NUMPY:
            raise ValueError(f"asks for {module}.{name}")
        return _Call


@np.errstate(all="ignore")  # what is no number is refused
def view_of(npy: bytes) -> View:
    """Return the view whose dict is pickled in the array of a .npy file; raises whatever there is
    to raise where it holds another thing."""
    file = io.BytesIO(npy)
    np.lib.format.read_magic(file)
    np.lib.format.read_array_header_1_0(file)
    stored = _Reader(file).load().state[4][0]
    pc, part = _numbers(stored["pc"]), _numbers(stored["part"])
    there = (pc.sum(1) != 0.0) & (_numbers(stored["detection"]) != 0.0)
    R = part[:, :9].reshape(-1, 3, 3)
    if not len(R) or not np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max() < _SKEW:
        raise ValueError("nine numbers of a part are no rotation")
    T = np.array([transform(*pose) for pose in zip(R, part[:, 9:12], strict=True)])
    if not np.isfinite(pc[there]).all() or not np.isfinite(T).all():
        raise ValueError("holds numbers that are not finite")
    return View(pc[there], _numbers(stored["segmentation"])[there].astype(np.int64) - 1, T)


def _numbers(call: _Call) -> Floats:
    """Return the array that numpy would make of its pickled state."""
    _, shape, dtype, is_fortran, data = call.state
    (code, *_), (_, order, *_) = dtype.args, dtype.state
    if not re.fullmatch("[biuf][1248]", code):
        raise ValueError(f"holds {code}, no numbers")
    array = np.frombuffer(data, order + code).reshape(shape, order="F" if is_fortran else "C")
    return array.astype(np.float64)
