"""The renderers: one table, and what the stages ask of each by what it can do, never by name.

A renderer is a file with `render(mesh, views) -> DepthMaps` and one line of BACKENDS; or a file in
another package, whose line is an entry point of the group `articugen.backends`: see
docs/extending.md.
"""

import importlib
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from articugen.core import plugins
from articugen.core.arrays import Bools
from articugen.core.errors import BrokenPlugin
from articugen.core.records import DepthMaps, LabelledMesh, Views
from articugen.core.yaml_files import nearest


class Overlay(Protocol):
    """Keeps the maps of what never moves and draws over them what does, again and again."""

    def draw(self, mesh: LabelledMesh, *, closed: Bools, first_face: int) -> DepthMaps:
        """Draw a mesh and return the faces seen, valid until the next call; face f of `mesh` is
        `first_face + f`."""
        ...


HINTS = ("closed", "keep_depth")  # what a module's `render` may take besides; see `Backend.render`


@dataclass(frozen=True)
class Backend:
    """A renderer.

    Attributes:
        module: has `render(mesh, views) -> DepthMaps`, and may have a class `Overlay(static)`, see
            above, without which everything is drawn again for each instance; imported when it is
            first used.
        needs: what must be installed for it, in words; "" where articugen brings it along.
        tells_faces: whether its maps say which face each pixel sees.
        takes: which of the keywords of `Backend.render` the module's own takes as well.
    """

    module: str
    needs: str = ""
    tells_faces: bool = False
    takes: tuple[str, ...] = ()

    def render(
        self,
        mesh: LabelledMesh,
        views: Views,
        *,
        closed: Bools | None = None,
        keep_depth: bool = True,
    ) -> DepthMaps:
        """Render what each of `views` sees of `mesh`.

        Args:
            mesh: unit frame.
            closed: (F,) which faces bound closed solids, outwards: their backs cannot be seen.
            keep_depth: False where the faces alone will do; the depth may then be None.

        Raises:
            MissingExtra, MissingDriver: what it needs is not there.
            BrokenPlugin: there is no such module or function, or it gives no faces after all.
            ValueError: a part of the mesh does not lie in front of a pinhole camera.
        """
        offered = {"closed": closed, "keep_depth": keep_depth}
        try:
            module = importlib.import_module(self.module)
        except ModuleNotFoundError as error:
            if error.name != self.module:
                raise
            raise BrokenPlugin(
                f"renderer {self.module}: there is no such module; correct its line in the table"
            ) from None
        if not hasattr(module, "render"):
            raise BrokenPlugin(f"renderer {self.module}: has no function render; add one")
        maps = module.render(mesh, views, **{k: offered[k] for k in self.takes})
        if self.tells_faces and maps.face is None:
            raise BrokenPlugin(
                f"renderer {self.module}: gives no faces though its line in the table says "
                "tells_faces=True; give them, or leave that out"
            )
        return maps

    def render_parts(
        self, mesh: LabelledMesh, views: Views, *, closed: Bools | None = None
    ) -> DepthMaps:
        """Render with faces in any case: of a backend without faces each part is drawn alone, and
        its first face stands for all of the part where that is the nearest."""
        if self.tells_faces:
            return self.render(mesh, views, closed=closed)
        depth = np.full((len(views), views.height, views.width), np.inf, np.float32)
        face = np.full(depth.shape, -1, np.int32)
        for part in np.unique(mesh.part_of_face).tolist():
            of_part = self.render(mesh.part(part), views).depth
            assert of_part is not None
            nearer = of_part < depth
            depth[nearer] = of_part[nearer]
            face[nearer] = np.argmax(mesh.part_of_face == part)
        return DepthMaps(depth, face, views)

    def overlay_on(self, static: DepthMaps) -> Overlay | None:
        """Return what draws over the maps of part 0; None where the backend has no such thing."""
        overlay = getattr(importlib.import_module(self.module), "Overlay", None)
        return overlay and overlay(static)

    def __post_init__(self) -> None:
        if unknown := set(self.takes) - set(HINTS):
            raise ValueError(f"takes={self.takes}: there is no {unknown}, only {HINTS}")


BACKENDS: dict[str, Backend] = {
    "rasterizer": Backend(
        "articugen.rendering.rasterizer", tells_faces=True, takes=("closed", "keep_depth")
    ),
    "embree": Backend("articugen.rendering.embree", needs="open3d", tells_faces=True),
    "opengl": Backend("articugen.rendering.opengl", needs="pyrender and EGL or OSMesa"),
    "sapien": Backend("articugen.rendering.sapien", needs="sapien and a Vulkan driver"),
}
"""By the name that recipes give (`views.backend`); the first one is the default."""

_TABLE = plugins.Table(
    "articugen.backends", BACKENDS, ("render", "render_parts", "overlay_on"), "backend", ValueError
)
names = _TABLE.names


def check_name(name: str) -> str:
    """Return the name; ValueError where there is no backend of that name."""
    if name not in BACKENDS and name not in names():
        hint = nearest(name, list(names()))
        there = [f"{n} (needs {b.needs})" if b.needs else n for n, b in BACKENDS.items()]
        raise ValueError(
            f"no backend {name!r}{hint}; there are: {', '.join((*there, *names()[len(there) :]))}"
        )
    return name


def backend_named(name: str) -> Backend:
    """Return the backend of that name, ours or a package's; BrokenPlugin if that is unusable."""
    check_name(name)
    return _TABLE.load(name)
