"""A mesh as a file."""

from pathlib import Path

from articugen.core.errors import ArticugenError
from articugen.core.records import Mesh

MESH_FORMATS = (".ply", ".obj", ".stl", ".glb")


def check_format(path: Path) -> None:
    """Raise ArticugenError where its ending names no format that meshes are written in."""
    if path.suffix not in MESH_FORMATS:
        raise ArticugenError(f"{path}: choose one of {', '.join(MESH_FORMATS)}")


def export(mesh: Mesh, path: Path) -> None:
    """Write a mesh in the format that the ending of `path` names; ArticugenError if it cannot."""
    import trimesh  # noqa: PLC0415 - takes a second, which whoever makes no file would wait for

    check_format(path)
    try:
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    except OSError as error:
        raise ArticugenError(f"{path}: cannot be written: {error.strerror}") from None
