"""How a field of a row is declared: `Instance` in `schema.py` declares all of them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

MAX_TEXT = 255
"""Bytes of a text in UTF-8: an object_id, the name of a joint or a part."""

SYMBOLS: Mapping[str, tuple[str, str]] = {
    "N": ("instances in the shard", ""),
    "J": ("moving joints", ""),
    "P": ("parts, J + 1: part 0 is the fixed one, joint j carries part j + 1", ""),
    "R": ("resolution of the grid", ""),
    "S": ("surface points", "sampling.surface_points"),
    "U": ("uniform points", "sampling.uniform_points"),
    "K": ("points near the surface", "sampling.near_points"),
    "C": ("cameras", "sampling.partial_views"),
    "M": ("points a camera", "sampling.partial_points"),
    "E": ("points on sharp edges", "sampling.sharp_points"),
    "V": ("images", "images.views"),
    "H": ("pixels along the edge of an image", "images.resolution"),
}
"""The number that a letter in the fields' shapes stands for, one in a whole shard, and the recipe's
key that decides it, if one does."""


@dataclass(frozen=True)
class Field:
    """One data set of a shard.

    Attributes:
        name: of the data set; <R> stands for a grid's resolution.
        dtype: as numpy writes it, byte order included; "S" is UTF-8 of a fixed length of at most
            MAX_TEXT bytes, padded with zero bytes.
        shape: numbers, and letters from SYMBOLS; the first is always N.
        unit: of one number.
        frame: the coordinates it is given in, or "".
        meaning: one sentence or two.
        compressed: with gzip, for what gets smaller by it; random 16-bit coordinates do not.
        optional: a shard may lack it.
        asked_by: the recipe's key that asks for it, or "" where every recipe does.
    """

    name: str
    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    frame: str
    meaning: str
    compressed: bool = False
    optional: bool = False
    asked_by: str = ""

    @property
    def stem(self) -> str:
        """The name without a grid's resolution."""
        return self.name.removesuffix("_<R>")

    @property
    def is_grid(self) -> bool:
        return self.stem != self.name

    @property
    def itemsize(self) -> int:
        """Bytes of one number, or of one text."""
        return MAX_TEXT if self.dtype == "S" else np.dtype(self.dtype).itemsize

    @property
    def written_shape(self) -> str:
        """The shape as people write it: (N, P, 4, 4)."""
        return f"({', '.join(map(str, self.shape))}{',' if len(self.shape) == 1 else ''})"

    def matches(self, name: str) -> bool:
        """Return whether a data set of this name is described by this field."""
        if not self.is_grid:
            return name == self.name
        return re.fullmatch(f"{self.stem}_[1-9][0-9]{{0,2}}", name) is not None

    def fits(self, name: str, shape: tuple[int, ...], known: dict[str, int]) -> bool:
        """Return whether `shape` is this field's; the letters it settles are added to `known`."""
        if len(shape) != len(self.shape):
            return False
        for want, size in zip(self.shape, shape, strict=True):
            if isinstance(want, int):
                expected = want
            elif want == "R":
                expected = resolution_of(name)
            else:
                expected = known.setdefault(want, size)
            if size != expected:
                return False
        return True


f8 = Annotated[NDArray[np.float64], "<f8"]
f4 = Annotated[NDArray[np.float32], "<f4"]
u2 = Annotated[NDArray[np.uint16], "<u2"]
u1 = Annotated[NDArray[np.uint8], "u1"]
i1 = Annotated[NDArray[np.int8], "i1"]
grids = Annotated[Mapping[int, NDArray[np.uint8]], "u1"]
number = Annotated[float, "<f8"]
text = Annotated[str, "S"]
texts = Annotated[tuple[str, ...], "S"]


_NO_GRIDS: Mapping[int, NDArray[Any]] = MappingProxyType({})


def stored(
    shape: str,
    meaning: str,
    *,
    unit: str = "",
    frame: str = "",
    gzip: bool = False,
    optional: bool = False,
    asked_by: str = "",
) -> Any:
    """Declare a field of `Instance`; its annotation says the dtype. See `Field` for the arguments.

    One that not every recipe asks for is None by default, samples are none by default, grids too.
    """
    sizes = tuple(int(size) if size.isdigit() else size for size in shape.split())
    optional = optional or bool(asked_by)
    described = Field("", "", sizes, unit, frame, meaning, gzip, optional, asked_by)
    about = {"described": described}
    if "R" in sizes:
        return field(default_factory=lambda: _NO_GRIDS, metadata=about)
    if optional:
        return field(default=None, metadata=about)
    if any(SYMBOLS[size][1] for size in sizes if isinstance(size, str)):
        none = tuple(size if isinstance(size, int) else 0 for size in sizes[1:])
        return field(default_factory=lambda: np.zeros(none), metadata=about)
    return field(metadata=about)


def fields_of(row: type) -> tuple[Field, ...]:
    """The fields that a dataclass declares by `stored`, with the dtypes of its annotations."""
    hints = get_type_hints(row, include_extras=True)
    declared = ((one.name, one.metadata["described"]) for one in fields(row))
    return tuple(
        replace(
            described,
            name=f"{name}_<R>" if "R" in described.shape else name,
            dtype=_dtype_in(hints[name]),
        )
        for name, described in declared
    )


def _dtype_in(hint: Any) -> str:
    """Return the text that is annotated to a type, or to one of a union's."""
    if hasattr(hint, "__metadata__"):
        return hint.__metadata__[0]
    return next(_dtype_in(kind) for kind in get_args(hint) if kind is not type(None))


def resolution_of(name: str) -> int:
    """Of the grid that a data set of this name holds."""
    return int(name.rpartition("_")[2])
