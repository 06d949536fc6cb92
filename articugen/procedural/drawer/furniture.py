"""The fixed body of a piece of furniture: its boards and compartments, its legs, its top."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from articugen.core.geometry import rotation_about, transform
from articugen.core.portable import total
from articugen.procedural.drawer.layouts import Kind, Layout, Split
from articugen.procedural.kit.outlines import circle, rectangle
from articugen.procedural.kit.parts import Rect, plank, rod, tapered
from articugen.procedural.kit.solids import Solid, along_y, block, box, prism, ring, stack


@dataclass(frozen=True)
class Cell:
    """One compartment.

    Attributes:
        opening: the free space between the boards.
        front: up to the middle of the boards, or to the carcass's edge: what a front may cover.
        edge: the thickness of the thinnest board around it.
    """

    kind: Kind
    opening: Rect
    front: Rect
    edge: float


@dataclass(frozen=True)
class Carcass:
    """The body's box: `outer` seen from the front, x from `x0` to `x1`; thicknesses of its boards
    (`board`) and of its back."""

    outer: Rect
    x0: float
    x1: float
    board: float
    back: float


def divided(
    node: "Split | Kind", opening: Rect, front: Rect, carcass: Carcass
) -> tuple[list[Cell], list[Solid]]:
    """Build the compartments of an opening, whose `front` is as that of a `Cell`, top left first,
    and the boards between them."""
    if isinstance(node, str):
        return [Cell(node, opening, front, carcass.board)], []
    rows, board = node.way == "rows", carcass.board
    free = (opening.height if rows else opening.width) - board * (len(node.shares) - 1)
    sizes = np.array(node.shares) * (free / total(node.shares))
    cells, boards = [], []
    at, near = (opening.z1, front.z1) if rows else (opening.y0, front.y0)
    step = -1.0 if rows else 1.0
    for k, (size, child) in enumerate(zip(sizes, node.children, strict=True)):
        end = at + step * size
        last = k == len(sizes) - 1
        far = (front.z0 if rows else front.y1) if last else end + step * board / 2
        piece, covered = _between(opening, rows, at, end), _between(front, rows, near, far)
        more_cells, more_boards = divided(child, piece, covered, carcass)
        cells, boards = cells + more_cells, boards + more_boards
        at, near = end + step * board, far
        if not last:
            boards.append(plank(_between(opening, rows, end, at), carcass.x0, carcass.x1))
    return cells, boards


def _between(rect: Rect, rows: bool, a: float, b: float) -> Rect:
    """Return the part of a rectangle between two heights, or else between two y."""
    a, b = min(a, b), max(a, b)
    return Rect(rect.y0, a, rect.y1, b) if rows else Rect(a, rect.z0, b, rect.z1)


def shell(rng: np.random.Generator, carcass: Carcass, layout: Layout) -> list[Solid]:
    """Sides, floor, ceiling and back; some sides are frames around a thinner panel, or posts."""
    o, t, x0, x1 = carcass.outer, carcass.board, carcass.x0, carcass.x1
    inner = o.shrunk(t)
    solids = [
        box((x0, inner.y0, o.z0), (x1, inner.y1, o.z0 + t)),
        box((x0, inner.y0, inner.z1), (x1, inner.y1, o.z1)),
        box((x0, inner.y0, inner.z0), (x0 + carcass.back, inner.y1, inner.z1), panel=True),
    ]
    framed = rng.uniform() < 0.35
    if layout.lidless:
        solids[1] = box((x0, inner.y0, inner.z1), (x0 + 4 * t, inner.y1, o.z1))
        solids.append(box((x1 - 4 * t, inner.y0, inner.z1), (x1, inner.y1, o.z1)))
    if layout.bare:
        x, y, z = (x0, x1 - 2 * t), ((o.y0, inner.y0), (inner.y1, o.y1)), (o.z0, o.z1)
        return [*solids, *(box((a, b, z[0]), (a + 2 * t, c, z[1])) for a in x for b, c in y)]
    for y0, y1, outward in ((o.y0, inner.y0, -1), (inner.y1, o.y1, 1)):
        if not framed:
            solids.append(box((x0, y0, o.z0), (x1, y1, o.z1)))
            continue
        outer = np.array([(o.z0, x0), (o.z1, x0), (o.z1, x1), (o.z0, x1)])
        bar = 0.16 * min(o.height, x1 - x0)
        hole = outer + bar * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
        solids.append(along_y(ring(outer, hole, y0, y1)))
        a, b = (y0 + 0.3 * t, y1) if outward < 0 else (y0, y1 - 0.3 * t)
        solids.append(box((x0 + bar, a, o.z0 + bar), (x1 - bar, b, o.z1 - bar)))
    return solids


def top(
    rng: np.random.Generator,
    layout: Layout,
    carcass: Carcass,
    slab: float,
    front: float,
    bow: float,
) -> list[Solid]:
    """Return the slab on top, `slab` thick; it reaches at least `front` over the carcass's front
    edge."""
    width, _, height = layout.size
    side = float(rng.choice([0.0, 0.6, 1.2])) * carcass.board + layout.overhang
    reach = front + float(rng.choice([0.0, 0.4, 1.0])) * carcass.board
    low = (carcass.x0, -width / 2 - side, height - slab)
    high = (carcass.x1 + reach, width / 2 + side, height)
    if bow > 0.0:
        y = np.linspace(low[1], high[1], 16)
        arc = np.stack([high[0] + bow * (1.0 - (2.0 * y / (high[1] - low[1])) ** 2), y], axis=1)
        outline = np.concatenate([[(low[0], low[1])], arc, [(low[0], high[1])]])
        solids = [prism(outline, low[2], high[2])]
    else:
        bevel = float(rng.choice([0.05, 0.2, 0.4])) * slab
        radius = float(rng.choice([0.0, 1.0])) * carcass.board
        solids = [block(low, high, radius=radius, bevel=(bevel, bevel), segments=4)]
    if rng.uniform() < 0.2:
        rail = rng.uniform(1.5, 4.0) * carcass.board
        far = (low[0] + carcass.board, width / 2, height + rail)
        solids.append(block((low[0], -width / 2, height), far, bevel=(0.0, 0.2 * carcass.board)))
    return solids


def support(rng: np.random.Generator, layout: Layout, board: float) -> tuple[list[Solid], float]:
    """Build the feet or plinth of the carcass, and return the height of its floor."""
    width, depth, height = layout.size
    kind = str(rng.choice(layout.supports))
    y0 = -width / 2 + layout.kneehole * width
    foot = Rect(-depth / 2, y0, depth / 2, width / 2)  # (x, y) instead of (y, z)
    built, share = _SUPPORTS[kind]
    lift = share * height * rng.uniform(0.85, 1.25)
    if kind.startswith("high"):
        rows = 2.0 if layout.kneehole else 1.0  # of drawers into which a hand must get
        lift = min(lift, height - (2.5 + 2.5 * rows) * board - 0.04 * rows)
    solids = built(foot, lift, board)
    if layout.kneehole > 0.0:
        x, y = depth / 2, -width / 2
        solids.append(box((-x, y, 0.0), (x, y + 1.2 * board, height - board)))
        beam = y0 + 0.5 * board
        solids.append(box((-x, y + board, 0.5 * height), (board - x, beam, height - board)))
    return solids, lift


def _corners(foot: Rect, inset: float) -> list[tuple[float, float, float, float]]:
    """Return (x, y, outward x, outward y) of four places, `inset` from the sides."""
    x, y = foot.center
    a, b = foot.width / 2 - inset, foot.height / 2 - inset
    return [(x + i * a, y + j * b, i, j) for i in (-1, 1) for j in (-1, 1)]


def _plinth(foot: Rect, lift: float, board: float) -> list[Solid]:
    inner = foot.shrunk(board)
    return [box((inner.y0, inner.z0, 0.0), (inner.y1, inner.z1, lift))]


def _floor(foot: Rect, lift: float, board: float) -> list[Solid]:
    return [
        tapered((board, 1.1 * board), (0.0, lift)).shifted(x, y)
        for x, y, _, _ in _corners(foot, 1.8 * board)
    ]


def _legs(foot: Rect, lift: float, board: float) -> list[Solid]:
    wide = 1.1 * board
    solids = []
    for x, y, i, j in _corners(foot, wide):
        square = rectangle(2 * wide, 2 * wide)
        tip = 0.55 * square + (0.45 * wide * i, 0.45 * wide * j)
        solids.append(stack([tip, square], (0.0, lift)).shifted(x, y))
    return solids


def _legs_round(foot: Rect, lift: float, board: float) -> list[Solid]:
    radii = np.array((0.7, 0.75, 1.2, 1.0, 0.7, 1.15, 1.15)) * board
    heights = np.array((0.0, 0.08, 0.35, 0.6, 0.7, 0.85, 1.0)) * lift
    return [tapered(radii, heights).shifted(x, y) for x, y, _, _ in _corners(foot, 1.5 * board)]


def _splayed(foot: Rect, lift: float, board: float) -> list[Solid]:
    solids = []
    for x, y, i, j in _corners(foot, 0.3 * min(foot.width, foot.height)):
        out = np.array((i, j)) * 0.22 * lift
        tip, head = circle(0.6 * board, 14, out), circle(1.1 * board, 14)
        solids.append(stack([tip, head], (0.0, lift)).shifted(x, y))
    return solids


def _sled(foot: Rect, lift: float, board: float) -> list[Solid]:
    r = 0.45 * board
    solids = []
    for y in (foot.z0 + 4 * r, foot.z1 - 4 * r):
        a, b = foot.y0 + 2 * r, foot.y1 - 2 * r
        for x in (a, b):
            solids.append(box((x - r, y - r, 0.0), (x + r, y + r, lift)))
        solids.append(box((a, y - r, 0.0), (b, y + r, 2 * r)))
    return solids


def _brackets(foot: Rect, lift: float, board: float) -> list[Solid]:
    """Feet cut from a board that runs around the corners."""
    reach, t = 0.2 * min(foot.width, foot.height), 1.1 * board
    profile = np.array([(0, 0), (0.45, 0), (0.6, 0.45), (1.0, 0.8), (1.0, 1.0), (0, 1.0)])
    solids = []
    for x, y, i, j in _corners(foot, 0.0):
        side = along_y(prism(profile[:, ::-1][::-1] * (lift, reach), 0.0, t))
        across = side.mirrored(1).moved(_QUARTER_TURN)
        for solid in (side, across):
            flipped = solid if i < 0 else solid.mirrored(0)
            flipped = flipped if j < 0 else flipped.mirrored(1)
            solids.append(flipped.shifted(x, y))
    return solids


_QUARTER_TURN = transform(rotation_about((0, 0, 1), np.pi / 2).round())  # turns x to y, about z


def _casters(foot: Rect, lift: float, board: float) -> list[Solid]:
    solids = []
    r = 0.42 * lift
    for x, y, _, _ in _corners(foot, 1.2 * r):
        half = max(0.35 * r, 0.5 * board)
        wheel = along_y(prism(circle(r, 18), -half, half))
        # A polygon reaches its circle at its vertices alone, and none of them is lowest.
        solids += [
            wheel.shifted(x, y, -wheel.vertices[:, 2].min()),
            rod([(x, y, r), (x, y, lift)], max(0.3 * r, 0.4 * board)),
        ]
    return solids


def _tall(foot: Rect, lift: float, board: float) -> list[Solid]:
    """Square legs with a shelf between them."""
    inner = foot.shrunk(board)
    z = 0.25 * lift
    shelf = box((inner.y0, inner.z0, z), (inner.y1, inner.z1, z + board))
    return [*_legs(foot, lift, board), shelf]


def _tall_round(foot: Rect, lift: float, board: float) -> list[Solid]:
    """Turned legs, two stretchers and a bar between them."""
    solids = _legs_round(foot, lift, board)
    inset, r = 1.5 * board, 0.6 * board
    z = max(0.16 * lift, r)
    a, b = foot.y0 + inset, foot.y1 - inset
    for y in (foot.z0 + inset, foot.z1 - inset):
        solids.append(rod([(a, y, z), (b, y, z)], r))
    x = (a + b) / 2
    return [*solids, rod([(x, foot.z0 + inset, z), (x, foot.z1 - inset, z)], r)]


_SUPPORTS: dict[str, tuple[Callable[[Rect, float, float], list[Solid]], float]] = {
    "plinth": (_plinth, 0.1),
    "floor": (_floor, 0.02),
    "legs": (_legs, 0.2),
    "legs_round": (_legs_round, 0.2),
    "splayed": (_splayed, 0.26),
    "sled": (_sled, 0.2),
    "brackets": (_brackets, 0.12),
    "casters": (_casters, 0.1),
    "tall": (_tall, 0.42),
    "tall_round": (_tall_round, 0.6),
    "high": (_legs, 0.78),
    "high_round": (_legs_round, 0.78),
    "high_shelf": (_tall, 0.78),
    "high_bars": (_tall_round, 0.78),
}
"""What stands on the floor, and how high it lifts the carcass, part of the whole height."""
