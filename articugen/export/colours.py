"""The colours of parts, those of the contact sheet."""

import numpy as np
from numpy.typing import NDArray

from articugen.core.colours import colour_of
from articugen.pictures.shading import linear


def of_parts(part: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Return (n, 3) sRGB of each part (n,)."""
    palette = [list(bytes.fromhex(colour_of(k)[1:])) for k in range(256)]
    return np.array(palette, np.uint8)[part]


def linear_of_part(part: int) -> list[float]:
    """Red, green, blue and alpha in linear light, 0 to 1."""
    return [*linear(colour_of(part)).tolist(), 1.0]
