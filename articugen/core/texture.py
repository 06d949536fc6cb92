"""Colours that change within a face: pictures laid on it, and colours at its corners."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from articugen.core.arrays import Bools, Bytes, Floats, Indices


@dataclass(frozen=True, eq=False)
class Texture:
    """Pictures on F faces.

    Attributes:
        pictures: (h, w, 3) sRGB, the uppermost row first; they repeat in their plane.
        which: (F,) the picture on each face; -1 where its colour does not change.
        places: (F, 3, 2) of its corners in that, in widths and heights from the lower left corner.
        tint: (F, 3, 3) sRGB from 0 to 1 at its corners, which the picture is multiplied by.
    """

    pictures: tuple[Bytes, ...]
    which: Indices
    places: Floats
    tint: Floats

    def of(self, faces: Indices | Bools) -> "Texture":
        """Return the pictures on some faces, in their order."""
        return Texture(self.pictures, self.which[faces], self.places[faces], self.tint[faces])

    def turned(self) -> "Texture":
        """Return the same, of faces whose corners come in the other order."""
        return Texture(self.pictures, self.which, self.places[:, ::-1], self.tint[:, ::-1])

    @staticmethod
    def joined(textures: Sequence["Texture | None"], counts: Sequence[int]) -> "Texture | None":
        """Return the pictures on several meshes of `counts` of faces, in order; None where none has
        any."""
        if all(texture is None for texture in textures):
            return None
        every = [texture or _nothing(n) for texture, n in zip(textures, counts, strict=True)]
        pictures = {id(picture): picture for texture in every for picture in texture.pictures}
        number = {key: n for n, key in enumerate(pictures)}
        numbers = [np.array([*(number[id(p)] for p in t.pictures), -1], np.intp) for t in every]
        return Texture(
            tuple(pictures.values()),
            np.concatenate([n[t.which] for n, t in zip(numbers, every, strict=True)]),
            np.concatenate([texture.places for texture in every]),
            np.concatenate([texture.tint for texture in every]),
        )

    def colours(self, face: Indices, weights: Floats) -> Bytes:
        """Return (n, 3) sRGB at points of faces (n,), which are `weights` (n, 3) of their corners
        that add up to 1."""
        shown = between(self.tint[face], weights)
        at = between(self.places[face], weights)
        for n in np.unique(self.which[face]):
            if n >= 0:
                rows = np.flatnonzero(self.which[face] == n)
                shown[rows] *= texels(self.pictures[n], at[rows]) / 255.0
        return np.round(255.0 * np.clip(shown, 0.0, 1.0)).astype(np.uint8)


def _nothing(count: int) -> Texture:
    which, corners = np.full(count, -1, np.intp), np.zeros((count, 3, 3))
    return Texture((), which, corners[..., :2], corners)


def between(corners: Floats, weights: Floats) -> Floats:
    """Return (n, k), the sums of values (n, 3, k) at corners times `weights` (n, 3) or (3,)."""
    a, b, c = np.moveaxis(weights, -1, 0)[..., None]
    return a * corners[:, 0] + b * corners[:, 1] + c * corners[:, 2]


def texels(picture: Bytes, at: Floats) -> Bytes:
    """Return (n, 3) of a picture that repeats, at places (n, 2) as those of `Texture` are."""
    height, width = picture.shape[:2]
    at = at % 1.0
    column = np.minimum((at[:, 0] * width).astype(np.intp), width - 1)
    row = np.minimum(((1.0 - at[:, 1]) * height).astype(np.intp), height - 1)
    return picture[row, column]
