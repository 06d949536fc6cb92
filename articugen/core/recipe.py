"""Recipes: everything that decides what a data set holds, read from YAML.

A recipe may say `extends: <name>`; `extends: category` means the category's own recipe. Unknown
keys are refused with the nearest valid name. The hash of the resolved recipe is its identity.
"""

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator

from articugen.core import backends, schema
from articugen.core.content import RECIPES
from articugen.core.errors import InvalidRecipe, printable
from articugen.core.schema import SYMBOLS, resolution_of
from articugen.core.schema import Field as Described
from articugen.core.yaml_files import Section as _Section
from articugen.core.yaml_files import find, resolved, resolved_mapping, validated

_CATEGORY = re.compile(r"\w(?:[\w .+-]{0,98}[\w+-])?")

MAX_TEXT_BYTES = 32_000
"""Of a resolved recipe: it is kept in an attribute of each shard, which can hold 60,000."""
MAX_INSTANCE_BYTES = 1 << 27  # of an instance in memory: some are held at once
MAX_PIXELS = 1 << 28  # of all views together, 4 bytes each
MOST_PARTS = 255
LEAST_STEP = 0.3
"""Share of a joint's range: `--range-scale` of Ditto's published generate_data_seg.py."""

_Pattern = Annotated[str, Field(min_length=1, max_length=255)]
_Degrees = Annotated[float, Field(ge=-3600.0, le=3600.0)]
_Metres = Annotated[float, Field(ge=-1000.0, le=1000.0)]


class Articulation(_Section):
    """Choice of joint states.

    Attributes:
        states: random joint states per object, besides instance 0, the canonical pose.
        one_at_a_time: in each only one joint is not as in the state before, each in its turn, but
            `LEAST_STEP` of its range from there, as Ditto's scenes want it.
        canonical: which URDF joint value is the canonical pose (q = 0); `source` asks source.yaml.
        revolute_degrees: the range sampled from, relative to the canonical pose; also the limits
            of continuous joints and of joints without any.
        prismatic_metres: the same for prismatic joints; null means up to the URDF's own limit.
        clip_to_limits: stay inside the URDF's limits; `source` asks source.yaml: models made by
            others do, our own procedural ones keep the range of the recipe.
        movable: names of joints that move, as patterns with * and ?; the others are locked at the
            canonical value and their links ride on what they hang on. [] means: ask source.yaml.
        collision: what becomes of a state in which parts are in one another: `ignore` does not
            look, `label` writes down how deep they are, `reject` also draws the state again.
        collision_depth: for `reject`, how deep two parts may be in one another, or deeper than in
            the canonical pose, as hinges often are; in the unit frame.
    """

    states: int = Field(default=100, ge=0, le=65_535)
    one_at_a_time: bool = False
    canonical: Literal["source", "zero", "lower", "upper"] = "source"
    revolute_degrees: tuple[_Degrees, _Degrees] = (0.0, 135.0)
    prismatic_metres: tuple[_Metres, _Metres] | None = None
    clip_to_limits: bool | Literal["source"] = "source"
    movable: tuple[_Pattern, ...] = ()
    collision: Literal["ignore", "label", "reject"] = "ignore"
    collision_depth: float = Field(default=0.01, ge=0.0, le=0.5)

    @model_validator(mode="after")
    def _ranges_ascend(self) -> "Articulation":
        for name in ("revolute_degrees", "prismatic_metres"):
            ends = getattr(self, name)
            if ends is not None and not ends[0] < ends[1]:
                raise ValueError(f"{name} is a range from a lower to a higher value, not {ends}")
        return self


_Sigma = Annotated[float, Field(gt=0.0, le=0.5)]


class ViewSettings(_Section):
    """The views that are fused: `count` of them, spread evenly over the sphere.

    Attributes:
        backend: what renders them, and the partial clouds: see `rendering.backends.BACKENDS`.
    """

    count: int = Field(default=100, ge=4, le=10_000)
    projection: Literal["orthographic", "pinhole"] = "orthographic"
    resolution: int = Field(default=256, ge=16, le=4096)
    backend: Annotated[str, AfterValidator(backends.check_name)] = "rasterizer"

    @model_validator(mode="after")
    def _fit_into_memory(self) -> "ViewSettings":
        if self.count * self.resolution**2 > MAX_PIXELS:
            raise ValueError(
                f"{self.count:,} views of {self.resolution} x {self.resolution} pixels have more "
                f"than {MAX_PIXELS:,}; lower count or resolution"
            )
        return self


class Fusion(_Section):
    """Fusion of depth maps into a field; docs/conventions.md states the rules.

    Attributes:
        rule: `seen`: outside is what at least one view sees free; `reachable`: and the space open
            to that; `mean`: where the mean of the truncated distances is positive (Curless and
            Levoy 1996, Occupancy Networks); `rigid`: what no part's own solid holds, the material
            alone, the fastest.
        opening: for `reachable`, the width of openings that count, in the unit frame: those of half
            the width never do.
        truncation: in the unit frame.
        sheet_thickness: what a sheet without any thickness is given, in the unit frame.
    """

    rule: Literal["seen", "reachable", "mean", "rigid"] = "seen"
    truncation: float = Field(default=0.01, gt=0.0, le=0.5)
    opening: float = Field(default=1 / 48, ge=1 / 128, le=0.5)
    sheet_thickness: float = Field(default=1.5 / 256, ge=0.0, le=0.1)


class Sampling(_Section):
    """Numbers of samples of an instance. Lengths are in the unit frame.

    Attributes:
        grids: resolutions of the grids of labels.
        coverage: whether each grid comes with the share of every cell that is inside, which keeps
            the thin parts that lie between the centres of a coarse grid.
        surface_points, uniform_points, near_points: how many.
        near_sigma: how far from the surface `near_points` are; where it is several, they take
            turns.
        near_sharp: which share of `near_points`, the last of them, is around `sharp_points` instead
            of points uniform on the surface.
        signed_distance: query points come with their signed distance from the surface, up to this;
            0 for none.
        sharp_points: how many on sharp edges; 0 for none.
        sharp_degrees: an edge is sharp where its faces turn by this or more.
        surface_color: surface points come with the colours of the model there.
        partial_views, partial_points, partial_resolution: how many depth cameras, points of each,
            pixels along the edge of its image.
        partial_cameras: where they are: `around` the object, each image just filled by it; or
            `held`, the same in all states, as those of `images`, but nearer and not centred.
        depth_noise: standard deviation of what they measure.
        kinect_metres: they measure as a Kinect does that sees the unit frame as a cube of this
            edge, in metres; 0 for exact ones. See `instance.sampling.as_kinect`.
    """

    grids: tuple[int, ...] = (16, 32, 64)
    coverage: bool = False
    surface_points: int = Field(default=8192, ge=0, le=1_000_000)
    uniform_points: int = Field(default=8192, ge=0, le=1_000_000)
    near_points: int = Field(default=8192, ge=0, le=1_000_000)
    near_sigma: _Sigma | Annotated[tuple[_Sigma, ...], Field(min_length=1, max_length=16)] = 0.01
    near_sharp: float = Field(default=0.0, ge=0.0, le=1.0)
    signed_distance: float = Field(default=0.0, ge=0.0, le=2.0)
    sharp_points: int = Field(default=0, ge=0, le=1_000_000)
    sharp_degrees: float = Field(default=30.0, gt=0.0, lt=180.0)
    surface_color: bool = False
    partial_views: int = Field(default=4, ge=0, le=256)
    partial_points: int = Field(default=1024, ge=0, le=1_000_000)
    partial_resolution: int = Field(default=192, ge=16, le=2048)
    partial_cameras: Literal["around", "held"] = "around"
    depth_noise: float = Field(default=0.0, ge=0.0, le=0.1)
    kinect_metres: float = Field(default=0.0, ge=0.0, le=10.0)

    @model_validator(mode="after")
    def _makes_sense(self) -> "Sampling":
        if self.near_sharp and not self.sharp_points:
            raise ValueError("near_sharp wants sharp_points to draw around; ask for some")
        if any(not 1 <= r <= 256 for r in self.grids) or len(set(self.grids)) != len(self.grids):
            raise ValueError("grids are different sizes from 1 to 256")
        return self


class Images(_Section):
    """Images of every instance by cameras that all instances of an object share: pinholes that
    see it from random places above its middle.

    Attributes:
        views: how many; 0 for none.
        resolution: pixels along their edges.
        fields: what of `depth`, `part`, `normal` and `rgba` is stored of each.
        colours: of `rgba`: a colour for each of the `parts`, or those of the `model`.
    """

    views: int = Field(default=0, ge=0, le=1000)
    resolution: int = Field(default=256, ge=16, le=2048)
    fields: tuple[Literal["depth", "part", "normal", "rgba"], ...] = (
        *("depth", "part", "normal", "rgba"),
    )
    colours: Literal["parts", "model"] = "parts"


_LATER = {
    "articulation": ("one_at_a_time", "collision", "collision_depth"),
    "sampling": (
        *("near_sharp", "signed_distance", "sharp_points", "sharp_degrees"),
        *("surface_color", "partial_cameras", "kinect_metres"),
    ),
    "images": tuple(Images.model_fields),
}
"""Keys that ask for nothing by default and that the recipes of older data sets do not have."""


class Recipe(_Section):
    """One recipe, resolved. See the sections for the meaning of each key.

    Attributes:
        objects: how many of the category; null means all.
        max_rejected_fraction: with more rejected objects than that a data set counts as failed.
        seconds_per_object: an object that takes longer is rejected; null means ten minutes and five
            seconds more for each instance.
        memory_per_object_mb: so is one for which a worker comes to hold more.
    """

    name: Annotated[str, Field(min_length=1, max_length=255)]
    articulation: Articulation = Articulation()
    views: ViewSettings = ViewSettings()
    fusion: Fusion = Fusion()
    sampling: Sampling = Sampling()
    images: Images = Images()
    padding: float = Field(default=0.1, ge=0.0, lt=1.0)
    objects: int | None = Field(default=None, ge=1, le=1_000_000)
    max_rejected_fraction: float = Field(default=0.1, ge=0.0, le=1.0)
    seconds_per_object: float | None = Field(default=None, gt=0.0, le=1e7)
    memory_per_object_mb: float = Field(default=4096.0, ge=256.0, le=1e7)

    @model_validator(mode="after")
    def _fits_a_shard(self) -> "Recipe":
        sizes = self.instance_bytes()
        name, most = max(sizes.items(), key=lambda item: item[1])
        section = "images" if name.startswith("image_") else "sampling"
        if most > schema.MAX_CHUNK_BYTES:
            raise ValueError(
                f"{section}: {name} would take {most / 2**20:,.0f} MiB an instance, more than the "
                f"{schema.MAX_CHUNK_BYTES >> 20} that a shard can hold; ask for less"
            )
        if sum(sizes.values()) > MAX_INSTANCE_BYTES:
            raise ValueError(
                f"sampling: an instance would take {sum(sizes.values()) / 2**20:,.0f} MiB, more "
                f"than {MAX_INSTANCE_BYTES >> 20}; ask for fewer points, smaller grids or images"
            )
        length = len(self.text())
        if length > MAX_TEXT_BYTES:
            raise ValueError(
                f"the recipe takes {length:,} bytes when written out, more than {MAX_TEXT_BYTES:,};"
                " use fewer or shorter patterns in articulation.movable"
            )
        return self

    def text(self) -> str:
        """Return the resolved recipe as canonical JSON; equal recipes have equal texts. Keys that
        came after the first data sets are left out where they ask for nothing: those stay as they
        are."""
        values = self.model_dump(mode="json")
        for section, keys in _LATER.items():
            usual = type(getattr(self, section))().model_dump(mode="json")
            for key in keys:
                if values[section][key] == usual[key]:
                    del values[section][key]
        values = {name: value for name, value in values.items() if value != {}}
        return json.dumps(values, sort_keys=True, separators=(",", ":"))

    @staticmethod
    def of_text(text: str) -> "Recipe | None":
        """Return the recipe that has this `text`; None where it is of another version."""
        try:
            return Recipe.model_validate_json(text)
        except ValidationError:
            return None

    def fields(self) -> dict[str, Described]:
        """Return the data sets of a shard by this recipe, by name."""
        return {
            f"{described.stem}_{r}" if described.is_grid else described.name: described
            for described in schema.FIELDS
            if self._asks_for(described)
            for r in (self.sampling.grids if described.is_grid else (0,))
        }

    def _asks_for(self, described: Described) -> bool:
        if not described.asked_by:
            return True
        if described.asked_by == "images.fields":
            name = described.name.removeprefix("image_")
            return self.images.views > 0 and name in self.images.fields
        return self.at(described.asked_by) not in (0, "ignore")

    @property
    def shows_colours(self) -> bool:
        """Return whether models must be read with their colours."""
        return self.sampling.surface_color or self.images.colours == "model"

    def at(self, key: str) -> Any:
        """Return the value of a key, "sampling.grids" say."""
        section, name = key.split(".")
        return getattr(getattr(self, section), name)

    def instance_shapes(self) -> dict[str, tuple[int | None, ...]]:
        """Return the shape of each field of one instance; None for a number that its object
        decides."""
        numbers = {letter: self.at(key) for letter, (_, key) in SYMBOLS.items() if key}
        shapes: dict[str, tuple[int | None, ...]] = {}
        for name, described in self.fields().items():
            known = numbers | ({"R": resolution_of(name)} if described.is_grid else {})
            letters = described.shape[1:]
            shapes[name] = tuple(n if isinstance(n, int) else known.get(n) for n in letters)
        return shapes

    def instance_bytes(self) -> dict[str, int]:
        """Return the bytes of each field of an instance, unpacked, with as many parts as can be."""
        fields = self.fields()
        return {
            name: fields[name].itemsize * math.prod(MOST_PARTS if n is None else n for n in shape)
            for name, shape in self.instance_shapes().items()
        }

    def for_one_object(self) -> "Recipe":
        """Return the part of the recipe that decides an object's data: neither its name nor numbers
        and limits."""
        fields = Recipe.model_fields
        limits = ("seconds_per_object", "memory_per_object_mb")
        aside = {"name": "object", "objects": None, "max_rejected_fraction": 1.0}
        return self.model_copy(update=aside | {name: fields[name].default for name in limits})

    def sha256(self) -> str:
        return hashlib.sha256(self.text().encode()).hexdigest()

    def with_options(
        self,
        *,
        objects: int | None = None,
        states: int | None = None,
        max_rejected: float | None = None,
        movable: Sequence[str] = (),
        canonical: str | None = None,
    ) -> "Recipe":
        """Return it with other values, where given; InvalidRecipe if it cannot have them."""
        changes = {"objects": objects, "max_rejected_fraction": max_rejected}
        joints = {"states": states, "movable": list(movable) or None, "canonical": canonical}
        data = self.model_dump()
        for section, values in ((data, changes), (data["articulation"], joints)):
            section |= {name: value for name, value in values.items() if value is not None}
        return validated(Recipe, data, f"recipe {self.name!r}")

    def for_source(self, *, clips_to_limits: bool) -> "Recipe":
        """This recipe as it is for a source: that its joints are clipped, or not, is then said."""
        if self.articulation.clip_to_limits != "source":
            return self
        articulation = self.articulation.model_copy(update={"clip_to_limits": clips_to_limits})
        return self.model_copy(update={"articulation": articulation})


def check_category(name: str) -> None:
    """Raise InvalidRecipe for other signs than letters, digits, _, and within space - . +."""
    if not _CATEGORY.fullmatch(name):
        raise InvalidRecipe(
            f"{printable(name)!r} cannot be a category's name; use up to 100 letters, digits, _ "
            "and, within, - or ., without any /"
        )


def load_recipe(
    wanted: "str | Path | Mapping[str, Any] | Recipe | None", category: str, source: str = ""
) -> Recipe:
    """Return the recipe `wanted`: a name under recipes/, a path, the keys of such a file, a recipe,
    which is taken as it is, or None for the category's own.

    A category's own is recipes/<category>-<source>.yaml, where that source has one to itself, else
    recipes/<category>.yaml, else recipes/default.yaml.

    Raises:
        InvalidRecipe: no such recipe, bad YAML, an unknown key or a bad value.
    """
    if isinstance(wanted, Recipe):
        return wanted
    check_category(category)
    names = [f"{category}-{source}"] if _CATEGORY.fullmatch(source) else []  # else it is a path
    paths = [RECIPES / f"{name}.yaml" for name in (*names, category, "default")]
    path_of_category = next((path for path in paths if path.is_file()), paths[-1])

    def base_of(base: str) -> Path:
        return path_of_category if base == "category" else find(base, learner=False)

    if isinstance(wanted, Mapping):
        data = {"name": "own"} | resolved_mapping(wanted, base_of)
        return validated(Recipe, data, "the recipe that is given")
    path = path_of_category if wanted is None else find(str(wanted), learner=False)
    return validated(Recipe, {"name": path.stem} | resolved(path, base_of), str(path))
