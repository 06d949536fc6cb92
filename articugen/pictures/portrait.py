"""Pictures of an object coloured by part: of its stored points, or of a triangle mesh.

The surface points of many instances of an object are brought to its canonical pose by the stored
motions of their parts, which makes a dense cloud, and from there to each pose that is drawn.
"""

from collections.abc import Sequence

import numpy as np

from articugen.core.arrays import Floats, Ints
from articugen.core.colours import PALETTE, colour_of, linear
from articugen.core.geometry import apply, invert_rigid, joint_motion
from articugen.core.records import JointKind, dequantize
from articugen.core.schema import Instance
from articugen.pictures.camera import Camera, framed
from articugen.pictures.layout import TILE
from articugen.pictures.light import SurfaceCloud
from articugen.pictures.shading import SUPERSAMPLING, Picture, shaded
from articugen.pictures.solids import ColouredMesh, draw_solid, spread
from articugen.pictures.splats import draw
from articugen.pictures.surfels import OrientedPoints, Surfels, surfels
from articugen.store.rows import Row

NOTHING = ColouredMesh(np.zeros((0, 3, 3)), np.zeros(0, np.int64), ())
_NO_CLOUD = spread(NOTHING.triangles, 0)
Drawing = tuple[Floats, Floats, Floats]  # depth, normals and colours, pixel by pixel

_LIGHT = (PALETTE / 255.0) ** 2.2
"""(256, 3) the colour of each part, as linear light."""

AZIMUTHS = tuple(np.radians((-35.0, 35.0, 145.0, 215.0)))
ELEVATION = float(np.radians(27.0))

AJAR = 0.35
"""Of its joints' ranges, how far what can be turned is open at first: shut, nothing seems to move.
"""

SWEPT = np.linspace(0.0, 1.0, 7)  # shares of their ranges at which joints are looked at together


def oriented_points(instance: Instance) -> OrientedPoints:
    """Return the stored surface points of an instance."""
    normals = instance.surface_normals.astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return OrientedPoints(dequantize(instance.surface_points), normals, instance.surface_part)


def instance_of(row: Row) -> Instance:
    """Return what pictures show of a row: its surface points and its joints."""
    names = ("kind", "parent", "state", "lower", "upper", "axis", "pivot")
    fields = [f"joint_{name}" for name in names]
    fields += ["surface_points", "surface_normals", "surface_part", "part_motion"]
    return Instance(
        object_id=row.object_id,
        state_index=row.state_index,
        center=row.center,
        scale=row.scale,
        **{name: row.stored(name) for name in fields},
    )


def pooled(instances: Sequence[Instance]) -> Surfels:
    """Discs of one object in its canonical pose, from the points of all these instances."""
    return surfels([oriented_points(i).moved(invert_rigid(i.part_motion)) for i in instances])


def tile_camera(points: Floats, azimuth: float, size: int = TILE) -> Camera:
    """Return the camera whose tile of `size` pixels the points (n, 3) fill."""
    return framed(points, azimuth, ELEVATION, SUPERSAMPLING * size, fill=0.86)


def best_azimuth(instances: Sequence[Instance]) -> float:
    """Return the side from which most of the parts of these instances can be seen."""
    posed = [surfels([oriented_points(instance)]) for instance in instances]
    return max(AZIMUTHS, key=lambda azimuth: sum(_seen(discs, azimuth) for discs in posed))


def _seen(discs: Surfels, azimuth: float) -> float:
    """Return how much of the parts can be seen from this side: the sum of their fractions."""
    camera = framed(discs.points, azimuth, ELEVATION, 128, fill=0.9)
    depth, _, _ = draw(discs, np.zeros((len(discs.points), 0)), camera)
    x, y, z = apply(camera.T_camera_world, discs.points).T
    column = (camera.focal * x / z + camera.cx).astype(int)
    row = (camera.focal * y / z + camera.cy).astype(int)
    visible = np.bincount(discs.part[z < depth[row, column] + discs.spacing], minlength=256)
    return float((visible / np.maximum(np.bincount(discs.part, minlength=256), 1)).sum())


def swept(instance: Instance) -> Floats:
    """Return (n, 3) where its surface points come when its joints go through their ranges
    together."""
    points, everywhere = dequantize(instance.surface_points), []
    for share in SWEPT:
        for part, T in enumerate(opened(instance, share)):
            everywhere.append(apply(T, points[instance.surface_part == part]))
    return np.concatenate(everywhere)


def opened(instance: Instance, share: float) -> Floats:
    """Return (P, 4, 4) how each part moves from this pose to the one in which all joints are at
    this share of their ranges."""

    def motion(part: int) -> Floats:
        if part == 0:
            return np.eye(4)
        j = part - 1  # its parent may be a later part
        axis, pivot = instance.joint_axis[j], instance.joint_pivot[j]
        q = (1.0 - share) * instance.joint_lower[j] + share * instance.joint_upper[j]
        q -= instance.joint_state[j]
        moved = joint_motion(instance.joint_kind[j] != JointKind.PRISMATIC, axis, q, pivot)
        return motion(instance.joint_parent[j]) @ moved

    return np.stack([motion(part) for part in range(len(instance.joint_kind) + 1)])


def portrait(
    discs: Surfels,
    instance: Instance,
    camera: Camera,
    floor: float,
    *,
    beside: ColouredMesh = NOTHING,
) -> Picture:
    """Draw an instance with the `pooled` discs of its object in the colours of its parts.

    Args:
        floor: the height of what it stands on.
        beside: drawn as well, without a shadow.
    """
    posed, points = discs.moved(instance.part_motion), oriented_points(instance)
    area = np.full(len(points.points), points.spacing() ** 2)
    coarse = SurfaceCloud(points.points, points.normals, area)
    picture = nearer(draw(posed, _LIGHT[posed.part], camera), _drawn(beside, camera))
    return shaded(picture, camera, coarse, posed.cloud, floor)


def plain_portrait(discs: Surfels, T_part: Floats, camera: Camera) -> Picture:
    """Draw `pooled` discs, moved by `T_part` (P, 4, 4), without shadows: twice as fast, and the
    same on all machines."""
    posed = discs.moved(T_part)
    return shaded(draw(posed, _LIGHT[posed.part], camera), camera, _NO_CLOUD, _NO_CLOUD, 0.0)


def solid_portrait(
    solid: ColouredMesh, camera: Camera, floor: float, *, beside: ColouredMesh = NOTHING
) -> Picture:
    """Draw a mesh as `portrait` draws points; an empty picture where there is none."""
    picture = nearer(_drawn(solid, camera), _drawn(beside, camera))
    coarse, fine = (spread(solid.triangles, count) for count in (8192, 65536))
    return shaded(picture, camera, coarse, fine, floor)


def parts_portrait(
    triangles: Floats, part: Ints, size: int, colours: Sequence[str] = ()
) -> Picture:
    """Draw the triangles (F, 3, 3) of one object, which fills a picture of `size` pixels, each in
    the colour of its part (F,), or in that of `colours` by number."""
    corners = triangles.reshape(-1, 3)
    shown = colours or [colour_of(k) for k in range(part.max() + 1)]
    solid = ColouredMesh(triangles, part, shown)
    camera = tile_camera(corners, AZIMUTHS[0], size)
    return solid_portrait(solid, camera, float(corners[:, 2].min()))


def _drawn(solid: ColouredMesh, camera: Camera) -> Drawing:
    colours = np.array([linear(colour) for colour in solid.colours]).reshape(-1, 3)
    return draw_solid(solid, colours, camera)


def nearer(a: Drawing, b: Drawing) -> Drawing:
    """Return the nearer of two drawings by one camera, pixel by pixel."""
    if np.isinf(b[0]).all():
        return a
    first = (a[0] <= b[0])[..., None]
    return (np.minimum(a[0], b[0]), np.where(first, a[1], b[1]), np.where(first, a[2], b[2]))
