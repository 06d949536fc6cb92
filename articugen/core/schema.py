"""A row of a shard, declared once: each field of `Instance` says its dtype, shape, unit, frame and
meaning. The writer, the recipe's sizes, every check and docs/format.md follow from it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Annotated, Any

import numpy as np

from articugen.core.fields import (
    MAX_TEXT,
    SYMBOLS,
    Field,
    f4,
    f8,
    fields_of,
    grids,
    i1,
    number,
    stored,
    text,
    texts,
    u1,
    u2,
)

SCHEMA_VERSION = 3
"""Of what is written. Readers take every version up to it: a later one only adds optional fields,
and tells apart what an earlier one did not (docs/format.md says what)."""

FORMAT = "articugen shard"
"""The attribute `format` of every shard."""

MAX_INSTANCES = 65_536
MAX_CHUNK_BYTES = 1 << 26
"""No field of one instance may take more than 64 MiB: what a reader risks on a hostile file."""

SPLIT = r"^[A-Za-z0-9_][A-Za-z0-9_-]{0,99}$"
"""What a split may be called: shards and folders are called after it."""

USER_GROUP = "user"
"""A group of this name belongs to whoever uses the data: everybody leaves it alone."""

_STORED = "x = stored / 65535 - 0.5."
_INTRINSICS = "fx, fy, cx, cy: u = fx x / z + cx, v = fy y / z + cy; pixel centres at + 0.5."
_LABEL = "0 free, k + 1 material of part k, 255 enclosed: no view sees it, no part holds it."


@dataclass(frozen=True, eq=False, kw_only=True)
class Instance:
    """One object at one joint state: all that a row of a shard holds, in the unit frame.

    Point coordinates are stored in fixed point: `records.quantize` and `dequantize` say how. P
    parts, J moving joints (P = J + 1), joint j carries part j + 1. Labels: 0 free, k + 1 material
    of part k, 255 enclosed; parts: k. What a shard lacks is None.
    """

    object_id: text = stored("N", "Which object it is.", unit="UTF-8", gzip=True)
    state_index: Annotated[int, "<u4"] = stored(
        "N", "Counts an object's instances; 0 is canonical."
    )
    center: f8 = stored("N 3", "x_world = x_unit * scale + center.", unit="m", frame="world")
    scale: number = stored("N", "Length of the unit frame's unit; one an object.", unit="m")
    joint_kind: u1 = stored("N J", "1 revolute (or continuous), 2 prismatic.")
    joint_name: texts | None = stored(
        "N J", "What the model's file calls joint j.", unit="UTF-8", gzip=True, optional=True
    )
    joint_parent: u1 = stored("N J", "The part that joint j and part j + 1 hang on.")
    joint_state: f8 = stored(
        "N J",
        "How far each joint is from the canonical pose; prismatic ones in the unit frame's unit.",
        unit="rad or unit",
    )
    joint_lower: f8 = stored(
        "N J",
        "Least joint state that is sampled; the canonical pose, 0, may lie below.",
        unit="rad or unit",
    )
    joint_upper: f8 = stored("N J", "Greatest joint state that is sampled.", unit="rad or unit")
    joint_axis: f8 = stored(
        "N J 3",
        "Unit direction, at this instance's joint state: a rotation is counter-clockwise about "
        "it, a translation along it.",
        unit="1",
        frame="unit",
    )
    joint_pivot: f8 = stored(
        "N J 3", "A point on the axis, at this instance's state.", unit="unit", frame="unit"
    )
    part_motion: f8 = stored(
        "N P 4 4",
        "Rigid motion of each part from the canonical pose: x = motion @ x_canonical. motion[j "
        "+ 1] = (rotation about, or translation along, axis j) @ motion[joint_parent[j]].",
        unit="unit",
        frame="unit",
    )
    part_name: texts | None = stored(
        "N P",
        "What the model's file calls each part: the root link, or the one that joint j moves.",
        unit="UTF-8",
        gzip=True,
        optional=True,
    )
    part_semantic: texts | None = stored(
        "N P",
        "What that link is (door, lid, ...) where the source says so, else empty.",
        unit="UTF-8",
        gzip=True,
        optional=True,
    )
    occupancy: grids = stored(
        "N R R R",
        f"Label at the voxel centres (i + 0.5) / R - 0.5, indexed [x, y, z]. {_LABEL}",
        unit="label",
        frame="unit",
        gzip=True,
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
    surface_points: u2 = stored(
        "N S 3",
        f"Uniform by area over the visible surface, on the field's zero level. {_STORED}",
        unit="1/65535",
        frame="unit",
    )
    surface_normals: i1 = stored(
        "N S 3",
        "Outward unit normals there: n = stored / 127.",
        unit="1/127",
        frame="unit",
        gzip=True,
    )
    surface_part: u1 = stored("N S", "The part each belongs to.", unit="part", gzip=True)
    uniform_points: u2 = stored(
        "N U 3", f"Uniform in the unit cube. {_STORED}", unit="1/65535", frame="unit"
    )
    uniform_label: u1 = stored("N U", f"Labels there. {_LABEL}", unit="label", gzip=True)
    near_points: u2 = stored(
        "N K 3",
        "Surface points moved by Gaussian noise (recipe: near_sigma; where that is several, "
        "point k has the (k mod how many)-th); the last near_sharp of them are points of sharp "
        f"edges, moved so. {_STORED}",
        unit="1/65535",
        frame="unit",
    )
    near_label: u1 = stored("N K", f"Labels there. {_LABEL}", unit="label", gzip=True)
    uniform_distance: f4 | None = stored(
        "N U",
        "Of uniform_points to the nearest face that can be seen, below 0 where label > 0, no "
        "farther than the recipe's signed_distance.",
        unit="unit",
        gzip=True,
        asked_by="sampling.signed_distance",
    )
    near_distance: f4 | None = stored(
        "N K",
        "Of near_points to the nearest face that can be seen, below 0 where label > 0, no "
        "farther than the recipe's signed_distance.",
        unit="unit",
        gzip=True,
        asked_by="sampling.signed_distance",
    )
    sharp_points: u2 | None = stored(
        "N E 3",
        "Uniform by length over the visible edges at which faces turn by the recipe's "
        f"sharp_degrees or more; where there are none, over the surface. {_STORED}",
        unit="1/65535",
        frame="unit",
        asked_by="sampling.sharp_points",
    )
    sharp_normals: i1 | None = stored(
        "N E 3",
        "Unit normals half-way between those of the edge's two faces: n = stored / 127.",
        unit="1/127",
        frame="unit",
        gzip=True,
        asked_by="sampling.sharp_points",
    )
    sharp_part: u1 | None = stored(
        "N E", "The part each belongs to.", unit="part", gzip=True, asked_by="sampling.sharp_points"
    )
    collision_depth: number | None = stored(
        "N",
        "How far at most a point on the surface of a part lies within another one's material; 0 "
        "where none does.",
        unit="unit",
        asked_by="articulation.collision",
    )
    partial_points: u2 = stored(
        "N C M 3", f"What each of C depth cameras sees. {_STORED}", unit="1/65535", frame="unit"
    )
    partial_part: u1 = stored("N C M", "The part each belongs to.", unit="part", gzip=True)
    partial_T_camera_world: f8 = stored(
        "N C 4 4",
        "x_camera = T @ x_unit; camera axes: x right, y down, z forward.",
        unit="unit",
        frame="camera from unit",
    )
    partial_intrinsics: f8 = stored("N C 4", _INTRINSICS, unit="pixel", frame="image")
    image_depth: f4 | None = stored(
        "N V H H",
        "z along the optical axis at the pixel's centre, rows from the top; 0 where nothing is.",
        unit="unit",
        frame="camera",
        gzip=True,
        asked_by="images.fields",
    )
    image_part: u1 | None = stored(
        "N V H H",
        "k + 1 where part k is seen, 0 where nothing is.",
        unit="part + 1",
        gzip=True,
        asked_by="images.fields",
    )
    image_normal: i1 | None = stored(
        "N V H H 3",
        "Unit normals of the faces that are seen, towards the camera: n = stored / 127; 0 where "
        "nothing is.",
        unit="1/127",
        frame="unit",
        gzip=True,
        asked_by="images.fields",
    )
    image_rgba: u1 | None = stored(
        "N V H H 4",
        "sRGB of the parts' colours, shaded; opacity 255 where something is, else all 0.",
        unit="1/255",
        gzip=True,
        asked_by="images.fields",
    )
    image_T_camera_world: f8 | None = stored(
        "N V 4 4",
        "x_camera = T @ x_unit; the same in all instances of an object. Axes as above.",
        unit="unit",
        frame="camera from unit",
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
        """Every field that it has, by its name in a shard; grids as `occupancy_<resolution>`."""
        all_fields = {f.name: getattr(self, f.name) for f in fields(self)}
        grids = {
            f"{name}_{r}": grid
            for name in GRIDS
            for r, grid in sorted(all_fields.pop(name).items())
        }
        return {name: value for name, value in all_fields.items() if value is not None} | grids


FIELDS = fields_of(Instance)
"""Every data set; those with <R> once for each grid."""

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


def markdown() -> str:
    """Return the tables of docs/format.md."""
    rows = [
        f"| `{f.name}`{'?' if f.optional else ''} | `{f.dtype}`{' gzip' if f.compressed else ''} "
        f"| {f.written_shape} | {f.unit} | {f.frame} | {f.meaning} |"
        for f in FIELDS
    ]
    checked = f"| `{CHECKED_ATTRIBUTES}` | bytes | All the others as JSON; see below. |"
    letters = [f"| {letter} | {meaning} |" for letter, (meaning, _) in SYMBOLS.items()]
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
