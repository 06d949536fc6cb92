"""The measures of laptops: what kinds there are, and how one of them is drawn."""

from dataclasses import dataclass

import numpy as np

from articugen.geometry import Array
from articugen.sources.procedural.outlines import rounded_rectangle

MM = 1e-3


@dataclass(frozen=True)
class Kind:
    """The ranges of one kind of laptop, millimetres and inches."""

    diagonal: tuple[float, float]
    base_rear: tuple[float, float]
    wedge: tuple[float, float]
    lid: tuple[float, float]
    corner: tuple[float, float]
    bezel: tuple[float, float]
    hinges: tuple[str, ...]


KINDS = {
    "ultrabook": Kind((12, 15), (9, 14), (0.35, 0.8), (4, 6), (6, 16), (4, 9), ("center", "full")),
    "business": Kind((12.5, 15.6), (15, 22), (0.75, 1), (6, 9), (3, 8), (8, 16), ("pair", "full")),
    "gaming": Kind((15.6, 17.3), (20, 28), (0.8, 1), (7, 10), (2, 12), (7, 14), ("pair", "center")),
    "retro": Kind((10, 14), (26, 40), (0.7, 1), (10, 15), (4, 14), (16, 28), ("pair", "full")),
    "rugged": Kind((10, 14), (26, 36), (0.95, 1), (13, 18), (6, 12), (16, 26), ("full", "pair")),
    "netbook": Kind(
        (8.9, 11.6), (16, 24), (0.7, 1), (8, 12), (12, 26), (12, 22), ("full", "center")
    ),
}
_ASPECTS = (16 / 9, 16 / 10, 3 / 2, 4 / 3)


@dataclass(frozen=True)
class LaptopShape:
    """One laptop's measures, metres, in the user's frame with the origin on the hinge's axis.

    Attributes:
        kind: its name in `KINDS`.
        width, depth, corner: of the base's outline, and the radius of its corners.
        reach: from the axis to the rear edges of base and lid.
        barrel: the hinge's radius.
        gap: between the closed lid and the deck.
        bottom_rear, bottom_front: heights of the base's underside.
        floor: the height that the feet stand on.
        base_bevel: height of the underside's bevel.
        well: by how much the keys' floor lies below the deck.
        lid, lid_inset, lid_bevel: its thickness, how far it stays within the base's outline, and
            the bevel of its back.
        recess: by how much the screen lies behind its bezel.
        bezel: its width at the sides, at the free edge and at the hinge.
        hinge: "pair", "center" or "full".
    """

    kind: str
    width: float
    depth: float
    corner: float
    reach: float
    barrel: float
    gap: float
    bottom_rear: float
    bottom_front: float
    floor: float
    base_bevel: float
    well: float
    lid: float
    lid_inset: float
    lid_bevel: float
    recess: float
    bezel: tuple[float, float, float]
    hinge: str

    @property
    def deck(self) -> float:
        return -self.gap / 2

    @property
    def rear(self) -> float:
        return -self.reach

    @property
    def front(self) -> float:
        return -self.reach - self.depth

    @property
    def middle(self) -> Array:
        return np.array([0.0, (self.rear + self.front) / 2])

    def outline(self, inset: float, segments: int = 5) -> Array:
        """The outline from above, `inset` within the base's walls."""
        size = self.width - 2 * inset, self.depth - 2 * inset
        return rounded_rectangle(*size, max(self.corner - inset, 0.5 * MM), self.middle, segments)

    def bottom(self, y: Array | float) -> Array | float:
        """The height of the base's underside, which falls to the rear."""
        t = (np.asarray(y) - self.front) / self.depth
        return self.bottom_front + t * (self.bottom_rear - self.bottom_front)


def draw_shape(rng: np.random.Generator) -> LaptopShape:
    """The measures of a laptop of any kind."""
    kind = str(rng.choice(list(KINDS)))
    ranges = KINDS[kind]
    diagonal = rng.uniform(*ranges.diagonal) * 25.4 * MM
    ratio = _ASPECTS[2 + rng.integers(2)] if kind == "retro" else _ASPECTS[rng.integers(3)]
    screen = diagonal * np.array([ratio, 1.0]) / np.hypot(ratio, 1.0)
    side = rng.uniform(*ranges.bezel) * MM
    top, chin = side * rng.uniform(1.0, 1.6), side * rng.uniform(1.3, 3.0)
    lid = rng.uniform(*ranges.lid) * MM
    rear = rng.uniform(*ranges.base_rear) * MM
    gap = rng.uniform(1.2, 2.4) * MM
    barrel = min(rng.uniform(0.55, 0.95) * (lid + gap), 0.5 * rear)
    foot = rng.uniform(1.2, 3.0) * MM
    bottom_rear = -gap / 2 - rear
    return LaptopShape(
        kind=kind,
        width=screen[0] + 2 * side,
        depth=screen[1] + top + chin,
        corner=rng.uniform(*ranges.corner) * MM,
        reach=barrel + 0.5 * MM,
        barrel=barrel,
        gap=gap,
        bottom_rear=bottom_rear,
        bottom_front=-gap / 2 - rear * rng.uniform(*ranges.wedge),
        floor=bottom_rear - foot,
        base_bevel=rng.choice([0.08, 0.2, 0.35]) * rear * ranges.wedge[0],
        well=rng.choice([0.6, 1.0, 1.5]) * MM,
        lid=lid,
        lid_inset=rng.choice([0.0, 0.0, 0.8]) * MM,
        lid_bevel=rng.choice([0.1, 0.25, 0.45]) * lid,
        recess=rng.uniform(0.12, 0.3) * lid,
        bezel=(side, top, chin),
        hinge=str(rng.choice(ranges.hinges)),
    )
