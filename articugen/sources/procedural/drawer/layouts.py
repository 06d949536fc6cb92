"""What pieces of furniture with three drawers there are, and how their fronts are divided."""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from articugen.sources.procedural.kit.ranges import Either, Range, draw

Kind = Literal["drawer", "shelf", "door"]


@dataclass(frozen=True)
class Split:
    """Compartments one above the other (rows, top first) or side by side (columns).

    Attributes:
        shares: the relative size of each child.
    """

    way: Literal["rows", "columns"]
    shares: tuple[float, ...]
    children: tuple["Split | Kind", ...]


@dataclass(frozen=True)
class Layout:
    """What a piece is for.

    Attributes:
        size: (width, depth, height), metres.
        cells: how the front is divided; exactly three compartments are drawers.
        supports: names in `_SUPPORTS` that suit it.
        kneehole: the part of the width that is left open at one side: a desk.
    """

    size: tuple[float, float, float]
    cells: Split
    supports: tuple[str, ...]
    kneehole: float


def draw_layout(rng: np.random.Generator) -> Layout:
    """The layout of any of the pieces."""
    piece = _PIECES[rng.integers(len(_PIECES))]
    growth = draw(rng, piece.growth)
    width, depth, height = (draw(rng, side) for side in piece.size)
    cells = piece.cells.drawn(rng, growth)
    return Layout((width, depth, height), cells, piece.supports, draw(rng, piece.kneehole))


@dataclass(frozen=True)
class _Cut:
    """A `Split` to be drawn: each share, child and whether the children change places."""

    way: Literal["rows", "columns"]
    shares: tuple[float | Range, ...]
    children: tuple["_Cut | Either | Kind", ...]
    swap: Either | bool = False

    def drawn(self, rng: np.random.Generator, growth: float = 1.0) -> Split:
        """The split; each of its children is `growth` times as large as the one before."""
        kinds = [draw(rng, child) for child in self.children]
        children = [kind.drawn(rng) if isinstance(kind, _Cut) else kind for kind in kinds]
        if draw(rng, self.swap):
            children.reverse()
        shares = tuple(draw(rng, share) * growth**k for k, share in enumerate(self.shares))
        return Split(self.way, shares, tuple(children))


_rows, _columns = partial(_Cut, "rows"), partial(_Cut, "columns")


@dataclass(frozen=True)
class _Piece:
    """The ranges of one piece: its (width, depth, height), and as in `Layout`; `growth` is how
    much larger each drawer is than the one above."""

    size: tuple[Range, Range, Range]
    cells: _Cut
    supports: tuple[str, ...] = (
        "plinth", "legs", "legs_round", "splayed", "sled", "floor", "brackets", "tall"
    )  # fmt: skip
    kneehole: Range | float = 0.0
    growth: Range | float = 1.0


_THREE: tuple[Kind, ...] = ("drawer", "drawer", "drawer")
_LOW = ("legs", "splayed", "sled", "plinth")
_ANY_ORDER = Either(0.5, False, True)

# fmt: off
_PIECES = (
    _Piece(((0.45, 1.0), (0.38, 0.52), (0.6, 0.9)),  # a chest
           _rows((1, 1, 1), _THREE), growth=(1.0, 1.45)),
    _Piece(((0.38, 0.5), (0.34, 0.42), (0.55, 0.72)),  # a nightstand
           _rows((1, 1, 1), _THREE)),
    _Piece(((0.3, 0.42), (0.36, 0.45), (0.85, 1.15)),  # a tower, open above
           _rows(((1.0, 1.8), 1, 1, 1), ("shelf", *_THREE))),
    _Piece(((0.42, 0.7), (0.38, 0.46), (0.6, 0.85)),  # a nightstand, open below
           _rows((1, 1, 1, (1.0, 1.7)), (*_THREE, "shelf"))),
    _Piece(((0.38, 0.46), (0.48, 0.58), (0.5, 0.65)),  # an office pedestal
           _rows((0.55, 1, (1.2, 2.0)), _THREE), ("casters", "floor")),
    _Piece(((1.0, 1.35), (0.36, 0.48), (0.62, 0.82)),  # a console
           _columns((1, (0.8, 1.6), 1), _THREE), ("tall", "tall_round")),
    _Piece(((1.0, 1.4), (0.38, 0.48), (0.36, 0.52)),  # a low console
           _columns((1, (0.8, 1.4), 1), _THREE), _LOW),
    _Piece(((0.75, 1.05), (0.4, 0.5), (0.55, 0.75)),  # one over two, or two over one
           _rows((1, (1.0, 1.5)), ("drawer", _columns((1, 1), _THREE[:2])), _ANY_ORDER)),
    _Piece(((1.1, 1.5), (0.38, 0.48), (0.42, 0.6)),  # for a television
           _columns((1, (1.0, 1.6), 1), ("drawer", _rows((1, 1), ("shelf", "drawer")), "drawer")),
           (*_LOW, "floor")),
    _Piece(((0.75, 1.1), (0.38, 0.5), (0.6, 0.85)),  # a door beside drawers
           _columns((1, 1), ("door", _rows((1, 1, (1.0, 1.4)), _THREE)), _ANY_ORDER)),
    _Piece(((1.0, 1.35), (0.4, 0.48), (0.72, 0.88)),  # a sideboard
           _rows((1, (1.7, 2.4)), (_columns((1, 1, 1), _THREE),
                                   Either(0.6, _columns((1, 1), ("door", "door")), "shelf")))),
    _Piece(((0.9, 1.3), (0.34, 0.44), (0.6, 0.85)),  # shelves beside drawers
           _columns((1, (0.8, 1.4)), (_rows((1, 1, 1), _THREE),
                                      _rows((1, (1.0, 1.5)), ("shelf", "shelf"))))),
    _Piece(((0.7, 1.0), (0.36, 0.45), (0.6, 0.9)),  # drawers on both sides, one shelf
           _columns((1, (0.7, 1.3)), (_rows((1, (0.8, 1.3)), ("drawer", "drawer")),
                                      _rows((1, (0.8, 1.3)), ("shelf", "drawer"))))),
    _Piece(((1.0, 1.35), (0.5, 0.6), (0.72, 0.78)),  # a desk
           _rows((1, 1, (1.0, 2.0)), _THREE), ("legs", "floor"), kneehole=(0.55, 0.66)),
)
# fmt: on
