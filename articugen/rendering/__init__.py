"""Depth maps: one call, and a table of ways to make them, `backends.BACKENDS`.

`rasterizer` (numba) is the default and needs no display and no system package; `embree`, `opengl`
and `sapien` wrap well-known renderers, for those who want to compare.
"""

from articugen.core.backends import backend_named
from articugen.core.records import DepthMaps, LabelledMesh, Views


def render(mesh: LabelledMesh, views: Views, *, backend: str = "rasterizer") -> DepthMaps:
    """Render depth maps of `mesh` from `views` by the named backend; see `Backend.render`.

    Raises:
        ValueError: no such backend; a part of the mesh does not lie in front of a pinhole camera.
        MissingExtra, MissingDriver: what the backend needs is not there.
    """
    return backend_named(backend).render(mesh, views)
