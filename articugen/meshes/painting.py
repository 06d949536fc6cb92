"""Colours and pictures of meshes: those of other faces carried over, few of them, and faces by
them."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from articugen.core.arrays import Bytes, Floats, Indices, Ints
from articugen.core.colours import colour_of, linear, rgb, srgb_linear
from articugen.core.geometry import area_vectors, plane_weights
from articugen.core.portable import norm
from articugen.core.records import Mesh
from articugen.core.texture import Texture, between

MOST_COLOURS = 32
"""Of a part: each is a material, a texture's could be thousands."""

_HALVINGS = 10  # of an edge until the border of two colours on it is known
_INWARDS = 0.02  # from a corner towards the middle of a face, which lies on one side of a seam
_AGREES = 0.02  # of a picture's edge: faces that differ by more have no common map


class Look(NamedTuple):
    """Faces of a mesh that are drawn in one colour: #rrggbb, and the same as linear light, (3,);
    their area is in the mesh's units. Or in a picture (h, w, 3), of which that is the mean, at the
    `places` (n, 3, 2) of their corners; see `Texture`."""

    colour: str
    light: Floats
    faces: Indices
    area: float
    picture: Bytes | None = None
    places: Floats | None = None

    @property
    def rgba(self) -> list[float]:
        """(4,) sRGB and opacity, from 0 to 1."""
        return [*(channel / 255.0 for channel in rgb(self.colour)), 1.0]


def looks(mesh: Mesh, part: int = 0) -> list[Look]:
    """Return the faces of a mesh by their colours and pictures, the widest first; all of it in the
    colour of a `part` in our pictures where it has none."""
    area = 0.5 * norm(area_vectors(mesh.triangles))
    if mesh.colours is None:
        colour = colour_of(part)
        return [Look(colour, linear(colour), np.arange(len(area)), area.sum())]
    numbers, which = np.unique(_number(mesh.colours), return_inverse=True)
    some = [(f"#{n:06x}", np.flatnonzero(which == k)) for k, n in enumerate(numbers)]
    groups = [Look(c, srgb_linear(c), faces, area[faces].sum()) for c, faces in some]
    if (texture := mesh.texture) is not None:
        shown = [int(texture.which[look.faces[0]]) for look in groups]
        groups = [
            look._replace(picture=texture.pictures[n], places=texture.places[look.faces])
            if n >= 0 else look
            for n, look in zip(shown, groups, strict=True)
        ]  # fmt: skip
    return sorted(groups, key=lambda look: -round(look.area, 6))


def _number(colours: Ints | Bytes) -> Ints:
    return colours.astype(np.int64) @ np.array([65536, 256, 1])


def few(colours: Bytes, weights: Floats) -> Bytes:
    """Return colours (F, 3) as at most MOST_COLOURS: where they are more, the means by `weights`
    (F,) of the cells of the finest even grid of colours that does."""
    step = 1
    while True:
        cells, which = np.unique(_number(colours // step), return_inverse=True)
        if len(cells) <= MOST_COLOURS:
            break
        step = max(step + 1, step * 5 // 4)
    if step == 1:
        return colours
    share = weights + 1e-12  # of faces without area alone
    means = [np.bincount(which, share * column) / np.bincount(which, share) for column in colours.T]
    return np.stack(means, axis=1).round().astype(np.uint8)[which]


def settled(
    colours: Bytes, texture: Texture | None, weights: Floats
) -> tuple[Bytes, Texture | None]:
    """Return the colours (F, 3) and the texture of faces as materials have them: pictures in their
    tint, whose faces have a colour that no others have, about their mean by `weights` (F,); others
    as `few`."""
    if texture is None:
        return few(colours, weights), None
    wide = np.array([picture.size > colours.shape[1] for picture in texture.pictures] + [False])
    laid = wide[texture.which]
    plain = few(colours[~laid], weights[~laid])
    tint = few(np.round(255.0 * texture.tint.mean(axis=1)).astype(np.uint8), weights)
    keys = np.where(laid, (texture.which << 24) + _number(tint), -1)
    settled, which, pictures = colours.copy(), np.full(len(keys), -1), []
    settled[~laid] = plain
    taken = set(_number(plain).tolist())
    for key in np.unique(keys[laid]):
        some = np.flatnonzero(keys == key)
        which[some] = len(pictures)
        picture = texture.pictures[key >> 24] * (tint[some[0]] / 255.0)
        pictures.append(np.round(picture).astype(np.uint8))
        mean = np.average(colours[some], axis=0, weights=weights[some] + 1e-12)
        number = int(_number(mean.round().astype(np.uint8)))
        while number in taken:
            number = (number + 1) % 2**24
        taken.add(number)
        settled[some] = rgb(f"#{number:06x}")
    even = np.ones_like(texture.tint)
    return settled, Texture(tuple(pictures), which, texture.places, even) if pictures else None


def laid_like(mesh: Mesh, triangles: Floats, colours: Bytes, texture: Texture) -> Mesh:
    """Return a mesh whose faces have some of the `settled` colours (F, 3) of other `triangles` (F,
    3, 3) near them, with the pictures that lie on these."""
    which, places = np.full(len(mesh.faces), -1), np.zeros((len(mesh.faces), 3, 2))
    for n in range(len(texture.pictures)):
        some = np.flatnonzero(texture.which == n)
        rows = np.flatnonzero((mesh.colours == colours[some[0]]).all(axis=1))
        which[rows] = n
        corners = mesh.triangles[rows]
        middle = corners.mean(axis=1, keepdims=True)
        inner = corners + _INWARDS * (middle - corners)
        whole, apart = (
            _placed(corners, by, triangles[some], texture.places[some]) for by in (middle, inner)
        )
        agree = np.abs(whole.mean(axis=1) - apart.mean(axis=1)).max(axis=1) < _AGREES
        places[rows] = np.where(agree[:, None, None], apart, whole)
    even = np.ones((*places.shape[:2], 3))
    return replace(mesh, texture=Texture(texture.pictures, which, places, even))


def _placed(corners: Floats, by: Floats, triangles: Floats, places: Floats) -> Floats:
    """Return (m, 3, 2) where corners (m, 3, 3) of faces are in a picture whose places are those of
    the corners of triangles, by the ones that are nearest to points `by` (m, 1 or 3, 3)."""
    from articugen.meshes.distances import nearest  # noqa: PLC0415 - compiles; hulls need none

    near = nearest(by.reshape(-1, 3), triangles)[1].reshape(by.shape[:2])
    near = np.broadcast_to(near, corners.shape[:2]).ravel()
    weights = plane_weights(triangles[near], corners.reshape(-1, 3))
    return between(places[near], weights).reshape(*corners.shape[:2], 2)


def coloured_like(mesh: Mesh, triangles: Floats, colours: Bytes) -> Mesh:
    """Return a fine mesh in the colours (F, 3) of the nearest of other `triangles` (F, 3, 3): cut
    along where they change, as watertight as before."""
    from articugen.meshes.distances import nearest  # noqa: PLC0415 - compiles; hulls need none

    _, first, index = np.unique(_number(colours), return_index=True, return_inverse=True)
    if len(first) == 1:
        return replace(mesh, colours=np.tile(colours[:1], (len(mesh.faces), 1)))
    at = index[nearest(mesh.vertices, triangles)[1]]
    sides = np.sort(mesh.faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)  # each opposite a corner
    crossed = at[sides[..., 0]] != at[sides[..., 1]]
    edges, number = np.unique(sides[crossed], axis=0, return_inverse=True)
    here, there = mesh.vertices[edges].swapaxes(0, 1).copy()
    for _ in range(_HALVINGS):
        middle = 0.5 * (here + there)
        same = index[nearest(middle, triangles)[1]] == at[edges[:, 0]]
        here[same], there[~same] = middle[same], middle[~same]
    cut = np.zeros(sides.shape[:2], np.int64)
    cut[crossed] = len(mesh.vertices) + number.reshape(-1)
    count = crossed.sum(axis=1)
    kept, middle = count == 0, count == 3  # of three colours: their corners, and one in the middle
    pieces = [mesh.faces[kept], cut[middle]]
    looks = [at[mesh.faces[kept, 0]], at[mesh.faces[middle, 0]]]
    for k in range(3):
        a, b, c = np.roll(mesh.faces, -k, axis=1).T
        _, ca, ab = np.roll(cut, -k, axis=1).T
        lone = (count == 2) & ~crossed[:, k]
        for some, corners in (lone | middle, (a, ab, ca)), (lone, (b, c, ab)), (lone, (c, ca, ab)):
            pieces.append(np.stack(corners, axis=1)[some])
            looks.append(at[corners[0][some]])
    vertices = np.concatenate([mesh.vertices, 0.5 * (here + there)])
    return Mesh(vertices, np.concatenate(pieces), colours[first[np.concatenate(looks)]])
