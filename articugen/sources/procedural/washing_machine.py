"""Front loaders: one round or square door that opens about +z or -z in front of a hollow drum.

The body is solid around the drum. The door hangs in front of it, hinged at its outer edge on one
side; its bowl reaches through the opening and is so tapered that it swings out without touching.
"""

from dataclasses import dataclass

import numpy as np

from articugen.geometry import rotation_about, transform
from articugen.sources.procedural.appliance_parts import (
    Rect,
    handle,
    knob,
    lathe,
    plate,
    row,
    tapered,
)
from articugen.sources.procedural.model import Model, ModelJoint, ModelLink
from articugen.sources.procedural.outlines import circle, matched, rounded_rectangle
from articugen.sources.procedural.solids import Solid, along_x, block, box, prism, ring

GAP = 0.003
"""Metres between the door and the body, on all sides, at every angle."""

RANGE = (0.0, float(np.deg2rad(135.0)))
SIDES = 40


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
        pedestal: height of a base with a drawer, 0 for none.
        stacked: a dryer that does not open stands on top.
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
    pedestal: float
    stacked: bool

    @property
    def front(self) -> float:
        """The thickness of the body's front around the opening."""
        return 2.5 * self.wall

    def bowl_radius(self, depth: float) -> float:
        """How wide the bowl may be `depth` behind the body's front face.

        At distance D inward of the hinge and U along the front, a point swings out on a circle of
        radius sqrt(D^2 + U^2) and moves away from the hinge by at most D^2 / (2 U) on its way; the
        opening must have room for that.
        """
        inward = self.thickness + GAP + depth
        return self.opening - 2 * GAP - inward**2 / (2 * self.rim)


def build(rng: np.random.Generator) -> Model:
    """One object: links body and door."""
    washer = _draw(rng)
    unit = _unit(rng, washer)
    door = _door(rng, washer)
    body = [*unit, *_base(rng, washer), *_hinge(washer)]
    if washer.stacked:
        dryer = [*unit, *_hinge(washer), *(s.shifted(x=-GAP) for s in door)]
        body += [s.shifted(z=washer.body.height + 0.02) for s in dryer]
        between = washer.body.z1 - 0.01
        inner = washer.body.shrunk(0.02)
        body.append(
            box((-washer.depth + 0.02, inner.y0, between), (-0.02, inner.y1, between + 0.04))
        )
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    if side < 0.0:
        body, door = ([s.mirrored(1) for s in solids] for solids in (body, door))
    hinge = (GAP + washer.thickness, side * washer.rim, washer.middle)
    joint = ModelJoint("door_hinge", "revolute", "body", "door", hinge, (0.0, 0.0, side), *RANGE)
    links = (
        ModelLink("body", "washing_machine_body", tuple(body)),
        ModelLink("door", "door", tuple(door)),
    )
    return Model(links, (joint,))


def _draw(rng: np.random.Generator) -> Washer:
    u = rng.uniform
    kind = str(rng.choice(["standard", "standard", "slim", "large", "compact", "stacked"]))
    (w_low, w_high), (d_low, d_high), (h_low, h_high) = _SIZES[kind]
    w, depth, h = u(w_low, w_high), u(d_low, d_high), u(h_low, h_high)
    pedestal = u(0.22, 0.36) if kind == "large" and u() < 0.6 else 0.0
    lift = u(0.015, 0.035) + pedestal
    body = Rect(-w / 2, lift, w / 2, lift + h)
    strip, kick = u(0.12, 0.18) * h, u(0.06, 0.14) * h
    fascia = Rect(-w / 2, body.z1 - strip, w / 2, body.z1)
    room = min(w / 2 - 0.045, (h - strip - kick) / 2 - 0.012)
    rim = room * u(0.74, 1.0)
    low, high = lift + kick + rim, fascia.z0 - 0.01 - rim
    tall = 2 * h if kind == "stacked" else h
    extent = max(tall + lift, depth + 2 * rim)
    opening = rim - u(0.03, 0.05) * extent
    square = float(rng.choice([0.0, 0.0, 0.0, 0.45])) * rim
    return Washer(
        body,
        depth,
        radius=float(rng.choice([0.0, 0.015, 0.04])),
        middle=low + u(0.4, 1.0) * (high - low),
        opening=opening,
        drum=(min(opening + u(0.03, 0.07), w / 2 - 0.03), depth * u(0.6, 0.78)),
        rim=rim,
        square=square,
        thickness=u(0.03, 0.05) * max(extent, 0.75),
        wall=0.0125 * extent,
        look=str(rng.choice(["bowl", "bowl", "dome", "flat", "deep"])),
        fascia=fascia,
        pedestal=pedestal,
        stacked=kind == "stacked",
    )


_SIZES = {
    "standard": ((0.58, 0.62), (0.5, 0.64), (0.8, 0.88)),
    "slim": ((0.56, 0.6), (0.34, 0.44), (0.8, 0.86)),
    "large": ((0.66, 0.72), (0.66, 0.78), (0.88, 1.0)),
    "compact": ((0.46, 0.54), (0.4, 0.48), (0.58, 0.7)),
    "stacked": ((0.58, 0.66), (0.56, 0.66), (0.8, 0.86)),
}
"""(low, high) of width, depth and height, metres."""


def _unit(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """The casing with its drum, top and controls."""
    return [
        *_casing(washer),
        *_drum(rng, washer),
        *_top(rng, washer),
        *_fascia(rng, washer),
    ]


def _casing(washer: Washer) -> list[Solid]:
    """The solid body: a front with the opening, the drum's space, the back."""
    center, outline = (0.0, washer.middle), washer.body.outline(washer.radius)
    radius, deep = washer.drum

    def layer(hole: float, x0: float, x1: float) -> Solid:
        return along_x(ring(*matched(outline, circle(hole, SIDES, center), center), x0, x1))

    x = -washer.front
    return [
        layer(washer.opening, x, 0.0),
        layer(radius, x - deep, x),
        plate(washer.body, -washer.depth, x - deep, radius=washer.radius),
    ]


def _drum(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """What is seen inside: a lining with a lip, lifters, a hub with spokes."""
    radius, deep = washer.drum
    wall, x = washer.wall, -washer.front
    back, inner = x - deep, radius - wall
    lining = lathe(
        [(inner, back), (inner, x - 2 * wall), (washer.opening + 0.3 * wall, x)],
        [(radius, back), (radius, x - 2 * wall), (radius, x)],
        SIDES,
    )
    tall, wide = 0.16 * radius, 0.14 * radius
    lifter = np.array(
        [(-1.0, -1.01 * inner), (1.0, -1.01 * inner), (0.4, tall - inner), (-0.4, tall - inner)]
    ) * (wide, 1.0)
    hub = along_x(tapered((0.3 * radius, 0.22 * radius), (back, back + wall), sides=20))
    spoke = box((back, -0.04 * radius, 0.0), (back + 0.8 * wall, 0.04 * radius, 0.98 * inner))
    solids = [along_x(lining), hub]
    count = int(rng.integers(3, 5))
    for k in range(count):
        solids.append(_turned(along_x(prism(lifter, back, x - 4 * wall)), k / count + 0.05))
    solids += [_turned(spoke, k / 6) for k in range(6)]
    return [s.shifted(z=washer.middle) for s in solids]


def _turned(solid: Solid, turns: float) -> Solid:
    """The solid turned about x."""
    return solid.moved(transform(rotation_about((1, 0, 0), 2 * np.pi * turns)))


def _top(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """A lid; none on rounded bodies and under a dryer."""
    if washer.radius > 0.02 or washer.stacked:
        return []
    body, thick = washer.body, rng.uniform(1.2, 2.4) * washer.wall
    over = rng.uniform(0.0, 0.012)
    low = (-washer.depth, body.y0 - over, body.z1)
    high = (over + 0.01, body.y1 + over, body.z1 + thick)
    bevel = rng.uniform(0.1, 0.45) * thick
    return [block(low, high, radius=rng.uniform(0.0, 0.03), bevel=(0.0, bevel), segments=4)]


def _fascia(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """The controls: a detergent tray, a dial, a display, buttons."""
    rect, e = washer.fascia, washer.wall
    out = rng.uniform(0.4, 1.2) * e
    slab = rect.shrunk(0.0, 0.002).shrunk(0.5 * washer.radius, 0.25 * washer.radius)
    solids = [plate(slab, 0.0, out, radius=0.3 * washer.radius, bevel=0.2 * out)]
    z, tall = rect.center[1], 0.36 * rect.height
    width = slab.width
    left = slab.y0 + 0.03 * width
    tray = Rect(left, z - tall, left + rng.uniform(0.24, 0.34) * width, z + tall)
    solids += _tray(rng, tray, out, e)
    dial_y = float(rng.choice([0.5, 0.62, 0.88])) * width + slab.y0
    radius = min(rng.uniform(0.75, 1.0) * tall, 0.055)
    reach = rng.uniform(1.5, 2.6) * e
    collar = along_x(ring(circle(1.25 * radius, 28), circle(radius, 28), out, out + 0.4 * e))
    dial = knob(str(rng.choice(["plain", "grip", "cone"])), radius, reach, sides=28)
    solids += [collar.shifted(y=dial_y, z=z), *(s.shifted(out, dial_y, z) for s in dial)]
    free = [(tray.y1, dial_y - 1.4 * radius), (dial_y + 1.4 * radius, slab.y1)]
    a, b = max(free, key=lambda span: span[1] - span[0])
    middle, half = (a + b) / 2, (b - a) / 2
    if rng.uniform() < 0.75:
        screen = Rect(middle - 0.75 * half, z - 0.05 * tall, middle + 0.75 * half, z + 0.75 * tall)
        solids.append(plate(screen, out, out + 0.5 * e, bevel=0.2 * e))
    size = min(0.12 * half, 0.2 * tall)
    count = int(rng.integers(3, 7))
    for y in row(middle, 0.8 * half, count):
        key = Rect(y - size, z - 0.6 * tall - size, y + size, z - 0.6 * tall + size)
        solids.append(plate(key, out, out + 0.6 * e, radius=0.4 * size))
    return solids


def _tray(rng: np.random.Generator, rect: Rect, x: float, e: float) -> list[Solid]:
    """The front of a detergent tray, with a lip or a grip to pull."""
    front = x + 0.9 * e
    solids = [plate(rect, x, front, radius=0.15 * rect.height, bevel=0.25 * e)]
    y, z = rect.center
    if rng.uniform() < 0.5:
        made = handle("cup", 0.6 * rect.width, 2.0 * e, e)
    else:
        made = [plate(Rect(-0.3 * rect.width, -0.5 * e, 0.3 * rect.width, 0.5 * e), 0.0, 1.2 * e)]
    return [*solids, *(s.shifted(front, y, z) for s in made)]


def _base(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """Feet on the floor z = 0, a kick plate with a hatch, a pedestal with its drawer."""
    body, back, e = washer.body, -washer.depth, washer.wall
    foot_top = body.z0 - washer.pedestal
    inset = max(0.05, washer.radius)
    radius = 1.6 * e
    places = [(x, y) for x in (-inset, back + inset) for y in (body.y0 + inset, body.y1 - inset)]
    solids = [tapered((radius, 0.8 * radius), (0.0, foot_top + e)).shifted(*p) for p in places]
    if washer.pedestal > 0.0:
        low, high = (back + 0.01, body.y0, foot_top), (0.0, body.y1, body.z0)
        drawer = Rect(body.y0, foot_top, body.y1, body.z0).shrunk(0.012)
        pull = handle("bar", 0.6 * drawer.width, 3.0 * e, 1.2 * e)
        solids += [block(low, high, bevel=0.0), plate(drawer, 0.0, 1.2 * e, bevel=0.2 * e)]
        solids += [s.shifted(1.2 * e, 0.0, drawer.z1 - 4 * e) for s in pull]
    kick = washer.middle - washer.rim - 0.01 - body.z0
    if kick > 0.05:
        strip = Rect(body.y0, body.z0, body.y1, body.z0 + min(0.8 * kick, 0.12))
        strip = strip.shrunk(0.8 * washer.radius + 0.004, 0.004)
        solids.append(plate(strip, 0.0, 0.4 * e))
        solids += _hatch(rng, strip, 0.4 * e, e)
    return solids


def _hatch(rng: np.random.Generator, strip: Rect, x: float, e: float) -> list[Solid]:
    """The cover of the drain filter."""
    half = 0.38 * strip.height
    y = strip.y0 + float(rng.choice([0.15, 0.5, 0.85])) * (strip.width - 4 * half) + 2 * half
    z = strip.center[1]
    if rng.uniform() < 0.5:
        disc = along_x(tapered((half, half, 0.9 * half), (x, x + 0.4 * e, x + 0.6 * e), 24))
        return [disc.shifted(y=y, z=z)]
    return [plate(Rect(y - 1.6 * half, z - half, y + 1.6 * half, z + half), x, x + 0.6 * e)]


def _hinge(washer: Washer) -> list[Solid]:
    """The body's half of the hinge: it stays beside the pin, where the door never comes."""
    y, z, tall = washer.rim + GAP, washer.middle, 0.28 * washer.rim
    front = 0.8 * washer.thickness
    return [plate(Rect(y, z - tall, y + 0.024, z + tall), 0.0, front, bevel=0.006)]


def _door(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """The door's rim, glass, handle and hinge leaf; hinged at y = +rim."""
    t, wall, rim = washer.thickness, washer.wall, washer.rim
    pane = washer.bowl_radius(-GAP)
    x0, x1 = GAP, GAP + t
    hole = circle(pane - 0.5 * wall, SIDES)
    if washer.square > 0.0:
        outline = rounded_rectangle(2 * rim, 2 * rim, washer.square, segments=6)
        leaf = along_x(ring(*matched(outline, hole), x0, x1))
    else:
        edge, slant = pane - 0.5 * wall, rng.uniform(0.1, 0.5) * t
        leaf = along_x(
            lathe(
                [(edge, x0), (edge, x1 - slant), (edge + 0.4 * wall, x1)],
                [(rim, x0), (rim, x1 - slant), (rim - slant, x1)],
                SIDES,
            )
        )
    solids = [leaf, *_glass(rng, washer, pane), *_grip(rng, washer, pane)]
    tall = 0.22 * rim
    solids.append(box((x0, pane, -tall), (x0 + 0.8 * t, rim, tall)))
    return [s.shifted(z=washer.middle) for s in solids]


def _glass(rng: np.random.Generator, washer: Washer, pane: float) -> list[Solid]:
    """The pane and the bowl behind it, around x; `pane` is the bowl's radius at the rim."""
    t, wall = washer.thickness, washer.wall
    face = GAP + t
    reach = rng.uniform(0.08, 0.12) if washer.look == "deep" else rng.uniform(0.03, 0.075)
    reach = min(reach, 0.4 * washer.drum[1])
    depths = np.linspace(0.0, reach, 5)
    round_off = 1.0 - rng.uniform(0.1, 0.3) * (depths / reach) ** 2
    radii = np.minimum([washer.bowl_radius(d) for d in depths], pane) * round_off
    outer = np.concatenate([[(pane, GAP + 0.6 * t)], np.c_[radii, -depths]])
    if washer.look in ("bowl", "deep"):
        inner = outer - (wall, 0.0) + np.linspace(0.0, wall, len(outer))[:, None] * (0.0, 1.0)
        end = along_x(tapered((radii[-1], radii[-1] - 0.2 * wall), (-reach, wall - reach), SIDES))
        return [along_x(lathe(inner, outer, SIDES)), end]
    plug = along_x(tapered(tuple(outer[::-1, 0]), tuple(outer[::-1, 1]), SIDES))
    if washer.look == "flat":
        disc = tapered((1.02 * pane, 1.02 * pane), (GAP + 0.5 * t, face - 0.1 * t), SIDES)
        return [plug, along_x(disc)]
    bulge = rng.uniform(0.02, 0.05)
    shape = np.array(((1.0, 0.0), (0.95, 0.35), (0.8, 0.7), (0.5, 0.93), (0.2, 1.0)))
    dome = tapered(tuple(shape[:, 0] * pane), tuple(face - 0.3 * t + shape[:, 1] * bulge), SIDES)
    seat = tapered((pane, pane), (GAP + 0.5 * t, face - 0.3 * t), SIDES)
    return [plug, along_x(seat), along_x(dome)]


def _grip(rng: np.random.Generator, washer: Washer, pane: float) -> list[Solid]:
    """What one pulls at, on the side away from the hinge."""
    t, wall, rim = washer.thickness, washer.wall, washer.rim
    middle, width = -(rim + pane) / 2, rim - pane
    if rng.uniform() < 0.5:
        tall = rng.uniform(0.2, 0.32) * rim
        tab = Rect(-rim - 0.35 * width, -tall, middle, tall)
        return [plate(tab, GAP + 0.25 * t, GAP + t + wall, radius=0.4 * width, bevel=0.5 * wall)]
    bar = handle("arch", 0.6 * rim, 2.8 * wall, 1.2 * wall, upright=True)
    return [s.shifted(GAP + 0.8 * t, middle, 0.0) for s in bar]
