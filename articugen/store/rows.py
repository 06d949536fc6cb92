"""One instance as people want it: points in the unit frame, joints with names, field by field.

A `Row` reads a field when it is asked for, and once. `in_units` brings what is stored to floats;
what docs/format.md calls a label, a part or a name comes as it is.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from articugen.core import schema
from articugen.core.arrays import Bytes, Floats
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import apply, invert_rigid
from articugen.core.records import JointKind
from articugen.core.schema import resolution_of

Float32 = NDArray[np.float32]

_NORMALS = "1/127"
_UNITS = {"1/65535": (1 / 65535, -0.5), _NORMALS: (1 / 127, 0.0), "1/255": (1 / 255, 0.0)}
"""For numbers that are stored whole, by the schema's unit: x = stored * step + first."""


def is_scaled(name: str) -> bool:
    """Return whether a field is stored in whole numbers that `in_units` makes floats of."""
    field = schema.field_of(name)
    return field is not None and field.unit in _UNITS


def in_units(name: str, stored: NDArray[Any], out: Float32 | None = None) -> Float32:
    """Return a stored field with `is_scaled` as float32: coordinates in the unit frame and shares
    of a cell, exact to 6e-8; normals, which rounding made too short or too long by up to 0.7 %, of
    unit length, or zeros."""
    field = schema.field_of(name)
    assert field is not None
    step, first = _UNITS[field.unit]
    out = np.multiply(stored, np.float32(step), out=out, dtype=np.float32)
    if field.unit == _NORMALS:
        length = np.sqrt(np.einsum("...i,...i->...", out, out))[..., None]
        return np.divide(out, length, out=out, where=length > 0)
    return np.add(out, np.float32(first), out=out) if first else out


def texts(stored: Any) -> Any:
    """Return a text as str, an array of them as a tuple, whatever they are stored as."""
    if isinstance(stored, np.ndarray):
        return tuple(map(texts, stored)) if stored.ndim else texts(stored[()])
    return stored.decode() if isinstance(stored, bytes) else stored


@dataclass(frozen=True, eq=False)
class RowJoint:
    """A joint of an instance.

    Attributes:
        name: in the model's file; "" where the shard has none.
        kind: "revolute" (or continuous) or "prismatic".
        state: how far from the canonical pose: rad, or m of the model's own frame; what
            `Maker.at` takes.
        lower, upper: the range that states are sampled from, likewise.
        state_unit, lower_unit, upper_unit: the same as a shard holds them: rad, or lengths of the
            unit frame.
        axis, pivot: (3,) unit direction, and a point on the axis, as posed, unit frame.
        parent, part: the part that it hangs on, and the part that it moves.
    """

    name: str
    kind: str
    state: float
    lower: float
    upper: float
    state_unit: float
    lower_unit: float
    upper_unit: float
    axis: Floats
    pivot: Floats
    parent: int
    part: int

    def __repr__(self) -> str:
        where = f"{self.state:.3g} of {self.lower:.3g} to {self.upper:.3g}"
        unit = "rad" if self.kind == "revolute" else "m"
        return f"Joint({self.name or 'part ' + str(self.part)!r}, {self.kind}, {where} {unit})"


@dataclass(frozen=True, eq=False)
class RowPart:
    """A part of an instance: the names of its first link, and `motion` (4, 4), the rigid motion
    from the canonical pose, unit frame."""

    name: str
    semantic: str
    motion: Floats


class _Group:
    """The fields whose names begin alike, each read when it is asked for, and once.

    Classes name those that come with a type; the schema decides which there are.
    """

    def __init__(self, row: "Row", stem: str) -> None:
        self._row, self._stem = row, stem

    def __getattr__(self, name: str) -> Any:
        field = "" if name.startswith("_") else f"{self._stem}_{name}"
        if schema.field_of(field) is None:
            raise AttributeError(f"{type(self).__name__} has no {name!r}")
        value = self._row.stored(field)
        if is_scaled(field) and field != "image_rgba":  # people want bytes of colours
            value = in_units(field, value)
        self.__dict__[name] = value
        return value

    def __dir__(self) -> list[str]:
        names = (name.partition(f"{self._stem}_") for name in self._row.fields)
        return [*super().__dir__(), *(name for empty, _, name in names if not empty)]


class _Cloud(_Group):
    points: Float32

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(points {_span(self.points)})"


class RowSurface(_Cloud):
    """Surface points, see `Row.surface`."""

    normals: Float32
    part: Bytes
    color: Bytes


class RowQueries(_Cloud):
    """Query points, see `Row.uniform`."""

    label: Bytes
    distance: Float32


class RowPartial(_Cloud):
    """Clouds of depth cameras, see `Row.partial`."""

    part: Bytes
    T_camera_world: Floats
    intrinsics: Floats


class RowImages(_Group):
    """Images, see `Row.images`."""

    depth: Float32
    part: Bytes
    normal: Float32
    rgba: NDArray[np.uint8]
    T_camera_world: Floats
    intrinsics: Floats


class RowGrids(Mapping[int, NDArray[Any]]):
    """Grids by their resolution, read when asked for: (R, R, R), indexed [x, y, z]."""

    def __init__(self, row: "Row", stem: str) -> None:
        self._row, self._stem = row, stem
        names = (name for name in row.fields if name.rpartition("_")[0] == stem)
        self._resolutions = sorted(map(resolution_of, names))

    def __getitem__(self, resolution: int) -> NDArray[Any]:
        if resolution not in self._resolutions:
            there = ", ".join(map(str, self._resolutions)) or "none"
            raise KeyError(f"no {self._stem} grid of {resolution}; there are: {there}")
        name = f"{self._stem}_{resolution}"
        stored = self._row.stored(name)
        return in_units(name, stored) if is_scaled(name) else stored

    def __iter__(self) -> Iterator[int]:
        return iter(self._resolutions)

    def __len__(self) -> int:
        return len(self._resolutions)

    def __repr__(self) -> str:
        return f"Grids({', '.join(f'{r}³' for r in self)})"


class Row:
    """One object at one joint state. Lengths are in the unit frame; see docs/format.md.

    Attributes:
        fields: the names of what is stored of it.
        split: "train" or "test"; "" where it is in no data set.
        category: what it is, "laptop" say.
    """

    draw: ClassVar[Callable[["Row"], str] | None] = None
    """Makes HTML of a row for a notebook; `inspection.notebook`, which may draw, puts it here."""

    def __init__(
        self,
        read: Callable[[Sequence[str]], Sequence[Any]],
        fields: Collection[str],
        *,
        split: str = "",
        category: str = "",
    ) -> None:
        """Take `read`, which gives what is stored of several fields, and is called once for
        each."""
        self._read = read
        self._known: dict[str, Any] = {}
        self.fields = tuple(sorted(fields))
        self.split, self.category = split, category

    def stored(self, name: str) -> Any:
        """Return a field as it is stored: an array, read-only, or text; see docs/format.md.

        Raises:
            InvalidArgument: there is no such field.
            CorruptShard: the bytes fail their checksum.
        """
        if name not in self.fields:
            raise InvalidArgument(f"{self.object_id}: {self._why_not(name)}")
        return self._one(name)

    def _why_not(self, name: str) -> str:
        field = schema.field_of(name)
        if field is None or not field.asked_by:
            return f"no field {name!r} is stored; there are: {', '.join(self.fields)}"
        none = field.asked_by == "images.fields" and "image_intrinsics" not in self.fields
        key = "images.views" if none else field.asked_by
        return f"{name} is not stored; ask for it with {key} in the recipe, and make the data again"

    def _learn(self, names: Sequence[str]) -> None:
        left = [name for name in names if name in self.fields and name not in self._known]
        for name, value in zip(left, self._read(left) if left else (), strict=True):
            field = schema.field_of(name)
            self._known[name] = texts(value) if field and field.dtype == "S" else value

    @property
    def object_id(self) -> str:
        return self._one("object_id")

    @property
    def state_index(self) -> int:
        """0 is the canonical pose."""
        return int(self._one("state_index"))

    @property
    def center(self) -> Floats:
        """(3,) float64, metres: x_world = x_unit * scale + center."""
        return self._one("center")

    @property
    def scale(self) -> float:
        """Metres that the unit frame's unit is long."""
        return float(self._one("scale"))

    def _one(self, name: str) -> Any:
        self._learn([name])
        return self._known[name]

    def to_metres(self, points: NDArray[Any]) -> Floats:
        """Unit-frame points (..., 3) in metres of the world frame, which a `yaw_degrees` turns."""
        return np.asarray(points, np.float64) * self.scale + self.center

    @cached_property
    def surface(self) -> RowSurface:
        """Points uniform by area over the visible surface: `points` (S, 3) float32, unit frame,
        their outward `normals` (S, 3) float32 of unit length, the `part` (S,) of each; where the
        recipe asks for it, the `color` (S, 3) uint8 sRGB of the model."""
        return RowSurface(self, "surface")

    @cached_property
    def uniform(self) -> RowQueries:
        """Points uniform in the unit cube: `points` (U, 3) float32, unit frame; the `label` (U,)
        uint8 of each, 0 free, k + 1 material of part k, 255 enclosed; where the recipe asks for it,
        the `distance` (U,) float32 from the surface, below 0 inside."""
        return RowQueries(self, "uniform")

    @cached_property
    def near(self) -> RowQueries:
        """The same near the surface, (K, 3)."""
        return RowQueries(self, "near")

    @cached_property
    def partial(self) -> RowPartial:
        """Points that C depth cameras see: `points` (C, M, 3) float32, unit frame, the `part` (C,
        M) of each; `T_camera_world` (C, 4, 4) from the unit frame to the camera's, `intrinsics` (C,
        4) in pixels: fx, fy, cx, cy."""
        return RowPartial(self, "partial")

    @cached_property
    def sharp(self) -> RowSurface:
        """Points on sharp edges, as `surface`, where the recipe asks for sampling.sharp_points."""
        return RowSurface(self, "sharp")

    @cached_property
    def images(self) -> RowImages:
        """Images of V cameras, where the recipe asks for images.views: `depth` (V, H, H) float32, 0
        where nothing is; `part` (V, H, H), k + 1 for part k; `normal` (V, H, H, 3) float32; `rgba`
        (V, H, H, 4) uint8; `T_camera_world` (V, 4, 4) from the unit frame; `intrinsics` (V, 4): fx,
        fy, cx, cy."""
        return RowImages(self, "image")

    @property
    def collision_depth(self) -> float:
        """Depth of parts in one another, unit frame, where the recipe asks for it."""
        return float(self.stored("collision_depth"))

    @cached_property
    def grids(self) -> RowGrids:
        """Bytes at voxel centres by resolution: `row.grids[64]` (64, 64, 64) uint8."""
        return RowGrids(self, "occupancy")

    @cached_property
    def coverage(self) -> RowGrids:
        """The share of each voxel that is inside, float32 in [0, 1], by resolution."""
        return RowGrids(self, "coverage")

    @cached_property
    def joints(self) -> tuple[RowJoint, ...]:
        """Joint j moves part j + 1."""
        names = ("name", "kind", "state", "lower", "upper", "axis", "pivot", "parent")
        self._learn(["scale", *(f"joint_{name}" for name in names)])
        fields: dict[str, Any] = {name: self._known.get(f"joint_{name}") for name in names}
        fields["name"] = fields["name"] or ("",) * len(fields["kind"])
        joints: list[RowJoint] = []
        for j, number in enumerate(fields["kind"]):
            one, kind = {name: fields[name][j] for name in names}, str(JointKind(number))
            metres = self.scale if kind == "prismatic" else 1.0
            for name in ("state", "lower", "upper"):
                one[f"{name}_unit"] = float(one[name])
                one[name] = one[f"{name}_unit"] * metres
            one |= {"kind": kind, "parent": int(one["parent"]), "part": j + 1}
            joints.append(RowJoint(**one))
        return tuple(joints)

    @cached_property
    def parts(self) -> tuple[RowPart, ...]:
        """Part 0 is the fixed one."""
        self._learn(["part_motion", "part_name", "part_semantic"])
        motion = self._known["part_motion"]
        none = ("",) * len(motion)
        named = (self._known.get(f"part_{name}") or none for name in ("name", "semantic"))
        return tuple(map(RowPart, *named, motion))

    def flow_to(self, other: "Row") -> Float32:
        """Return (S, 3) float32: where each of its surface points moves to when the object takes
        the joint state of `other`, less where it is; unit frame.

        Raises:
            InvalidArgument: `other` is of another object or in another unit frame.
        """
        same_frame = self.scale == other.scale and np.array_equal(self.center, other.center)
        if self.object_id != other.object_id or not same_frame:
            raise InvalidArgument(
                f"{self.object_id} does not flow to {other.object_id}: they are not one object in "
                "one unit frame; take both from one data set, or from one Maker"
            )
        back, forth = (row.stored("part_motion") for row in (self, other))
        points, part = np.asarray(self.surface.points, np.float64), self.surface.part
        flow = apply(forth[part], apply(invert_rigid(back)[part], points)) - points
        return flow.astype(np.float32)

    def _which(self) -> str:
        return f"[{self.state_index}]"

    def __repr__(self) -> str:
        split = f", {self.split}" if self.split else ""
        head = f"{type(self).__name__}({self.object_id} {self._which()}{split})"
        clouds = [g for g in (self.surface, self.uniform, self.near) if len(g)]
        lines = [f"  {group._stem:8} {_span(group.points)}" for group in clouds]
        return "\n".join([head, *(f"  {joint!r}" for joint in self.joints), *lines])

    def _repr_html_(self) -> str | None:
        return self.draw() if self.draw else None


def _span(points: Float32) -> str:
    """Shape and box of points: (8192, 3) in [-0.45, 0.45] x [...] x [...]."""
    flat = points.reshape(-1, 3)
    if not len(flat):
        return f"{points.shape}"
    ends = zip(flat.min(axis=0), flat.max(axis=0), strict=True)
    return f"{points.shape} in " + " x ".join(f"[{low:.2f}, {high:.2f}]" for low, high in ends)
