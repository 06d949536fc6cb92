"""What kinds of ovens there are: their proportions and what their fronts hold."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from articugen.sources.procedural.kit import GAP
from articugen.sources.procedural.kit.parts import Rect


@dataclass(frozen=True)
class Oven:
    """The plan of one oven; the front face of its body is x = 0, rectangles lie in (y, z).

    Attributes:
        body: the outside of the body, above its feet.
        depth: of the body; its back is x = -depth.
        radius: of the body's corners, seen from the front.
        flange: the body is narrower behind a rim of this width, for building in.
        feet: feet, plinth, legs or none.
        door: the one that opens.
        thickness: how far doors and control panels stand out from the body.
        look: of all doors: window, wide, glass, solid or porthole.
        fixed_doors, drawers: fronts that only look as if they opened.
        controls: None, or where the control panel is.
        sloped: the control panel leans back.
        stove: what is on top: none, gas, coil, glass, plates or lids.
        guard: height of the back guard, 0 for none.
        guard_controls: knobs are on the back guard.
    """

    body: Rect
    depth: float
    radius: float
    flange: float
    feet: str
    door: Rect
    thickness: float
    look: str
    fixed_doors: tuple[Rect, ...] = ()
    drawers: tuple[Rect, ...] = ()
    controls: Rect | None = None
    sloped: bool = False
    stove: str = "none"
    guard: float = 0.0
    guard_controls: bool = False

    @property
    def extent(self) -> float:
        """About the longest side of the oven in all its states."""
        height = self.body.z1 + self.guard
        return max(self.body.width, height, self.depth + self.door.height)


def _hung(y0: float, z0: float, y1: float, ceiling: float, thickness: float) -> Rect:
    """A door that may fill the space below `ceiling`.

    Its upper inner edge rises while it swings, up to the length of the front's diagonal
    sqrt(height^2 + thickness^2) above the hinge.
    """
    diagonal = ceiling - GAP - z0
    return Rect(y0, z0, y1, z0 + float(np.sqrt(diagonal**2 - (thickness + GAP) ** 2)))


def _range(rng: np.random.Generator) -> Oven:
    """A free-standing range, 50 to 76 cm wide."""
    u = rng.uniform
    w, h, depth, t = u(0.5, 0.76), u(0.86, 0.93), u(0.56, 0.66), u(0.036, 0.05)
    lift = u(0.025, 0.1)
    body, y = Rect(-w / 2, lift, w / 2, h), w / 2 - u(0.0, 0.012)
    drawer = Rect(-y, lift + 0.012, y, lift + u(0.13, 0.2))
    drawers = (drawer,) if u() < 0.75 else ()
    floor = drawer.z1 + GAP if drawers else lift + u(0.02, 0.05)
    guard_controls = bool(u() < 0.35)
    ceiling = h - (0.02 if guard_controls else u(0.09, 0.14))
    return Oven(
        body,
        depth,
        radius=0.0,
        flange=0.0,
        feet=str(rng.choice(["feet", "plinth"])),
        door=_hung(-y, floor, y, ceiling, t),
        thickness=t,
        look=str(rng.choice(["window", "wide", "glass", "solid"])),
        drawers=drawers,
        controls=None if guard_controls else Rect(-w / 2, ceiling, w / 2, h),
        sloped=bool(u() < 0.4),
        stove=str(rng.choice(["gas", "gas", "coil", "glass", "plates"])),
        guard=u(0.12, 0.24) if guard_controls else float(rng.choice([0.0, 0.05, 0.12])),
        guard_controls=guard_controls,
    )


def _professional(rng: np.random.Generator) -> Oven:
    """A wide range on legs with a narrow closed compartment beside the oven."""
    u = rng.uniform
    w, h, depth, t = u(0.9, 1.1), u(0.88, 0.93), u(0.6, 0.7), u(0.042, 0.055)
    lift = u(0.1, 0.16)
    body, ceiling = Rect(-w / 2, lift, w / 2, h), h - u(0.12, 0.16)
    cut, left = u(0.12, 0.2) * w, bool(u() < 0.5)
    door = _hung(-w / 2 + 0.01, lift + 0.02, cut, ceiling, t)
    beside = Rect(cut + GAP, door.z0, w / 2 - 0.01, door.z1)
    if left:
        door, beside = _flipped(door), _flipped(beside)
    return Oven(
        body,
        depth,
        radius=0.0,
        flange=0.0,
        feet="legs",
        door=door,
        thickness=t,
        look=str(rng.choice(["window", "solid"])),
        fixed_doors=(beside,),
        controls=Rect(-w / 2, ceiling, w / 2, h),
        sloped=bool(u() < 0.5),
        stove="gas",
        guard=float(rng.choice([0.0, 0.07, 0.16])),
    )


def _retro(rng: np.random.Generator) -> Oven:
    """A small cooker with round corners on high legs."""
    u = rng.uniform
    w, depth, t = u(0.46, 0.6), u(0.46, 0.56), u(0.036, 0.045)
    lift = u(0.12, 0.26)
    h = lift + u(0.55, 0.68)
    body, side, ceiling = Rect(-w / 2, lift, w / 2, h), u(0.03, 0.06), h - u(0.11, 0.15)
    return Oven(
        body,
        depth,
        radius=u(0.03, 0.07),
        flange=0.0,
        feet="legs",
        door=_hung(-w / 2 + side, lift + u(0.03, 0.07), w / 2 - side, ceiling, t),
        thickness=t,
        look=str(rng.choice(["solid", "porthole", "window"])),
        controls=Rect(-w / 2 + side, ceiling, w / 2 - side, h - 0.02),
        stove=str(rng.choice(["coil", "plates", "gas"])),
        guard=float(rng.choice([0.0, 0.1, 0.25])),
    )


def _built_in(rng: np.random.Generator) -> Oven:
    """A single oven for a kitchen cabinet, full height or compact."""
    u = rng.uniform
    w, h, depth, t = u(0.56, 0.62), float(rng.choice([0.46, 0.6])), u(0.5, 0.57), u(0.03, 0.042)
    body, ceiling = Rect(-w / 2, 0.0, w / 2, h), h - u(0.08, 0.12)
    return Oven(
        body,
        depth,
        radius=0.0,
        flange=u(0.014, 0.03),
        feet="none",
        door=_hung(-w / 2, u(0.012, 0.03), w / 2, ceiling, t),
        thickness=t,
        look=str(rng.choice(["wide", "glass", "glass", "window"])),
        controls=Rect(-w / 2, ceiling, w / 2, h),
    )


def _double(rng: np.random.Generator) -> Oven:
    """Two ovens in a tower, of which the lower one opens."""
    u = rng.uniform
    w, h, depth, t = u(0.58, 0.76), u(0.98, 1.15), u(0.52, 0.6), u(0.036, 0.048)
    body, strip = Rect(-w / 2, 0.0, w / 2, h), u(0.08, 0.12)
    middle = h * u(0.5, 0.6)
    return Oven(
        body,
        depth,
        radius=0.0,
        flange=u(0.014, 0.03),
        feet="none",
        door=_hung(-w / 2, u(0.015, 0.05), w / 2, middle, t),
        thickness=t,
        look=str(rng.choice(["window", "wide", "glass"])),
        fixed_doors=(Rect(-w / 2, middle + GAP, w / 2, h - strip - GAP),),
        controls=Rect(-w / 2, h - strip, w / 2, h),
    )


def _toaster(rng: np.random.Generator) -> Oven:
    """A counter-top oven with its knobs in a column beside the door."""
    u = rng.uniform
    w, h, depth, t = u(0.4, 0.54), u(0.25, 0.36), u(0.28, 0.4), u(0.016, 0.02)
    lift = u(0.014, 0.022)
    body, cut = Rect(-w / 2, lift, w / 2, h), w * u(0.2, 0.27)
    door = _hung(-w / 2 + 0.008, lift + u(0.015, 0.03), cut, h - u(0.006, 0.02), t)
    return Oven(
        body,
        depth,
        radius=float(rng.choice([0.0, 0.02, 0.045])),
        flange=0.0,
        feet="feet",
        door=door,
        thickness=t,
        look=str(rng.choice(["wide", "glass", "window"])),
        controls=Rect(cut + GAP, lift + 0.012, w / 2 - 0.008, h - 0.012),
    )


def _stove_with_lids(rng: np.random.Generator) -> Oven:
    """A heavy cast-iron cooker: four doors, of which one opens, and lidded hotplates."""
    u = rng.uniform
    w, h, depth, t = u(0.86, 1.05), u(0.84, 0.9), u(0.58, 0.66), u(0.042, 0.052)
    lift = u(0.06, 0.12)
    body, ceiling = Rect(-w / 2, lift, w / 2, h), h - u(0.09, 0.12)
    middle, edge = (lift + ceiling) / 2, u(0.03, 0.05)
    columns = ((-w / 2 + edge, -edge / 2), (edge / 2, w / 2 - edge))
    lower = [_hung(a, lift + 0.03, b, middle, t) for a, b in columns]
    upper = [_hung(a, middle + 0.02, b, ceiling, t) for a, b in columns]
    doors = [*lower, *upper]
    chosen = doors.pop(int(rng.integers(4)))
    return Oven(
        body,
        depth,
        radius=u(0.0, 0.02),
        flange=0.0,
        feet="plinth",
        door=chosen,
        thickness=t,
        look="solid",
        fixed_doors=tuple(doors),
        controls=Rect(-w / 2, ceiling, w / 2, h),
        stove="lids",
    )


def _flipped(rect: Rect) -> Rect:
    return Rect(-rect.y1, rect.z0, -rect.y0, rect.z1)


STYLES: tuple[Callable[[np.random.Generator], Oven], ...] = (
    _range,
    _range,
    _range,
    _professional,
    _retro,
    _built_in,
    _double,
    _toaster,
    _toaster,
    _stove_with_lids,
)
