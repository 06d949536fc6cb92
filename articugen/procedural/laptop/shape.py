"""The measures of laptops: what kinds there are, and how one of them is drawn."""

from dataclasses import dataclass

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.portable import norm
from articugen.procedural.kit import MM
from articugen.procedural.kit.outlines import rounded_rectangle

SLIT = 0.7 * MM  # between the knuckles of a hinge, and what must stay free around it


@dataclass(frozen=True)
class Kind:
    """The ranges of one kind of laptop: inches, millimetres, and shares of the width.

    Real ones are 0.034 to 0.081 of their width high without the lid, half of them below 0.047.

    Attributes:
        diagonal: of the screen, inches.
        height: of all that does not move, feet and hinge included, part of the width.
        wedge: the base's thickness in front, part of that in the rear.
        lid: its thickness, part of the width.
        corner, bezel: millimetres.
        hinges: "pair", "center" or "full".
        dropping: how many have a hinge over which the lid drops behind the base.
    """

    diagonal: tuple[float, float]
    height: tuple[float, float]
    wedge: tuple[float, float]
    lid: tuple[float, float]
    corner: tuple[float, float]
    bezel: tuple[float, float]
    hinges: tuple[str, ...]
    dropping: float


# fmt: off
KINDS = {  # diagonal, height, wedge, lid, corner, bezel; hinges, dropping
    "ultrabook": Kind((12, 15), (0.035, 0.042), (0.5, 0.9), (0.016, 0.021), (6, 16), (4, 9),
                      ("center", "full"), 0.5),
    "business": Kind((12.5, 15.6), (0.038, 0.049), (0.75, 1), (0.018, 0.025), (3, 8), (8, 16),
                     ("pair", "full"), 0.3),
    "gaming": Kind((15.6, 17.3), (0.041, 0.053), (0.8, 1), (0.018, 0.025), (2, 12), (7, 14),
                   ("pair", "center"), 0.3),
    "retro": Kind((10, 14), (0.052, 0.076), (0.8, 1), (0.024, 0.034), (4, 14), (16, 28),
                  ("pair", "full"), 0.3),
    "rugged": Kind((10, 14), (0.056, 0.079), (0.95, 1), (0.03, 0.042), (6, 12), (16, 26),
                   ("full", "pair"), 0.0),
    "netbook": Kind((8.9, 11.6), (0.043, 0.06), (0.7, 1), (0.022, 0.032), (12, 26), (12, 22),
                    ("full", "center"), 0.3),
}
OTHERS = {
    "slim": Kind((12, 16), (0.026, 0.036), (0.35, 1), (0.011, 0.017), (4, 20), (4, 12),
                 ("center", "full"), 0.5),
    "broad": Kind((13, 17.5), (0.042, 0.075), (0.5, 1), (0.014, 0.032), (2, 22), (6, 26),
                  ("pair", "center", "full"), 0.4),
    "brick": Kind((12, 16), (0.065, 0.14), (0.7, 1), (0.024, 0.05), (2, 16), (12, 32),
                  ("pair", "full"), 0.3),
    "tablet": Kind((10, 13.5), (0.03, 0.045), (0.7, 1), (0.024, 0.042), (6, 22), (8, 18),
                   ("center", "full"), 0.2),
}
# fmt: on
"""What varied ones may be besides: 5 mm thin, or as thick as they were in 1995; lids thicker than
what they close."""

_BEHIND = {"gaming": 14 * MM, "retro": 6 * MM}

_PROUD = 0.5 * MM  # about how far keys and trackpad stand out of the deck

_ASPECTS = (16 / 9, 16 / 10, 3 / 2, 4 / 3)
_OLD = ("retro", "brick")


@dataclass(frozen=True)
class LaptopShape:
    """One laptop's measures, metres, in the user's frame with the origin on the hinge's axis.

    Attributes:
        kind: its name in `KINDS`.
        width, depth, corner: of the base's outline up to the hinge, and the radius of its corners.
        reach: from the axis to the rear edge of that outline.
        barrel: the hinge's radius.
        deck: the height of the base's upper side.
        gap: between the closed lid and the deck.
        lid_rear: the rear edge of the lid.
        bottom_rear, bottom_front: heights of the base's underside.
        floor: the height that the feet stand on.
        base_bevel: height of the underside's bevel.
        well: by how much the keys' floor lies below the deck.
        lid, lid_inset, lid_bevel: its thickness, how far it stays within the base's outline, and
            the bevel of its back.
        recess: by how much the screen lies behind its bezel.
        bezel: its width at the sides, at the free edge and at the hinge.
        hinge: "pair", "center" or "full".
        behind: how far the base reaches behind the lid's rear edge, if at all.
        drops: the hinge lies below the lid, which drops behind the base; otherwise it lies between
            lid and base, in notches of the base.
    """

    kind: str
    width: float
    depth: float
    corner: float
    reach: float
    barrel: float
    deck: float
    gap: float
    lid_rear: float
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
    behind: float
    drops: bool

    @property
    def under(self) -> float:
        """The height of the closed lid's underside."""
        return self.deck + self.gap

    @property
    def back(self) -> float:
        """The height of the closed lid's back."""
        return self.under + self.lid

    @property
    def shelf(self) -> float:
        """The height below which the base may reach back under the hinge, whatever the angle."""
        if self.drops:
            return -norm((self.lid_rear, self.back)) - SLIT
        return -self.barrel - SLIT

    @property
    def rear(self) -> float:
        return -self.reach

    @property
    def front(self) -> float:
        return -self.reach - self.depth

    @property
    def middle(self) -> Floats:
        return np.array([0.0, (self.rear + self.front) / 2])

    def outline(self, inset: float) -> Floats:
        """Return the outline from above up to the hinge, `inset` within the base's walls."""
        return self._rounded(self.rear, inset, float(self.drops))

    def lid_outline(self, inset: float) -> Floats:
        """Return the lid's outline from above when closed, `inset` within its walls."""
        return self._rounded(self.lid_rear, inset, 1.0)

    def _rounded(self, rear: float, inset: float, rear_share: float) -> Floats:
        """Return a rounded rectangle from the front to `rear`; its rear corners have `rear_share`
        of the radius of the others."""
        depth = rear - self.front
        radii = np.array([1.0, 1.0, rear_share, rear_share]) * self.corner - inset
        middle = (0.0, self.front + depth / 2)
        size = self.width - 2 * inset, depth - 2 * inset
        return rounded_rectangle(*size, np.maximum(radii, 0.5 * MM), middle, segments=5)

    def bottom(self, y: Floats | float) -> Floats | float:
        """Return the height of the base's underside, which falls to the rear."""
        t = (np.asarray(y) - self.front) / self.depth
        return self.bottom_front + t * (self.bottom_rear - self.bottom_front)


def draw_shape(rng: np.random.Generator, *, varied: bool = False) -> LaptopShape:
    """Return the measures of a laptop of any kind; a varied one has others at its choice, too, a
    higher chin, a hinge above the deck, or reaches far behind its hinge."""
    kind = str(rng.choice([*KINDS, *OTHERS, *OTHERS] if varied else list(KINDS)))
    ranges = (KINDS | OTHERS)[kind]
    diagonal = rng.uniform(*ranges.diagonal) * 25.4 * MM
    ratio = _ASPECTS[2 + rng.integers(2)] if kind in _OLD else _ASPECTS[rng.integers(3)]
    screen = diagonal * np.array([ratio, 1.0]) / norm((ratio, 1.0))
    side = rng.uniform(*ranges.bezel) * MM
    top = side * rng.uniform(1.0, 1.6)
    chin = side * rng.uniform(1.3, 5.0 if kind in OTHERS else 3.0)
    width = screen[0] + 2 * side
    lid = rng.uniform(*ranges.lid) * width
    foot = rng.uniform(0.8, 2.0) * MM
    tall = rng.uniform(*ranges.height) * width - foot
    gap = rng.uniform(1.0, 1.8) * MM
    drops = bool(rng.random() < ranges.dropping)
    girth = rng.uniform(0.2, 0.3)
    if drops:
        barrel = max(0.75 * girth * tall, 1.5 * MM)
        deck = barrel + SLIT - gap
        highest = deck + _PROUD
    else:
        barrel = min(max(girth * tall, 1.6 * MM), 0.8 * (lid + gap / 2))
        deck = -gap / 2
        # of some the lid lies as low as its hinge, or lower
        if varied and kind != "rugged" and rng.random() < 0.4:
            barrel = max(min(rng.uniform(0.7, 1.1) * lid, 0.35 * tall), barrel)
            deck -= rng.uniform(0.3, 0.8) * max(barrel - gap, 0.0)
        highest = barrel
    bottom_rear = highest - tall
    reach = barrel + SLIT
    # The lid behind the axis: closed it is above 45 degrees, opened it ends above the floor.
    over = min(rng.uniform(0.75, 1.0) * barrel, -1.2 * bottom_rear - deck - gap - lid)
    over = max(over, 0.5 * barrel)
    behind = _BEHIND.get(kind, 0.0)
    if varied and kind != "rugged" and rng.random() < 0.4:  # whose bumpers turn behind it
        behind = rng.uniform(4, 40) * MM
    thick = deck - bottom_rear
    front = max(thick * rng.uniform(*ranges.wedge), min(thick, 5 * MM))
    return LaptopShape(
        kind=kind,
        width=width,
        depth=screen[1] + top + chin,
        corner=rng.uniform(*ranges.corner) * MM,
        reach=reach,
        barrel=barrel,
        deck=deck,
        gap=gap,
        lid_rear=over if drops else -reach,
        bottom_rear=bottom_rear,
        bottom_front=deck - front,
        floor=bottom_rear - foot,
        base_bevel=rng.choice([0.08, 0.16, 0.24]) * front,
        well=rng.choice([0.5, 0.8, 1.2]) * MM,
        lid=lid,
        lid_inset=rng.choice([0.0, 0.0, 0.8]) * MM,
        lid_bevel=rng.choice([0.1, 0.25, 0.45]) * lid,
        recess=rng.uniform(0.12, 0.3) * lid,
        bezel=(side, top, chin),
        hinge=str(rng.choice(ranges.hinges)),
        behind=behind,
        drops=drops,
    )
