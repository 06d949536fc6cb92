"""What a shard holds, declared once; the writer, every check and docs/format.md follow from it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

SCHEMA_VERSION = 3
"""Of what is written. Readers take every version up to it: a later one only adds optional fields,
and tells apart what an earlier one did not (docs/format.md says what)."""

FORMAT = "articugen shard"
"""The attribute `format` of every shard."""

MAX_INSTANCES = 65_536
MAX_CHUNK_BYTES = 1 << 26
"""No field of one instance may take more than 64 MiB: what a reader risks on a hostile file."""

MAX_TEXT = 255
"""Bytes of a text in UTF-8: an object_id, the name of a joint or a part."""

SPLIT = r"^[A-Za-z0-9_][A-Za-z0-9_-]{0,99}$"
"""What a split may be called: shards and folders are called after it."""

USER_GROUP = "user"
"""A group of this name belongs to whoever uses the data: everybody leaves it alone."""

SYMBOLS = {
    "N": "instances in the shard",
    "J": "moving joints",
    "P": "parts, J + 1: part 0 is the fixed one, joint j carries part j + 1",
    "R": "resolution of the grid",
    "S": "surface points",
    "U": "uniform points",
    "K": "points near the surface",
    "C": "cameras",
    "M": "points a camera",
    "E": "points on sharp edges",
    "V": "images",
    "H": "pixels along the edge of an image",
}
"""What the letters in the fields' shapes stand for; a letter is one number in a whole shard."""


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
    """

    name: str
    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    frame: str
    meaning: str
    compressed: bool = False
    optional: bool = False

    @property
    def stem(self) -> str:
        """The name without a grid's resolution."""
        return self.name.removesuffix("_<R>")

    @property
    def is_grid(self) -> bool:
        return self.stem != self.name

    def matches(self, name: str) -> bool:
        """Whether a data set of this name is described by this field."""
        if not self.is_grid:
            return name == self.name
        return re.fullmatch(f"{self.stem}_[1-9][0-9]{{0,2}}", name) is not None

    def fits(self, name: str, shape: tuple[int, ...], known: dict[str, int]) -> bool:
        """Whether `shape` is this field's; the letters it settles are added to `known`."""
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


_FIXED_POINT = "1/65535"
_UNIT = "unit"
_STORED = "x = stored / 65535 - 0.5."
_INTRINSICS = "fx, fy, cx, cy: u = fx x / z + cx, v = fy y / z + cy; pixel centres at + 0.5."
_LABEL = "0 free, k + 1 material of part k, 255 enclosed: no view sees it, no part holds it."

FIELDS = (
    Field("object_id", "S", ("N",), "UTF-8", "", "Which object it is.", True),
    Field("state_index", "<u4", ("N",), "", "", "Counts an object's instances; 0 is canonical."),
    Field("center", "<f8", ("N", 3), "m", "world", "x_world = x_unit * scale + center."),
    Field("scale", "<f8", ("N",), "m", "", "Length of the unit frame's unit; one an object."),
    Field("joint_kind", "u1", ("N", "J"), "", "", "1 revolute (or continuous), 2 prismatic."),
    Field(
        "joint_name",
        "S",
        ("N", "J"),
        "UTF-8",
        "",
        "What the model's file calls joint j.",
        True,
        optional=True,
    ),
    Field(
        "joint_parent",
        "u1",
        ("N", "J"),
        "",
        "",
        "The part that joint j and part j + 1 hang on.",
    ),
    Field(
        "joint_state",
        "<f8",
        ("N", "J"),
        "rad or unit",
        "",
        "How far each joint is from the canonical pose; prismatic ones in the unit frame's unit.",
    ),
    Field(
        "joint_lower",
        "<f8",
        ("N", "J"),
        "rad or unit",
        "",
        "Least joint state that is sampled; the canonical pose, 0, may lie below.",
    ),
    Field(
        "joint_upper", "<f8", ("N", "J"), "rad or unit", "", "Greatest joint state that is sampled."
    ),
    Field(
        "joint_axis",
        "<f8",
        ("N", "J", 3),
        "1",
        _UNIT,
        "Unit direction, at this instance's joint state: a rotation is counter-clockwise about it, "
        "a translation along it.",
    ),
    Field(
        "joint_pivot",
        "<f8",
        ("N", "J", 3),
        "unit",
        _UNIT,
        "A point on the axis, at this instance's state.",
    ),
    Field(
        "part_motion",
        "<f8",
        ("N", "P", 4, 4),
        "unit",
        _UNIT,
        "Rigid motion of each part from the canonical pose: x = motion @ x_canonical. "
        "motion[j + 1] = (rotation about, or translation along, axis j) @ motion[joint_parent[j]].",
    ),
    Field(
        "part_name",
        "S",
        ("N", "P"),
        "UTF-8",
        "",
        "What the model's file calls each part: the root link, or the one that joint j moves.",
        True,
        optional=True,
    ),
    Field(
        "part_semantic",
        "S",
        ("N", "P"),
        "UTF-8",
        "",
        "What that link is (door, lid, ...) where the source says so, else empty.",
        True,
        optional=True,
    ),
    Field(
        "occupancy_<R>",
        "u1",
        ("N", "R", "R", "R"),
        "label",
        _UNIT,
        f"Label at the voxel centres (i + 0.5) / R - 0.5, indexed [x, y, z]. {_LABEL}",
        True,
        optional=True,
    ),
    Field(
        "coverage_<R>",
        "u1",
        ("N", "R", "R", "R"),
        "1/255",
        _UNIT,
        "Share of each cell that is inside (label > 0) x 255; the cell reaches from i / R - 0.5 to "
        "(i + 1) / R - 0.5, indexed [x, y, z].",
        True,
        optional=True,
    ),
    Field(
        "surface_points",
        "<u2",
        ("N", "S", 3),
        _FIXED_POINT,
        _UNIT,
        f"Uniform by area over the visible surface, on the field's zero level. {_STORED}",
    ),
    Field(
        "surface_normals",
        "i1",
        ("N", "S", 3),
        "1/127",
        _UNIT,
        "Outward unit normals there: n = stored / 127.",
        True,
    ),
    Field("surface_part", "u1", ("N", "S"), "part", "", "The part each belongs to.", True),
    Field(
        "uniform_points",
        "<u2",
        ("N", "U", 3),
        _FIXED_POINT,
        _UNIT,
        f"Uniform in the unit cube. {_STORED}",
    ),
    Field("uniform_label", "u1", ("N", "U"), "label", "", f"Labels there. {_LABEL}", True),
    Field(
        "near_points",
        "<u2",
        ("N", "K", 3),
        _FIXED_POINT,
        _UNIT,
        "Surface points moved by Gaussian noise (recipe: near_sigma; where that is several, point "
        "k has the (k mod how many)-th); the last near_sharp of them are points of sharp edges, "
        f"moved so. {_STORED}",
    ),
    Field("near_label", "u1", ("N", "K"), "label", "", f"Labels there. {_LABEL}", True),
    *(
        Field(
            f"{name}_distance",
            "<f4",
            ("N", letter),
            "unit",
            "",
            f"Of {name}_points to the nearest face that can be seen, below 0 where label > 0, "
            "no farther than the recipe's signed_distance.",
            True,
            optional=True,
        )
        for name, letter in (("uniform", "U"), ("near", "K"))
    ),
    Field(
        "sharp_points",
        "<u2",
        ("N", "E", 3),
        _FIXED_POINT,
        _UNIT,
        "Uniform by length over the visible edges at which faces turn by the recipe's "
        f"sharp_degrees or more; where there are none, over the surface. {_STORED}",
        optional=True,
    ),
    Field(
        "sharp_normals",
        "i1",
        ("N", "E", 3),
        "1/127",
        _UNIT,
        "Unit normals half-way between those of the edge's two faces: n = stored / 127.",
        True,
        optional=True,
    ),
    Field(
        "sharp_part", "u1", ("N", "E"), "part", "", "The part each belongs to.", True, optional=True
    ),
    Field(
        "collision_depth",
        "<f8",
        ("N",),
        "unit",
        "",
        "How far at most a point on the surface of a part lies within another one's material; 0 "
        "where none does.",
        optional=True,
    ),
    Field(
        "partial_points",
        "<u2",
        ("N", "C", "M", 3),
        _FIXED_POINT,
        _UNIT,
        f"What each of C depth cameras sees. {_STORED}",
    ),
    Field("partial_part", "u1", ("N", "C", "M"), "part", "", "The part each belongs to.", True),
    Field(
        "partial_T_camera_world",
        "<f8",
        ("N", "C", 4, 4),
        "unit",
        "camera from unit",
        "x_camera = T @ x_unit; camera axes: x right, y down, z forward.",
    ),
    Field(
        "partial_intrinsics",
        "<f8",
        ("N", "C", 4),
        "pixel",
        "image",
        _INTRINSICS,
    ),
    Field(
        "image_depth",
        "<f4",
        ("N", "V", "H", "H"),
        "unit",
        "camera",
        "z along the optical axis at the pixel's centre, rows from the top; 0 where nothing is.",
        True,
        optional=True,
    ),
    Field(
        "image_part",
        "u1",
        ("N", "V", "H", "H"),
        "part + 1",
        "",
        "k + 1 where part k is seen, 0 where nothing is.",
        True,
        optional=True,
    ),
    Field(
        "image_normal",
        "i1",
        ("N", "V", "H", "H", 3),
        "1/127",
        _UNIT,
        "Unit normals of the faces that are seen, towards the camera: n = stored / 127; 0 where "
        "nothing is.",
        True,
        optional=True,
    ),
    Field(
        "image_rgba",
        "u1",
        ("N", "V", "H", "H", 4),
        "1/255",
        "",
        "sRGB of the parts' colours, shaded; opacity 255 where something is, else all 0.",
        True,
        optional=True,
    ),
    Field(
        "image_T_camera_world",
        "<f8",
        ("N", "V", 4, 4),
        "unit",
        "camera from unit",
        "x_camera = T @ x_unit; the same in all instances of an object. Axes as above.",
        optional=True,
    ),
    Field(
        "image_intrinsics",
        "<f8",
        ("N", "V", 4),
        "pixel",
        "image",
        _INTRINSICS,
        optional=True,
    ),
)
"""Every data set; those with <R> once for each grid."""

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
    """The field that describes the data set `name`, or None."""
    return next((field for field in FIELDS if field.matches(name)), None)


def resolution_of(name: str) -> int:
    """Of the grid that a data set of this name holds."""
    return int(name.rpartition("_")[2])


def misfit(names_and_shapes: Mapping[str, tuple[int, ...]]) -> str | None:
    """Why data sets of these names and shapes are not one shard; None where they are."""
    known: dict[str, int] = {}
    for name, shape in names_and_shapes.items():
        field = field_of(name)
        if field is None:
            return f"data set {name!r} is not in the schema"
        if not field.fits(name, shape, known):
            return f"data set {name!r} has shape {shape}, not {written_shape(field)} with {known}"
    missing = [f.name for f in FIELDS if not f.optional and f.name not in names_and_shapes]
    if missing:
        return f"data set {missing[0]!r} is missing"
    if known["P"] != known["J"] + 1:
        return f"{known['P']} parts for {known['J']} joints"
    if not 1 <= known["N"] <= MAX_INSTANCES:
        return f"{known['N']} instances, not 1 to {MAX_INSTANCES}"
    return None


def written_shape(field: Field) -> str:
    """The shape as people write it: (N, P, 4, 4)."""
    return f"({', '.join(map(str, field.shape))}{',' if len(field.shape) == 1 else ''})"


def markdown() -> str:
    """The tables of docs/format.md."""
    rows = [
        f"| `{f.name}`{'?' if f.optional else ''} | `{f.dtype}`{' gzip' if f.compressed else ''} "
        f"| {written_shape(f)} | {f.unit} | {f.frame} | {f.meaning} |"
        for f in FIELDS
    ]
    checked = f"| `{CHECKED_ATTRIBUTES}` | bytes | All the others as JSON; see below. |"
    letters = [f"| {letter} | {meaning} |" for letter, meaning in SYMBOLS.items()]
    attributes = [f"| `{n}` | {kind.__name__} | {what} |" for n, (kind, what) in ATTRIBUTES.items()]
    return "\n".join(
        [
            "| data set | dtype | shape | unit | frame | meaning |",
            "|---|---|---|---|---|---|",
            *rows,
            "",
            "| letter | number of |",
            "|---|---|",
            *letters,
            "",
            "| attribute of the file | type | meaning |",
            "|---|---|---|",
            *attributes,
            checked,
            "",
        ]
    )
