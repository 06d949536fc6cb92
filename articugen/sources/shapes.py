"""What links show, whatever the format: shapes put together, and counted before they are made."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import InvalidSource
from articugen.core.geometry import apply
from articugen.core.records import Mesh
from articugen.core.texture import Texture
from articugen.meshes import read
from articugen.meshes.looks import GREY, in_bytes, rgb_of, wanted_looks
from articugen.meshes.model_files import ModelFiles, quoted
from articugen.meshes.scenes import check_size
from articugen.sources.xml_check import MAX_NUMBER


def joined(shapes: Iterable[Mesh]) -> Mesh:
    """Return all shapes as one mesh, in their order."""
    shapes = [Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)), *shapes]
    first = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
    faces = [s.faces + np.int32(n) for s, n in zip(shapes, first, strict=False)]
    colours = None
    if any(shape.colours is not None for shape in shapes):
        known = (painted(shape, GREY.kd).colours for shape in shapes)
        colours = np.concatenate([part for part in known if part is not None])
    texture = Texture.joined([shape.texture for shape in shapes], [len(s.faces) for s in shapes])
    vertices = np.concatenate([shape.vertices for shape in shapes])
    return Mesh(vertices, np.concatenate(faces), colours, texture)


def painted(mesh: Mesh, colour: tuple[float, ...] | None) -> Mesh:
    """Return the mesh in a colour of 0 to 1, where it has none; None is no colour."""
    if mesh.colours is not None or colour is None:
        return mesh
    return replace(mesh, colours=np.tile(in_bytes(colour), (len(mesh.faces), 1)))


class Shapes:
    """Makes the meshes of the links of the model at `path`; each mesh file is read once."""

    def __init__(self, path: Path, files: ModelFiles, kinds: Iterable[str]) -> None:
        """InvalidSource where shapes of these kinds, all that will be shown, are too large."""
        self._path, self._files = path, files
        self._faces = self._vertices = 0
        self._cache: dict[Path, Mesh] = {}
        check_size(path, faces=sum(read.PRIMITIVE_FACES.get(kind, 0) for kind in kinds))

    def link(self, by: str, shapes: Iterable[tuple[Mesh, Any, Floats]]) -> Mesh:
        """Put a link together of shapes, each with its element, whose rgba a mesh without colours
        gets, and (4, 4) where it stands in the link's frame; `by` names the link."""
        return joined(self._placed(by, *shape) for shape in shapes)

    def file(self, name: str, by: str) -> Mesh:
        """Read the mesh that a model calls `name`; `NoMesh` where there is none."""
        place = self._files.find(name, by)
        if place is None:
            raise read.NoMesh(
                f"{by}: mesh {quoted(name)} does not exist; put the file there or remove the "
                "<visual>"
            )
        if place not in self._cache:
            self._cache[place] = read.read_mesh(place, self._files)
        return self._cache[place]

    def _placed(self, by: str, shape: Mesh, element: Any, T: Floats) -> Mesh:
        self._faces += len(shape.faces)
        self._vertices += len(shape.vertices)
        # all visuals together: a small file can name one large mesh many times
        check_size(self._path, faces=self._faces, vertices=self._vertices)
        vertices = apply(T, shape.vertices)
        if not (np.abs(vertices) <= MAX_NUMBER).all():
            raise InvalidSource(
                f"{by}: its <{element.tag}> reaches beyond {MAX_NUMBER:,.0f} m; correct its scale, "
                "or the unit of its file"
            )
        rgba = element.get("rgba", "").split()[:3] if wanted_looks() else ()
        return painted(replace(shape, vertices=vertices), rgb_of(rgba))
