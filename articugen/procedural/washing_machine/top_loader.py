"""Machines that are loaded from above: a lid that opens about -y over an upright drum.

The lid lies on the deck and turns about its upper rear edge, so that no point of it comes behind
that before it stands upright; a console behind it limits it to that.
"""

import numpy as np

from articugen.core.geometry import rotation_about, transform
from articugen.procedural.kit import GAP
from articugen.procedural.kit.model import Model, ModelLink, moving_part
from articugen.procedural.kit.outlines import circle, matched, rectangle
from articugen.procedural.kit.parts import row, tapered
from articugen.procedural.kit.solids import Solid, block, box, prism, ring
from articugen.procedural.washing_machine.controls import console


def build_top_loader(rng: np.random.Generator) -> Model:
    """Build one object: links body and door."""
    u = rng.uniform
    width, depth, height = u(0.4, 0.74), u(0.5, 0.74), u(0.78, 1.0)
    wall, lift = 0.0125 * (height + 0.5 * depth), u(0.012, 0.035)
    deck = lift + height
    foot = u(0.09, 0.15) if u() < 0.65 else 0.0  # how deep the console is
    behind = foot + 3.0 * wall if foot else 0.02  # knobs reach 2.6 walls out of the console
    hinge_x = -depth + behind + GAP
    front = u(0.02, 0.1) if foot else u(0.06, 0.12)  # of the deck, before the lid
    radius = min(width / 2, (depth - behind - 0.01 - front) / 2) - u(0.025, 0.05)
    middle = (hinge_x - front) / 2
    body = [*_casing(width, depth, lift, deck, (middle, radius), wall), *_inside(
        rng, lift, deck, middle, radius - wall, wall
    )]  # fmt: skip
    body += _feet(width, depth, lift, wall)
    upper = np.deg2rad(u(75.0, 90.0))
    if foot:
        high, head = u(0.08, 0.18), u(0.3, 0.8) * foot
        body += console(rng, (-depth, deck), (width, high), (foot, head), wall)
    else:
        body += _keys(rng, width, deck, front, wall)
        upper = np.deg2rad(u(80.0, 105.0))
    thick = u(1.2, 2.8) * wall
    lid = _lid(rng, (hinge_x, -front), width * u(0.8, 0.98), deck + GAP, thick, wall)
    hinge = (hinge_x, 0.0, deck + GAP + thick)
    opens = moving_part("door", "door", lid, hinge, (0.0, -1.0, 0.0), upper)
    return Model.of(ModelLink("body", "washing_machine_body", tuple(body)), [opens])


def _casing(
    width: float, depth: float, lift: float, deck: float, hole: tuple[float, float], wall: float
) -> list[Solid]:
    """Build a floor, walls around the drum's space, and the deck with its opening."""
    middle, radius = hole
    outline, center = rectangle(depth, width, (-depth / 2, 0.0)), (middle, 0.0)
    wide = circle(radius + 0.5 * wall, 40, center)
    floor, ceiling = lift + 0.12 * (deck - lift), deck - 1.5 * wall
    return [
        prism(outline, lift, floor),
        ring(*matched(outline, wide, center), floor, ceiling),
        ring(*matched(outline, circle(0.9 * radius, 40, center), center), ceiling, deck),
    ]


def _inside(
    rng: np.random.Generator, lift: float, deck: float, middle: float, radius: float, wall: float
) -> list[Solid]:
    """Build what turns: a plate with vanes, or a column."""
    floor = lift + 0.12 * (deck - lift)
    plate_radius = 0.85 * radius
    solids = [tapered((plate_radius, 0.9 * plate_radius), (floor, floor + 1.2 * wall), 32)]
    tall = rng.uniform(0.4, 0.7) * (deck - lift) if rng.uniform() < 0.5 else 3.0 * wall
    solids.append(tapered((0.3 * radius, 0.16 * radius), (floor, floor + tall), 24))
    for k in range(4):
        vane = box((0.1 * radius, -0.4 * wall, floor), (0.8 * radius, 0.4 * wall, floor + 3 * wall))
        solids.append(vane.moved(transform(rotation_about((0, 0, 1), (k / 2 + 0.1) * np.pi))))
    return [s.shifted(x=middle) for s in solids]


def _feet(width: float, depth: float, lift: float, wall: float) -> list[Solid]:
    foot = tapered(np.array((1.6, 1.28)) * wall, (0.0, lift + wall))
    x, y = depth / 2 - 0.06, width / 2 - 0.06
    return [foot.shifted(-depth / 2 + i * x, j * y) for i in (-1, 1) for j in (-1, 1)]


def _keys(
    rng: np.random.Generator, width: float, deck: float, front: float, wall: float
) -> list[Solid]:
    """Build a display and keys on the deck, before the lid."""
    middle, half = -front / 2, 0.22 * front
    count = int(rng.integers(3, 8))
    screen = block(
        (middle - half, -0.1 * width, deck), (middle + half, 0.1 * width, deck + 0.3 * wall)
    )
    keys = [
        block((middle - half, y - half, deck), (middle + half, y + half, deck + 0.3 * wall))
        for side in (-1, 1)
        for y in row(side * 0.28 * width, 0.14 * width, count)
    ]
    return [screen, *keys]


def _lid(
    rng: np.random.Generator,
    span: tuple[float, float],
    width: float,
    under: float,
    thick: float,
    wall: float,
) -> list[Solid]:
    """Build the lid from x = span[0] at its hinge to span[1]: a plate, or a frame around glass."""
    x0, x1 = span
    low, high = (x0, -width / 2, under), (x1, width / 2, under + thick)
    if rng.uniform() < 0.5:
        solids = [block(low, high, bevel=(0.0, rng.uniform(0.1, 0.5) * thick), segments=4)]
    else:
        outline, middle = rectangle(x1 - x0, width, ((x0 + x1) / 2, 0.0)), ((x0 + x1) / 2, 0.0)
        share = rng.uniform(0.6, 0.85)
        hole = rectangle(share * (x1 - x0), share * width, middle)
        glass = prism(hole, under + 0.3 * thick, under + 0.7 * thick)
        solids = [ring(outline, hole, under, under + thick), glass]
    half = rng.uniform(0.06, 0.2) * width
    lip = box((x1, -half, under), (x1 + rng.uniform(0.5, 1.0) * wall, half, under + 0.6 * thick))
    return [*solids, lip]
