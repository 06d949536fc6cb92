"""Recipes: everything that decides what a data set holds, read from YAML.

A recipe may say `extends: <name>`; `extends: category` means the category's own recipe. Unknown
keys are refused with the nearest valid name. The hash of the resolved recipe is its identity.
"""

import difflib
import hashlib
import json
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from articugen.errors import InvalidRecipe

RECIPE_FOLDER = Path(__file__).resolve().parent.parent / "recipes"


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Articulation(_Section):
    """How joint states are chosen.

    Attributes:
        states: random joint states per object, besides instance 0, the canonical pose.
        canonical: which URDF joint value is the canonical pose (q = 0); `source` asks source.yaml.
        revolute_degrees: the range sampled from, relative to the canonical pose; also the limits
            of continuous joints and of joints without any.
        prismatic_metres: the same for prismatic joints; null means up to the URDF's own limit.
        clip_to_limits: stay inside the URDF's limits.
        movable: names of joints that move, as patterns with * and ?; the others are locked at the
            canonical value and their links ride on what they hang on. [] means: ask source.yaml.
    """

    states: int = Field(default=100, ge=0, le=65_535)
    canonical: Literal["source", "zero", "lower", "upper"] = "source"
    revolute_degrees: tuple[float, float] = (0.0, 135.0)
    prismatic_metres: tuple[float, float] | None = None
    clip_to_limits: bool = False
    movable: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _ranges_ascend(self) -> "Articulation":
        for name in ("revolute_degrees", "prismatic_metres"):
            ends = getattr(self, name)
            if ends is not None and not ends[0] < ends[1]:
                raise ValueError(f"{name} is a range from a lower to a higher value, not {ends}")
        return self


class ViewSettings(_Section):
    """The views that are fused: `count` of them, spread evenly over the sphere."""

    count: int = Field(default=100, ge=4, le=10_000)
    projection: Literal["orthographic", "pinhole"] = "orthographic"
    resolution: int = Field(default=256, ge=16, le=4096)
    backend: Literal["rasterizer", "embree", "opengl", "sapien"] = "rasterizer"


class Fusion(_Section):
    """How depth maps become a field; docs/conventions.md states the rules.

    Attributes:
        rule: `seen`: outside is what at least one view sees free; `reachable`: and what lies open
            to that; `mean`: where the mean of the truncated distances is positive (Curless and
            Levoy 1996, Occupancy Networks).
        opening: for `reachable`, the width of openings that count, in the unit frame: those of half
            the width never do.
        truncation: in the unit frame.
        sheet_thickness: what a sheet without any thickness is given, in the unit frame.
    """

    rule: Literal["seen", "reachable", "mean"] = "seen"
    truncation: float = Field(default=0.01, gt=0.0, le=0.5)
    opening: float = Field(default=1 / 48, ge=1 / 128, le=0.5)
    sheet_thickness: float = Field(default=1.5 / 256, ge=0.0, le=0.1)


class Sampling(_Section):
    """How many samples an instance gets. Lengths are in the unit frame."""

    grids: tuple[int, ...] = (16, 32, 64)
    surface_points: int = Field(default=8192, ge=0, le=1_000_000)
    uniform_points: int = Field(default=8192, ge=0, le=1_000_000)
    near_points: int = Field(default=8192, ge=0, le=1_000_000)
    near_sigma: float = Field(default=0.01, gt=0.0, le=0.5)
    partial_views: int = Field(default=4, ge=0, le=256)
    partial_points: int = Field(default=1024, ge=0, le=1_000_000)
    partial_resolution: int = Field(default=192, ge=16, le=2048)
    depth_noise: float = Field(default=0.0, ge=0.0, le=0.1)

    @model_validator(mode="after")
    def _grids_are_sizes(self) -> "Sampling":
        if any(not 1 <= r <= 256 for r in self.grids) or len(set(self.grids)) != len(self.grids):
            raise ValueError("grids are different sizes from 1 to 256")
        return self


class Recipe(_Section):
    """One recipe, resolved. See the sections for the meaning of each key."""

    name: str
    articulation: Articulation = Articulation()
    views: ViewSettings = ViewSettings()
    fusion: Fusion = Fusion()
    sampling: Sampling = Sampling()
    padding: float = Field(default=0.1, ge=0.0, lt=1.0)
    objects: int | None = Field(default=None, ge=1)
    max_rejected_fraction: float = Field(default=0.1, ge=0.0, le=1.0)

    def text(self) -> str:
        """The resolved recipe as canonical JSON; equal recipes have equal texts."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))

    def for_one_object(self) -> "Recipe":
        """What of the recipe decides an object's data: neither its name nor how many objects."""
        aside = {"name": "object", "objects": None, "max_rejected_fraction": 1.0}
        return self.model_copy(update=aside)

    def sha256(self) -> str:
        return hashlib.sha256(self.text().encode()).hexdigest()

    def with_counts(self, *, objects: int | None = None, states: int | None = None) -> "Recipe":
        """This recipe with other numbers of objects and of random states; None keeps its own."""
        data = self.model_dump()
        if objects is not None:
            data["objects"] = objects
        if states is not None:
            data["articulation"]["states"] = states
        return Recipe.model_validate(data)


def load_recipe(name: str | Path | None, category: str) -> Recipe:
    """The recipe `name` (a name under recipes/, a path, or None for the category's own).

    A category without a recipe of its own gets recipes/default.yaml.

    Raises:
        InvalidRecipe: no such recipe, bad YAML, an unknown key or a bad value.
    """
    path = _category_recipe(category) if name is None else _find(str(name))
    data = _resolve(path, category, chain=())
    return _validate(data | {"name": data.get("name", path.stem)}, path)


def _category_recipe(category: str) -> Path:
    own = RECIPE_FOLDER / f"{category}.yaml"
    return own if own.is_file() else RECIPE_FOLDER / "default.yaml"


def _find(name: str) -> Path:
    for path in (RECIPE_FOLDER / f"{name}.yaml", Path(name)):
        if path.is_file():
            return path
    known = sorted(p.stem for p in RECIPE_FOLDER.glob("*.yaml"))
    raise InvalidRecipe(f"no recipe {name!r}{nearest(name, known)}; there are: {', '.join(known)}")


def _resolve(path: Path, category: str, chain: tuple[Path, ...]) -> dict[str, Any]:
    if path in chain:
        raise InvalidRecipe(f"{path}: extends itself")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except OSError as error:
        raise InvalidRecipe(f"{path}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidRecipe(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise InvalidRecipe(f"{path}: a recipe is a mapping of keys to values")
    base = data.pop("extends", None)
    if base is None:
        return data
    base_path = _category_recipe(category) if base == "category" else _find(str(base))
    return _merged(_resolve(base_path, category, (*chain, path)), data)


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merged(base[key], value) if nested else value
    return merged


def _validate(data: dict[str, Any], path: Path) -> Recipe:
    try:
        return Recipe.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            hint = nearest(str(first["loc"][-1]), _keys_at(first["loc"][:-1]))
            raise InvalidRecipe(f"{path}: unknown key {where!r}{hint}") from None
        message = first["msg"].removeprefix("Value error, ")
        raise InvalidRecipe(f"{path}: {where}: {message}") from None


def _keys_at(location: tuple[int | str, ...]) -> list[str]:
    section: type[BaseModel] = Recipe
    for name in location:
        annotation = section.model_fields[str(name)].annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            section = annotation
    return list(section.model_fields)


def nearest(name: str, known: list[str]) -> str:
    """The hint "; did you mean 'x'?", or nothing where no known name is near."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
