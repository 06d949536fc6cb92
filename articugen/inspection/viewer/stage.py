"""What is drawn: layers of plain arrays as viser's scene, and the camera that frames them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import look_along
from articugen.inspection.viewer.layers import Drawn, Lines, Points, Solid
from articugen.pictures.camera import direction
from articugen.pictures.portrait import ELEVATION

if TYPE_CHECKING:
    import viser

FIELD_OF_VIEW = float(np.radians(35.0))  # from the lower to the upper edge of the window
FILL = 0.9  # of the window's width or height, that what is framed takes
NARROW, SHEET_LEAVES = 576, 0.4
"""In windows of fewer pixels, phones, viser's controls are a sheet that leaves this share of the
height free, at the top."""


class Stage:
    """The scene of a server: layers by name, and the camera on them.

    Attributes:
        framed: whether that is settled.
    """

    def __init__(self, server: "viser.ViserServer") -> None:
        self._server = server
        self._layers: dict[str, list[tuple[Drawn, Any]]] = {}
        self.framed = False
        self._placed: dict[int, tuple[float, Floats]] = {}
        self._points, self._toward_eye = np.zeros((1, 3)), np.array([1.0, 0.0, 0.0])
        server.scene.set_up_direction("+z")
        # its usual brightness leaves pale parts white, and none in the colour that it has
        server.scene.configure_environment_map(environment_intensity=0.45)
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._forget)

    def frame(self, azimuth: float, points: Floats) -> None:
        """Look from this side (rad) at points (n, 3)."""
        self._toward_eye, self._points = direction(azimuth, ELEVATION), points
        self.framed = True
        for client in self._server.get_clients().values():
            self._place(client)

    def draw(self, layer: str, drawn: Sequence[Drawn]) -> None:
        """Have a layer show this and nothing else."""
        from viser.transforms import SO3  # noqa: PLC0415 - optional

        before = self._layers.pop(layer, [])
        shown = [one for one in drawn if _holds_anything(one)]
        with self._server.atomic():
            if _only_moved([old for old, _ in before], shown):
                handles = [handle for _, handle in before]
            else:
                for _, handle in before:
                    handle.remove()
                handles = [self._add(f"/{layer}/{n}", one) for n, one in enumerate(shown)]
            for handle, one in zip(handles, shown, strict=True):
                if isinstance(one, Solid):
                    handle.position = one.T[:3, 3]
                    handle.wxyz = SO3.from_matrix(one.T[:3, :3]).wxyz
        self._layers[layer] = list(zip(shown, handles, strict=True))

    def _add(self, name: str, drawn: Drawn) -> Any:
        scene = self._server.scene
        if isinstance(drawn, Points):
            return scene.add_point_cloud(
                name, drawn.points.astype(np.float32), drawn.colours,
                point_size=drawn.size, point_shape="circle", point_shading="flat",
            )  # fmt: skip
        if isinstance(drawn, Lines):
            # viser 1.1 takes the colours of lines for linear light, unlike all others
            linear = np.round(255.0 * (drawn.colours / 255.0) ** 2.2).astype(np.uint8)
            return scene.add_line_segments(
                name, drawn.ends.astype(np.float32), linear,
                thickness=drawn.width, thickness_units="screen",
            )  # fmt: skip
        return scene.add_mesh_simple(
            name, drawn.vertices.astype(np.float32), drawn.faces, color=drawn.colour,
            flat_shading=True, side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _welcome(self, client: "viser.ClientHandle") -> None:
        """Place a window's camera, again as its shape settles, until somebody turns it."""
        self._place(client)

        @client.camera.on_update
        async def _(camera: "viser.CameraHandle") -> None:
            shape, position = self._placed.get(client.client_id, (0.0, np.zeros(3)))
            untouched = np.allclose(camera.position, position, atol=1e-3)
            if untouched and abs(camera.aspect - shape) > 1e-3:
                self._place(client)

    def _forget(self, client: "viser.ClientHandle") -> None:
        """Keep nothing of a window that was closed."""
        self._placed.pop(client.client_id, None)

    def _place(self, client: "viser.ClientHandle") -> None:
        """Turn a window's camera to what is framed, whatever its shape."""
        if not self.framed:
            return
        camera = client.camera
        free = SHEET_LEAVES if camera.image_width < NARROW else 1.0
        eye = eye_of(self._points, self._toward_eye, camera.aspect, free)
        with client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.fov = FIELD_OF_VIEW
            camera.position = eye
            middle = self._points.mean(axis=0)
            camera.look_at = eye + ((middle - eye) @ self._toward_eye) * self._toward_eye
        self._placed[client.client_id] = (camera.aspect, camera.position)


def eye_of(points: Floats, toward_eye: Floats, aspect: float, free: float) -> Floats:
    """Return (3,) the nearest place from which a window sees all of the points (n, 3), in its
    middle.

    Args:
        toward_eye: (3,) where it is, as seen from them.
        aspect: the window's width by its height, of which `free` is to be filled, at the top.
    """
    R = look_along(-toward_eye)[:3, :3]
    x, y, z = R @ points.T  # to the right, down, away
    high = np.tan(FIELD_OF_VIEW / 2.0)
    rim = (1.0 - FILL) * high * free
    across = (FILL * high * aspect,) * 2
    along = (high - rim, (2.0 * free - 1.0) * high - rim)
    depth = min(_deepest(x, z, *across), _deepest(y, z, *along))
    return R.T @ [_middle(x, z - depth, *across), _middle(y, z - depth, *along), depth]


def _deepest(u: Floats, z: Floats, before: float, after: float) -> float:
    """Return the greatest depth d of an eye that sees all of the points at `u` and depth `z`: with
    some c, -before * (z - d) <= u - c <= after * (z - d)."""
    return ((u + before * z).min() - (u - after * z).max()) / (before + after)


def _middle(u: Floats, z: Floats, before: float, after: float) -> float:
    """Find the c of an eye at depth 0 which leaves as much room on one side as on the other."""
    c = 0.0
    for _ in range(20):
        outermost = (u - c) / z
        c += 0.5 * (outermost.min() + outermost.max() + before - after) * z.mean()
    return c


def _only_moved(before: Sequence[Drawn], now: Sequence[Drawn]) -> bool:
    """Return whether these are the same solids as before, wherever they stand."""
    return len(before) == len(now) and all(
        isinstance(old, Solid) and isinstance(new, Solid) and old.vertices is new.vertices
        for old, new in zip(before, now, strict=True)
    )


def _holds_anything(drawn: Drawn) -> bool:
    if isinstance(drawn, Points):
        return len(drawn.points) > 0
    return len(drawn.ends if isinstance(drawn, Lines) else drawn.faces) > 0
