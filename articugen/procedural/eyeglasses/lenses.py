"""The outlines of spectacle lenses."""

from dataclasses import dataclass

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.portable import cos, norm, power, sin


@dataclass(frozen=True)
class Lens:
    """A lens's outline: a superellipse that is warped.

    Attributes:
        aspect: height / width.
        power: 2 is an ellipse, more is squarer.
        taper: how much wider the top is than the bottom.
        lift: of the outer top corner, as a part of the width (cat-eye).
        droop: of the outer bottom corner, as a part of the width (aviator).
        sides: vertices; few make a polygon that is seen as one.
    """

    aspect: float
    power: float
    taper: float
    lift: float
    droop: float
    sides: int = 44


def lens_shapes(rng: np.random.Generator) -> dict[str, Lens]:
    """Return one lens of each shape, by its name."""
    u = rng.uniform
    return {
        "round": Lens(u(0.93, 1.0), 2.0, 0.0, 0.0, 0.0),
        "oval": Lens(u(0.58, 0.72), u(2.0, 2.3), 0.0, u(0, 0.03), 0.0),
        "square": Lens(u(0.72, 0.9), u(4.0, 6.5), u(0.0, 0.06), 0.0, 0.0),
        "rectangle": Lens(u(0.48, 0.62), u(3.5, 6.0), u(0.0, 0.08), u(0, 0.03), 0.0),
        "trapezoid": Lens(u(0.7, 0.85), u(3.0, 4.5), u(0.1, 0.2), u(0.0, 0.06), 0.0),
        "aviator": Lens(u(0.82, 0.95), u(2.3, 2.9), u(0.04, 0.12), 0.0, u(0.08, 0.16)),
        "cat-eye": Lens(u(0.6, 0.75), u(2.3, 3.2), u(0.05, 0.15), u(0.12, 0.2), 0.0),
        "polygon": Lens(u(0.82, 0.95), 2.0, 0.0, 0.0, 0.0, int(rng.integers(6, 9))),
    }


def lens_outline(lens: Lens, width: float, slant: float) -> Floats:
    """Return the outline (n, 2) of the right lens about its middle: x outward, y up."""
    # Vertices at equal steps of length: first many, then as many as wanted.
    angles = np.linspace(0.0, 2.0 * np.pi, 721)
    cosine, sine = cos(angles), sin(angles)
    x = np.sign(cosine) * power(np.abs(cosine), 2.0 / lens.power)
    y = np.sign(sine) * power(np.abs(sine), 2.0 / lens.power)
    outward = np.clip((x + 1.0) / 2.0, 0.0, 1.0)
    warped_x = x * (1.0 + lens.taper * y)
    warped_y = y * lens.aspect
    warped_y += 2.0 * lens.lift * outward * outward * outward * np.clip(y, 0.0, 1.0)
    warped_y -= 2.0 * lens.droop * outward**2 * np.clip(-y, 0.0, 1.0)
    warped_y += slant * x
    dense = np.stack([warped_x, warped_y], axis=1) * width / 2
    if lens.sides < 20:
        steps = np.linspace(0.0, 720.0, lens.sides, endpoint=False) + 720.0 / lens.sides / 2
        return dense[steps.astype(int)]
    length = np.concatenate([[0.0], np.cumsum(norm(np.diff(dense, axis=0)))])
    at = (np.arange(lens.sides) + 0.5) * length[-1] / lens.sides
    return np.stack([np.interp(at, length, dense[:, k]) for k in range(2)], axis=1)
