"""Microwaves: a door hinged at a side, the controls beside it or below; some drop open."""

import numpy as np

from articugen.procedural.kit.model import Model
from articugen.procedural.kit.ranges import Either
from articugen.procedural.oven import assembled
from articugen.procedural.oven.plans import PLAIN, draw_plan

# fmt: off
_COUNTER = PLAIN | {
    "width": (0.44, 0.62), "height": (0.26, 0.36), "depth": (0.3, 0.46), "thickness": (0.014, 0.03),
    "lift": (0.008, 0.02), "side": 0.006, "front": "panel beside", "cut": (0.16, 0.3),
    "sill": (0.006, 0.02), "strip": (0.006, 0.02), "feet": "feet", "radius": [0.0, 0.0, 0.02],
    "look": ["wide", "glass", "window"], "hinge": "left",
}
_BUILT_IN = PLAIN | {  # in a kitchen cabinet, its controls above the door
    "width": (0.55, 0.62), "height": (0.34, 0.46), "depth": (0.3, 0.5), "thickness": (0.018, 0.03),
    "strip": (0.05, 0.1), "flange": (0.0, 0.025), "sill": (0.01, 0.03),
    "look": ["wide", "glass", "window"], "hinge": Either(0.6, "left", "bottom"),
}
# fmt: on


def build(rng: np.random.Generator) -> Model:
    """Build one object: links body and door."""
    plan = draw_plan(rng, (_COUNTER, _COUNTER, _BUILT_IN))
    return assembled(rng, plan, np.deg2rad(rng.uniform(85.0, 120.0)), name="microwave")
