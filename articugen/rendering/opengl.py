"""Depth by OpenGL: pyrender, off-screen, on EGL (on OSMesa where PYOPENGL_PLATFORM=osmesa).

pyrender 0.1.45 as shipped draws four samples a pixel and keeps the depth of one that is not at the
pixel's centre (up to 2e-2 off), and its depth pass culls back faces whatever its flags say.
`_renderer_class` mends both in a subclass; pyrender itself stays as it is.

The depth buffer spends its precision on the mesh alone: the near and the far plane of each view
just enclose it.
"""

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.records import DepthMaps, LabelledMesh, Views
from articugen.rendering.foreign import depth_ranges, import_library, missing_driver, unseen


def render(mesh: LabelledMesh, views: Views) -> DepthMaps:
    """Render `mesh` in each of `views`: depth only, `face` is None.

    Raises:
        MissingExtra, MissingDriver: pyrender, EGL or OSMesa cannot be used.
        ValueError: a part of the mesh does not lie in front of a pinhole camera.
    """
    # Read once, when PyOpenGL and pyglet are first imported; without them both want a display.
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    os.environ.setdefault("PYGLET_HEADLESS", "1")
    pyrender = import_library("pyrender", "opengl", _system_packages())
    depth = unseen(views)
    if len(mesh.faces) == 0:
        return DepthMaps(depth, None, views)

    ranges = depth_ranges(mesh, views)
    scene = pyrender.Scene()
    scene.add(pyrender.Mesh([pyrender.Primitive(mesh.vertices, indices=mesh.faces)]))
    camera = _camera_class()()
    scene.add(camera)
    flags = pyrender.RenderFlags.DEPTH_ONLY | pyrender.RenderFlags.OFFSCREEN
    with _renderer(pyrender, views) as renderer:
        for k, (near, far) in enumerate(ranges):
            T_clip_camera = _projection(views, k, near, far)
            camera.T_clip_world = T_clip_camera @ views.T_camera_world[k]
            stored = renderer.render(scene, flags).astype(np.float64)
            if views.projection == "pinhole":
                z = far * near / (far - stored * (far - near))
            else:
                z = near + stored * (far - near)
            depth[k] = np.where(stored < 1.0, z, np.inf)
    return DepthMaps(depth, None, views)


def _projection(views: Views, k: int, near: float, far: float) -> Floats:
    """Return the (4, 4) projection of view k from camera coordinates to OpenGL's clip space.

    The image is drawn upside down, so that OpenGL's bottom row, the first it gives back, is row 0.
    """
    pinhole = views.projection == "pinhole"
    w = 2 if pinhole else 3  # clip w is this coordinate of (x, y, z, 1)
    P = np.zeros((4, 4))
    P[0, 0], P[0, w] = 2 * views.fx[k] / views.width, 2 * views.cx[k] / views.width - 1
    P[1, 1], P[1, w] = 2 * views.fy[k] / views.height, 2 * views.cy[k] / views.height - 1
    P[2, 2:] = np.array([far + near, -2 * far * near] if pinhole else [2, -far - near])
    P[2] /= far - near
    P[3, w] = 1
    return P


def _system_packages() -> str:
    osmesa = os.environ["PYOPENGL_PLATFORM"] == "osmesa"
    return "libgl1 libosmesa6 (and pip install 'PyOpenGL>=3.1.7')" if osmesa else "libgl1 libegl1"


@contextmanager
def _renderer(pyrender: ModuleType, views: Views) -> Iterator[Any]:
    """A renderer in an OpenGL context of its own, on the platform that PYOPENGL_PLATFORM names."""
    try:
        context = pyrender.OffscreenRenderer(views.width, views.height)
    except Exception as error:  # OpenGL's bindings raise whatever they stumble over
        raise missing_driver("pyrender", _system_packages(), error) from error
    renderer = _renderer_class()(views.width, views.height)
    try:
        yield renderer
    finally:
        renderer.delete()
        context.delete()


@cache
def _camera_class() -> Any:
    """Return a class of pyrender cameras with a projection of our own; made late since pyrender is
    optional."""
    Camera: Any = importlib.import_module("pyrender").Camera

    class ProjectionCamera(Camera):
        T_clip_world: Floats

        def get_projection_matrix(self, width: int, height: int) -> Floats:
            return self.T_clip_world

    return ProjectionCamera


@cache
def _renderer_class() -> Any:
    """pyrender's renderer with its faults mended; made late since pyrender is optional."""
    GL = importlib.import_module("OpenGL.GL")
    Renderer: Any = importlib.import_module("pyrender.renderer").Renderer

    class DepthRenderer(Renderer):
        def _configure_main_framebuffer(self) -> None:
            """Make the multisampled buffers again with one sample a pixel, at its centre."""
            if self._main_fb is not None:
                return
            super()._configure_main_framebuffer()
            for buffer, kind in (
                (self._main_cb_ms, GL.GL_RGBA),
                (self._main_db_ms, GL.GL_DEPTH_COMPONENT32F),
            ):
                GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
                GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, *self._main_fb_dims)

        def _bind_and_draw_primitive(
            self, primitive: Any, pose: Floats, program: Any, flags: int
        ) -> None:
            """Both sides of every triangle; pyrender's own culls back faces in a depth pass."""
            program.set_uniform("M", pose)
            primitive._bind()
            GL.glDisable(GL.GL_CULL_FACE)
            GL.glDrawElementsInstanced(
                primitive.mode, primitive.indices.size, GL.GL_UNSIGNED_INT, None, 1
            )
            primitive._unbind()

        def _read_main_framebuffer(self, scene: Any, flags: int) -> NDArray[np.float32]:
            """Return (H, W) what the depth buffer holds, the bottom row first."""
            width, height = self._main_fb_dims
            GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
            stored = GL.glReadPixels(0, 0, width, height, GL.GL_DEPTH_COMPONENT, GL.GL_FLOAT)
            return np.frombuffer(stored, np.float32).reshape(height, width)

    return DepthRenderer
