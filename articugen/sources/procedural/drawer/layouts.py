"""What pieces of furniture with three drawers there are, and how their fronts are divided."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

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
    kneehole: float = 0.0


def _rows(*shares: float, of: tuple["Split | Kind", ...]) -> Split:
    return Split("rows", shares, of)


def _columns(*shares: float, of: tuple["Split | Kind", ...]) -> Split:
    return Split("columns", shares, of)


def _chest(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    grow = u(1.0, 1.45)
    size = (u(0.45, 1.0), u(0.38, 0.52), u(0.6, 0.9))
    return Layout(size, _rows(1.0, grow, grow**2, of=("drawer",) * 3), _ANY)


def _nightstand(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.38, 0.5), u(0.34, 0.42), u(0.55, 0.72))
    return Layout(size, _rows(1.0, 1.0, 1.0, of=("drawer",) * 3), _ANY)


def _tower(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.3, 0.42), u(0.36, 0.45), u(0.85, 1.15))
    cells = _rows(u(1.0, 1.8), 1.0, 1.0, 1.0, of=("shelf", "drawer", "drawer", "drawer"))
    return Layout(size, cells, _ANY)


def _bedside_with_shelf(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.42, 0.7), u(0.38, 0.46), u(0.6, 0.85))
    cells = _rows(1.0, 1.0, 1.0, u(1.0, 1.7), of=("drawer", "drawer", "drawer", "shelf"))
    return Layout(size, cells, _ANY)


def _pedestal(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.38, 0.46), u(0.48, 0.58), u(0.5, 0.65))
    cells = _rows(0.55, 1.0, u(1.2, 2.0), of=("drawer", "drawer", "drawer"))
    return Layout(size, cells, ("casters", "floor"))


def _console(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(1.0, 1.35), u(0.36, 0.48), u(0.62, 0.82))
    cells = _columns(1.0, u(0.8, 1.6), 1.0, of=("drawer",) * 3)
    return Layout(size, cells, ("tall", "tall_round"))


def _low_console(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(1.0, 1.4), u(0.38, 0.48), u(0.36, 0.52))
    cells = _columns(1.0, u(0.8, 1.4), 1.0, of=("drawer",) * 3)
    return Layout(size, cells, ("legs", "splayed", "sled", "plinth"))


def _one_over_two(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.75, 1.05), u(0.4, 0.5), u(0.55, 0.75))
    pair = _columns(1.0, 1.0, of=("drawer", "drawer"))
    order = ("drawer", pair) if u() < 0.5 else (pair, "drawer")
    return Layout(size, _rows(1.0, u(1.0, 1.5), of=order), _ANY)


def _media(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(1.1, 1.5), u(0.38, 0.48), u(0.42, 0.6))
    middle = _rows(1.0, 1.0, of=("shelf", "drawer"))
    cells = _columns(1.0, u(1.0, 1.6), 1.0, of=("drawer", middle, "drawer"))
    return Layout(size, cells, ("legs", "splayed", "sled", "plinth", "floor"))


def _door_beside(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.75, 1.1), u(0.38, 0.5), u(0.6, 0.85))
    three = _rows(1.0, 1.0, u(1.0, 1.4), of=("drawer",) * 3)
    pair = ("door", three) if u() < 0.5 else (three, "door")
    return Layout(size, _columns(1.0, 1.0, of=pair), _ANY)


def _sideboard(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(1.0, 1.35), u(0.4, 0.48), u(0.72, 0.88))
    drawers = _columns(1.0, 1.0, 1.0, of=("drawer",) * 3)
    doors = _columns(1.0, 1.0, of=("door", "door")) if u() < 0.6 else "shelf"
    return Layout(size, _rows(1.0, u(1.7, 2.4), of=(drawers, doors)), _ANY)


def _shelves_beside(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.9, 1.3), u(0.34, 0.44), u(0.6, 0.85))
    three = _rows(1.0, 1.0, 1.0, of=("drawer",) * 3)
    shelves = _rows(1.0, u(1.0, 1.5), of=("shelf", "shelf"))
    return Layout(size, _columns(1.0, u(0.8, 1.4), of=(three, shelves)), _ANY)


def _checkered(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(0.7, 1.0), u(0.36, 0.45), u(0.6, 0.9))
    left = _rows(1.0, u(0.8, 1.3), of=("drawer", "drawer"))
    right = _rows(1.0, u(0.8, 1.3), of=("shelf", "drawer"))
    return Layout(size, _columns(1.0, u(0.7, 1.3), of=(left, right)), _ANY)


def _desk(rng: np.random.Generator) -> Layout:
    u = rng.uniform
    size = (u(1.0, 1.35), u(0.5, 0.6), u(0.72, 0.78))
    cells = _rows(1.0, 1.0, u(1.0, 2.0), of=("drawer",) * 3)
    return Layout(size, cells, ("legs", "floor"), kneehole=u(0.55, 0.66))


_ANY = ("plinth", "legs", "legs_round", "splayed", "sled", "floor", "brackets", "tall")

LAYOUTS: tuple[Callable[[np.random.Generator], Layout], ...] = (
    _chest,
    _nightstand,
    _tower,
    _bedside_with_shelf,
    _pedestal,
    _console,
    _low_console,
    _one_over_two,
    _media,
    _door_beside,
    _sideboard,
    _shelves_beside,
    _checkered,
    _desk,
)
