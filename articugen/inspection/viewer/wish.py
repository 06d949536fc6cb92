"""What somebody wants to see."""

from dataclasses import dataclass

from articugen.core.records import Floats

SURFACE, NORMALS, MESHES, GRID, INSIDE, OUTSIDE, PARTIAL, AXES, PREDICTION = LAYERS = (
    "Surface points", "Normals", "Part meshes", "Occupancy grid", "Query points inside",
    "Query points outside", "Partial clouds, cameras", "Axes and pivots", "Prediction beside",
)  # fmt: skip

AT_FIRST = frozenset({MESHES, AXES, PREDICTION})

EASY_GRID = 64
"""The finest occupancy grid that is shown unless a finer one is asked for."""


@dataclass(frozen=True, eq=False)
class Wish:
    """Attributes:
    object_id: of whom.
    q: (J,) joint values, rad or m; None for a state a little open.
    layers: what is drawn of it.
    resolution: of the occupancy grid; 0 for whichever is easily looked at.
    """

    object_id: str
    q: Floats | None = None
    layers: frozenset[str] = AT_FIRST
    resolution: int = 0
