"""Refrigerators: one door, two above each other or two side by side, hinged at their sides."""

import numpy as np

from articugen.procedural.kit.model import Model
from articugen.procedural.kit.ranges import Either
from articugen.procedural.oven import assembled
from articugen.procedural.oven.plans import PLAIN, draw_plan

# fmt: off
_ONE = PLAIN | {
    "width": (0.48, 0.76), "height": (0.8, 1.95), "depth": (0.5, 0.76), "thickness": (0.04, 0.075),
    "sill": (0.0, 0.08), "strip": (0.0, 0.04), "side": (0.0, 0.01), "guard_controls": True,
    "feet": "plinth", "lift": Either(0.5, 0.0, (0.02, 0.06)), "look": ["solid", "glass"],
    "radius": [0.0, 0.0, 0.015, 0.03], "hinge": ["left", "right"],
}
_TWO = _ONE | {  # a freezer above or below
    "height": (1.3, 2.0), "front": "two above", "both": True, "hinge": ["lefts", "rights"],
    "middle": Either(0.5, (0.25, 0.45), (0.58, 0.75)), "radius": 0.0,
}
_FRENCH = _ONE | {
    "width": (0.8, 1.1), "height": (1.6, 1.95), "front": "two beside", "both": True, "cut": 0.0,
    "hinge": "sides", "radius": 0.0,
}
_SIDE_BY_SIDE = _FRENCH | {"cut": (-0.15, 0.12)}
# fmt: on


def build(rng: np.random.Generator) -> Model:
    """Build one object: links body and door, or door_0 and door_1."""
    plan = draw_plan(rng, (_ONE, _TWO, _FRENCH, _SIDE_BY_SIDE))
    return assembled(rng, plan, np.deg2rad(rng.uniform(90.0, 135.0)), name="refrigerator")
