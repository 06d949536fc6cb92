"""What pieces of furniture with drawers there are, and how their fronts are divided."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from articugen.procedural.kit.ranges import Either, Range, draw

Kind = Literal["drawer", "shelf", "door", "blank"]


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
    """Purpose of a piece of furniture.

    Attributes:
        size: (width, depth, height), metres.
        cells: how the front is divided.
        supports: names in `_SUPPORTS` that suit it.
        kneehole: the part of the width that is left open at one side: a desk.
        overhang: how far the top reaches over each side, metres.
        bare: posts at the corners stand for the sides.
        lidless: there is no top, as of cabinets that a worktop will cover.
    """

    size: tuple[float, float, float]
    cells: Split
    supports: tuple[str, ...]
    kneehole: float
    overhang: float = 0.0
    bare: bool = False
    lidless: bool = False


def draw_layout(rng: np.random.Generator, *, varied: bool = False) -> Layout:
    """Draw the layout of any of the pieces with three drawers; of any at all where it may be
    varied, half of them tables."""
    pieces = _PIECES
    if varied:
        pieces = _TABLES if rng.uniform() < 0.5 else _PIECES[::2] + _WITH_FEWER + _DEEP
    piece = pieces[rng.integers(len(pieces))]
    growth = draw(rng, piece.growth)
    width, depth, height = (draw(rng, side) for side in piece.size)
    cells = piece.cells.drawn(rng, growth)
    layout = Layout((width, depth, height), cells, piece.supports, draw(rng, piece.kneehole))
    if not varied:
        return layout
    over = rng.uniform(0.0, piece.overhang) * width
    bare, lidless = (bool(rng.uniform() < share) for share in (piece.bare, piece.lidless))
    return replace(layout, overhang=over, bare=bare, lidless=lidless)


@dataclass(frozen=True)
class _Cut:
    """A `Split` to be drawn: each share, child and whether the children change places."""

    way: Literal["rows", "columns"]
    shares: tuple[float | Range, ...]
    children: tuple["_Cut | Either | Kind", ...]
    swap: Either | bool = False

    def drawn(self, rng: np.random.Generator, growth: float = 1.0) -> Split:
        """Return the split; each of its children is `growth` times as large as the one before."""
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
    much larger each drawer is than the one above, `overhang` the most of the width, `bare` and
    `lidless` how many are."""

    size: tuple[Range, Range, Range]
    cells: _Cut
    supports: tuple[str, ...] = (
        "plinth", "legs", "legs_round", "splayed", "sled", "floor", "brackets", "tall"
    )  # fmt: skip
    kneehole: Range | float = 0.0
    growth: Range | float = 1.0
    overhang: float = 0.0
    bare: float = 0.0
    lidless: float = 0.0


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
"""Those with three drawers, the number of moving parts that PPD's drawers have."""

_DOORS = Either(0.5, "door", _columns((1, 1), ("door", "door")))
_BELOW = Either(0.7, _DOORS, "shelf")
_TWO = _THREE[:2]
_ON_THE_FLOOR = ("plinth", "floor", "brackets", "legs")

# fmt: off
_WITH_FEWER = (
    _Piece(((0.4, 0.85), (0.4, 0.6), (0.65, 0.95)),  # a drawer over a door or two
           _rows(((0.25, 0.6), 1), ("drawer", _BELOW)), _ON_THE_FLOOR),
    _Piece(((0.45, 0.95), (0.35, 0.55), (0.55, 0.85)),  # a table
           _rows((1,), ("drawer",)), ("tall", "tall_round")),
    _Piece(((0.45, 0.8), (0.4, 0.6), (0.35, 0.55)),  # a bedside box
           _rows((1, (0.5, 1.2)), ("drawer", Either(0.6, "door", "shelf")), _ANY_ORDER),
           (*_LOW, "floor")),
    _Piece(((0.35, 0.5), (0.36, 0.5), (0.8, 1.2)),  # a tower
           _rows((1, (1.0, 3.0)), ("drawer", Either(0.5, "door", _rows((1, 1), ("shelf",) * 2))),
                 _ANY_ORDER), _ON_THE_FLOOR),
    _Piece(((0.38, 0.65), (0.42, 0.6), (0.5, 0.75)),  # for files
           _rows((1, (1.0, 1.4)), _TWO), ("casters", *_ON_THE_FLOOR)),
    _Piece(((0.45, 0.85), (0.4, 0.58), (0.7, 0.95)),  # two drawers over doors
           _rows((1, 1, (1.2, 2.8)), (*_TWO, _BELOW)), _ON_THE_FLOOR),
    _Piece(((0.75, 1.2), (0.4, 0.58), (0.7, 0.95)),  # two side by side over doors
           _rows((1, (1.2, 3.0)), (_columns((1, 1), _TWO), _BELOW)), _ON_THE_FLOOR),
    _Piece(((0.8, 1.3), (0.34, 0.45), (0.65, 0.85)),  # a console
           _columns((1, (0.8, 1.25)), _TWO), ("tall", "tall_round")),
    _Piece(((1.1, 1.5), (0.38, 0.48), (0.4, 0.6)),  # for a television
           _columns((1, (1.0, 1.6), 1), ("drawer", Either(0.5, "shelf", "door"), "drawer")),
           (*_LOW, "floor")),
    _Piece(((0.75, 1.1), (0.38, 0.5), (0.55, 0.85)),  # a door beside a drawer or two
           _columns((1, 1), ("door", Either(0.5, _rows((1, 1), _TWO),
                                            _rows((1, (0.8, 1.6)), ("drawer", "shelf")))),
                    _ANY_ORDER), _ON_THE_FLOOR),
    _Piece(((1.0, 1.35), (0.5, 0.6), (0.72, 0.78)),  # a desk
           _rows((1, (1.0, 2.5)), ("drawer", Either(0.5, "drawer", "door"))), ("legs", "floor"),
           kneehole=(0.55, 0.66)),
)
# fmt: on
"""Those with one or two."""

_HIGH = ("high", "high", "high_round", "high_shelf", "high_bars")
_ROW = partial(_columns, children=("blank", "drawer", "blank"))

# fmt: off
_TABLES = (
    _Piece(((0.4, 0.95), (0.35, 0.8), (0.5, 0.85)),  # one drawer from leg to leg
           _rows((1,), ("drawer",)), _HIGH, overhang=0.1, bare=0.3),
    *(_Piece(((0.45, wide), (0.4, 0.9), (0.6, 0.85)),  # one drawer in the middle
             _ROW(shares=((0.15, 0.8), 1, (0.15, 0.8))), _HIGH, overhang=0.1)
      for wide in (1.7, 0.9)),
    *(_Piece(((0.9, 1.8), (0.4, 0.9), (low, 0.8)), _columns((1, (0.8, 1.25)), _TWO), _HIGH,
             overhang=0.08, bare=0.2)
      for low in (0.4, 0.6)),
    *(_Piece(((1.1, 1.9), (0.4, 0.9), (0.6, 0.8)), _columns((1, (0.8, wide), 1), _THREE), _HIGH,
             overhang=0.08)
      for wide in (1.2, 2.5)),
    _Piece(((0.9, 1.8), (0.4, 0.9), (0.5, 0.85)),  # in a row, away from the legs
           _columns(((0.2, 0.7), 1, 1, (0.2, 0.7)), ("blank", *_TWO, "blank")), _HIGH,
           overhang=0.1),
    _Piece(((1.2, 2.0), (0.4, 0.8), (0.6, 0.85)), _columns((1,) * 4, ("drawer",) * 4), _HIGH,
           overhang=0.06),
    _Piece(((1.1, 1.9), (0.45, 0.9), (0.65, 0.8)),  # drawers at both ends
           _columns((1, (0.8, 2.5), 1), ("drawer", "blank", "drawer")), _HIGH, overhang=0.08),
    _Piece(((1.0, 1.8), (0.5, 0.9), (0.65, 0.8)),  # in a hanging pedestal
           _rows((1, (1.0, 1.6)), _TWO), ("high", "legs"), kneehole=(0.55, 0.75)),
    _Piece(((0.4, 0.7), (0.4, 0.7), (0.4, 0.65)),  # at a bed or a sofa
           _rows((1,), ("drawer",)), ("tall", "high_shelf", "high"), overhang=0.08, bare=0.5),
)
"""Desks, side tables and consoles with shallow drawers under their tops."""

_DEEP = (
    _Piece(((0.4, 0.7), (0.4, 0.7), (0.35, 0.7)),  # cubes
           _rows(((0.4, 1.2), 1), ("drawer", Either(0.5, "blank", "drawer"))),
           ("floor", "plinth"), lidless=0.2),
    _Piece(((0.5, 1.0), (0.5, 0.66), (0.7, 0.95)),  # for a kitchen
           _rows(((0.25, 0.5), 1), ("drawer", _BELOW)), ("plinth",), lidless=0.5),
    _Piece(((0.3, 0.6), (0.5, 0.66), (0.7, 0.95)), _rows((1, 1, 1, 1), ("drawer",) * 4),
           ("plinth", "floor"), growth=(1.0, 1.3), lidless=0.4),
    _Piece(((0.5, 1.0), (0.35, 0.55), (0.8, 1.3)), _rows((1,) * 4, ("drawer",) * 4),  # tallboys
           growth=(1.0, 1.2)),
    _Piece(((0.9, 1.6), (0.4, 0.55), (0.6, 1.0)),  # two banks
           _columns((1, 1), (_rows((1, 1), _TWO), _rows((1, 1), _TWO)))),
    _Piece(((0.9, 1.4), (0.4, 0.6), (0.3, 0.6)),  # small drawers at both ends
           _columns((1, (3.0, 7.0), 1),
                    (_rows((1, 1), _TWO), Either(0.6, "shelf", "blank"), _rows((1, 1), _TWO)))),
)
# fmt: on
"""Cabinets as deep as they are wide, and those with four drawers: PPD has no more sliding parts."""
