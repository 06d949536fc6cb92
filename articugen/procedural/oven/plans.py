"""What kinds of ovens there are: their proportions and what their fronts hold."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any

import numpy as np

from articugen.procedural.kit import GAP
from articugen.procedural.kit.parts import Rect
from articugen.procedural.kit.ranges import Either, draw_all


@dataclass(frozen=True)
class Leaf:
    """A door that opens; `hinge` is the edge it turns about: bottom, left or right (at y0, y1)."""

    rect: Rect
    hinge: str = "bottom"


@dataclass(frozen=True)
class Oven:
    """The plan of one oven; the front face of its body is x = 0, rectangles lie in (y, z).

    Attributes:
        body: the outside of the body, above its feet.
        doors: those that open, each before a cavity; side by side, or one above the other.
        fixed_doors, drawers: fronts that only look as if they opened.
        controls: None, or where the control panel is.
        depth: of the body; its back is x = -depth.
        radius: of the body's corners, seen from the front.
        flange: the body is narrower behind a rim of this width, for building in.
        feet: feet, plinth, legs or none.
        thickness: how far doors and control panels stand out from the body.
        look: of all doors: window, wide, glass, solid or porthole.
        sloped: the control panel leans back.
        stove: what is on top: none, gas, coil, glass, plates or lids.
        guard: height of the back guard, 0 for none.
        guard_controls: knobs are on the back guard.
    """

    body: Rect
    doors: tuple[Leaf, ...]
    fixed_doors: tuple[Rect, ...]
    drawers: tuple[Rect, ...]
    controls: Rect | None
    depth: float
    radius: float
    flange: float
    feet: str
    thickness: float
    look: str
    sloped: bool
    stove: str
    guard: float
    guard_controls: bool

    @property
    def extent(self) -> float:
        """About the longest side of the oven in all its states."""
        height = self.body.z1 + self.guard
        return max(self.body.width, height, self.depth + self.doors[0].rect.height)


def draw_plan(rng: np.random.Generator, kinds: Sequence[Mapping[str, Any]]) -> Oven:
    """Return the plan of one of these kinds, tables of ranges as those below."""
    drawn = PLAIN | draw_all(rng, kinds[int(rng.integers(len(kinds)))])
    kept = {k: v for k, v in drawn.items() if k in {field.name for field in fields(Oven)}}
    return Oven(**_rectangles(SimpleNamespace(**drawn)), **kept)


def _rectangles(d: SimpleNamespace) -> dict[str, Any]:
    """Return the rectangles of an oven with these measures."""
    half, top = d.width / 2, d.height or d.lift + d.rise
    left, right, floor, ceiling = d.side - half, half - d.side, d.lift + d.sill, top - d.strip
    panel = Rect(-half, ceiling, half, top)
    fixed, drawers = [], []
    if d.drawer:
        drawers = [Rect(left, d.lift + 0.012, right, d.lift + d.drawer_height)]
        floor = drawers[0].z1 + GAP
    doors = [_hung(left, floor, right, ceiling, d.thickness)]
    match d.front:
        case "inset panel":
            panel = Rect(left, ceiling, right, top - 0.02)
        case "door above":
            doors = [_hung(left, floor, right, d.middle * top, d.thickness)]
            fixed = [Rect(left, d.middle * top + GAP, right, ceiling - GAP)]
        case "door beside":
            doors = [_hung(left, floor, d.cut * d.width, ceiling, d.thickness)]
            fixed = [Rect(doors[0].y1 + GAP, floor, right, doors[0].z1)]
        case "panel beside":
            doors = [_hung(left, floor, d.cut * d.width, ceiling, d.thickness)]
            panel = Rect(doors[0].y1 + GAP, d.lift + 0.012, right, top - 0.012)
        case "four doors":
            middle, columns = (d.lift + ceiling) / 2, ((left, -d.side / 2), (d.side / 2, right))
            rows = ((floor, middle), (middle + 0.02, ceiling))
            doors = [_hung(a, z, b, end, d.thickness) for z, end in rows for a, b in columns]
            fixed = doors[: d.opens] + doors[d.opens + 1 :]
        case "two beside":
            spans = ((left, d.cut * d.width), (d.cut * d.width + GAP, right))
            doors = [_hung(a, floor, b, ceiling, d.thickness) for a, b in spans]
        case "two above":
            middle = floor + d.middle * (ceiling - floor)
            spans = ((floor, middle), (middle + 0.02, ceiling))
            doors = [_hung(left, z, right, end, d.thickness) for z, end in spans]
        case "tower":
            low = floor + d.below * (ceiling - floor - d.tall)
            high = low + d.tall
            doors = [_hung(left, low, right, high, d.thickness)]
            fixed = [*_closed(d, floor, low, left, right), *_closed(d, high, ceiling, left, right)]
    if d.hinge == "bottom":
        leaves = [Leaf(door) for door in (doors if d.both else [doors[d.opens]])]
    else:
        sides = _SIDES[d.hinge]
        leaves = [_swung(r, side, d.thickness) for r, side in zip(doors, sides, strict=True)]
    if d.mirrored:
        leaves = [_mirrored(leaf) for leaf in leaves]
        fixed = [Rect(-r.y1, r.z0, -r.y0, r.z1) for r in fixed]
    return {
        "body": Rect(-half, d.lift, half, top),
        "doors": tuple(leaves),
        "fixed_doors": tuple(fixed),
        "drawers": tuple(drawers),
        "controls": None if d.guard_controls else panel,
    }


def _closed(d: SimpleNamespace, z0: float, z1: float, left: float, right: float) -> list[Rect]:
    """Return the fronts that fill a tower from z0 to z1: none where it is lower than a hand."""
    count = min(d.fronts, int((z1 - z0) / 0.1))
    edges = np.linspace(z0, z1, count + 1)
    return [Rect(left, edges[k] + GAP, right, edges[k + 1] - GAP) for k in range(count)]


def _mirrored(leaf: Leaf) -> Leaf:
    r, other = leaf.rect, {"bottom": "bottom", "left": "right", "right": "left"}
    return Leaf(Rect(-r.y1, r.z0, -r.y0, r.z1), other[leaf.hinge])


def _swung(rect: Rect, side: str, thickness: float) -> Leaf:
    """Return a door hinged at a side that may fill the rectangle: as `_hung`, sideways."""
    width = float(np.sqrt((rect.width - GAP) ** 2 - (thickness + GAP) ** 2))
    y0, y1 = (rect.y0, rect.y0 + width) if side == "left" else (rect.y1 - width, rect.y1)
    return Leaf(Rect(y0, rect.z0, y1, rect.z1), side)


def _hung(y0: float, z0: float, y1: float, ceiling: float, thickness: float) -> Rect:
    """Return a door that may fill the space below `ceiling`.

    Its upper inner edge rises while it swings, up to the length of the front's diagonal
    sqrt(height^2 + thickness^2) above the hinge.
    """
    diagonal = ceiling - GAP - z0
    return Rect(y0, z0, y1, z0 + float(np.sqrt(diagonal**2 - (thickness + GAP) ** 2)))


# Metres, and as in `Oven`. The body begins at `lift` and ends at `height`, or at `rise` above it;
# `side`, `sill` and `strip` are left free beside, below and above the door. What `front` says of
# another door or the panel: the door ends at `cut` of the width, counted from the middle, or at
# `middle` of the height; a tower's door is `tall`, `below` of what is left lies under it, and
# `fronts` at most close what is left on either side. `both` doors open; `hinge` is "bottom" or one
# of `_SIDES`.
# fmt: off
_SIDES = {
    "left": ("left",), "right": ("right",), "lefts": ("left",) * 2, "rights": ("right",) * 2,
    "sides": ("left", "right"),
}
PLAIN = {
    "front": "plain", "height": 0.0, "lift": 0.0, "side": 0.0, "drawer": False, "mirrored": False,
    "opens": 0, "radius": 0.0, "flange": 0.0, "feet": "none", "sloped": False, "stove": "none",
    "guard": 0.0, "guard_controls": False, "hinge": "bottom", "both": False,
}
"""What an oven has where its kind says nothing else."""

_RANGE = {  # free-standing
    "width": (0.5, 0.76), "height": (0.86, 0.93), "depth": (0.56, 0.66),
    "thickness": (0.036, 0.05), "lift": (0.025, 0.1), "side": (0.0, 0.012),
    "drawer_height": (0.13, 0.2), "drawer": Either(0.75),
    "sill": Either("drawer", 0.0, (0.02, 0.05)),
    "guard_controls": Either(0.35), "strip": Either("guard_controls", 0.02, (0.09, 0.14)),
    "feet": ["feet", "plinth"], "look": ["window", "wide", "glass", "solid"],
    "sloped": Either(0.4), "stove": ["gas", "gas", "coil", "glass", "plates"],
    "guard": Either("guard_controls", (0.12, 0.24), [0.0, 0.05, 0.12]),
}
_PROFESSIONAL = {  # wide, on legs, with a narrow closed compartment beside the oven
    "width": (0.9, 1.1), "height": (0.88, 0.93), "depth": (0.6, 0.7), "thickness": (0.042, 0.055),
    "lift": (0.1, 0.16), "side": 0.01, "sill": 0.02, "strip": (0.12, 0.16), "feet": "legs",
    "front": "door beside", "cut": (0.12, 0.2), "mirrored": Either(0.5),
    "look": ["window", "solid"], "sloped": Either(0.5), "stove": "gas", "guard": [0.0, 0.07, 0.16],
}
_RETRO = {  # a small cooker with round corners on high legs
    "width": (0.46, 0.6), "depth": (0.46, 0.56), "thickness": (0.036, 0.045),
    "lift": (0.12, 0.26), "rise": (0.55, 0.68), "side": (0.03, 0.06), "strip": (0.11, 0.15),
    "feet": "legs", "front": "inset panel", "radius": (0.03, 0.07), "sill": (0.03, 0.07),
    "look": ["solid", "porthole", "window"], "stove": ["coil", "plates", "gas"],
    "guard": [0.0, 0.1, 0.25],
}
_BUILT_IN = {  # for a kitchen cabinet, full height or compact
    "width": (0.56, 0.62), "height": [0.46, 0.6], "depth": (0.5, 0.57), "thickness": (0.03, 0.042),
    "strip": (0.08, 0.12), "flange": (0.014, 0.03), "sill": (0.012, 0.03),
    "look": ["wide", "glass", "glass", "window"],
}
_DOUBLE = {  # two ovens in a tower, of which the lower one opens
    "width": (0.58, 0.76), "height": (0.98, 1.15), "depth": (0.52, 0.6),
    "thickness": (0.036, 0.048), "strip": (0.08, 0.12), "front": "door above",
    "middle": (0.5, 0.6), "flange": (0.014, 0.03), "sill": (0.015, 0.05),
    "look": ["window", "wide", "glass"],
}
_TOASTER = {  # for the counter, its knobs in a column beside the door
    "width": (0.4, 0.54), "height": (0.25, 0.36), "depth": (0.28, 0.4), "thickness": (0.016, 0.02),
    "lift": (0.014, 0.022), "side": 0.008, "front": "panel beside", "cut": (0.2, 0.27),
    "sill": (0.015, 0.03), "strip": (0.006, 0.02), "feet": "feet", "radius": [0.0, 0.02, 0.045],
    "look": ["wide", "glass", "window"],
}
_CAST_IRON = {  # a heavy cooker: four doors, of which one opens, and lidded hotplates
    "width": (0.86, 1.05), "height": (0.84, 0.9), "depth": (0.58, 0.66),
    "thickness": (0.042, 0.052), "lift": (0.06, 0.12), "sill": 0.03, "strip": (0.09, 0.12),
    "side": (0.03, 0.05), "front": "four doors", "opens": [0, 1, 2, 3], "radius": (0.0, 0.02),
    "feet": "plinth", "look": "solid", "stove": "lids",
}
# fmt: on
KINDS = (*(_RANGE,) * 3, _PROFESSIONAL, _RETRO, _BUILT_IN, _DOUBLE, *(_TOASTER,) * 2, _CAST_IRON)

# fmt: off
_TALL = {  # an oven low in a tower or high over drawers, as fitted kitchens have
    "width": (0.5, 0.66), "height": (1.1, 2.1), "depth": (0.5, 0.66), "thickness": (0.02, 0.042),
    "sill": (0.02, 0.12), "strip": (0.03, 0.1), "front": "tower", "fronts": [1, 1, 2, 3],
    "below": Either(0.4, (0.0, 0.1), (0.2, 0.7)), "tall": (0.3, 0.65), "side": (0.0, 0.02),
    "look": ["window", "wide", "glass", "solid"],
}
_WIDE = _PROFESSIONAL | {  # two ovens side by side under one hob
    "width": (0.9, 1.25), "lift": (0.02, 0.16), "front": "two beside", "both": True,
    "cut": [-0.12, 0.0, 0.0, 0.1, 0.16], "feet": ["legs", "plinth", "feet"],
    "stove": ["gas", "gas", "coil", "glass", "plates"],
}
_FRENCH = _WIDE | {"width": (0.6, 0.95), "cut": 0.0, "hinge": "sides"}
_STACKED = _DOUBLE | {  # both of which open
    "height": (0.9, 1.4), "lift": (0.0, 0.1), "front": "two above", "middle": (0.45, 0.6),
    "both": True, "flange": 0.0, "side": (0.0, 0.012), "feet": "plinth",
    "stove": ["none", "none", "gas", "glass"],
}
_LOW = {  # built in, wider than high
    "width": (0.58, 0.92), "height": (0.4, 0.62), "depth": (0.5, 0.75), "thickness": (0.02, 0.045),
    "strip": (0.06, 0.2), "sill": (0.006, 0.03), "side": (0.0, 0.012),
    "look": ["wide", "glass", "window", "solid"],
}
_PLAIN_RANGE = _RANGE | {  # the door reaches from edge to edge, and nearly to the floor
    "width": (0.56, 0.92), "height": (0.7, 0.95), "depth": (0.5, 0.78), "lift": (0.0, 0.06),
    "thickness": (0.02, 0.05), "side": (0.0, 0.006), "drawer": Either(0.35),
    "stove": ["gas", "gas", "none", "coil", "glass", "plates"],
}
_SIDEWAYS = _PLAIN_RANGE | {"hinge": ["left", "right"]}
_SIDEWAYS_LOW = _LOW | {"hinge": ["left", "right"]}
# fmt: on
VARIED = (
    *KINDS,
    *(_PLAIN_RANGE,) * 3,
    *(_WIDE,) * 2,
    *(_TALL,) * 2,
    *(_STACKED,) * 2,
    *(_LOW,) * 2,
    _FRENCH,
    _SIDEWAYS,
    _SIDEWAYS_LOW,
)
"""With what else there is: in towers, two doors, side by side, hinged at a side."""
