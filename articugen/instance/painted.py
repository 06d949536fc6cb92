"""What is seen of the colours of a model, at points of the object posed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from articugen import fusion
from articugen.core.arrays import Bytes, Floats, Indices
from articugen.core.colours import plain_colour
from articugen.core.geometry import apply, invert_rigid, nearest_weights
from articugen.core.records import ArticulatedObject, LabelledMesh, Link
from articugen.core.texture import Texture


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours of F faces, whose triangles may be turned over or shifted from the model's.

    Attributes:
        flat: (F, 3) sRGB, the mean over each face.
        texture: of which these are the means; None where no colour changes within a face.
        corners: (F, 3, 3) of the model's own faces, canonical pose, unit frame.
    """

    flat: Bytes
    texture: Texture | None
    corners: Floats

    @staticmethod
    def of(
        obj: ArticulatedObject, soup: LabelledMesh, parts: Sequence[fusion.SolidPart]
    ) -> "Paint":
        """Return that of the faces of all parts, whose own ones are in `soup`, unit frame; of links
        that state no colours, plain ones."""
        links = [obj.links[i] for i in np.argsort(obj.part_of_link, kind="stable")]  # as the soup's
        first = np.searchsorted(soup.part_of_face, np.arange(len(parts)))
        origin = np.concatenate([
            fusion.origins(part.mesh, part.origin, soup.part(k)) + first[k]
            for k, part in enumerate(parts)
        ])  # fmt: skip
        flat = np.concatenate([_flat(link, obj.category) for link in links])
        textures = [link.mesh.texture for link in links]
        texture = Texture.joined(textures, [len(link.mesh.faces) for link in links])
        corners = soup.vertices[soup.faces[origin]]
        return Paint(flat[origin], texture and texture.of(origin), corners)

    def at(self, face: Indices, points: Floats, part: Bytes, part_motion: Floats) -> Bytes:
        """Return (n, 3) sRGB at points (n, 3), unit frame, of faces (n,) that belong to parts (n,),
        each moved from the canonical pose by its own of `part_motion` (P, 4, 4)."""
        colours = self.flat[face]
        if self.texture is None:
            return colours
        rows = np.flatnonzero(self.texture.which[face] >= 0)
        back = invert_rigid(part_motion)[part[rows]]
        weights = nearest_weights(self.corners[face[rows]], apply(back, points[rows]))
        colours[rows] = self.texture.colours(face[rows], weights)
        return colours


def _flat(link: Link, category: str) -> Bytes:
    if link.mesh.colours is not None:
        return link.mesh.colours
    plain = np.array(plain_colour(category, link.semantic or link.name), np.uint8)
    return np.tile(plain, (len(link.mesh.faces), 1))
