"""Every threshold of `verify`, with the reason for it and the margin that was measured.

`python -m tests.benchmarks.soundness` measures the margins again, on sound sets of all kinds.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

# --- What is exact: how far it may be off.


@dataclass(frozen=True)
class Tolerance:
    """Greatest error of a number that is known exactly: `most` is let through, `sound` is the most
    that was measured in sound sets."""

    most: float
    sound: float

    def exceeded_by(self, off: ArrayLike) -> NDArray[np.bool_]:
        return np.asarray(off) > self.most


TOLERANCES = {
    # float64: of what is 0 or 1 in a rotation, a unit vector, a canonical pose
    "unit": Tolerance(most=1e-9, sound=7e-16),
    # a part's motion, which joints that hang on each other multiply
    "motion": Tolerance(most=1e-6, sound=2e-16),
    # an axis or a pivot of a joint on the fixed part, between instances
    "fixed joint": Tolerance(most=1e-6, sound=0.0),
    # a joint state beyond its range, rad or unit frame
    "range": Tolerance(most=1e-9, sound=0.0),
    # the length of a normal: rounding to 1/127 changes it by 0.0069 at most
    "normal": Tolerance(most=0.01, sound=0.0066),
    # a surface point beyond the box of all poses and a sheet's thickness
    "box": Tolerance(most=0.002, sound=0.0),
    # an occupied query point beyond it, which coarse views may not see free
    "occupied box": Tolerance(most=0.022, sound=0.0),
    # a point of a depth map off its pixel's centre, pixels, beyond what FIXED_POINT explains
    "pixel": Tolerance(most=1e-3, sound=0.0),
    # a query point's distance beyond that to a surface point, which was rounded to 16 bits
    "distance": Tolerance(most=5e-5, sound=1.3e-5),
    # what an image shows beyond the box of all poses and a sheet's thickness
    "image": Tolerance(most=0.002, sound=0.0),
}
"""By what is compared; lengths in the unit frame. `sound` by 44 sets of three instances
each; 0 where nothing was beyond at all."""

FIXED_POINT = 5e-5
"""How far rounding to 16 bits may move a point across a ray, unit frame, and then some: 1.3e-5."""

INSIDE_CUBE = 0.4999
"""Depth noise may push points out of the cube; they are stored on its faces, off their ray. Those
beyond this coordinate are not judged."""

# --- What is sampled: the share of places that must agree.

CHANCE = 1e-9
"""That a share is refused though the true one is what it must be. An instance has some hundred
shares: one that is sound is refused with a chance below 1e-6."""


@dataclass(frozen=True)
class Bound:
    """Least share of places that must agree.

    Attributes:
        least: the true share of any sound object is at least that.
        sound: the least share measured in sound instances, of those that could be refused.
        faulty: the greatest share that gives away one of the faults of tests/test_invariants.py.
        per: how many places say no more than one. Points are drawn each for itself; voxels beside
            each other lie in the same plate, or in the same gap.
    """

    least: float
    sound: float
    faulty: float
    per: int = 1

    def refuses(self, agree: int, judged: int) -> bool:
        """Return whether a true share of `least` would hardly show as `agree` of `judged` places or
        less.

        By Chernoff's bound of the binomial distribution: of n draws, each of probability p, a share
        of q or less agrees with a chance of exp(-n D) at most, D the divergence of q from p.
        """
        share = agree / max(judged, 1)
        if judged == 0 or share >= self.least:
            return False
        divergence = (1.0 - share) * math.log((1.0 - share) / (1.0 - self.least))
        if share > 0.0:
            divergence += share * math.log(share / self.least)
        return judged / self.per * divergence > -math.log(CHANCE)


BOUNDS = {
    "free": Bound(least=0.9, sound=0.99, faulty=0.01),
    "occupied": Bound(least=0.8, sound=0.91, faulty=0.4),
    "filling": Bound(least=0.8, sound=0.87, faulty=0.4, per=4),
    "parts": Bound(least=0.6, sound=0.73, faulty=0.1, per=4),
    "coverage": Bound(least=0.8, sound=0.92, faulty=0.65, per=4),
    "near": Bound(least=0.9, sound=0.99, faulty=0.75),
    "zero level": Bound(least=0.8, sound=0.88, faulty=0.45),
    "inner part": Bound(least=0.7, sound=0.96, faulty=0.1),
    "partial parts": Bound(least=0.7, sound=0.91, faulty=0.1),
    "seen": Bound(least=0.6, sound=0.78, faulty=0.25),
    "flow": Bound(least=0.8, sound=0.92, faulty=0.6),
}
"""For each kind of share; `sound` by 230 sets of three instances each."""

LEAST_EXTENT = 0.75
"""Of the box, that the surface points of all instances reach; 0.96 at least in sound sets, 0.5 in
an object of half the size."""

FEWEST_FOR_EXTENT = 1000
"""Of so few surface points the outermost may lie well within the box by chance."""

# --- Which samples are compared: distances in the unit frame.

NEAR = 0.004
"""A query point so close to a surface point is judged by that point's tangent plane: surfaces bend,
and end, farther away."""

OFF_PLANE = 0.001
"""Closer to that plane its side is not sure; 65 steps of the 16 bits."""

STEEPEST = 0.5
"""The least cosine between the plane's normal and the way to the point: beside an edge, a point
that is far along the plane and little off it may be on either side."""

CLOSE = 0.02
"""A voxel so close to a sample in the material has one of its own part within three times that."""

SAME_SURFACE = 0.01
"""A partial point so close to a surface point is taken to lie on the same part."""

ANY_SURFACE = 0.05
"""Every place on a surface has a surface point so close: twice what 8192 points leave. Where there
are few, see `sampled._spacing`."""

MOST_NOISE = 0.003
"""Recipes with more depth noise may move partial points to where another part is closer."""

# --- The field made again, see replay.py.

IN_FRONT, BEHIND = 0.1 / 256, 0.5 / 256
"""The zero level passes between a surface point moved out by the one and in by the other: within
half a voxel of 1/256. Out less, so that a wall close by is not met first."""

MOST_OFF_LEVEL = 0.05
"""Share of surface points that may lie off the zero level: beside edges finer than a voxel. The
most in sound sets with views of 128 pixels and more was 0.031, of a thin faucet."""

OFF_LEVEL_PER_PIXEL = 8.0
"""With coarse views more may: multiples of the width of a pixel, in the unit frame. What is finer
than a pixel (a sheet's edge, a slot) no view need see. The most in sound sets was five times. Of a
surface a voxel beside the level half and more is off it."""


def on_level(pixel_width: float) -> Bound:
    """Return the share of surface points on the zero level, by views of such pixels, unit frame."""
    most_off = max(MOST_OFF_LEVEL, OFF_LEVEL_PER_PIXEL * pixel_width)
    return Bound(least=max(1.0 - most_off, 0.5), sound=0.98, faulty=0.5)
