"""What kinds of front loaders there are: their proportions and what they consist of."""

from dataclasses import dataclass, replace

import numpy as np

from articugen.procedural.kit import GAP
from articugen.procedural.kit.parts import Rect


@dataclass(frozen=True)
class Washer:
    """The plan of one machine; the front face of its body is x = 0, rectangles lie in (y, z).

    Attributes:
        body: the outside of the body, above its feet.
        depth: of the body; its back is x = -depth.
        radius: of the body's corners, seen from the front.
        middle: z of the door's center; its y is 0.
        opening: radius of the hole in the front.
        drum: (radius, depth) of the space behind the front.
        rim: half the door's size.
        square: radius of a square door's corners, 0 for a round door.
        thickness: of the door's rim.
        wall: of the bowl's glass and other shells.
        look: of the door: bowl, dome, flat or deep.
        fascia: the strip above the door that holds the controls.
        console: controls stand on a board at the top's rear; the fascia is plain.
        pedestal: height of a base with a drawer, 0 for none.
        legs: the body stands on four short legs and has no kick plate.
        stacked: a dryer that does not open stands on top.
        sides: of everything round.
    """

    body: Rect
    depth: float
    radius: float
    middle: float
    opening: float
    drum: tuple[float, float]
    rim: float
    square: float
    thickness: float
    wall: float
    look: str
    fascia: Rect
    console: bool
    pedestal: float
    legs: bool
    stacked: bool
    sides: int

    @property
    def front(self) -> float:
        """The thickness of the body's front around the opening."""
        return 2.5 * self.wall

    def bowl_radius(self, depth: float) -> float:
        """Return how wide the bowl may be `depth` behind the body's front face.

        At distance D inward of the hinge and U along the front, a point swings out on a circle of
        radius sqrt(D^2 + U^2) and moves away from the hinge by at most D^2 / (2 U) on its way; the
        opening must have room for that.
        """
        inward = self.thickness + GAP + depth
        return self.opening - 2 * GAP - inward**2 / (2 * self.rim)


def draw(rng: np.random.Generator, *, varied: bool = False) -> Washer:
    """Return the plan of one machine; in a varied one the door may be smaller, square, and to one
    side."""
    u = rng.uniform
    kind = str(rng.choice(_KINDS))
    (w_low, w_high), (d_low, d_high), (h_low, h_high) = _SIZES[kind]
    w, depth, h = u(w_low, w_high), u(d_low, d_high), u(h_low, h_high)
    pedestal = u(0.22, 0.36) if kind == "large" and u() < 0.5 else 0.0
    lift = u(0.02, 0.06) if kind == "mini" else u(0.015, 0.035) + pedestal
    body = Rect(-w / 2, lift, w / 2, lift + h)
    console = kind in ("standard", "large", "narrow") and pedestal == 0.0 and bool(u() < 0.3)
    strip = 0.03 if console else u(0.2, 0.26) if kind == "mini" else u(0.12, 0.2)
    strip, kick = strip * h, u(0.04, 0.16) * h
    fascia = Rect(-w / 2, body.z1 - strip, w / 2, body.z1)
    room = min(w / 2 - 0.045, (h - strip - kick) / 2 - 0.012)
    rim = room * u(0.72, 1.0)
    low, high = lift + kick + rim, fascia.z0 - 0.01 - rim
    tall = 2 * h if kind == "stacked" else h
    extent = max(tall + lift, depth + 2 * rim)
    opening = rim - u(0.03, 0.055) * extent
    washer = Washer(
        body,
        depth,
        radius=u(0.07, 0.12) if kind == "mini" else float(rng.choice([0.0, 0.015, 0.04])),
        middle=low + u(0.3, 1.0) * (high - low),
        opening=opening,
        drum=(min(opening + u(0.03, 0.07), w / 2 - 0.03), depth * u(0.6, 0.78)),
        rim=rim,
        square=float(rng.choice([0.0, 0.0, 0.0, 0.35, 0.55])) * rim,
        thickness=u(0.03, 0.05) * max(extent, 0.75),
        wall=0.0125 * extent,
        look=str(rng.choice(["bowl", "bowl", "dome", "flat", "deep"])),
        fascia=fascia,
        console=console,
        pedestal=pedestal,
        legs=kind == "mini",
        stacked=kind == "stacked",
        sides=24 if kind == "stacked" else 40,
    )
    return _aside(rng, washer, w / 2 - 0.045) if varied else washer


def _aside(rng: np.random.Generator, washer: Washer, room: float) -> Washer:
    """Return the machine with its door elsewhere: the body is moved, the door stays at y = 0."""
    u = rng.uniform
    share = u(0.72, 1.0)
    rim = share * washer.rim
    opening = share * washer.opening
    most = max(min(room - rim, washer.body.width / 2 - 0.06 - opening), 0.0)  # room for the drum
    far = 0.0 if washer.console or washer.stacked else u(-1.0, 1.0) * most
    radius = min(washer.drum[0], washer.body.width / 2 - 0.03 - abs(far))
    square = float(rng.choice([0.0, 0.35, 0.2])) * rim
    body, fascia = (Rect(r.y0 + far, r.z0, r.y1 + far, r.z1) for r in (washer.body, washer.fascia))
    return replace(
        washer, body=body, fascia=fascia, rim=rim, opening=opening, square=square,
        drum=(radius, washer.drum[1]),
    )  # fmt: skip


_KINDS = ("standard",) * 3 + ("slim", "large", "large", "compact", "mini", "narrow", "stacked")

_SIZES = {
    "standard": ((0.58, 0.62), (0.5, 0.64), (0.8, 0.88)),
    "slim": ((0.56, 0.6), (0.32, 0.42), (0.8, 0.86)),
    "large": ((0.66, 0.74), (0.66, 0.8), (0.88, 1.0)),
    "compact": ((0.46, 0.54), (0.4, 0.48), (0.58, 0.7)),
    "mini": ((0.44, 0.54), (0.36, 0.46), (0.44, 0.56)),
    "narrow": ((0.4, 0.46), (0.56, 0.64), (0.84, 0.92)),
    "stacked": ((0.58, 0.66), (0.56, 0.66), (0.8, 0.86)),
}
"""(low, high) of width, depth and height, metres."""
