"""Laptops: a base with keyboard and trackpad, a lid with a screen, one revolute joint.

q = 0 is the closed lid; the lid opens about +y to 135 degrees. The front looks towards -x and the
hinge is at the rear. Everything is drawn in the user's frame (x to the right, y away, z up) with
the origin on the hinge's axis and turned at the end.

No two parts meet at any q. Before the axis the base lies below the lid, which turns away from it.
Where the hinge lies between the two, the rear edge of the lid comes no nearer to the axis than
`reach`, and what the base has behind the axis stays within that; the knuckles of the lid turn in
notches of the base. Where the lid drops behind the base, the whole hinge lies below the closed lid,
of which no point behind the axis is below 45 degrees: opened by 135 degrees it hangs straight down
at most, and the base ends before the axis.
"""

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import transform
from articugen.core.portable import cos, norm, sin
from articugen.procedural.kit import MM, RANGE
from articugen.procedural.kit.model import Model, ModelJoint, ModelLink
from articugen.procedural.kit.outlines import circle, ellipse, matched, rounded_rectangle
from articugen.procedural.kit.solids import (
    Solid,
    along_x,
    block,
    box,
    cylinder,
    loft,
    prism,
    ring,
    stack,
    sweep,
)
from articugen.procedural.laptop.keyboard import Keyboard
from articugen.procedural.laptop.shape import SLIT, LaptopShape, draw_shape

_T_WORLD_USER = transform([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def build(rng: np.random.Generator) -> Model:
    """Build a laptop with links `body` and `lid` and the joint `hinge`."""
    return _built(rng, draw_shape(rng), RANGE[1])


def build_varied(rng: np.random.Generator) -> Model:
    """Build one of any age, as thin or as thick as there are, some of which open less far."""
    shape = draw_shape(rng, varied=True)
    upper = np.deg2rad(rng.uniform(95.0, 135.0)) if rng.random() < 0.3 else RANGE[1]
    return _built(rng, shape, upper)


def _built(rng: np.random.Generator, shape: LaptopShape, upper: float) -> Model:
    base_knuckles, lid_knuckles = _hinge(rng, shape)
    base = [*_chassis(shape), *_feet(rng, shape), *_deck(rng, shape), *base_knuckles]
    lid = [*_lid(rng, shape), *lid_knuckles]
    if shape.kind == "rugged":
        base += [*_bumpers(shape, shape.floor + 2 * MM, shape.deck), *_handle(rng, shape)]
        lid += _bumpers(shape, shape.under, shape.back + 2 * MM)
    T = _T_WORLD_USER @ transform(translation=(0.0, 0.0, -shape.floor))
    links = (
        ModelLink("body", "base_body", tuple(s.moved(T) for s in base)),
        ModelLink("lid", "screen_frame", tuple(s.moved(T) for s in lid)),
    )
    axis = (0.0, 1.0, 0.0)
    joint = ModelJoint("hinge", "revolute", "body", "lid", T[:3, 3], axis, upper=upper)
    return Model(links, (joint,))


def _chassis(s: LaptopShape) -> list[Solid]:
    """Return the base's body up to the floor that the keys stand on; a wedge with a bevelled
    underside."""
    top = s.deck - s.well
    bottom = s.bottom_rear + s.base_bevel
    layers = [(s.base_bevel * 1.5, 0.0), (0.0, s.base_bevel)]
    outlines = [s.outline(inset) for inset, _ in layers]
    rings = [np.c_[o, s.bottom(o[:, 1]) + z] for o, (_, z) in zip(outlines, layers, strict=True)]
    rings.append(np.c_[s.outline(0.0), np.full(len(rings[0]), top)])
    body = [loft(rings)]
    if not s.drops and s.shelf - bottom > MM:
        body.append(prism(_behind(s, -s.width / 2, s.width / 2), bottom, s.shelf))
    if s.behind > 0.0:
        body += _rear_block(s, bottom)
    return body


def _behind(s: LaptopShape, left: float, right: float) -> Floats:
    """Return the outline of the base around and behind the hinge, from x = `left` to `right`."""
    size = right - left, s.reach + s.barrel + 2 * MM
    ends = (right > s.width / 2 - MM, left < MM - s.width / 2)
    corner = min(s.corner, 0.8 * (s.reach + s.barrel))
    radii = [0.5 * MM, 0.5 * MM, *(corner if end else 0.5 * MM for end in ends)]
    middle = ((left + right) / 2, s.barrel - size[1] / 2)
    return rounded_rectangle(*size, radii, middle)


def _rear_block(s: LaptopShape, bottom: float) -> list[Solid]:
    """Build the block behind the hinge, below the lid's reach: an exhaust, or ports."""
    back = s.reach + s.behind
    lowest = -np.sqrt(0.5) * max(s.back + s.lid_rear, 0.0)  # of the lid there, at 135 degrees
    top = min(s.shelf, lowest - 1.5 * MM)
    if top - bottom < 4.5 * MM:
        return []
    half = s.width / 2 - s.corner
    if s.kind == "retro":
        half *= 0.8
    outline = [(-half, s.rear - MM), (half, s.rear - MM), (half * 0.93, back), (-half * 0.93, back)]
    solids = [prism(np.array(outline), bottom, top)]
    z0, z1 = bottom + 1.5 * MM, top - 1.5 * MM
    for x in np.linspace(-0.85, 0.85, 24 if s.kind == "gaming" else 9) * half:
        solids.append(box((x - 1.5 * MM, back - MM, z0), (x + 1.5 * MM, back + MM, z1)))
    return solids


def _feet(rng: np.random.Generator, s: LaptopShape) -> list[Solid]:
    """Four round feet or two long strips, on the floor and well into the underside."""
    x, y0, y1 = s.width * 0.38, s.front + 0.12 * s.depth, s.rear - 0.12 * s.depth
    depth = min(2 * MM, 0.2 * (s.deck - s.well - s.bottom_front))
    tops = {y: float(s.bottom(y)) + depth for y in (y0, y1)}
    if rng.random() < 0.5:
        radius = rng.uniform(4, 8) * MM
        return [
            cylinder(radius, s.floor, tops[y], sides=16).shifted(sign * x, y)
            for y in (y0, y1)
            for sign in (-1, 1)
        ]
    half = rng.uniform(2.5, 4) * MM
    return [
        block((-x, y - half, s.floor), (x, y + half, tops[y]), radius=half * 0.9) for y in (y0, y1)
    ]


def _deck(rng: np.random.Generator, s: LaptopShape) -> list[Solid]:
    """Build the plate around the keys, the keys, the trackpad and what stands beside them."""
    board = _keyboard(rng, s)
    width, depth = board.size
    rear = s.rear - rng.uniform(0.25, 0.6) * (s.depth - depth) * 0.55 - 3 * MM
    margin = 2 * MM
    well = np.array([0.0, rear - depth / 2])
    opening = rounded_rectangle(width + 2 * margin, depth + 2 * margin, 2 * MM, well, segments=2)
    plate = ring(*matched(s.outline(0.0), opening, well), s.deck - s.well, s.deck)
    proud = min(rng.uniform(0.2, 0.9) * MM, s.gap - 0.5 * MM)
    keys = board.solids(-width / 2, rear, s.deck - s.well, s.deck + proud)
    typing = -width / 2 + 7.5 * board.pitch[0]
    palm_rest = rear - depth - margin - s.front
    return [
        plate,
        *keys,
        *_trackpad(rng, s, typing * rng.choice([0.0, 0.8]), palm_rest),
        *_beside_keys(rng, s, width / 2 + margin, rear),
    ]


def _keyboard(rng: np.random.Generator, s: LaptopShape) -> Keyboard:
    number_pad = s.width > 330 * MM and rng.random() < 0.7
    units = 19.25 if number_pad else 15.0
    room = s.width - 2 * rng.uniform(8, 26) * MM
    across = min(room / units, 19.5 * MM)
    along = min(across * rng.uniform(0.92, 1.0), 0.5 * s.depth / 6.0)
    island = rng.random() < 0.6
    return Keyboard(
        pitch=(across, along),
        gap=across * (rng.uniform(0.13, 0.22) if island else rng.uniform(0.04, 0.07)),
        taper=across * (0.02 if island else rng.uniform(0.06, 0.12)),
        corner=across * 0.12 if rng.random() < 0.5 else 0.0,
        function_row=float(rng.choice([0.0, 0.55, 0.7, 1.0], p=[0.1, 0.35, 0.35, 0.2])),
        function_keys=int(rng.integers(12, 17)),
        last_row=int(rng.integers(4)),
        big_enter=bool(rng.random() < 0.35),
        number_pad=bool(number_pad),
    )


def _trackpad(rng: np.random.Generator, s: LaptopShape, x: float, palm_rest: float) -> list[Solid]:
    """Return a plate of slight relief, sometimes with buttons of its own; or, rarely, a
    trackball."""
    depth = palm_rest * rng.uniform(0.6, 0.88)
    width = min(depth * rng.uniform(1.25, 2.0), 0.5 * s.width)
    y = s.front + palm_rest / 2
    relief = rng.uniform(0.3, 0.6) * MM
    z = s.deck, s.deck + relief
    style = rng.choice(["plate", "plate", "buttons", "ball"], p=[0.4, 0.3, 0.25, 0.05])
    if style == "ball":
        radii = 12 * MM * sin(np.linspace(np.pi / 2, 0.05, 4))
        heights = [s.deck + relief * h for h in (0.0, 0.5, 0.85, 1.0)]
        return [stack([circle(r, 20, (x, y)) for r in radii], heights)]
    corner = rng.uniform(0.5, 5) * MM
    if style == "plate":
        return [prism(rounded_rectangle(width, depth, corner, (x, y), 3), *z, panel=True, seen=1)]
    strip = 0.22 * depth
    pad = (x, y + strip / 2 + 0.5 * MM)
    row = y - depth / 2 + strip / 2 - 0.5 * MM
    solids = [
        prism(rounded_rectangle(width, depth - strip, corner, pad, 3), *z, panel=True, seen=1)
    ]
    for sign in (-1, 1):
        low = (x + sign * (width / 4) - width / 4 + MM / 2, row - strip / 2, s.deck)
        high = (low[0] + width / 2 - MM, row + strip / 2 - MM / 2, z[1])
        solids.append(block(low, high, radius=1.5 * MM, segments=2))
    return solids


def _beside_keys(rng: np.random.Generator, s: LaptopShape, half: float, rear: float) -> list[Solid]:
    """Ribs over the loudspeakers where there is room, and a power button."""
    solids = []
    top = s.deck + 0.35 * MM
    side = s.width / 2 - half
    if side > 14 * MM and rng.random() < 0.8:
        for y in np.arange(rear - 0.4 * s.depth, rear - 4 * MM, 5 * MM):
            for sign in (-1, 1):
                x = sign * (half + side / 2)
                low, high = (x - side * 0.28, y, s.deck), (x + side * 0.28, y + 2 * MM, top)
                solids.append(box(low, high))
    strip = s.rear - rear
    if strip > 12 * MM:
        y = s.rear - strip / 2 + MM
        if rng.random() < 0.5:
            n = int(rng.integers(20, 40))
            for x in np.linspace(-0.3, 0.3, n) * s.width:
                solids.append(box((x - MM, y - 2.5 * MM, s.deck), (x + MM, y + 2.5 * MM, top)))
        x = s.width * rng.choice([-0.42, 0.42])
        solids.append(cylinder(3.5 * MM, s.deck, top, sides=16).shifted(x, y))
    return solids


def _lid(rng: np.random.Generator, s: LaptopShape) -> list[Solid]:
    """Bezel, screen and back, drawn closed: the screen looks down."""
    under, back = s.under, s.back
    face = under + s.recess
    side, top, chin = s.bezel
    low = np.array([-s.width / 2 + side, s.front + top])
    high = np.array([s.width / 2 - side, s.lid_rear - chin])
    middle = (low + high) / 2
    size = high - low
    corner = rng.choice([0.2, 4.0]) * MM
    outer = s.lid_outline(s.lid_inset)
    while True:  # Where the bezel is narrow, a round lid's corner would cut off a sharp screen's.
        opening = rounded_rectangle(size[0], size[1], corner, middle, segments=2)
        around, within = matched(outer, opening, middle)
        if np.all(norm(around - middle) > norm(within - middle) + 0.1 * MM):
            break
        corner += MM
    bezel = ring(around, within, under, face)
    b = s.lid_bevel
    layers = [(0.0, face), (0.0, back - b), (b, back)]
    if rng.random() < 0.5:  # A softer back.
        layers = [(0.0, face), (0.0, back - b), (0.35 * b, back - 0.4 * b), (1.6 * b, back)]
    shell = stack([s.lid_outline(s.lid_inset + d) for d, _ in layers], [z for _, z in layers])
    screen = prism(opening, face - 0.4 * s.recess, face, panel=True, seen=-1)
    return [shell, bezel, screen, *_camera(rng, s, under, face), *_emblem(rng, s, back)]


def _camera(rng: np.random.Generator, s: LaptopShape, under: float, face: float) -> list[Solid]:
    """Return a lens in the bezel, sometimes in a tab that juts out of the lid's free edge;
    bumpers."""
    y = s.front + s.bezel[1] / 2
    proud = 0.3 * s.gap
    solids = [
        cylinder(min(2.5 * MM, s.bezel[1] * 0.3), under - proud, face, sides=12).shifted(0, y)
    ]
    if rng.random() < 0.3:
        half = rng.uniform(12, 40) * MM
        low = (-half, s.front - rng.uniform(2, 4) * MM, under)
        solids.append(
            block(low, (half, s.front + 0.9 * s.bezel[1], face + 0.3 * s.lid), radius=2 * MM)
        )
    for x in (-0.44, 0.44):
        solids.append(
            cylinder(1.8 * MM, under - 0.6 * s.gap, face, sides=10).shifted(x * s.width, y)
        )
    return solids


def _emblem(rng: np.random.Generator, s: LaptopShape, back: float) -> list[Solid]:
    """Build the emblem on the lid's back."""
    z = back, back + rng.uniform(0.4, 0.8) * MM
    x, y = s.middle
    size = rng.uniform(12, 26) * MM
    style = str(rng.choice(["none", "round", "oval", "hexagon", "bar", "panel", "stripes"]))
    inner = s.width - 4 * (s.lid_inset + 1.6 * s.lid_bevel) - 20 * MM
    if style == "panel":
        outline = rounded_rectangle(inner * 0.8, s.depth * 0.6, 8 * MM, (x, y))
        return [prism(outline, z[0], z[1] + MM)]
    if style == "stripes":
        bar = np.array([(-4, -0.35), (4, -0.35), (10, 0.35), (2, 0.35)]) * (MM, s.depth)
        return [
            prism(bar + np.array([sign * inner * 0.25, y]), *z, panel=True, seen=1)
            for sign in (-1, 1)
        ]
    outlines = {
        "round": circle(size, 28, (x, y)),
        "oval": ellipse(size * 1.6, size * 0.7, 28, (x, y)),
        "hexagon": circle(size, 6, (x, y)),
        "bar": rounded_rectangle(4 * size, 0.5 * size, 2 * MM, (x, y)),
    }
    return [prism(outlines[style], *z, panel=True, seen=1)] if style in outlines else []


def _hinge(rng: np.random.Generator, s: LaptopShape) -> tuple[list[Solid], list[Solid]]:
    """Build the knuckles of the base and those of the lid, side by side on the axis."""
    cuts = _cuts(rng, s)
    knuckles: dict[str, list[Solid]] = {"base": [], "lid": []}
    for left, right, owner in cuts:
        a, b = left + SLIT / 2, right - SLIT / 2
        bevel = min(0.25 * s.barrel, 0.2 * (b - a))
        knuckles[owner].append(along_x(cylinder(s.barrel, a, b, sides=20, bevel=bevel)))
        knuckles[owner] += _arm(s, owner, a + bevel, b - bevel)
    if not s.drops:
        knuckles["base"] += _between_notches(s, [cut[:2] for cut in cuts if cut[2] == "lid"])
    return knuckles["base"], knuckles["lid"]


def _cuts(rng: np.random.Generator, s: LaptopShape) -> list[tuple[float, float, str]]:
    """Return where along the axis the knuckles are, and whose."""
    corner = s.corner + 15 * MM if s.kind == "rugged" else max(s.corner, 6 * MM)
    end = s.width / 2 - corner  # Beyond it the outline is round, or padded.
    if s.hinge == "pair":
        x, half = s.width * rng.uniform(0.26, 0.38), s.width * rng.uniform(0.03, 0.07)
        x = min(x, end - half)
        cuts = [(-x - half, -x, "lid"), (-x, -x + half, "base")]
        return cuts + [(-b, -a, owner) for a, b, owner in cuts]
    if s.hinge == "center":
        x, side = s.width * rng.uniform(0.25, 0.36), s.width * rng.uniform(0.02, 0.05)
        return [(-x - side, -x, "base"), (-x, x, "lid"), (x, x + side, "base")]
    count = int(rng.choice([3, 5, 7]))
    weight = np.where(np.arange(count) % 2 == 0, rng.uniform(0.3, 1.0), 1.0)
    edges = np.concatenate([[0.0], np.cumsum(weight)]) / weight.sum() - 0.5
    edges *= 2 * end
    return [(edges[i], edges[i + 1], ("base", "lid")[i % 2]) for i in range(count)]


def _arm(s: LaptopShape, owner: str, left: float, right: float) -> list[Solid]:
    """Build the arm between a knuckle and its base or lid."""
    far, joined = 0.85 * s.barrel, s.rear - 2 * MM
    if not s.drops:  # A base's knuckle lies in the base itself.
        return [box((left, joined, 0.0), (right, 0.0, far))] if owner == "lid" else []
    if owner == "base":
        return [box((left, joined, -far), (right, 0.0, min(s.deck, far)))]
    half = 0.8 * s.lid_rear
    return [box((left, -half, 0.0), (right, half, s.under + 0.4 * s.lid))]


def _between_notches(s: LaptopShape, notches: list[tuple[float, float]]) -> list[Solid]:
    """Build the base's rear, up to the deck, wherever there is no knuckle of the lid."""
    edges = [-s.width / 2, s.width / 2]
    for a, b in notches:
        edges += [a - SLIT / 2, b + SLIT / 2]
    edges.sort()
    low = min(s.shelf, s.deck - s.well) - 0.5 * MM
    spans = zip(edges[::2], edges[1::2], strict=True)
    return [prism(_behind(s, *span), low, s.deck) for span in spans]


def _bumpers(s: LaptopShape, z0: float, z1: float) -> list[Solid]:
    """Padding around the four corners; it reaches less far back than the hinge's axis."""
    out, size = min(2.5 * MM, 0.3 * s.reach), s.corner + 14 * MM
    bumpers = []
    for sign in np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]):
        corner = s.middle + sign * (np.array([s.width, s.depth]) / 2 + out)
        inner = corner - sign * size
        low, high = np.minimum(corner, inner), np.maximum(corner, inner)
        bumpers.append(block((*low, z0), (*high, z1), radius=5 * MM, bevel=MM))
    return bumpers


def _handle(rng: np.random.Generator, s: LaptopShape) -> list[Solid]:
    """Build a carrying handle at the front."""
    half, out, r = s.width * rng.uniform(0.18, 0.3), rng.uniform(24, 34) * MM, 5 * MM
    z = (s.deck + s.floor) / 2
    turn, bend = np.linspace(0.0, np.pi / 2, 5), 14 * MM
    arc = np.stack([-half + bend * (1 - cos(turn)), -bend * sin(turn)], 1)
    arc[:, 1] += s.front - out + bend
    left = np.concatenate([[(-half, s.front + 3 * MM)], arc])
    path = np.concatenate([left, left[::-1] * (-1, 1)])
    return [sweep(np.c_[path, np.full(len(path), z)], circle(r, 12))]
