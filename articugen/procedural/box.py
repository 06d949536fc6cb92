"""Boxes: an open carton with one, two or four flaps on its upper edges.

Closed, flaps lie over the opening and meet along its middle or, where there are four, along the
diagonals: each can be opened whatever the others do.
"""

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import rotation_about, transform
from articugen.procedural.kit import GAP
from articugen.procedural.kit.model import Model, ModelLink, moving_part
from articugen.procedural.kit.outlines import rectangle
from articugen.procedural.kit.solids import box, prism, ring


def build(rng: np.random.Generator) -> Model:
    """Build one object: links body and flap, or flap_0 and so on."""
    depth, width = rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.7)
    height, wall = rng.uniform(0.12, 0.6), rng.uniform(0.008, 0.016)
    x, y = depth / 2, width / 2
    floor = box((wall - x, wall - y, 0.0), (x - wall, y - wall, wall))
    inner = rectangle(depth - 2 * wall, width - 2 * wall)
    walls = ring(rectangle(depth, width), inner, 0.0, height)
    flaps = []
    count, upper = int(rng.choice([1, 2, 4])), np.deg2rad(rng.uniform(110.0, 200.0))
    upper = min(upper, np.pi + GAP / wall)  # beyond, its edge would turn into the wall
    for k in range(count):
        sideways = k % 2 == 1 if count == 4 else count == 2
        reach, along = (y, x) if sideways else (x, y)  # from the edge to the middle, and half of it
        turn = {1: 2, 2: 1 + 2 * k, 4: k}[count]
        flap = prism(_outline(reach, along, count), height + GAP, height + GAP + wall)
        R = rotation_about((0, 0, 1), turn * np.pi / 2).round()
        name = "flap" if count == 1 else f"flap_{k}"
        edge, axis = R @ (reach + GAP, 0.0, height + GAP), R @ (0.0, 1.0, 0.0)
        solids = (flap.moved(transform(R)),)
        flaps.append(moving_part(name, "rotation_lid", solids, edge, axis, upper))
    return Model.of(ModelLink("body", "box_body", (walls, floor)), flaps)


def _outline(reach: float, along: float, count: int) -> Floats:
    """Return a flap (n, 2) that hangs on the edge x = reach, y from -along to along."""
    edge = reach + GAP
    if count < 4:
        end = -reach if count == 1 else GAP
        return np.array([(end, -along), (edge, -along), (edge, along), (end, along)])
    # Cut along the diagonals of the opening, up to the middle of its shorter sides.
    tip = max(reach - along, 0.0) + GAP
    half = along - (reach - tip) if reach - tip < along else GAP
    half, side = max(half - GAP, 0.1 * GAP), along - 2 * GAP
    return np.array([(tip, -half), (reach - GAP, -side), (edge, -side),
                     (edge, side), (reach - GAP, side), (tip, half)])  # fmt: skip
