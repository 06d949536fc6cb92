"""A row of a shard, declared once: each field of `Instance` says its dtype, shape, unit, frame and
meaning. The writer, the recipe's sizes, every check and docs/format.md follow from it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Bytes, Floats

SCHEMA_VERSION = 3
"""Of what is written. Readers take every version up to it: a later one only adds optional fields,
and distinguishes what an earlier one did not (docs/format.md says what)."""

FORMAT = "articugen shard"  # the attribute `format` of every shard
MAX_INSTANCES = 65_536
MAX_CHUNK_BYTES = 1 << 26
"""No field of one instance may take more than 64 MiB: what a reader risks on a hostile file."""

SPLIT = r"^[A-Za-z0-9_][A-Za-z0-9_-]{0,99}$"
"""What a split may be called: shards and folders are called after it."""

USER_GROUP = "user"
"""A group of this name belongs to whoever uses the data: everybody leaves it alone."""
MAX_TEXT = 255  # bytes of a text in UTF-8: an object_id, the name of a joint or a part

SYMBOLS: Mapping[str, tuple[str, str]] = {
    "N": ("instances in the shard", ""),
    "J": ("moving joints", ""),
    "P": ("parts, J + 1: part 0 is the fixed one, joint j carries part j + 1", ""),
    "R": ("resolution of the grid", ""),
    "S": ("surface points", "sampling.surface_points"),
    "U": ("uniform points", "sampling.uniform_points"),
    "K": ("points near the surface", "sampling.near_points"),
    "C": ("cameras", "sampling.partial_views"),
    "M": ("points a camera", "sampling.partial_points"),
    "E": ("points on sharp edges", "sampling.sharp_points"),
    "V": ("images", "images.views"),
    "H": ("pixels along the edge of an image", "images.resolution"),
}
"""The number that a letter in the fields' shapes stands for, one in a whole shard, and the recipe's
key that decides it, if one does."""


@dataclass(frozen=True)
class Field:
    """One data set of a shard.

    Attributes:
        name: of the data set; <R> stands for a grid's resolution.
        dtype: as numpy writes it, byte order included; "S" is UTF-8 of a fixed length of at most
            MAX_TEXT bytes, padded with zero bytes.
        shape: numbers, and letters from SYMBOLS; the first is always N.
        unit: of one number.
        frame: the coordinates it is given in, or "".
        meaning: one sentence or two.
        compressed: with gzip, for what gets smaller by it; random 16-bit coordinates do not.
        optional: a shard may lack it.
        asked_by: the recipe's key that asks for it, or "" where every recipe does.
    """

    name: str
    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    frame: str
    meaning: str
    compressed: bool = False
    optional: bool = False
    asked_by: str = ""

    @property
    def stem(self) -> str:
        """The name without a grid's resolution."""
        return self.name.removesuffix("_<R>")

    @property
    def is_grid(self) -> bool:
        return self.stem != self.name

    @property
    def itemsize(self) -> int:
        """Bytes of one number, or of one text."""
        return MAX_TEXT if self.dtype == "S" else np.dtype(self.dtype).itemsize

    @property
    def written_shape(self) -> str:
        """The shape as people write it: (N, P, 4, 4)."""
        return f"({', '.join(map(str, self.shape))}{',' if len(self.shape) == 1 else ''})"

    def matches(self, name: str) -> bool:
        """Return whether a data set of this name is described by this field."""
        if not self.is_grid:
            return name == self.name
        return re.fullmatch(f"{self.stem}_[1-9][0-9]{{0,2}}", name) is not None

    def fits(self, name: str, shape: tuple[int, ...], known: dict[str, int]) -> bool:
        """Return whether `shape` is this field's; the letters it settles are added to `known`."""
        if len(shape) != len(self.shape):
            return False
        for want, size in zip(self.shape, shape, strict=True):
            if isinstance(want, int):
                expected = want
            elif want == "R":
                expected = resolution_of(name)
            else:
                expected = known.setdefault(want, size)
            if size != expected:
                return False
        return True


f8 = Annotated[Floats, "<f8"]
f4 = Annotated[NDArray[np.float32], "<f4"]
u2 = Annotated[NDArray[np.uint16], "<u2"]
u1 = Annotated[Bytes, "u1"]
i1 = Annotated[NDArray[np.int8], "i1"]
grids = Annotated[Mapping[int, Bytes], "u1"]
number = Annotated[float, "<f8"]
text = Annotated[str, "S"]
texts = Annotated[tuple[str, ...], "S"]


_NO_GRIDS: Mapping[int, NDArray[Any]] = MappingProxyType({})


def stored(
    shape: str,
    meaning: str,
    *,
    unit: str = "",
    frame: str = "",
    gzip: bool = False,
    optional: bool = False,
    asked_by: str = "",
) -> Any:
    """Declare a field of `Instance`; its annotation says the dtype. See `Field` for the arguments.

    One that not every recipe asks for is None by default, samples are none by default, grids too.
    """
    sizes = tuple(int(size) if size.isdigit() else size for size in shape.split())
    optional = optional or bool(asked_by)
    described = Field("", "", sizes, unit, frame, meaning, gzip, optional, asked_by)
    about = {"described": described}
    if "R" in sizes:
        return field(default_factory=lambda: _NO_GRIDS, metadata=about)
    if optional:
        return field(default=None, metadata=about)
    if any(SYMBOLS[size][1] for size in sizes if isinstance(size, str)):
        none = tuple(size if isinstance(size, int) else 0 for size in sizes[1:])
        return field(default_factory=lambda: np.zeros(none), metadata=about)
    return field(metadata=about)


def fields_of(row: type) -> tuple[Field, ...]:
    """Return fields that a dataclass declares by `stored`, with the dtypes of its annotations."""
    hints = get_type_hints(row, include_extras=True)
    declared = ((one.name, one.metadata["described"]) for one in fields(row))
    return tuple(
        replace(
            described,
            name=f"{name}_<R>" if "R" in described.shape else name,
            dtype=_dtype_in(hints[name]),
        )
        for name, described in declared
    )


def _dtype_in(hint: Any) -> str:
    """Return the text that is annotated to a type, or to one of a union's."""
    if hasattr(hint, "__metadata__"):
        return hint.__metadata__[0]
    return next(_dtype_in(kind) for kind in get_args(hint) if kind is not type(None))


def resolution_of(name: str) -> int:
    """Return the resolution of the grid in the field of this name."""
    return int(name.rpartition("_")[2])


_STORED = "x = stored / 65535 - 0.5."
_INTRINSICS = "fx, fy, cx, cy: u = fx x / z + cx, v = fy y / z + cy; pixel centres at + 0.5."
_FAR = (
    "to where material ends, below 0 in material (0 < label < 255), no farther than the recipe's "
    "signed_distance."
)
_LABEL = "0 free, k + 1 material of part k, 255 enclosed: no view sees it, no part holds it."

_named = partial(stored, unit="UTF-8", gzip=True, optional=True)
_states = partial(stored, unit="rad or unit")
_placed = partial(stored, unit="unit", frame="unit")
_points = partial(stored, unit="1/65535", frame="unit")
_normals = partial(stored, unit="1/127", frame="unit", gzip=True)
_parts = partial(stored, unit="part", gzip=True)
_labels = partial(stored, unit="label", gzip=True)
_distances = partial(stored, unit="unit", gzip=True, asked_by="sampling.signed_distance")
_cameras = partial(stored, unit="unit", frame="camera from unit")
_image = partial(stored, gzip=True, asked_by="images.fields")


@dataclass(frozen=True, eq=False, kw_only=True)
class Instance:
    """One object at one joint state: all that a row of a shard holds, in the unit frame.

    Point coordinates are stored in fixed point: `records.quantize` and `dequantize` say how. P
    parts, J moving joints (P = J + 1), joint j carries part j + 1. Labels: 0 free, k + 1 material
    of part k, 255 enclosed; parts: k. What a shard lacks is None.
    """

    object_id: text = _named("N", "Which object it is.", optional=False)
    state_index: Annotated[int, "<u4"] = stored(
        "N", "Counts an object's instances; 0 is canonical."
    )
    center: f8 = stored("N 3", "x_world = x_unit * scale + center.", unit="m", frame="world")
    scale: number = stored("N", "Length of the unit frame's unit; one an object.", unit="m")
    joint_kind: u1 = stored("N J", "1 revolute (or continuous), 2 prismatic.")
    joint_name: texts | None = _named("N J", "What the model's file calls joint j.")
    joint_parent: u1 = stored("N J", "The part that joint j and part j + 1 hang on.")
    joint_state: f8 = _states(
        "N J",
        "How far each joint is from the canonical pose; prismatic ones in the unit frame's unit.",
    )
    joint_lower: f8 = _states(
        "N J", "Least joint state that is sampled; the canonical pose, 0, may lie below."
    )
    joint_upper: f8 = _states("N J", "Greatest joint state that is sampled.")
    joint_axis: f8 = stored(
        "N J 3",
        "Unit direction, at this instance's joint state: a rotation is counter-clockwise about "
        "it, a translation along it.",
        unit="1",
        frame="unit",
    )
    joint_pivot: f8 = _placed("N J 3", "A point on the axis, at this instance's state.")
    part_motion: f8 = _placed(
        "N P 4 4",
        "Rigid motion of each part from the canonical pose: x = motion @ x_canonical. motion[j "
        "+ 1] = (rotation about, or translation along, axis j) @ motion[joint_parent[j]].",
    )
    part_name: texts | None = _named(
        "N P",
        "What the model's file calls each part: the root link, or the one that joint j moves.",
    )
    part_semantic: texts | None = _named(
        "N P", "What that link is (door, lid, ...) where the source says so, else empty."
    )
    occupancy: grids = _labels(
        "N R R R",
        f"Label at the voxel centres (i + 0.5) / R - 0.5, indexed [x, y, z]. {_LABEL}",
        frame="unit",
        asked_by="sampling.grids",
    )
    coverage: grids = stored(
        "N R R R",
        "Share of each cell that is inside (label > 0) x 255; the cell reaches from i / R - 0.5 "
        "to (i + 1) / R - 0.5, indexed [x, y, z].",
        unit="1/255",
        frame="unit",
        gzip=True,
        asked_by="sampling.coverage",
    )
    surface_points: u2 = _points(
        "N S 3", f"Uniform by area over the visible surface, on the field's zero level. {_STORED}"
    )
    surface_normals: i1 = _normals("N S 3", "Outward unit normals there: n = stored / 127.")
    surface_part: u1 = _parts("N S", "The part each belongs to.")
    surface_color: u1 | None = stored(
        "N S 3",
        "sRGB of the model there, unlit.",
        unit="sRGB",
        gzip=True,
        asked_by="sampling.surface_color",
    )
    uniform_points: u2 = _points("N U 3", f"Uniform in the unit cube. {_STORED}")
    uniform_label: u1 = _labels("N U", f"Labels there. {_LABEL}")
    near_points: u2 = _points(
        "N K 3",
        "Surface points moved by Gaussian noise (recipe: near_sigma; where that is several, "
        "point k has the (k mod how many)-th); the last near_sharp of them are points of sharp "
        f"edges, moved so. {_STORED}",
    )
    near_label: u1 = _labels("N K", f"Labels there. {_LABEL}")
    uniform_distance: f4 | None = _distances("N U", f"Of uniform_points {_FAR}")
    near_distance: f4 | None = _distances("N K", f"Of near_points {_FAR}")
    sharp_points: u2 | None = _points(
        "N E 3",
        "Uniform by length over the visible edges at which faces turn by the recipe's "
        f"sharp_degrees or more; where there are none, over the surface. {_STORED}",
        asked_by="sampling.sharp_points",
    )
    sharp_normals: i1 | None = _normals(
        "N E 3",
        "Unit normals half-way between those of the edge's two faces: n = stored / 127.",
        asked_by="sampling.sharp_points",
    )
    sharp_part: u1 | None = _parts(
        "N E", "The part each belongs to.", asked_by="sampling.sharp_points"
    )
    collision_depth: number | None = stored(
        "N",
        "How far at most a point on the surface of a part lies within another one's material; 0 "
        "where none does.",
        unit="unit",
        asked_by="articulation.collision",
    )
    partial_points: u2 = _points("N C M 3", f"What each of C depth cameras sees. {_STORED}")
    partial_part: u1 = _parts("N C M", "The part each belongs to.")
    partial_T_camera_world: f8 = _cameras(
        "N C 4 4", "x_camera = T @ x_unit; camera axes: x right, y down, z forward."
    )
    partial_intrinsics: f8 = stored("N C 4", _INTRINSICS, unit="pixel", frame="image")
    image_depth: f4 | None = _image(
        "N V H H",
        "z along the optical axis at the pixel's centre, rows from the top; 0 where nothing is.",
        unit="unit",
        frame="camera",
    )
    image_part: u1 | None = _image(
        "N V H H", "k + 1 where part k is seen, 0 where nothing is.", unit="part + 1"
    )
    image_normal: i1 | None = _image(
        "N V H H 3",
        "Unit normals of the faces that are seen, towards the camera: n = stored / 127; 0 where "
        "nothing is.",
        unit="1/127",
        frame="unit",
    )
    image_rgba: u1 | None = _image(
        "N V H H 4",
        "sRGB of the parts' colours, shaded; opacity 255 where something is, else all 0.",
        unit="1/255",
    )
    image_T_camera_world: f8 | None = _cameras(
        "N V 4 4",
        "x_camera = T @ x_unit; the same in all instances of an object. Axes as above.",
        asked_by="images.views",
    )
    image_intrinsics: f8 | None = stored(
        "N V 4", _INTRINSICS, unit="pixel", frame="image", asked_by="images.views"
    )

    def __post_init__(self) -> None:
        J = len(self.joint_kind)
        known = {"N": 1, "J": J, "P": J + 1}
        for described in FIELDS:
            value = getattr(self, described.stem)
            if described.is_grid:
                for resolution, grid in value.items():
                    if grid.shape != (resolution,) * 3 or grid.dtype != np.uint8:
                        name = f"{described.stem}[{resolution}]"
                        raise ValueError(f"Instance.{name}: {grid.shape} {grid.dtype}")
            elif described.shape != ("N",) and not (value is None and described.optional):
                self._fit(described, value, known)

    def _fit(self, described: Field, value: Any, known: dict[str, int]) -> None:
        """Check the shape of a field; set an array read-only, as the schema describes it."""
        is_text = described.dtype == "S"
        array = np.array(value, object if is_text else described.dtype, order="C")
        if not described.fits(described.name, (1, *array.shape), known):
            wanted = f"{described.written_shape} with {known}"
            raise ValueError(f"Instance.{described.name}: shape {(1, *array.shape)}, not {wanted}")
        if not is_text:
            array.flags.writeable = False
            object.__setattr__(self, described.name, array)

    def arrays(self) -> dict[str, Any]:
        """Return every field that it has, by its name in a shard; grids as
        `occupancy_<resolution>`."""
        all_fields = {f.name: getattr(self, f.name) for f in fields(self)}
        grids = {
            f"{name}_{r}": grid
            for name in GRIDS
            for r, grid in sorted(all_fields.pop(name).items())
        }
        return {name: value for name, value in all_fields.items() if value is not None} | grids


FIELDS = fields_of(Instance)  # every data set; those with <R> once for each grid
GRIDS = tuple(described.stem for described in FIELDS if described.is_grid)
"""Those fields of `Instance` that have an array for each of several resolutions."""

CHECKED_ATTRIBUTES = "checked_attributes"
"""The attribute that holds all others as JSON: of a fixed length, which HDF5 guards by a checksum.
Text of variable length, which plain readers get as str, it does not."""

ATTRIBUTES: Mapping[str, tuple[type, str]] = {
    "format": (str, f'Always "{FORMAT}".'),
    "schema_version": (int, "Of this description; readers refuse later ones."),
    "category": (str, "For instance laptop."),
    "split": (
        str,
        "train or test, say: letters, digits, _ and -, not - at first; each object is in one split "
        "only.",
    ),
    "recipe": (str, "The resolved recipe as canonical JSON: everything that decides the content."),
    "recipe_sha256": (str, "The hex digest of that text."),
    "seed": (int, "The master seed."),
    "articugen_version": (str, "What wrote it."),
}
"""Attributes of the file that every shard has; it may have more, all scalar."""


@lru_cache(1024)
def field_of(name: str) -> Field | None:
    """Return the field that describes the data set `name`, or None."""
    return next((field for field in FIELDS if field.matches(name)), None)


def misfit(names_and_shapes: Mapping[str, tuple[int, ...]]) -> str | None:
    """Return why data sets of these names and shapes are not one shard; None where they are."""
    known: dict[str, int] = {}
    for name, shape in names_and_shapes.items():
        field = field_of(name)
        if field is None:
            return f"data set {name!r} is not in the schema"
        if not field.fits(name, shape, known):
            return f"data set {name!r} has shape {shape}, not {field.written_shape} with {known}"
    missing = [f.name for f in FIELDS if not f.optional and f.name not in names_and_shapes]
    if missing:
        return f"data set {missing[0]!r} is missing"
    if known["P"] != known["J"] + 1:
        return f"{known['P']} parts for {known['J']} joints"
    if not 1 <= known["N"] <= MAX_INSTANCES:
        return f"{known['N']} instances, not 1 to {MAX_INSTANCES}"
    return None


def stored_name(name: str) -> str:
    """Return a name as it fits into a shard: whole characters of at most MAX_TEXT bytes of UTF-8.

    What UTF-8 or a text padded with zero bytes cannot hold becomes U+FFFD.
    """
    whole = name.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    return whole.replace("\0", "\ufffd").encode()[:MAX_TEXT].decode(errors="ignore")
