"""MeshLib's offset by voxels with an offset of nothing: a mesh made anew by one of its signs."""

import importlib
from typing import Any

import numpy as np

from articugen.core.records import LabelledMesh

SIGNS = {
    "projection normal": "ProjectionNormal",
    "winding rule": "WindingRule",
    "hole winding rule": "HoleWindingRule",
}
"""The signs that do not take the mesh to be closed and free of overlaps, as MeshLib names them."""


def remade(mesh: LabelledMesh, sign: str, voxel: float) -> LabelledMesh:
    """The zero level of the signed distance, by marching cubes; holes are closed where it can."""
    mm: Any = importlib.import_module("meshlib.mrmeshpy")
    arrays: Any = importlib.import_module("meshlib.mrmeshnumpy")

    used = mesh.compact()
    settings = mm.OffsetParameters()
    settings.voxelSize = voxel
    settings.signDetectionMode = getattr(mm.SignDetectionMode, SIGNS[sign])
    settings.closeHolesInHoleWindingNumber = True
    given = arrays.meshFromFacesVerts(np.array(used.faces), np.array(used.vertices))
    made = mm.mcOffsetMesh(mm.MeshPart(given), 0.0, settings)
    faces = np.asarray(arrays.getNumpyFaces(made.topology))
    vertices = np.asarray(arrays.getNumpyVerts(made), float)
    return LabelledMesh(vertices, faces, np.zeros(len(faces), np.uint8))
