"""The colours of parts, the same in every picture, page and file."""

import numpy as np

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


PALETTE = np.array([rgb(colour_of(part)) for part in range(256)], np.uint8)
"""(256, 3) sRGB of each part."""
