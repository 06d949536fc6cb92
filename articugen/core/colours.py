"""The colours of parts, the same in every picture, page and file."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from articugen.core.arrays import Floats

COLOURS = (
    "#d9d4cb",
    *("#4477aa", "#ddaa33", "#bb5566", "#44aa99", "#882255", "#88ccee", "#999933", "#cc88ee"),
    *("#444422", "#442288", "#66cc66", "#cc6622", "#226622", "#eeaacc", "#aa8866", "#2266cc"),
)
"""Of part 0, 1, ...: the first eight are pairs that readers with any colour vision distinguish
(after Paul Tol), the others as far from them and from each other as calm colours can be."""


def colour_of(part: int) -> str:
    """Return the colour of a part; from part 17 on they repeat, but for part 0's."""
    return COLOURS[0] if part == 0 else COLOURS[1 + (part - 1) % (len(COLOURS) - 1)]


def rgb(colour: str) -> tuple[int, int, int]:
    """#rrggbb as three bytes."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def linear(colour: str) -> Floats:
    """Return an #rrggbb colour as linear light, (3,) in [0, 1], by the power that pictures take; to
    9 digits, which are the same on all machines."""
    return ((np.array(rgb(colour)) / 255.0) ** 2.2).round(9)


def srgb_linear(colour: str) -> Floats:
    """Return the same by sRGB's own curve (IEC 61966-2-1), as files of others have it."""
    share = np.array(rgb(colour)) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4).round(9)


def srgb(light: ArrayLike) -> Floats:
    """Return linear light of 0 to 1 by the same curve, as sRGB of 0 to 1."""
    light = np.asarray(light, np.float64)
    curve = 1.055 * light ** (1.0 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, curve).round(9)


PALETTE = np.array([rgb(colour_of(part)) for part in range(256)], np.uint8)
"""(256, 3) sRGB of each part."""

_PLAIN = {
    "knob": "#8d9196", "handle": "#8d9196", "button": "#8d9196", "drawer body": "#9c7347",
    "drawer": "#b58a5a", "box": "#c19a6b", "laptop screen": "#2c2f33", "laptop": "#55585d",
    "oven door": "#303336", "oven": "#8a8e93", "microwave door": "#303336",
    "microwave": "#6a6e73", "glasses": "#3b2c24", "refrigerator door": "#f2f2f0",
    "refrigerator": "#d5d7d6", "washing door": "#87929b", "washing": "#f0efec",
    "door": "#c9c3b8", "": "#b4b4b4",
}  # fmt: skip
"""Metal, wood, cardboard, plastic and enamel, by words in the names of category and part."""


def plain_colour(category: str, part: str) -> tuple[int, int, int]:
    """Return sRGB that is usual for a part that states none."""
    name = f"{category} {part}".lower()
    return rgb(next(c for words, c in _PLAIN.items() if all(w in name for w in words.split())))


UNNAMED = "#5f5f5f"
"""Of a predicted part that no true part has voted for."""

_SHADES = (0.0, 0.45, -0.35, 0.7, -0.6)


def part_colours(labels: Sequence[int], dominant: Sequence[int]) -> list[str]:
    """Return #rrggbb of each predicted part: that of the true part whose label it has, where
    `labels` and `dominant` are as in the result of `evaluate`; -1 is no label.

    Where several share a label, the dominant one has the colour itself, the others paler and darker
    shades of it.
    """
    colours = [UNNAMED] * len(labels)
    for label in sorted(set(labels) - {-1}):
        parts = [i for i, one in enumerate(labels) if one == label]
        parts.sort(key=lambda i: dominant[i] != label)
        for rank, i in enumerate(parts):
            shade = _SHADES[min(rank, len(_SHADES) - 1)]
            colours[i] = shaded(colour_of(label), shade)
    return colours


def shaded(colour: str, shade: float) -> str:
    """#rrggbb mixed with white (`shade` above 0, up to 1) or with black (below 0)."""
    toward = 255 if shade > 0 else 0
    mixed = (round((1.0 - abs(shade)) * c + abs(shade) * toward) for c in rgb(colour))
    return f"#{bytes(mixed).hex()}"
