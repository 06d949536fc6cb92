"""Keyboards for laptops: rows of key caps in several layouts, each key a solid of its own."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from articugen.procedural.kit.outlines import rectangle, rounded_rectangle
from articugen.procedural.kit.solids import Solid, prism, stack

# Key widths from left to right, in units of the pitch, for the rows from the rear to the front.
# Every row of the letter block is 15 units wide; the arrow keys end the last one.
_NUMBERS = (*[1.0] * 13, 2.0)
_UPPER = (1.5, *[1.0] * 12, 1.5)
_HOME = (1.75, *[1.0] * 11, 2.25)
_LOWER = (2.25, *[1.0] * 10, 2.75)
_LAST_ROWS = (
    (1.25, 1.0, 1.25, 5.0, 1.25, 1.25, 1.0),
    (1.0, 1.0, 1.0, 1.25, 5.25, 1.25, 1.25),
    (1.5, 1.5, 1.5, 4.5, 1.5, 1.5),
    (1.0, 1.0, 1.25, 1.25, 4.0, 1.25, 1.25, 1.0),
)
_WIDTH = 15.0
_PAD = 4.25  # units that a number pad adds, the space before it included


@dataclass(frozen=True)
class Keyboard:
    """A keyboard's shape. Lengths in metres.

    Attributes:
        pitch: (across, along) from one key to the next.
        gap: between two keys.
        taper: by how much a key's top is smaller than its foot, on each side.
        corner: radius of the keys' corners; 0 makes them square.
        function_row: depth of the rearmost row, as a part of the pitch; 0 leaves it out.
        function_keys: how many keys it has.
        last_row: which of the layouts of the front row.
        big_enter: an L-shaped enter key over two rows.
        number_pad: four more columns on the right.
    """

    pitch: tuple[float, float]
    gap: float
    taper: float
    corner: float
    function_row: float
    function_keys: int
    last_row: int
    big_enter: bool
    number_pad: bool

    @property
    def size(self) -> tuple[float, float]:
        """Width and depth of the whole field of keys."""
        across = _WIDTH + (_PAD if self.number_pad else 0.0)
        return across * self.pitch[0], (5.0 + self.function_row) * self.pitch[1]

    def solids(self, left: float, rear: float, z0: float, z1: float) -> list[Solid]:
        """Build all keys between heights `z0` and `z1`; the field's corner is at (left, rear)."""
        keys = _letter_block(self)
        if self.number_pad:
            keys += _number_pad(self.function_row)
        p, q = self.pitch
        shapes = [
            self._key((left + x0 * p, rear - y1 * q), (left + x1 * p, rear - y0 * q), z0, z1)
            for x0, x1, y0, y1 in keys
        ]
        if self.big_enter:
            shapes.append(self._enter(left, rear, z0, z1))
        return shapes

    def _key(
        self, low: tuple[float, float], high: tuple[float, float], z0: float, z1: float
    ) -> Solid:
        center = np.add(low, high) / 2
        width, depth = np.subtract(high, low) - self.gap
        sizes = [(width - 2 * inset, depth - 2 * inset) for inset in (0.0, self.taper)]
        if self.corner > 0.0:
            outlines = [rounded_rectangle(*size, self.corner, center, 1) for size in sizes]
        else:
            outlines = [rectangle(*size, center) for size in sizes]
        return stack(outlines, (z0, z1))

    def _enter(self, left: float, rear: float, z0: float, z1: float) -> Solid:
        p, q = self.pitch
        h = self.gap / 2
        wide, narrow, right = left + 13.5 * p + h, left + 13.75 * p + h, left + 15.0 * p - h
        top = rear - (self.function_row + 1.0) * q - h
        step, bottom = top - q + self.gap, top - 2 * q + self.gap
        outline = [
            (narrow, bottom),
            (right, bottom),
            (right, top),
            (wide, top),
            (wide, step),
            (narrow, step),
        ]
        return prism(np.array(outline), z0, z1)


_Key = tuple[float, float, float, float]
"""Left, right, rear and front edge in units, counted from the rear left corner."""


def _row(widths: tuple[float, ...], rear: float, depth: float = 1.0) -> list[_Key]:
    edges = np.concatenate([[0.0], np.cumsum(widths)])
    return [(a, b, rear, rear + depth) for a, b in pairwise(edges)]


def _letter_block(board: Keyboard) -> list[_Key]:
    f = board.function_row
    keys = _row((_WIDTH / board.function_keys,) * board.function_keys, 0.0, f) if f > 0.0 else []
    upper, home = (_UPPER[:-1], (*_HOME[:-1], 1.0)) if board.big_enter else (_UPPER, _HOME)
    for k, widths in enumerate((_NUMBERS, upper, home, _LOWER, _LAST_ROWS[board.last_row])):
        keys += _row(widths, f + k)
    rear, middle, front = f + 4, f + 4.5, f + 5
    return [
        *keys,
        (12.0, 13.0, middle, front),
        (13.0, 14.0, rear, middle),
        (13.0, 14.0, middle, front),
        (14.0, 15.0, middle, front),
    ]


def _number_pad(f: float) -> list[_Key]:
    columns = [_WIDTH + _PAD - 4.0 + k for k in range(4)]
    keys = [(x, x + 1.0, f + r, f + r + 1.0) for r in range(5) for x in columns[:3]]
    keys = [key for key in keys if not (key[2] == f + 4 and key[0] == columns[1])]
    keys[-2] = (columns[0], columns[1] + 1.0, f + 4, f + 5)
    x = columns[3]
    keys += [(x, x + 1.0, f, f + 1), (x, x + 1.0, f + 1, f + 3), (x, x + 1.0, f + 3, f + 5)]
    if f > 0.0:
        keys += [(x, x + 1.0, 0.0, f) for x in columns]
    return keys
