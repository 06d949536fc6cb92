"""Control panels and what stands on top of an oven: grates, coils, hotplates, lids, back guards."""

from collections.abc import Callable

import numpy as np

from articugen.core.arrays import Floats
from articugen.procedural.kit.outlines import circle
from articugen.procedural.kit.parts import Rect, knob, leaning, plate, rod, row, tapered
from articugen.procedural.kit.solids import Solid, block, box, cylinder, ring
from articugen.procedural.oven.plans import Oven


def control_panel(rng: np.random.Generator, oven: Oven, rect: Rect) -> list[Solid]:
    """Build a panel in front of the body with knobs, and mostly a display and buttons."""
    t = oven.thickness
    if rect.height > rect.width:
        radius = min(0.6 * oven.radius, 0.3 * rect.width)
        board = plate(rect, 0.0, t, radius=radius, bevel=0.1 * t)
        return [board, *_column_of_controls(rng, oven, rect)]
    board, T = leaning(rect, 0.0, t, 0.25 * t if oven.sloped else t)
    return [board, *_row_of_controls(rng, oven, rect, T)]


def _row_of_controls(rng: np.random.Generator, oven: Oven, rect: Rect, T: Floats) -> list[Solid]:
    """Knobs on both sides of a display, or along the whole panel; `T` places the panel's middle."""
    e, half = oven.extent, rect.width / 2
    radius = min(rng.uniform(0.018, 0.026) * max(e, 0.7), 0.36 * rect.height)
    reach, kind = rng.uniform(0.9, 1.3) * radius, str(rng.choice(["plain", "grip", "cone"]))
    most = int(0.9 * half / (1.3 * radius))
    count = 2 * int(rng.integers(1, max(2, min(4, most // 2 + 1))))
    solids: list[Solid] = []
    if oven.stove == "gas" and rng.uniform() < 0.5:
        places = row(0.0, half, min(count + 2, most))
    else:
        spread = 0.55 * half
        right = row(half - spread / 2 - radius, spread / 2, count // 2)
        places = [s * y for y in right for s in (-1.0, 1.0)]
        inner = min(abs(y) for y in places) - 1.6 * radius
        solids += _display(rng, min(inner, 0.16), 0.3 * rect.height, 0.012 * e)
    for y in places:
        solids += [s.shifted(y=y) for s in knob(kind, radius, reach)]
    return [s.moved(T) for s in solids]


def _column_of_controls(rng: np.random.Generator, oven: Oven, rect: Rect) -> list[Solid]:
    count = int(rng.integers(2, 5))
    radius = min(0.3 * rect.width, 0.34 * rect.height / count)
    kind = str(rng.choice(["plain", "grip", "cone"]))
    y, z = rect.center
    solids, heights = [], row(z, rect.height / 2, count)
    for height in heights:
        if count > 2 and height == max(heights) and rng.uniform() < 0.4:
            control = _display(rng, 0.36 * rect.width, 0.7 * radius, 0.012 * oven.extent)
        else:
            control = knob(kind, radius, 0.8 * radius)
        solids += [s.shifted(oven.thickness, y, height) for s in control]
    return solids


def _display(rng: np.random.Generator, half: float, tall: float, out: float) -> list[Solid]:
    """Build a raised display at the origin, with buttons under or beside it."""
    if half < 0.02:
        return []
    screen = plate(Rect(-half, -tall, half, tall), 0.0, out, bevel=0.3 * out)
    if half < 0.06 or rng.uniform() < 0.4:
        return [screen]
    screen = plate(Rect(-half, -tall, 0.1 * half, tall), 0.0, out, bevel=0.3 * out)
    buttons = [
        plate(Rect(y - 0.08 * half, z - 0.25 * tall, y + 0.08 * half, z + 0.25 * tall), 0.0, out)
        for y in row(0.6 * half, 0.4 * half, 3)
        for z in (-0.55 * tall, 0.55 * tall)
    ]
    return [screen, *buttons]


def back_guard(rng: np.random.Generator, oven: Oven) -> list[Solid]:
    """Build the upright board behind the stove, its front leaning back."""
    if oven.guard <= 0.0:
        return []
    body, back = oven.body, -oven.depth
    face = Rect(body.y0, body.z1, body.y1, body.z1 + oven.guard)
    board, T = leaning(face, back, back + rng.uniform(0.06, 0.09), back + 0.03)
    if oven.guard < 0.1:
        return [board]
    if oven.guard_controls:
        return [board, *_row_of_controls(rng, oven, face, T)]
    return [board, *(s.moved(T) for s in _display(rng, 0.12, 0.025, 0.012 * oven.extent))]


def cooktop(rng: np.random.Generator, oven: Oven) -> list[Solid]:
    """Build a slab with its burners; nothing where the oven has no stove."""
    if oven.stove == "none":
        return []
    body, e = oven.body, oven.extent
    slab = rng.uniform(0.014, 0.03) * e
    out, edge = min(oven.thickness, 0.03), 0.3 * slab
    radius = min(oven.radius, 0.03)
    low, high = (-oven.depth, body.y0, body.z1), (out, body.y1, body.z1 + slab)
    solids = [block(low, high, radius=radius, bevel=(0.0, edge), segments=4)]
    back = -oven.depth + (0.1 if oven.guard else 0.03)
    area = Rect(back, body.y0 + 0.03, -0.02, body.y1 - 0.03)  # (x, y) instead of (y, z)
    burners = _BURNERS[oven.stove](rng, area, e)
    return [*solids, *(s.shifted(z=body.z1 + slab) for s in burners)]


def _spots(area: Rect, columns: int) -> list[tuple[float, float]]:
    """Return (x, y) of two rows of burners."""
    x, y = area.center
    return [
        (x + i * 0.25 * area.width, b) for b in row(y, area.height / 2, columns) for i in (-1, 1)
    ]


def _columns(area: Rect) -> int:
    return 3 if area.height > 0.75 else 2


def _gas(rng: np.random.Generator, area: Rect, e: float) -> list[Solid]:
    """Burners with caps under cast grates."""
    r, columns = 0.0075 * e, _columns(area)
    z = rng.uniform(0.03, 0.042)
    solids = []
    for x, y in _spots(area, columns):
        size = rng.uniform(0.03, 0.048)
        burner = tapered((1.3 * size, 1.2 * size, 0.9 * size, 0.9 * size), (0, 0.008, 0.01, 0.018))
        solids += [burner.shifted(x, y), cylinder(size, 0.016, 0.024, bevel=0.002).shifted(x, y)]
    half = area.height / columns / 2
    for y in row(area.center[1], area.height / 2, columns):
        solids += _grate(Rect(area.y0, y - half + r, area.y1, y + half - r), z, r)
    return solids


def _grate(area: Rect, z: float, r: float) -> list[Solid]:
    """Build a frame of square bars on four feet, with a cross over each of two burners."""
    (x, y), high = area.center, z + r

    def bar(x0: float, y0: float, x1: float, y1: float, bottom: float = z - r) -> Solid:
        return box((x0 - r, y0 - r, bottom), (x1 + r, y1 + r, high))

    a, b, c, d = area.y0 + r, area.y1 - r, area.z0 + r, area.z1 - r
    quarter = area.width / 4
    solids = [bar(a, c, b, c), bar(a, d, b, d), bar(a, c, a, d), bar(b, c, b, d), bar(x, c, x, d)]
    solids += [bar(p, q, p, q, bottom=-r) for p in (a, b) for q in (c, d)]
    inner = 0.3 * quarter
    for spot in (x - quarter, x + quarter):
        solids += [bar(spot, c, spot, y - inner), bar(spot, y + inner, spot, d)]
        for side in (-1, 1):
            ends = sorted((spot + side * inner, spot + side * quarter))
            solids.append(bar(ends[0], y, ends[1], y))
    return solids


def _coil(rng: np.random.Generator, area: Rect, e: float) -> list[Solid]:
    """Electric coils, drawn as rings over drip pans."""
    wide = 0.006 * e
    solids = []
    for x, y in _spots(area, _columns(area)):
        outer = rng.uniform(0.07, 0.095)
        pan = ring(circle(outer + 0.015, 28), circle(outer, 28), 0.0, 0.006)
        solids.append(pan.shifted(x, y))
        for radius in np.arange(outer - 0.012, 0.02, -0.026):
            tube = ring(circle(radius, 24), circle(radius - 2 * wide, 24), 0.0, 0.016)
            solids.append(tube.shifted(x, y))
    return solids


def _glass(rng: np.random.Generator, area: Rect, e: float) -> list[Solid]:
    """Build a ceramic plate with four marked zones."""
    z = 0.006
    solids = [block((area.y0, area.z0, 0.0), (area.y1, area.z1, z), radius=0.012, bevel=(0, 0.002))]
    for x, y in _spots(area, _columns(area)):
        radius = rng.uniform(0.06, 0.1)
        zone = ring(circle(radius, 28), circle(radius - 0.008, 28), z, z + 0.003)
        solids.append(zone.shifted(x, y))
    return solids


def _plates(rng: np.random.Generator, area: Rect, e: float) -> list[Solid]:
    """Cast hotplates."""
    solids = []
    for x, y in _spots(area, _columns(area)):
        radius = rng.uniform(0.065, 0.09)
        disc = cylinder(radius, 0.0, 0.018, sides=32, bevel=0.004).shifted(x, y)
        solids += [disc, cylinder(0.3 * radius, 0.0, 0.02, sides=16).shifted(x, y)]
    return solids


def _lids(rng: np.random.Generator, area: Rect, e: float) -> list[Solid]:
    """Two or three large round lids with sprung handles."""
    solids = []
    r = 0.0075 * e
    for y in row(area.center[1], area.height / 2, 2):
        x, radius = area.center[0], min(0.2 * area.height, 0.4 * area.width)
        dome = tapered(np.array((1.0, 1.0, 0.85, 0.5)) * radius, (0.0, 0.03, 0.05, 0.062), sides=36)
        grip = rod([(0.6 * radius, -0.06, 0.085), (0.6 * radius, 0.06, 0.085)], 1.2 * r)
        posts = [rod([(0.6 * radius, s, 0.03), (0.6 * radius, s, 0.085)], r) for s in (-0.05, 0.05)]
        solids += [solid.shifted(x, y) for solid in (dome, grip, *posts)]
    return solids


_BURNERS: dict[str, Callable[[np.random.Generator, Rect, float], list[Solid]]] = {
    "gas": _gas,
    "coil": _coil,
    "glass": _glass,
    "plates": _plates,
    "lids": _lids,
}
