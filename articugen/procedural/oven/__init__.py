"""Ranges, wall ovens, cookers and toaster ovens: one door that drops open about +y; varied ones may
have two, or doors that swing open about z.

The body is solid around a cavity with racks. A door hangs in front of it, hinged at its lower
outer edge: no point of it but its handle lies beyond its outer face, and none below its lower
edge, so it can swing by 135 degrees without meeting what is below.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from articugen.procedural.kit import GAP, RANGE
from articugen.procedural.kit.model import Model, ModelLink, moving_part
from articugen.procedural.kit.outlines import circle, matched
from articugen.procedural.kit.parts import Rect, frame, handle, plate, rod, row, tapered
from articugen.procedural.kit.solids import Solid, along_x, box, prism, ring
from articugen.procedural.oven.plans import KINDS, VARIED, Leaf, Oven, draw_plan
from articugen.procedural.oven.stovetop import back_guard, control_panel, cooktop

_CORNER = 0.06  # the radius of the cavity's corners, part of its height


@dataclass(frozen=True)
class Cavity:
    """The space behind a door: its opening, and the x of its back."""

    opening: Rect
    back: float


def build(rng: np.random.Generator) -> Model:
    """Build one object: links body and door."""
    return assembled(rng, draw_plan(rng, KINDS), RANGE[1])


def build_varied(rng: np.random.Generator) -> Model:
    """Build one of any layout: one or two doors, hinged below or at a side, that open by about a
    right angle; some have racks that slide out, which recipes lock."""
    oven = draw_plan(rng, VARIED)
    upper = np.deg2rad(rng.uniform(85.0, 95.0))
    return assembled(rng, oven, upper, loose=bool(rng.uniform() < 0.5))


def assembled(
    rng: np.random.Generator, oven: Oven, upper: float, *, loose: bool = False, name: str = "oven"
) -> Model:
    """Build what the plan of an oven, a refrigerator or a microwave says.

    Args:
        upper: how far doors open, rad.
        loose: racks slide out, each on a joint of its own.
        name: of the object; what is no oven has no fan and no heating element.
    """
    cavities = [_cavity(rng, oven, leaf.rect) for leaf in oven.doors]
    pull = _pull(rng, oven)
    racks: list[list[Solid]] = []
    body = _casing(oven, cavities)
    for cavity in cavities:
        shelves = _racks(rng, oven, cavity, loose=loose)
        racks += shelves if loose else []
        body += [] if loose else [s for shelf in shelves for s in shelf]
        body += _furnishings(rng, oven, cavity) if name == "oven" else []
    body += _feet(oven)
    if oven.controls is not None:
        body += control_panel(rng, oven, oven.controls)
    body += [*cooktop(rng, oven), *back_guard(rng, oven)]
    for rect in oven.fixed_doors:
        body += [*_door(oven, rect, 0.0), *pull.on(rect)]
    for rect in oven.drawers:
        body += [plate(rect, 0.0, oven.thickness, bevel=0.12 * oven.thickness), *pull.low(rect)]
    moving = []
    for k, (leaf, cavity) in enumerate(zip(oven.doors, cavities, strict=True)):
        door = "door" if len(cavities) == 1 else f"door_{k}"
        solids = [*_door(oven, leaf.rect, GAP), *pull.on(leaf.rect, GAP, leaf.hinge)]
        if leaf.hinge == "bottom":
            solids += _plug(rng, oven, leaf.rect, cavity.opening)
        at, axis = _axis(leaf)
        moving.append(moving_part(door, "door", solids, (GAP + oven.thickness, *at), axis, upper))
    for k, rack in enumerate(racks):
        at, way, stroke = rack[0].vertices[0], (1.0, 0.0, 0.0), round(0.5 * oven.depth, 4)
        moving.append(moving_part(f"rack_{k}", "shelf", rack, at, way, stroke, slides=True))
    return Model.of(ModelLink("body", f"{name}_body", tuple(body)), moving)


def _axis(leaf: Leaf) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Return (y, z) of a point on a door's hinge, and the axis about which it opens."""
    (y, z), r = leaf.rect.center, leaf.rect
    return {
        "bottom": ((y, r.z0), (0.0, 1.0, 0.0)),
        "left": ((r.y0, z), (0.0, 0.0, -1.0)),
        "right": ((r.y1, z), (0.0, 0.0, 1.0)),
    }[leaf.hinge]


def _cavity(rng: np.random.Generator, oven: Oven, door: Rect) -> Cavity:
    """Return the space behind a door."""
    small = min(door.width, door.height)
    side = min(rng.uniform(0.09, 0.14) * small, 0.3 * small)
    wall = 0.03 * oven.extent
    opening = door.shrunk(side)
    left = max(opening.y0, oven.body.y0 + oven.flange + wall)
    right = min(opening.y1, oven.body.y1 - oven.flange - wall)
    back = -oven.depth + rng.uniform(1.2, 2.5) * wall
    return Cavity(Rect(left, opening.z0, right, opening.z1), back)


def _casing(oven: Oven, cavities: Sequence[Cavity]) -> list[Solid]:
    """Build the solid body around the cavities, with a rim if it is for building in."""
    rim = -0.02 * oven.extent
    inner = oven.body.shrunk(oven.flange)
    start = rim if oven.flange > 0.0 else 0.0
    radius = oven.radius if len(cavities) == 1 else 0.0

    def around(outer: Rect, opening: Rect, x0: float, x1: float) -> Solid:
        corner = _CORNER * opening.height
        return frame(outer, opening, x0, x1, outer_radius=radius, inner_radius=corner)

    solids, blocks = [], (_blocks(body, cavities) for body in (inner, oven.body))
    for cavity, block, whole in zip(cavities, *blocks, strict=True):
        solids.append(plate(block, -oven.depth, cavity.back, radius=radius))
        solids.append(around(block, cavity.opening, cavity.back, start))
        if oven.flange > 0.0:
            solids.append(around(whole, cavity.opening, rim, 0.0))
    return solids


def _blocks(body: Rect, cavities: Sequence[Cavity]) -> list[Rect]:
    """Return the body cut between its cavities, which lie side by side or one above the other."""
    if len(cavities) == 1:
        return [body]
    a, b = (cavity.opening for cavity in cavities)
    if a.z1 < b.z0:
        z = (a.z1 + b.z0) / 2
        return [Rect(body.y0, body.z0, body.y1, z), Rect(body.y0, z, body.y1, body.z1)]
    y = (min(a.y1, b.y1) + max(a.y0, b.y0)) / 2
    halves = [Rect(body.y0, body.z0, y, body.z1), Rect(y, body.z0, body.y1, body.z1)]
    return halves if a.y0 < b.y0 else halves[::-1]


def _racks(
    rng: np.random.Generator, oven: Oven, cavity: Cavity, *, loose: bool
) -> list[list[Solid]]:
    """Build the racks between the cavity's sides; loose ones stay clear of them."""
    opening, r = cavity.opening, 0.0065 * oven.extent
    count = int(rng.integers(1, 4)) if opening.height > 0.25 else 1
    aside = r + GAP + _CORNER * opening.height
    wide = opening.shrunk(aside, 0.0) if loose else opening
    back = cavity.back + 4 * r if loose else cavity.back  # before the fan
    half = (0.3 if loose else 0.42) * opening.height  # below the heating element
    heights = row(opening.center[1], half, count)
    return [_rack(rng, wide, back, height, r) for height in heights]


def _furnishings(rng: np.random.Generator, oven: Oven, cavity: Cavity) -> list[Solid]:
    """Return a fan cover, a heating element."""
    opening, back, r = cavity.opening, cavity.back, 0.0065 * oven.extent
    y, z = opening.center
    solids = []
    if rng.uniform() < 0.6:
        radius = 0.3 * min(opening.width, opening.height)
        hoop = ring(circle(radius, 28), circle(0.85 * radius, 28), back, back + 1.5 * r)
        hub = prism(circle(0.45 * radius, 20), back, back + 1.5 * r)
        solids += [along_x(s).shifted(y=y, z=z) for s in (hoop, hub)]
    if rng.uniform() < 0.5:
        top, a, b = opening.z1 - 3.5 * r, back - r, -0.2 * oven.depth
        lanes = row(y, 0.38 * opening.width, 4)
        turns = [(x, lane, top) for k, lane in enumerate(lanes) for x in ((a, b), (b, a))[k % 2]]
        inset = [
            (max(x, back + 3 * r) if 0 < k < 7 else x, w, h) for k, (x, w, h) in enumerate(turns)
        ]
        solids.append(rod(inset, r))
    return solids


def _rack(rng: np.random.Generator, opening: Rect, back: float, z: float, r: float) -> list[Solid]:
    """Rods along x on rods along y, whose ends stick in the cavity's sides."""
    front, rear = 0.12 * back - 2 * r, back + 2 * r
    across = np.linspace(front, rear, int(rng.integers(2, 4)))
    solids = [rod([(x, opening.y0 - r, z), (x, opening.y1 + r, z)], r) for x in across]
    lanes = max(4, int(opening.width / max(0.04, 7 * r)))
    for y in row(opening.center[0], opening.width / 2, lanes):
        solids.append(rod([(rear, y, z + r), (front, y, z + r)], r, 6))
    return solids


def _door(oven: Oven, rect: Rect, x: float) -> list[Solid]:
    """Build a door's leaf, its back at `x`."""
    t, small = oven.thickness, min(rect.width, rect.height)
    corner = min(oven.radius, 0.2 * small)
    if oven.look in ("window", "wide"):
        share = 0.22 if oven.look == "window" else 0.11
        hole = replace(rect.shrunk(share * small), z1=rect.z1 - max(share, 0.2) * rect.height)
        leaf = frame(rect, hole, x, x + t, outer_radius=corner, inner_radius=0.1 * hole.height)
        return [leaf, plate(hole.shrunk(-0.001), x + 0.2 * t, x + 0.7 * t)]
    if oven.look == "porthole":
        center, radius = rect.center, 0.28 * small
        hole = circle(radius, 32, center)
        leaf = along_x(ring(*matched(rect.outline(corner), hole, center), x, x + t))
        hoop = ring(circle(1.15 * radius, 32, center), hole, x + 0.8 * t, x + t)
        return [leaf, along_x(hoop), along_x(prism(hole, x + 0.2 * t, x + 0.6 * t))]
    leaf = plate(rect, x, x + 0.65 * t, radius=corner, bevel=0.1 * t)
    if oven.look == "glass":
        glass = rect.shrunk(0.04 * small, 0.03 * small)
        return [leaf, plate(glass, x + 0.65 * t, x + t, radius=0.05 * small)]
    field = rect.shrunk(0.13 * small)
    return [leaf, plate(field, x + 0.65 * t, x + t, radius=corner, bevel=0.3 * t)]


def _plug(rng: np.random.Generator, oven: Oven, door: Rect, opening: Rect) -> list[Solid]:
    """Build a door's inner panel, which stands a little into the cavity.

    Its upper inner edge swings on a circle about the hinge and must pass below the opening's edge.
    """
    if rng.uniform() < 0.3:
        return []
    deep, z0 = 0.013 * oven.extent, door.z0
    reach = oven.thickness + GAP + deep
    top = float(np.sqrt((opening.z1 - z0 - GAP) ** 2 - reach**2)) + z0
    # The cavity's corners are round: stay clear of them.
    side = max(GAP, 0.3 * _CORNER * opening.height) + GAP
    rect = opening.shrunk(side)
    rect = replace(rect, z1=min(top, rect.z1))
    hole = rect.shrunk(0.16 * rect.height)
    return [frame(rect, hole, -deep, GAP, inner_radius=0.05 * rect.height)]


@dataclass(frozen=True)
class Pull:
    """The handles of one oven: all alike. `share` of a door's width is their length; see `handle`
    for the others."""

    kind: str
    share: float
    reach: float
    girth: float
    face: float

    def on(self, rect: Rect, x: float = 0.0, hinge: str = "bottom") -> list[Solid]:
        """Near the edge away from the hinge of a door whose back is at `x`."""
        upright, (y, z) = hinge != "bottom", rect.center
        along, across = (rect.height, rect.width) if upright else (rect.width, rect.height)
        inset = max(0.07 * across, 1.3 * self.girth)
        if upright:
            y = rect.y1 - inset if hinge == "left" else rect.y0 + inset
        else:
            z = rect.z1 - inset
        solids = handle(self.kind, self.share * along, self.reach, self.girth, upright=upright)
        return [s.shifted(x + 0.6 * self.face, y, z) for s in solids]

    def low(self, rect: Rect) -> list[Solid]:
        """On a drawer below the door, far enough down and short enough for the door to pass."""
        z = rect.z0 + 0.35 * rect.height
        solids = handle("flat", 0.6 * self.share * rect.width, 0.6 * self.reach, self.girth)
        return [s.shifted(self.face, rect.center[0], z) for s in solids]


def _pull(rng: np.random.Generator, oven: Oven) -> Pull:
    extent = max(oven.extent, 0.6)
    return Pull(
        kind=str(rng.choice(["bar", "bar", "flat", "arch", "strip"])),
        share=rng.uniform(0.55, 0.92),
        reach=rng.uniform(0.04, 0.055) * extent,
        girth=rng.uniform(0.0145, 0.02) * extent,
        face=oven.thickness,
    )


def _feet(oven: Oven) -> list[Solid]:
    """Between the floor z = 0 and the body."""
    lift, body, back = oven.body.z0, oven.body, -oven.depth
    if oven.feet == "none" or lift <= 0.0:
        return []
    if oven.feet == "plinth":
        inset = 0.04
        return [box((back + inset, body.y0 + inset, 0.0), (-inset, body.y1 - inset, lift))]
    wide = 0.02 * oven.extent if oven.feet == "feet" else 0.026 * oven.extent
    shape = ((1.0, 1.0), (0.0, lift)) if oven.feet == "feet" else ((0.55, 1.1), (0.0, lift))
    foot = tapered(wide * np.array(shape[0]), shape[1])
    inset = max(1.5 * wide, oven.radius)
    places = [(x, y) for x in (-inset, back + inset) for y in (body.y0 + inset, body.y1 - inset)]
    return [foot.shifted(x, y) for x, y in places]
