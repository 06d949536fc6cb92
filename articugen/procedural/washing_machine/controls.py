"""The controls of washing machines: a detergent tray, a dial, a display, keys."""

import numpy as np

from articugen.procedural.kit.outlines import circle
from articugen.procedural.kit.parts import Rect, handle, knob, leaning, plate, row
from articugen.procedural.kit.solids import Solid, along_x, ring


def panel(
    rng: np.random.Generator, width: float, height: float, e: float, *, tray: bool
) -> list[Solid]:
    """Build the controls around the origin, on the plane x = 0."""
    left, tall = -0.47 * width, 0.36 * height
    solids, used = [], left
    if tray:
        used = left + rng.uniform(0.22, 0.34) * width
        solids += _tray(rng, Rect(left, -tall, used, tall), e)
    dial_y = float(rng.choice([0.0, 0.12, 0.38])) * width
    radius = min(rng.uniform(0.75, 1.0) * tall, 0.055)
    collar = along_x(ring(circle(1.25 * radius, 28), circle(radius, 28), 0.0, 0.4 * e))
    kind, reach = str(rng.choice(["plain", "grip", "cone"])), rng.uniform(1.5, 2.6) * e
    dial = [collar, *knob(kind, radius, reach, sides=28)]
    solids += [s.shifted(y=dial_y) for s in dial]
    free = [(used, dial_y - 1.4 * radius), (dial_y + 1.4 * radius, 0.48 * width)]
    a, b = max(free, key=lambda span: span[1] - span[0])
    middle, half = (a + b) / 2, (b - a) / 2
    if rng.uniform() < 0.75:
        screen = Rect(middle - 0.75 * half, -0.05 * tall, middle + 0.75 * half, 0.75 * tall)
        solids.append(plate(screen, 0.0, 0.5 * e, bevel=0.2 * e))
    size = min(0.12 * half, 0.2 * tall)
    for y in row(middle, 0.8 * half, int(rng.integers(3, 7))):
        key = Rect(y - size, -0.6 * tall - size, y + size, -0.6 * tall + size)
        solids.append(plate(key, 0.0, 0.6 * e, radius=0.4 * size))
    return solids


def console(
    rng: np.random.Generator,
    at: tuple[float, float],
    size: tuple[float, float],
    deep: tuple[float, float],
    e: float,
) -> list[Solid]:
    """Build a board along the top's rear edge, leaning back, with the controls.

    Args:
        at: (x, z) of its rear lower edge.
        size: its width and height.
        deep: how deep it is at its foot and at its head.
    """
    (back, z), (width, high) = at, size
    board, T = leaning(Rect(-width / 2, 0.0, width / 2, high), 0.0, *deep)
    T[:3, 3] += (back, 0.0, z)
    placed = panel(rng, width, 0.8 * high, e, tray=False)
    return [board.shifted(back, 0.0, z), *(s.moved(T) for s in placed)]


def _tray(rng: np.random.Generator, rect: Rect, e: float) -> list[Solid]:
    """Build the front of a detergent tray, with a cup or a lip to pull."""
    front = 0.9 * e
    solids = [plate(rect, 0.0, front, radius=0.15 * rect.height, bevel=0.25 * e)]
    y, z = rect.center
    if rng.uniform() < 0.5:
        grip = handle("cup", 0.6 * rect.width, 2.0 * e, e)
    else:
        grip = [plate(Rect(-0.3 * rect.width, -0.5 * e, 0.3 * rect.width, 0.5 * e), 0.0, 1.2 * e)]
    return [*solids, *(s.shifted(front, y, z) for s in grip)]
