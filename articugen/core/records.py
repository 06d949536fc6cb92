"""The records that travel between stages: frozen, arrays read-only, shapes checked when made.

Units are metres and radians in `Mesh`, `Link`, `Joint`, `ArticulatedObject` and `PosedObject`. From
`Normalization` on everything is in the unit frame: the object inside [-0.5, 0.5]^3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bools, Bytes, Floats, Indices
from articugen.core.geometry import apply, invert_rigid
from articugen.core.portable import turned
from articugen.core.texture import Texture


class JointKind(IntEnum):
    """Kind of a joint's motion. The words are URDF's, the numbers those that shards store."""

    FIXED = 0
    REVOLUTE = 1
    CONTINUOUS = 3
    PRISMATIC = 2

    @property
    def stored(self) -> "JointKind":
        """Kind that a shard has for it: continuous is revolute without limits."""
        return JointKind.REVOLUTE if self is JointKind.CONTINUOUS else self

    def __str__(self) -> str:
        return self.name.lower()


STORED_KINDS = (JointKind.REVOLUTE, JointKind.PRISMATIC)
"""What a shard may say of a joint, all of which move."""

FREE, ENCLOSED = 0, 255
"""Labels of free space, and of what no view sees though no part's own solid holds it. The material
of part k has label k + 1."""


def is_material(label: Bytes) -> Bools:
    """Return where labels name the material of some part."""
    return (label != FREE) & (label != ENCLOSED)


def _freeze(record: Any, dtype: type = np.float64, **wanted: tuple[int | None, ...]) -> None:
    """Set each named array read-only with this dtype; raise ValueError where its shape differs."""
    for name, shape in wanted.items():
        array = np.array(getattr(record, name), dtype=dtype, order="C")
        fits = array.ndim == len(shape) and all(
            want is None or want == have for want, have in zip(shape, array.shape, strict=True)
        )
        if not fits:
            raise ValueError(f"{type(record).__name__}.{name}: shape {array.shape}, not {shape}")
        array.flags.writeable = False
        object.__setattr__(record, name, array)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle soup. `vertices` (V, 3) metres, `faces` (F, 3) int32 indices into them; where
    colours are wanted and the model states some, `colours` (F, 3) sRGB, and the `texture` of the
    faces of which these are the means."""

    vertices: Floats
    faces: NDArray[np.int32]
    colours: Bytes | None = None
    texture: Texture | None = None

    def __post_init__(self) -> None:
        _freeze(self, vertices=(None, 3))
        _freeze(self, np.int32, faces=(None, 3))
        if self.colours is not None:
            _freeze(self, np.uint8, colours=(len(self.faces), 3))

    @property
    def triangles(self) -> Floats:
        """(F, 3, 3) the corners of each face."""
        return self.vertices[self.faces]


@dataclass(frozen=True)
class Mimic:
    """URDF mimic: q = multiplier * q_of(joint) + offset."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of the kinematic tree.

    Attributes:
        name: unique in the object.
        parent, child: link names.
        T_parent_joint: (4, 4) the child link's frame, at q = 0, in the parent link's frame.
        axis: (3,) unit direction in the joint's (child link's) frame.
        lower, upper: limits of q, rad or m; -inf and inf where there is none.
        mimic: the joint that drives this one, or None.
        axis_length: of the axis as its file has it, which need not be 1.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    T_parent_joint: Floats
    axis: Floats
    lower: float = 0.0
    upper: float = 0.0
    mimic: Mimic | None = None
    axis_length: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.kind, JointKind):
            raise ValueError(f"joint {self.name}: its kind is {self.kind!r}, not a JointKind")
        _freeze(self, T_parent_joint=(4, 4), axis=(3,))
        if self.kind != JointKind.FIXED and abs(np.linalg.norm(self.axis) - 1.0) > 1e-9:
            raise ValueError(f"joint {self.name}: axis {self.axis} is not of unit length")

    def __repr__(self) -> str:
        unit = "m" if self.kind == JointKind.PRISMATIC else "rad"
        reach = f"{self.lower:.3g} to {self.upper:.3g} {unit}"
        follows = f", follows {self.mimic.joint!r}" if self.mimic else ""
        return f"Joint({self.name!r}, {self.kind}, {reach}{follows})"


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid body: `mesh` holds all its visuals, in the link's own frame. It may be empty."""

    name: str
    mesh: Mesh
    semantic: str = ""


@dataclass(frozen=True, eq=False)
class ArticulatedObject:
    """One CAD model, whatever source it came from. World frame: right-handed, z up, metres.

    Attributes:
        object_id: unique in its source and category.
        category: for instance "laptop".
        links: every link, the root first.
        joints: in topological order (a joint comes after the joint its parent hangs on).
        T_world_root: (4, 4) turns the model so that its joints point as docs/conventions.md says.
        sha256: hex digest of the bytes of every file the object was read from.
        source: the name of the source.
        notes: what a user should know (skipped meshes, locked joints), one sentence each.
        part_order: names of joints in the order in which their parts are numbered; () means that of
            `joints`.
    """

    object_id: str
    category: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    T_world_root: Floats
    sha256: str
    source: str = ""
    notes: tuple[str, ...] = ()
    part_order: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _freeze(self, T_world_root=(4, 4))

    @property
    def link_index(self) -> dict[str, int]:
        return {link.name: i for i, link in enumerate(self.links)}

    @property
    def moving_joints(self) -> tuple[Joint, ...]:
        """The joints that move, in part order: joint j carries part j + 1.

        Revolute and continuous joints first, then prismatic ones (PPD's release orders its parts
        so), each as `part_order` says.
        """
        rank = {name: k for k, name in enumerate(self.part_order)}
        moving = [j for j in self.joints if j.kind != JointKind.FIXED]
        moving.sort(key=lambda j: (j.kind == JointKind.PRISMATIC, rank.get(j.name, len(rank))))
        return tuple(moving)

    @property
    def part_of_link(self) -> NDArray[np.int32]:
        """(L,) the part that each link moves with; part 0 is the fixed one."""
        index = self.link_index
        part_of_moving = {joint.name: k + 1 for k, joint in enumerate(self.moving_joints)}
        part = np.zeros(len(self.links), np.int32)
        for joint in self.joints:
            moved = part_of_moving.get(joint.name)
            part[index[joint.child]] = part[index[joint.parent]] if moved is None else moved
        return part

    @property
    def part_count(self) -> int:
        return len(self.moving_joints) + 1


@dataclass(frozen=True, eq=False)
class ResolvedObject(ArticulatedObject):
    """An object with a recipe's choice of moving joints, of their ranges and canonical pose: what
    `articulation.resolve` makes of one that a source gives."""


@dataclass(frozen=True, eq=False)
class JointState:
    """`q` (J,): one number per moving joint in part order, rad or m, 0 in the canonical pose.

    Driven (mimic) joints have their own entry, already computed from the joint that drives them.
    """

    q: Floats

    def __post_init__(self) -> None:
        _freeze(self, q=(None,))


@dataclass(frozen=True, eq=False)
class PosedObject:
    """An object at one joint state, world frame, metres.

    Attributes:
        T_world_link: (L, 4, 4).
        T_world_part: (P, 4, 4) of the first link of each part (the child of its moving joint).
        pivots: (J, 3) a point on each moving joint's axis.
        axes: (J, 3) unit directions.
    """

    T_world_link: Floats
    T_world_part: Floats
    pivots: Floats
    axes: Floats

    def __post_init__(self) -> None:
        _freeze(self, T_world_link=(None, 4, 4), T_world_part=(None, 4, 4))
        _freeze(self, pivots=(None, 3), axes=(None, 3))


@dataclass(frozen=True, eq=False)
class Normalization:
    """The unit frame of one object: x_unit = (x_world - center) / scale; scale in metres."""

    center: Floats
    scale: float

    def __post_init__(self) -> None:
        _freeze(self, center=(3,))

    def to_unit(self, points: Floats) -> Floats:
        """World points (..., 3) in metres to the unit frame."""
        return (points - self.center) / self.scale

    def to_world(self, points: Floats) -> Floats:
        """Unit-frame points (..., 3) to metres."""
        return points * self.scale + self.center

    def rigid_to_unit(self, T_world: Floats) -> Floats:
        """Return a rigid motion (..., 4, 4) of world points, as it acts on unit-frame points."""
        T = np.array(T_world)
        moved = turned(T[..., :3, :3], self.center)
        T[..., :3, 3] = (T[..., :3, 3] + moved - self.center) / self.scale
        return T


@dataclass(frozen=True, eq=False)
class LabelledMesh:
    """A posed triangle soup in the unit frame with the part of every face: `vertices` (V, 3),
    `faces` (F, 3) int32, `part_of_face` (F,) uint8."""

    vertices: Floats
    faces: NDArray[np.int32]
    part_of_face: Bytes

    def __post_init__(self) -> None:
        _freeze(self, vertices=(None, 3))
        _freeze(self, np.int32, faces=(None, 3))
        _freeze(self, np.uint8, part_of_face=(len(self.faces),))

    @staticmethod
    def joined(meshes: Sequence["LabelledMesh"]) -> "LabelledMesh":
        """Several meshes as one, in order."""
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        return LabelledMesh(
            np.concatenate([mesh.vertices for mesh in meshes]),
            np.concatenate([m.faces + np.int32(n) for m, n in zip(meshes, first, strict=False)]),
            np.concatenate([mesh.part_of_face for mesh in meshes]),
        )

    def part(self, part: int) -> "LabelledMesh":
        """Return the faces of one part, with the vertices they use."""
        its = self.part_of_face == part
        return LabelledMesh(self.vertices, self.faces[its], self.part_of_face[its]).compact()

    def compact(self) -> "LabelledMesh":
        """Return the same faces without the vertices that none of them uses."""
        used = np.zeros(len(self.vertices), np.bool_)
        used[self.faces] = True
        number = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return LabelledMesh(self.vertices[used], number[self.faces], self.part_of_face)

    def moved(self, T_part: Floats) -> "LabelledMesh":
        """Return the mesh with each part moved by its own transform; `T_part` (P, 4, 4).

        Every vertex must belong to one part only.
        """
        vertices = np.array(self.vertices)
        part_of_vertex = np.zeros(len(vertices), np.intp)
        part_of_vertex[self.faces] = self.part_of_face[:, None]
        for part, T in enumerate(T_part):
            of_part = part_of_vertex == part
            vertices[of_part] = apply(T, vertices[of_part])
        return LabelledMesh(vertices, self.faces, self.part_of_face)


@dataclass(frozen=True, eq=False)
class Views:
    """A set of K cameras that share one image size.

    Camera axes: x right, y down, z forward. The centre of pixel (row i, column j) is at
    (u, v) = (j + 0.5, i + 0.5). A point (x, y, z) in camera coordinates projects to
    u = fx * x / w + cx, v = fy * y / w + cy with w = z for `pinhole` and w = 1 for `orthographic`
    (fx, fy are then pixels per unit of length).

    Attributes:
        projection: "orthographic" or "pinhole".
        T_camera_world: (K, 4, 4).
        fx, fy, cx, cy: (K,) pixels.
        width, height: pixels.
    """

    projection: Literal["orthographic", "pinhole"]
    T_camera_world: Floats
    fx: Floats
    fy: Floats
    cx: Floats
    cy: Floats
    width: int
    height: int

    def __post_init__(self) -> None:
        count = len(self.T_camera_world)
        _freeze(self, T_camera_world=(count, 4, 4))
        _freeze(self, fx=(count,), fy=(count,), cx=(count,), cy=(count,))
        if self.projection not in ("orthographic", "pinhole"):
            raise ValueError(f"Views.projection: {self.projection!r}")

    def __len__(self) -> int:
        return len(self.T_camera_world)

    @property
    def intrinsics(self) -> Floats:
        """(K, 4) fx, fy, cx, cy."""
        return np.stack([self.fx, self.fy, self.cx, self.cy], axis=1)

    def points(self, k: int | Indices, row: Indices, column: Indices, depth: Floats) -> Floats:
        """Return (n, 3) where the pinhole camera `k`, or those (n,), see something in pixels (n,),
        at `depth` (n,)."""
        x = (column + 0.5 - self.cx[k]) / self.fx[k] * depth
        y = (row + 0.5 - self.cy[k]) / self.fy[k] * depth
        T = invert_rigid(self.T_camera_world)[k]
        return turned(T[..., :3, :3], np.stack([x, y, depth], axis=1)) + T[..., :3, 3]


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """Depth and faces that K cameras see.

    Attributes:
        depth: (K, H, W) float32: z along the optical axis at the pixel's centre, inf where nothing
            is seen. It is neither a ray distance nor read anywhere else in the pixel. None where
            only the faces are kept.
        face: (K, H, W) int32: the face seen at the pixel's centre, -1 where nothing is; None from
            backends without faces.
        views: the cameras.
    """

    depth: NDArray[np.float32] | None
    face: NDArray[np.int32] | None
    views: Views

    def __post_init__(self) -> None:
        shape = (len(self.views), self.views.height, self.views.width)
        for name, kind in (("depth", np.float32), ("face", np.int32)):
            array = getattr(self, name)
            if array is None:
                continue
            if array.shape != shape:
                raise ValueError(f"DepthMaps.{name}: shape {array.shape}, not {shape}")
            object.__setattr__(self, name, np.ascontiguousarray(array, kind))


def quantize(points: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Unit-frame points, all in [-0.5, 0.5], to 16-bit fixed point: round((x + 0.5) * 65535)."""
    return np.round(np.clip((points + 0.5) * 65535.0, 0.0, 65535.0)).astype(np.uint16)


def dequantize(stored: NDArray[np.uint16]) -> Floats:
    """Return the inverse of `quantize`: x = stored / 65535 - 0.5, exact to 7.7e-6."""
    return stored / 65535.0 - 0.5
