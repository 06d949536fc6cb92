"""Front loaders: one round or square door that opens about +z or -z in front of a hollow drum.
Varied ones are loaded from above, too.

The body is solid around the drum. The door hangs in front of it, hinged at its outer edge on one
side; its bowl reaches through the opening and is so tapered that it swings out without touching.
"""

import numpy as np

from articugen.core.geometry import rotation_about, transform
from articugen.procedural.kit import GAP, RANGE
from articugen.procedural.kit.model import Model, ModelLink, first_sound, moving_part
from articugen.procedural.kit.outlines import circle, matched, rounded_rectangle
from articugen.procedural.kit.parts import Rect, handle, lathe, leaning, plank, plate, row, tapered
from articugen.procedural.kit.solids import Solid, along_x, block, box, prism, ring
from articugen.procedural.washing_machine.controls import console, panel
from articugen.procedural.washing_machine.plan import Washer, draw
from articugen.procedural.washing_machine.top_loader import build_top_loader


def build(rng: np.random.Generator) -> Model:
    """Build one object: links body and door.

    One in a hundred draws has a drum that comes through the casing, or a bowl too flat for its
    wall: it is drawn again.
    """
    return first_sound(lambda: _drawn(rng, draw(rng), RANGE[1]))


def build_varied(rng: np.random.Generator) -> Model:
    """Build one that is loaded in front, its door wherever there is room, or from above."""

    def drawn() -> Model:
        if rng.uniform() < 0.45:
            return build_top_loader(rng)
        return _drawn(rng, draw(rng, varied=True), np.deg2rad(rng.uniform(90.0, 135.0)))

    return first_sound(drawn)


def _drawn(rng: np.random.Generator, washer: Washer, upper: float) -> Model:
    unit = [*_casing(washer), *_drum(rng, washer), *_top(rng, washer), *_controls(rng, washer)]
    door = _door(rng, washer)
    body = [*unit, *_base(rng, washer), *_hinge(washer)]
    if washer.stacked:
        dryer = [*unit, *_hinge(washer), *(s.shifted(x=-GAP) for s in door)]
        body += [s.shifted(z=washer.body.height + 0.02) for s in dryer]
        between, inner = washer.body.z1 - 0.01, washer.body.shrunk(0.02)
        joint = Rect(inner.y0, between, inner.y1, between + 0.04)
        body.append(plank(joint, -washer.depth + 0.02, -0.02))
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    if side < 0.0:
        body, door = ([s.mirrored(1) for s in solids] for solids in (body, door))
    hinge = (GAP + washer.thickness, side * washer.rim, washer.middle)
    opens = moving_part("door", "door", door, hinge, (0.0, 0.0, side), upper)
    return Model.of(ModelLink("body", "washing_machine_body", tuple(body)), [opens])


def _casing(washer: Washer) -> list[Solid]:
    """Build the solid body: a front with the opening, the drum's space, the back."""
    center, outline = (0.0, washer.middle), washer.body.outline(washer.radius)
    radius, deep = washer.drum

    def layer(hole: float, x0: float, x1: float) -> Solid:
        return along_x(ring(*matched(outline, circle(hole, washer.sides, center), center), x0, x1))

    x = -washer.front
    return [
        layer(washer.opening, x, 0.0),
        layer(radius, x - deep, x),
        plate(washer.body, -washer.depth, x - deep, radius=washer.radius),
    ]


def _drum(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """Build the inside: a lining with a lip, lifters, a hub with spokes."""
    radius, deep = washer.drum
    wall, x = washer.wall, -washer.front
    back, inner = x - deep, radius - wall
    lining = lathe(
        [(inner, back), (inner, x - 2 * wall), (washer.opening + 0.3 * wall, x)],
        [(radius, back), (radius, x - 2 * wall), (radius, x)],
        washer.sides,
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
    """Build the solid turned about x."""
    return solid.moved(transform(rotation_about((1, 0, 0), 2 * np.pi * turns)))


def _top(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """Build a lid; none on rounded bodies and under a dryer."""
    if washer.radius > 0.02 or washer.stacked:
        return []
    body, thick = washer.body, rng.uniform(1.2, 2.4) * washer.wall
    over = rng.uniform(0.0, 0.012)
    low = (-washer.depth, body.y0 - over, body.z1)
    high = (over + 0.01, body.y1 + over, body.z1 + thick)
    bevel = rng.uniform(0.1, 0.45) * thick
    return [block(low, high, radius=rng.uniform(0.0, 0.03), bevel=(0.0, bevel), segments=4)]


def _controls(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """Return a panel with a detergent tray, a dial, a display and buttons, in front or on a
    console."""
    rect, e = washer.fascia, washer.wall
    if washer.console:
        high, foot = rng.uniform(0.1, 0.16), rng.uniform(0.09, 0.14)
        at = (-washer.depth, washer.body.z1)
        return console(rng, at, (washer.body.width, high), (foot, 0.04), e)
    slab = rect.shrunk(0.5 * washer.radius, 0.25 * washer.radius).shrunk(0.0, 0.002)
    out = rng.uniform(0.4, 1.2) * e
    lean = rng.uniform(0.5, 2.5) * e if rng.uniform() < 0.35 and washer.radius < 0.03 else 0.0
    board, T = leaning(slab, 0.0, out + lean, out)
    if lean == 0.0:
        board = plate(slab, 0.0, out, radius=0.3 * washer.radius, bevel=0.2 * out)
    placed = panel(rng, slab.width, slab.height, e, tray=True)
    return [board, *(s.moved(T) for s in placed)]


def _base(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """Feet on the floor z = 0, a kick plate with a hatch, a pedestal with its drawer."""
    body, back, e = washer.body, -washer.depth, washer.wall
    foot_top = body.z0 - washer.pedestal
    inset = max(0.05, washer.radius)
    radii = np.array((1.0, 1.8) if washer.legs else (1.6, 1.28)) * e
    places = [(x, y) for x in (-inset, back + inset) for y in (body.y0 + inset, body.y1 - inset)]
    solids = [tapered(radii, (0.0, foot_top + e)).shifted(*p) for p in places]
    if washer.pedestal > 0.0:
        low, high = (back + 0.01, body.y0, foot_top), (0.0, body.y1, body.z0)
        drawer = Rect(body.y0, foot_top, body.y1, body.z0).shrunk(0.012)
        pull = handle("bar", 0.6 * drawer.width, 3.0 * e, 1.2 * e)
        solids += [block(low, high, bevel=0.0), plate(drawer, 0.0, 1.2 * e, bevel=0.2 * e)]
        solids += [s.shifted(1.2 * e, 0.0, drawer.z1 - 4 * e) for s in pull]
    kick = min(washer.middle - washer.rim - 0.01 - body.z0, 0.15)
    if kick > 0.05 and not washer.legs:
        strip = Rect(body.y0, body.z0, body.y1, body.z0 + 0.85 * kick)
        strip = strip.shrunk(0.8 * washer.radius + 0.004, 0.004)
        solids += _grille(strip, e) if rng.uniform() < 0.3 else _hatch(rng, strip, 0.4 * e, e)
    return solids


def _grille(strip: Rect, e: float) -> list[Solid]:
    """Upright bars over an air inlet."""
    area = strip.shrunk(0.1 * strip.width, 0.14 * strip.height)
    count = int(area.width / (3.0 * e))
    return [
        plate(Rect(y - 0.7 * e, area.z0, y + 0.7 * e, area.z1), 0.0, e, bevel=0.3 * e)
        for y in row(area.center[0], area.width / 2, count)
    ]


def _hatch(rng: np.random.Generator, strip: Rect, x: float, e: float) -> list[Solid]:
    """Build a kick plate up to `x` with the cover of the drain filter."""
    kick_plate = plate(strip, 0.0, x)
    half = 0.38 * strip.height
    y = strip.y0 + float(rng.choice([0.15, 0.5, 0.85])) * (strip.width - 4 * half) + 2 * half
    z = strip.center[1]
    if rng.uniform() < 0.5:
        disc = along_x(tapered((half, half, 0.9 * half), (x, x + 0.4 * e, x + 0.6 * e), 24))
        return [kick_plate, disc.shifted(y=y, z=z)]
    cover = Rect(y - 1.6 * half, z - half, y + 1.6 * half, z + half)
    return [kick_plate, plate(cover, x, x + 0.6 * e)]


def _hinge(washer: Washer) -> list[Solid]:
    """Build the body's half of the hinge: it stays beside the pin, where the door never comes."""
    y, z, tall = washer.rim + GAP, washer.middle, 0.28 * washer.rim
    front = 0.8 * washer.thickness
    return [plate(Rect(y, z - tall, y + 0.024, z + tall), 0.0, front, bevel=0.006)]


def _door(rng: np.random.Generator, washer: Washer) -> list[Solid]:
    """Build the door's rim, glass, handle and hinge leaf; hinged at y = +rim."""
    t, wall, rim = washer.thickness, washer.wall, washer.rim
    pane = washer.bowl_radius(-GAP)
    x0, x1 = GAP, GAP + t
    hole = circle(pane - 0.5 * wall, washer.sides)
    if washer.square > 0.0:
        outline = rounded_rectangle(2 * rim, 2 * rim, washer.square, segments=6)
        leaf = along_x(ring(*matched(outline, hole), x0, x1))
    else:
        edge, slant = pane - 0.5 * wall, rng.uniform(0.1, 0.5) * t
        leaf = along_x(
            lathe(
                [(edge, x0), (edge, x1 - slant), (edge + 0.4 * wall, x1)],
                [(rim, x0), (rim, x1 - slant), (rim - slant, x1)],
                washer.sides,
            )
        )
    solids = [leaf, *_glass(rng, washer, pane), *_grip(rng, washer, pane)]
    tall = 0.22 * rim
    solids.append(box((x0, pane, -tall), (x0 + 0.8 * t, rim, tall)))
    return [s.shifted(z=washer.middle) for s in solids]


def _glass(rng: np.random.Generator, washer: Washer, pane: float) -> list[Solid]:
    """Build the pane and the bowl behind it, around x; `pane` is the bowl's radius at the rim."""
    t, wall = washer.thickness, washer.wall
    face = GAP + t
    reach = rng.uniform(0.08, 0.12) if washer.look == "deep" else rng.uniform(0.03, 0.075)
    reach = min(reach, 0.4 * washer.drum[1])
    depths = np.linspace(0.0, reach, 5)
    round_off = 1.0 - rng.uniform(0.1, 0.3) * (depths / reach) ** 2
    radii = np.minimum([washer.bowl_radius(d) for d in depths], pane) * round_off
    outer = np.concatenate([[(pane, GAP + 0.6 * t)], np.c_[radii, -depths]])
    sides = washer.sides
    if washer.look in ("bowl", "deep"):
        inner = outer - (wall, 0.0) + np.linspace(0.0, wall, len(outer))[:, None] * (0.0, 1.0)
        end = tapered((radii[-1], radii[-1] - 0.2 * wall), (-reach, wall - reach), sides)
        return [along_x(lathe(inner, outer, sides)), along_x(end)]
    plug = tapered(outer[::-1, 0], outer[::-1, 1], sides)
    if washer.look == "flat":
        disc = tapered((1.02 * pane, 1.02 * pane), (GAP + 0.5 * t, face - 0.1 * t), sides)
        return [along_x(plug), along_x(disc)]
    bulge = rng.uniform(0.02, 0.05)
    shape = np.array(((1.0, 0.0), (0.95, 0.35), (0.8, 0.7), (0.5, 0.93), (0.2, 1.0)))
    dome = tapered(shape[:, 0] * pane, face - 0.3 * t + shape[:, 1] * bulge, sides)
    seat = tapered((pane, pane), (GAP + 0.5 * t, face - 0.3 * t), sides)
    return [along_x(solid) for solid in (plug, seat, dome)]


def _grip(rng: np.random.Generator, washer: Washer, pane: float) -> list[Solid]:
    """Build the grip, on the side away from the hinge."""
    t, wall, rim = washer.thickness, washer.wall, washer.rim
    middle, width = -(rim + pane) / 2, rim - pane
    if rng.uniform() < 0.5:
        tall = rng.uniform(0.2, 0.32) * rim
        tab = Rect(-rim - 0.35 * width, -tall, middle, tall)
        return [plate(tab, GAP + 0.25 * t, GAP + t + wall, radius=0.4 * width, bevel=0.5 * wall)]
    bar = handle("arch", 0.6 * rim, 2.8 * wall, 1.2 * wall, upright=True)
    return [s.shifted(GAP + 0.8 * t, middle, 0.0) for s in bar]
