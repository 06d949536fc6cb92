"""Chests, consoles, desks and sideboards with three drawers that slide out along +x; varied ones
have one to four, under table tops or in deep cabinets, too.

A front is cut into compartments: some hold drawers, others are open shelves or doors that do not
open (what they would hide is filled). Every drawer is a hollow box behind a front plate.
"""

from dataclasses import dataclass, replace

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.portable import cos, sin
from articugen.procedural.drawer.furniture import Carcass, Cell, divided, shell, support, top
from articugen.procedural.drawer.layouts import Layout, draw_layout
from articugen.procedural.kit import GAP
from articugen.procedural.kit.model import Model, ModelLink, moving_part
from articugen.procedural.kit.parts import Rect, frame, handle, knob, plank, plate, row
from articugen.procedural.kit.solids import Solid, along_x, box, prism


@dataclass(frozen=True)
class Style:
    """Features that all drawers of one object share.

    Attributes:
        mount: full or partial: the front covers the boards' edges; inset: it fills the opening.
        front: flat, bevel, shaker, raised, slats, bow or slot (a cut-out instead of a pull).
        thickness, wall: of the front plate and of the box's boards.
        bow: how far a bowed front bulges in the middle of the carcass.
        pull: a kind of `knob` or `handle`, or none.
        pulls: on each front.
        length, reach, girth: of a pull; see `handle`.
        level: how high on the front pulls sit, 0.5 in the middle.
        side_height: of the box's boards, part of the opening's height.
        stroke: the upper limit, part of the box's depth.
        deep: the box's depth, part of the room there is.
        box: which of its boards there are: all, no floor, or none behind the front.
    """

    mount: str
    front: str
    thickness: float
    wall: float
    bow: float
    pull: str
    pulls: int
    length: float
    reach: float
    girth: float
    level: float
    side_height: float
    stroke: float
    deep: float = 1.0
    box: str = "all"


MOST_STROKE, MOST_STROKE_VARIED = 0.9, 1.0
"""How far a drawer slides out at most, part of its box's depth."""


def build(rng: np.random.Generator) -> Model:
    """Build one object: links body and drawer_0 to drawer_2."""
    return _built(rng, draw_layout(rng), varied=False)


def build_varied(rng: np.random.Generator) -> Model:
    """Build one with one to four drawers, which may slide all the way out; some are shallow, some
    have no pull or no bottom, or consist of a front alone."""
    return _built(rng, draw_layout(rng, varied=True), varied=True)


def _built(rng: np.random.Generator, layout: Layout, *, varied: bool) -> Model:
    width, depth, height = layout.size
    extent = max(width, height, 1.9 * depth)
    board = rng.uniform(0.017, 0.025) * extent
    style = _style(rng, extent, board, MOST_STROKE_VARIED if varied else MOST_STROKE)
    if varied:
        style = replace(
            style,
            pull="none" if rng.uniform() < 0.2 else style.pull,
            deep=rng.uniform(0.6, 1.0),
            box=str(rng.choice(["all"] * 8 + ["no floor", "none"])),
        )
        board *= rng.uniform(0.6, 1.0)
    legs, lift = support(rng, layout, board)
    slab = rng.uniform(0.9, 1.5) * board
    span = (-width / 2 + layout.kneehole * width, width / 2)
    outer = Rect(span[0], lift, span[1], height - slab)
    carcass = Carcass(outer, -depth / 2, depth / 2, board, 0.0115 * extent)
    overhang = GAP + style.thickness if style.mount != "inset" else 0.0

    cells, boards = divided(layout.cells, outer.shrunk(board), outer, carcass)
    if varied:  # pulls are no higher than half of the lowest front
        lowest = min(cell.opening.height for cell in cells if cell.kind == "drawer")
        style = replace(style, girth=min(style.girth, 0.2 * lowest))
    body = [*shell(rng, carcass, layout), *boards, *legs]
    body += [] if layout.lidless else top(rng, layout, carcass, slab, overhang, style.bow)
    drawers = []
    for cell in cells:
        if cell.kind == "door":
            body += _false_door(cell, carcass, style)
        elif cell.kind == "blank":
            body.append(plank(cell.opening, carcass.x1 - board, carcass.x1))
        elif cell.kind == "drawer":
            solids, length = _drawer(cell, carcass, style)
            at, stroke = (carcass.x1, *cell.opening.center), round(style.stroke * length, 4)
            name, way = f"drawer_{len(drawers)}", (1.0, 0.0, 0.0)
            drawers.append(moving_part(name, "drawer", solids, at, way, stroke, slides=True))
    return Model.of(ModelLink("body", "furniture_body", tuple(body)), drawers)


def _style(rng: np.random.Generator, extent: float, board: float, most_stroke: float) -> Style:
    fronts = ["flat", "flat", "flat", "bevel", "shaker", "shaker", "raised", "slats", "bow", "slot"]
    front = str(rng.choice(fronts))
    mount = str(rng.choice(["full", "partial", "inset"]))
    pulls = ["bar", "bar", "flat", "arch", "cup", "strip", "ball", "mushroom", "plain", "square"]
    pull = str(rng.choice(pulls))
    if front == "slot":
        pull = "none"
    if front == "bow":
        mount, pull = "full", str(rng.choice(["ball", "mushroom", "plain", "cone"]))
    return Style(
        mount=mount,
        front=front,
        thickness=rng.uniform(0.9, 1.25) * board,
        wall=rng.uniform(0.0115, 0.016) * extent,
        bow=rng.uniform(0.05, 0.08) * extent if front == "bow" else 0.0,
        pull=pull,
        pulls=int(rng.integers(1, 3)),
        length=rng.uniform(0.1, 0.22) * extent,
        reach=rng.uniform(0.03, 0.045) * extent,
        girth=rng.uniform(0.0135, 0.019) * extent,
        level=float(rng.choice([0.5, 0.5, 0.68])),
        side_height=rng.uniform(0.6, 0.88),
        stroke=rng.uniform(0.6, most_stroke),
    )


def _front_rect(cell: Cell, style: Style) -> Rect:
    if style.mount == "full":
        return cell.front.shrunk(GAP / 2)
    if style.mount == "partial":
        return cell.opening.shrunk(-0.25 * cell.edge)
    return cell.opening.shrunk(GAP)


def _drawer(cell: Cell, carcass: Carcass, style: Style) -> tuple[list[Solid], float]:
    """Build the solids of a drawer and the depth of its box."""
    front = _front_rect(cell, style)
    x_front = carcass.x1 - style.thickness if style.mount == "inset" else carcass.x1 + GAP
    solids = [*_front(front, x_front, carcass, style), *_pulls(front, x_front, carcass, style)]

    inside = cell.opening.shrunk(2 * GAP)
    y0, y1, z0 = inside.y0, inside.y1, inside.z0
    z1 = z0 + style.side_height * inside.height
    if style.front == "slot":  # The box's front is the plate: it must reach over the walls' edges.
        z1 = min(z1, z0 + 0.7 * inside.height)
    x0, wall = carcass.x0 + carcass.back + 3 * GAP, style.wall
    x0 += (1.0 - style.deep) * (x_front - x0)
    boards = [
        box((x0, y0, z0), (x_front, y0 + wall, z1)),
        box((x0, y1 - wall, z0), (x_front, y1, z1)),
        box((x0, y0 + wall, z0), (x0 + wall, y1 - wall, z1)),
        box((x0 + wall, y0 + wall, z0), (x_front, y1 - wall, z0 + wall), panel=True),
    ]
    boards = {"all": boards, "no floor": boards[:3], "none": []}[style.box]
    return [*solids, *boards], x_front - x0


def _false_door(cell: Cell, carcass: Carcass, style: Style) -> list[Solid]:
    """Build a door that does not open, and the filling behind it."""
    rect, opening = _front_rect(cell, style), cell.opening
    x = carcass.x1 - style.thickness if style.mount == "inset" else carcass.x1
    filled = plank(opening, carcass.x0, x)
    plain = style.pull in ("none", "cup", "strip")
    pull = "bar" if plain else style.pull
    pulls = _one_pull(pull, min(style.length, 0.5 * rect.height), style, upright=True)
    inward = 1.0 if rect.center[0] < carcass.outer.center[0] else -1.0
    y = rect.center[0] + inward * (0.5 * rect.width - 1.6 * style.girth)
    face = _face(rect, x, y, carcass, style)
    placed = [s.shifted(face, y, rect.center[1]) for s in pulls]
    return [filled, *_front(rect, x, carcass, style), *placed]


def _front(rect: Rect, x: float, carcass: Carcass, style: Style) -> list[Solid]:
    """Build the plate of a drawer or door, its back at `x`."""
    t = style.thickness
    field, hole = rect.shrunk(0.16 * min(rect.width, rect.height)), rect.shrunk(_stile(rect))
    match style.front:
        case "bevel":
            solids = [plate(rect, x, x + t, bevel=0.45 * t)]
        case "shaker":
            board = plank(hole, x, x + 0.7 * t, panel=True)
            solids = [frame(rect, hole, x, x + t, segments=1), board]
        case "raised":
            solids = [plate(rect, x, x + t, bevel=0.15 * t)]
            solids += [plate(field, x + t, x + 1.5 * t, bevel=0.45 * t)]
        case "slats":
            board = plank(rect, x, x + 0.7 * t, panel=True)
            solids = [board, *_slats(rect, x + 0.7 * t, x + 1.15 * t)]
        case "bow":
            y = np.linspace(rect.y0, rect.y1, 14)
            arc = np.stack([x + style.thickness + style.bow * _bulge(y, carcass), y], axis=1)
            outline = np.concatenate([[(x, rect.y0)], arc, [(x, rect.y1)]])
            solids = [prism(outline, rect.z0, rect.z1)]
        case "slot":
            solids = [along_x(prism(_notched(rect), x, x + t))]
        case _:
            solids = [plate(rect, x, x + t, bevel=0.08 * t)]
    return solids


def _stile(rect: Rect) -> float:
    """Return the width of a frame's bars around a recessed panel."""
    return 0.2 * min(rect.width, rect.height)


def _face(rect: Rect, x: float, y: float, carcass: Carcass, style: Style) -> float:
    """Return where a pull stands: the x of the plate's face."""
    t = style.thickness
    if style.front == "shaker":
        on_bar = abs(y - rect.center[0]) > 0.5 * rect.width - _stile(rect)
        return x + (t if on_bar else 0.7 * t)
    if style.front == "raised":
        on_field = abs(y - rect.center[0]) < 0.5 * rect.width - 0.3 * min(rect.width, rect.height)
        return x + (1.5 if on_field else 1.0) * t
    if style.front == "slats":
        return x + 1.15 * t
    return x + t + style.bow * _bulge(np.array([y]), carcass)[0] - (0.1 * t if style.bow else 0.0)


def _slats(rect: Rect, x0: float, x1: float) -> list[Solid]:
    count = max(3, round(rect.height / 0.06))
    pitch, groove = rect.height / count, 0.22 * rect.height / count
    spans = [(k * pitch + groove / 2, (k + 1) * pitch - groove / 2) for k in range(count)]
    return [plank(Rect(rect.y0, rect.z0 + a, rect.y1, rect.z0 + b), x0, x1) for a, b in spans]


def _bulge(y: Floats, carcass: Carcass) -> Floats:
    """Return the bow's height, 1 in the middle of the carcass and 0 at its sides."""
    s = (y - carcass.outer.center[0]) / (0.5 * carcass.outer.width)
    return np.maximum(1.0 - s * s, 0.0)


def _notched(rect: Rect) -> Floats:
    """Return the outline (n, 2) in (y, z) of a plate with a grip cut out of its upper edge."""
    half, deep = min(0.07, 0.22 * rect.width), min(0.2 * rect.height, 0.035)
    angle = np.linspace(0.0, np.pi, 11)
    arc = np.stack([half * cos(angle), -deep * sin(angle)], axis=1)
    cut = arc + np.array((rect.center[0], rect.z1))
    right = [(rect.y0, rect.z0), (rect.y1, rect.z0), (rect.y1, rect.z1)]
    return np.concatenate([right, cut, [(rect.y0, rect.z1)]])


def _one_pull(kind: str, length: float, style: Style, *, upright: bool = False) -> list[Solid]:
    if kind in ("bar", "flat", "arch", "cup", "strip"):
        return handle(kind, length, style.reach, style.girth, upright=upright)
    return knob(kind, 1.15 * style.girth, 0.8 * style.reach, sides=20)


def _pulls(rect: Rect, x: float, carcass: Carcass, style: Style) -> list[Solid]:
    """Build the pulls of one drawer's front, in their places."""
    if style.pull == "none":
        return []
    count = style.pulls if rect.width > 0.45 and style.pull != "strip" else 1
    length = min(style.length, 0.6 * rect.width / count)
    z = rect.z0 + style.level * rect.height
    if style.pull == "strip":
        length, z = 0.9 * rect.width, rect.z1 - 0.6 * style.girth
    if style.front == "shaker" and style.level > 0.5:
        z = rect.center[1]
    solids = []
    for y in row(rect.center[0], 0.5 * rect.width, count):
        face = x + style.thickness if style.pull == "strip" else _face(rect, x, y, carcass, style)
        solids += [s.shifted(face, y, z) for s in _one_pull(style.pull, length, style)]
    return solids
