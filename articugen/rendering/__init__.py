"""Depth maps: one call, four ways to make them.

`rasterizer` (numba) is the default and needs no display and no system package; `embree`, `opengl`
and `sapien` wrap well-known renderers, for those who want to compare.
"""

import importlib

from articugen.records import DepthMaps, LabelledMesh, Views

BACKENDS = ("rasterizer", "embree", "opengl", "sapien")


def render(mesh: LabelledMesh, views: Views, *, backend: str = "rasterizer") -> DepthMaps:
    """The depth maps of `mesh` from `views`, made by the named backend.

    Raises:
        ValueError: no such backend.
        MissingExtra: the backend's library is not installed.
    """
    if backend not in BACKENDS:
        raise ValueError(f"no backend {backend!r}; there are {', '.join(BACKENDS)}")
    return importlib.import_module(f"articugen.rendering.{backend}").render(mesh, views)
