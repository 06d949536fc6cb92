"""The measures of eyeglasses: what styles there are, and how one pair is drawn."""

from dataclasses import dataclass, replace

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import rotation_about, transform
from articugen.core.portable import product, turned
from articugen.procedural.eyeglasses.lenses import lens_outline, lens_shapes
from articugen.procedural.kit import MM
from articugen.procedural.kit.solids import Solid

_HIGHEST = 0.75


@dataclass(frozen=True)
class Glasses:
    """The measures of one pair of glasses, metres.

    Attributes:
        style: "wire" (metal rims), "acetate" (broad rims), "half" (rims above only), "browline"
            (broad above, wire below), "rimless" or "shield" (one curved pane).
        lens: its outline, x outward and y up, about its middle.
        lens_y: from the middle of the face to the middle of a lens.
        wire: radius of the metal parts.
        rim: (width across the lens's edge, depth along x) of a broad rim.
        wrap: by how much a lens is turned about z, following the face, radians.
        hinge_z: height of hinges and temples above the lenses' middle.
        temple: (thickness, height) at the hinge.
        round_temple: of round section, as wire frames have it.
        hug: how far a temple's tip reaches inwards, as heads are.
        straight: the range of a temple's length before its bend, mm.
        tilt: by how much the lenses lean forward at their lower edge, radians.
        glazed: whether there are lenses in the rims.
        upper: how far temples fold, radians.
        highest: how high hinges may lie over the lenses' middle, part of the lenses' height there.
    """

    style: str
    lens: Floats
    lens_y: float
    lens_thickness: float
    wire: float
    rim: tuple[float, float]
    wrap: float
    hinge_z: float
    temple: tuple[float, float]
    round_temple: bool
    hug: float
    straight: tuple[float, float] = (92, 112)
    tilt: float = 0.0
    glazed: bool = True
    upper: float = float(np.deg2rad(90.0))
    highest: float = _HIGHEST

    def placed(self, solid: Solid) -> Solid:
        """Return a solid, drawn about the right lens's middle (along_x applied), at its place."""
        turn = rotation_about((0, 0, 1), -self.wrap)
        if self.tilt:
            turn = product(rotation_about((0, 1, 0), -self.tilt), turn)
        return solid.moved(transform(turn)).shifted(y=self.lens_y)

    def place(self, point: Floats) -> Floats:
        """Return (y, z) on the right lens's plane to where it stands (x, y, z)."""
        wrapped = turned(rotation_about((0, 0, 1), -self.wrap), (0.0, *point))
        if self.tilt:
            wrapped = turned(rotation_about((0, 1, 0), -self.tilt), wrapped)
        return wrapped + np.array([0.0, self.lens_y, 0.0])


_STYLES = {
    "wire": 0.27,
    "acetate": 0.33,
    "half": 0.09,
    "browline": 0.11,
    "rimless": 0.1,
    "shield": 0.1,
}


def draw(rng: np.random.Generator) -> Glasses:
    """Return the measures of glasses of any style."""
    style = str(rng.choice(list(_STYLES), p=list(_STYLES.values())))
    shapes = lens_shapes(rng)
    name = str(rng.choice(list(shapes)))
    if style in ("half", "browline") and name in ("round", "polygon"):
        name = "trapezoid"
    width = rng.uniform(42, 58) * MM
    outline = lens_outline(shapes[name], width, slant=rng.uniform(0.0, 0.08))
    wire = rng.uniform(1.6, 2.4) * MM
    broad = rng.uniform(3.6, 8.5) * MM
    rim = {"wire": 2 * wire, "rimless": 0.0}.get(style, broad)
    metal = style in ("wire", "rimless") or (style in ("half", "browline") and rng.random() < 0.5)
    tall = rng.uniform(5.0, 16.0) if style in ("acetate", "shield") else rng.uniform(4.0, 8.0)
    round_temple = metal and rng.random() < 0.5
    return Glasses(
        style=style,
        lens=outline,
        lens_y=float(rng.uniform(14, 21) * MM / 2 + rim / 2 - outline[:, 0].min()),
        lens_thickness=rng.uniform(0.6, 2.4) * MM,
        wire=wire,
        rim=(broad, rng.uniform(3.6, 5.5) * MM),
        wrap=np.deg2rad(rng.uniform(0.0, 9.0)),
        hinge_z=float(outline[:, 1].max() * rng.uniform(0.15, _HIGHEST)),
        temple=(2.2 * wire, 2.2 * wire)
        if round_temple
        else (rng.uniform(2.6, 4.4) * MM, tall * MM),
        round_temple=round_temple,
        hug=rng.uniform(0.0, 5.0) * MM,
    )


def elsewise(rng: np.random.Generator, s: Glasses) -> Glasses:
    """Return the shape with proportions of its own: from wire to goggles, from short temples to
    long ones, which are as deep as .65 to 1.05 of the front is wide."""
    u = rng.uniform
    wide = 2 * (s.lens_y + float(s.lens[:, 0].max()))
    length = u(0.4, 0.8) * wide / MM
    thick, tall = s.temple
    if not s.round_temple:
        thick, tall = thick * u(0.8, 1.5), min(tall * u(0.8, 2.0), 16 * MM)
    broad = u(0.7, 1.8) if u() < 0.5 else 1.0
    highest = u(_HIGHEST, 1.0)  # of some as high as the rims
    return replace(
        s,
        highest=highest,
        hinge_z=float(s.lens[:, 1].max()) * u(0.3, 1.0) * highest,
        wire=s.wire * u(0.6, 1.4),
        rim=(s.rim[0] * broad, s.rim[1] * u(0.7, 1.5)),
        lens_y=s.lens_y + (broad - 1.0) * s.rim[0] / 2,
        wrap=s.wrap + (np.deg2rad(u(0.0, 12.0)) if u() < 0.3 else 0.0),
        tilt=float(np.deg2rad(u(0.0, 12.0))),
        temple=(thick, tall),
        straight=(0.95 * length, 1.05 * length),
        glazed=s.style in ("rimless", "half") or bool(u() < 0.55),
        upper=float(np.deg2rad(u(65.0, 90.0))) if u() < 0.5 else s.upper,
    )
