"""Eyeglasses: a front with two lenses and two temples that fold inwards.

q = 0 is open: the wearer looks towards -x, z is up and the temples reach straight back along +x.
The left temple (at -y, the wearer's left) folds by +90 degrees about an axis close to +z, the right
one by +90 degrees about the opposite axis.

No two parts meet at any two angles. Folded, a temple comes before its hinge by what it leans
inwards when open and no more, and the hinge stands that far behind the front. From above the
temples must cross in many states, since each is longer than half the face is wide. Therefore both
hinges lean about x by the same few degrees, as opticians set them: the temples turn in two parallel
planes, and `_lean` is the angle at which the left one, bent tip and all, passes over the right one.

Modellers rarely know: their hinges stand upright, and folded temples pass through each other. Those
of half of the varied glasses stand upright too, the left one higher than the right one by what the
temples, which are low and nearly straight there, need to pass each other.
"""

from dataclasses import replace

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import rotation_about, transform
from articugen.core.portable import cos, norm, power, product, sin
from articugen.procedural.eyeglasses.shape import Glasses, draw, elsewise
from articugen.procedural.kit import MM
from articugen.procedural.kit.model import Model, ModelJoint, ModelLink, first_sound
from articugen.procedural.kit.outlines import circle, ellipse, rounded_rectangle
from articugen.procedural.kit.solids import Solid, along_x, cylinder, prism, stack, sweep

_SLEEVE, _SLEEVE_GROWTH = 0.62, 1.25
"""Half the thickness of a tip's sleeve over the temple's, and how much it grows to its end."""
_SLIT = 0.35 * MM  # between the knuckles of a hinge and between a folding temple and the front
_BETWEEN = 0.6 * MM  # between the planes of the two temples
_MOST_LEAN = float(np.deg2rad(13.0))  # of the hinges; 5 to 11 degrees are usual
_BENDS = 0.55
"""The room along x that an end piece needs so that no bend folds over, part of its thickness."""
_LOW = 5.0 * MM  # how high temples are at most where hinges stand upright


def build(rng: np.random.Generator) -> Model:
    """Eyeglasses with links `front`, `left_temple`, `right_temple` and a joint for each temple."""
    return _built(rng, draw(rng), upright=False)


def build_varied(rng: np.random.Generator) -> Model:
    """Build glasses of any proportions, some without lenses, whose hinges lean or stand upright at
    two heights."""

    def drawn() -> Model:
        """May raise ValueError: temples too tall to fold, a bow that folds over itself."""
        shape, upright = elsewise(rng, draw(rng)), bool(rng.uniform() < 0.5)
        if upright:
            shape = replace(shape, temple=(shape.temple[0], min(shape.temple[1], _LOW)))
        return _built(rng, shape, upright=upright)

    return first_sound(drawn)


def _built(rng: np.random.Generator, shape: Glasses, *, upright: bool) -> Model:
    if shape.style == "shield":
        face, end = _shield(rng, shape)
        highest = float(end[2])
    else:
        right, end = _eye(shape), None
        middle = [*_bridge(rng, shape), *_nose_pads(rng, shape)]
        face = [*right, *(s.mirrored(1) for s in right), *middle]
        highest = shape.highest * float(shape.lens[:, 1].max())
    # From the middle of the face to the right hinge, which lies outside the lens.
    outermost = max(float(solid.vertices[:, 1].max()) for solid in face)
    across = outermost + shape.temple[0] / 2 + 0.5 * MM
    bare_temple = _temple(rng, shape, across, level=upright)
    lean = 0.0 if upright else _lean(bare_temple, across)
    heights_of = np.concatenate([solid.vertices[:, 2] for solid in bare_temple])
    apart = float(np.ptp(heights_of)) + _BETWEEN if upright else 0.0
    hinge_z = min(shape.hinge_z, highest - apart / 2)
    heights = {side: hinge_z - sign * apart / 2 for side, sign in _SIDES.items()}
    starts = {
        side: _at_edge(shape, z, 1.0) if end is None else np.array([*end[:2], z])
        for side, z in heights.items()
    }
    depth = _hinge_depth(shape, face, bare_temple, lean)
    depth = max(depth, *(p[0] + _clear(shape) + _BENDS * shape.temple[0] for p in starts.values()))
    hinges = {side: np.array([depth, across, z]) for side, z in heights.items()}
    parts: dict[str, list[Solid]] = {"front": list(face)}
    for side, sign in _SIDES.items():
        hinge = hinges[side]
        # Drawn on the right; the mirror image of what leans one way leans the other way.
        T_object_hinge = transform(rotation_about((1, 0, 0), sign * lean), hinge)
        fixed = [_end_piece(shape, starts[side], hinge)]
        fixed += [s.moved(T_object_hinge) for s in _knuckles(shape, of_temple=False)]
        temple = [s.shifted(*hinge) for s in bare_temple]
        temple += [s.moved(T_object_hinge) for s in _knuckles(shape, of_temple=True)]
        parts["front"] += fixed if sign > 0 else [s.mirrored(1) for s in fixed]
        parts[f"{side}_temple"] = temple if sign > 0 else [s.mirrored(1) for s in temple]
    lowest = min(float(s.vertices[:, 2].min()) for solids in parts.values() for s in solids)
    links, joints = [], []
    for name, solids in parts.items():
        semantic = "frame" if name == "front" else "leg"
        links.append(ModelLink(name, semantic, tuple(s.shifted(z=-lowest) for s in solids)))
    for side, sign in _SIDES.items():
        ends = ("front", f"{side}_temple", hinges[side] * (1.0, sign, 1.0) - (0.0, 0.0, lowest))
        axis = -sign * np.array([0.0, -sin(lean), cos(lean)])
        joints.append(ModelJoint(f"{side}_hinge", "revolute", *ends, axis, upper=shape.upper))
    return Model(tuple(links), tuple(joints))


_SIDES = {"left": -1.0, "right": 1.0}


def _eye(s: Glasses) -> list[Solid]:
    """Build the right lens and what holds it."""
    t = s.lens_thickness if s.style != "rimless" else max(s.lens_thickness, 1.8 * MM)
    lens = [s.placed(along_x(prism(s.lens, -t / 2, t / 2, panel=True)))] if s.glazed else []
    path = np.c_[np.zeros(len(s.lens)), s.lens]
    wire = circle(s.wire, 8)
    broad = _flat_section(*s.rim)
    if s.style == "rimless":
        return lens
    if s.style in ("wire", "acetate"):
        section = wire if s.style == "wire" else broad
        return [*lens, s.placed(sweep(path, section, closed=True, up=(1, 0, 0)))]
    upper = path[_upper_run(s.lens)]
    brow = s.placed(sweep(upper, broad, up=(1, 0, 0)))
    if s.style == "half":
        return [*lens, brow]
    thin = circle(min(s.wire, 1.7 * MM), 8)
    return [*lens, brow, s.placed(sweep(path, thin, closed=True, up=(1, 0, 0)))]


def _shield(rng: np.random.Generator, s: Glasses) -> tuple[list[Solid], Floats]:
    """Build one pane bent around the face, with a bar above, and the top of its right end."""
    half, bend = rng.uniform(62, 72) * MM, np.deg2rad(rng.uniform(28, 48))
    radius = half / sin(bend)
    turn = np.linspace(-bend, bend, 33)
    path = np.stack([radius * (1 - cos(turn)), radius * sin(turn), 0 * turn], axis=1)
    u = np.abs(turn) / bend
    top = rng.uniform(14, 20) * MM - rng.uniform(0, 4) * MM * u**2
    nose = np.clip(1.0 - u / 0.3, 0.0, 1.0)
    deep = rng.uniform(20, 34) * MM
    high = deep * power(nose, 1.5)
    bottom = -deep * (1.0 - u**2 * u**2 * rng.uniform(0.3, 0.75)) + high * rng.uniform(0.5, 0.75)
    t = max(s.lens_thickness, 1.2 * MM) / 2
    outline = ((-t, bottom), (t, bottom), (t, top), (-t, top))
    corners = [np.stack([x + 0 * u, z], axis=1) for x, z in outline]
    pane = sweep(path, np.stack(corners, axis=1))
    bar = np.c_[path[:, :2], top]
    rim = sweep(bar, _flat_section(s.rim[1], s.rim[0]))
    pad = along_x(stack([ellipse(f * 3 * MM, f * 6 * MM, 14) for f in (1, 0.8)], (0.0, 4 * MM)))
    pad = pad.shifted(path[21, 0] + 0.4 * MM, path[21, 1], (bottom[21] + top[21]) / 2)
    end = np.array([path[-1, 0], path[-1, 1] - MM, top[-1] - MM])
    return [pane, rim, pad, pad.mirrored(1)], end


def _flat_section(thickness: float, height: float) -> Floats:
    """Return a section with cut corners."""
    return rounded_rectangle(thickness, height, 0.3 * min(thickness, height), segments=1)


def _upper_run(outline: Floats) -> list[int]:
    """Return the vertices of the upper half, in the order of the outline."""
    n = len(outline)
    above = outline[:, 1] > 0.12 * outline[:, 1].max()
    first = next(i for i in range(n) if above[i] and not above[i - 1])
    return [(first + k) % n for k in range(int(above.sum()))]


def _bridge(rng: np.random.Generator, s: Glasses) -> list[Solid]:
    """Build the bridge between the eyes: a saddle, a wire, two wires, or a straight bar above."""
    heights = [rng.uniform(0.15, 0.45)]
    if s.style in ("wire", "rimless") and rng.random() < 0.35:
        heights = [rng.uniform(0.1, 0.2), rng.uniform(0.72, 0.85)]
    bars = []
    for k, height in enumerate(heights):
        start = _at_edge(s, height * s.lens[:, 1].max(), -1.0)
        arch = 0.0 if k else rng.uniform(2.0, 6.0) * MM
        bars.append(_arch(s, start, arch, rng.uniform(0.0, 2.5) * MM))
    return bars


def _arch(s: Glasses, start: Floats, rise: float, forward: float) -> Solid:
    """Build a bar from `start`, in the right rim, to its mirror image, arched up and forward."""
    u = np.linspace(1.0, -1.0, 11)
    bow = 1.0 - u**2
    path = np.stack([start[0] - forward * bow, start[1] * u, start[2] + rise * bow], axis=1)
    if s.style in ("wire", "rimless"):
        section = circle(s.wire, 8)
    elif s.style == "acetate":
        section = _flat_section(s.rim[1] * 0.95, s.rim[0] * 1.15)
    else:
        section = _flat_section(s.rim[1] * 0.7, s.wire * 2.2)
    return sweep(path, section)


def _at_edge(s: Glasses, z: float, sign: float) -> Floats:
    """Return the point (3,) of the lens's edge at height `z` that is nearest to the nose (-1), or
    where the right end piece starts (1); without a rim it lies a little inside the lens."""
    edge = s.lens[sign * s.lens[:, 0] > 0.0]
    edge = edge[np.argsort(edge[:, 1], kind="stable")]
    inside = 1.5 * s.wire if sign < 0.0 else -4 * MM
    y = np.interp(z, edge[:, 1], edge[:, 0]) + (inside if s.style == "rimless" else 0.0)
    return s.place(np.array([y, z]))


def _nose_pads(rng: np.random.Generator, s: Glasses) -> list[Solid]:
    """Two pads on arms, or, on broad rims, two swellings of the rim."""
    start = _at_edge(s, -0.25 * s.lens[:, 1].max(), -1.0)
    if s.style == "acetate":
        radii = (3.2 * MM, 5.2 * MM)
        outlines = [ellipse(f * radii[0], f * radii[1], 14) for f in (1.0, 0.85, 0.5)]
        swelling = stack(outlines, (0.0, 2.4 * MM, 3.6 * MM))
        pad = along_x(swelling).shifted(start[0] + s.rim[1] / 2 - 0.4 * MM, start[1], start[2])
        return [pad, pad.mirrored(1)]
    arm = 1.1 * MM
    size = rng.uniform(2.6, 3.4) * MM, rng.uniform(5.0, 7.0) * MM
    center = start + np.array([rng.uniform(5.0, 8.0), -1.5, -2.0]) * MM
    middle = (start + center) / 2 + np.array([1.0, 1.2, 1.0]) * MM
    pad = stack([ellipse(f * size[0], f * size[1], 14) for f in (0.7, 1, 0.7)], (-MM, 0.0, MM))
    # The pad's flat side looks to the nose and a little to the front.
    turn = product(rotation_about((0, 0, 1), np.deg2rad(60.0)), np.eye(3)[[2, 0, 1]])
    pad = pad.moved(transform(turn, center))
    solids = [sweep([start, middle, center], circle(arm, 6)), pad]
    return [*solids, *(solid.mirrored(1) for solid in solids)]


def _knuckle_radius(s: Glasses) -> float:
    return float(np.clip(0.5 * s.temple[0], 1.5 * MM, 2.2 * MM))


def _clear(s: Glasses) -> float:
    """Return how far end piece and temple stay from the hinge's axis."""
    half = (s.temple[0] + s.temple[1] * sin(_MOST_LEAN)) / 2
    return max(half, _knuckle_radius(s)) + _SLIT


def _lean(temple: list[Solid], across: float) -> float:
    """Return the least angle of the hinges at which the left temple's lowest point passes over the
    right one's highest; the right temple (its hinge at the origin) and its mirror image are
    `across` from the middle."""
    points = np.concatenate([solid.vertices for solid in temple])

    def room(lean: float) -> float:
        y, z = points[:, 1] * sin(lean), points[:, 2] * cos(lean)
        return float(2 * across * sin(lean) + (z + y).min() - (z - y).max())

    low, high = 0.0, _MOST_LEAN
    if room(high) < _BETWEEN:
        raise ValueError("temples too tall to fold over each other")
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (middle, high) if room(middle) < _BETWEEN else (low, middle)
    return high


def _hinge_depth(s: Glasses, face: list[Solid], temple: list[Solid], lean: float) -> float:
    """Return the x of the hinges' axes: behind all that either folded temple passes."""
    deepest = max(float(solid.vertices[:, 0].max()) for solid in face)
    points = np.concatenate([solid.vertices for solid in temple])
    y, z = points[:, 1] * cos(lean), points[:, 2] * sin(lean)
    inward = float(np.maximum(-y - z, z - y).max())
    return max(deepest + max(inward, _knuckle_radius(s)) + _SLIT, _clear(s) + 2 * MM)


def _temple_section(s: Glasses, scale: float = 1.0) -> Floats:
    if s.round_temple:
        return circle(s.temple[0] / 2 * scale, 8)
    return _flat_section(s.temple[0], s.temple[1] * scale)


def _end_piece(s: Glasses, start: Floats, hinge: Floats) -> Solid:
    """From the right rim outwards and back to the hinge."""
    end = hinge - np.array([_clear(s), 0.0, 0.0])
    bend = min(3 * MM, 0.6 * (end[0] - start[0]))
    elbow = np.array([start[0], max(end[1] - bend, start[1] + MM), end[2]])
    path = [start, elbow, (start[0] + bend, end[1], end[2]), end]
    return sweep(path, _temple_section(s))


def _knuckles(s: Glasses, *, of_temple: bool) -> list[Solid]:
    """Return hinge's barrel around z: the front's knuckles above and below that of the temple."""
    height = max(s.temple[1], 5.0 * MM)
    third = height / 3
    runs = [(-third / 2, third / 2)]
    if not of_temple:
        runs = [(-height / 2, -third / 2), (third / 2, height / 2)]
    radius = _knuckle_radius(s)
    way = 1.0 if of_temple else -1.0
    reach = _clear(s) + 0.6 * MM
    solids = []
    for low, high in runs:
        z0, z1 = low + _SLIT / 2, high - _SLIT / 2
        solids.append(cylinder(radius, z0, z1, sides=14))
        half = 0.7 * radius
        outline = np.array([(0, -half), (way * reach, -half), (way * reach, half), (0, half)])
        outline = outline if of_temple else outline[::-1]
        solids.append(prism(outline, z0, z1))
    return solids


def _temple(rng: np.random.Generator, s: Glasses, across: float, *, level: bool) -> list[Solid]:
    """Build the right temple, its hinge at the origin: back along +x, then bent down behind the ear
    (hardly, where `level`), sometimes with a sleeve. `across` is from the middle of the face to
    the hinge."""
    start = _clear(s)
    straight, tip = rng.uniform(*s.straight) * MM, rng.uniform(26, 45) * MM
    bend = np.deg2rad(rng.choice([rng.uniform(8, 18), rng.uniform(28, 48), rng.uniform(60, 120)]))
    radius = rng.uniform(8, 16) * MM
    tip = min(tip, 12 * MM) if bend > np.deg2rad(60) else tip
    bowed, waist, end = rng.uniform(0.0, 3.0) * MM, rng.uniform(0.55, 1.0), rng.uniform(0.7, 1.3)
    # Bent tighter than by half the bar's height, its inner side would fold over itself.
    radius = max(radius, 0.51 * max(waist, end) * s.temple[1])
    # The lower the tip, the more the hinges must lean for the temples to pass each other.
    lowest = max(4 * MM, min(20 * MM, 0.4 * across - 1.3 * s.temple[1]))
    if level:
        radius, lowest = 100 * MM, 1.5 * MM
    while radius * (1 - cos(bend)) + tip * sin(bend) > lowest:
        bend *= 0.95
    way = np.array([cos(bend), -sin(bend)])
    # Folded, the tip must end before the other end piece.
    slant = sin(min(bend, np.pi / 2))
    reach = radius * slant + tip * max(way[0], 0.0) + 0.85 * max(s.temple) * slant
    straight = min(straight, 2 * across - start - MM - reach)
    turn = np.linspace(0.0, bend, max(3, round(np.rad2deg(bend) / 7)) + 1)
    arc = np.stack([straight + radius * sin(turn), -radius * (1 - cos(turn))], axis=1)
    line = np.linspace(start, straight, 8)[:-1]
    flat = np.concatenate([np.c_[line, 0 * line], arc, arc[-1:] + way * tip])
    along = np.concatenate([[0], np.cumsum(norm(np.diff(flat, axis=0)))])
    along /= along[-1]
    # Bowed a little outwards in the middle and back inwards at the tip, as heads are.
    bow = bowed * sin(np.pi * along) - s.hug * along * along * along
    path = np.stack([flat[:, 0], bow, flat[:, 1]], axis=1)
    scale = np.interp(along, [0.0, 0.5, 1.0], [1.0, waist, end])
    floor = 2.2 * s.wire / s.temple[1]
    sections = np.stack([_temple_section(s, max(f, floor)) for f in scale])
    solids = [sweep(path, sections)]
    if s.style in ("wire", "rimless", "browline", "half") and rng.random() < 0.6:
        first = min(int(np.searchsorted(along, rng.uniform(0.5, 0.66))), len(path) - 4)
        sleeve = ellipse(
            _SLEEVE * s.temple[0], max(_SLEEVE * s.temple[1] * waist, 1.3 * s.wire), 10
        )
        thicker = [sleeve * f for f in np.linspace(1.0, _SLEEVE_GROWTH, len(path) - first)]
        solids.append(sweep(path[first:], np.stack(thicker)))
    return solids
