"""The schema of `urdf_sources/<source>/source.yaml`, which describes one source."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    NonNegativeInt,
    ValidationError,
    field_validator,
    model_validator,
)

from articugen.errors import InvalidSource
from articugen.recipe_files import Section, nearest, read_yaml
from articugen.sources.procedural import CATEGORIES

Reader = Literal["urdf", "procedural", "partnet_mobility", "shape2motion"]
Share = Annotated[NonNegativeInt, Field(le=1_000_000)] | tuple[str, ...] | None


class CategorySettings(Section):
    """What a source says about one of its categories.

    Attributes:
        canonical: the joint value that is the canonical pose: 0, the lower or the upper limit.
        movable: which joints move, as patterns with * and ? on the joint's name or its child link's
            semantic, in the order in which parts are numbered; () means all of them, in the order
            of the file.
        yaw_degrees: turns the model about the world's z so that its joints point as
            docs/conventions.md says.
        train, test: how many objects each split has, or their ids. Ids of one split alone leave the
            other objects to the other split; without either, a hash of the id decides, about 8 : 2.
        model_cat: the names of this category in PartNet-Mobility's meta.json.
        aliases: what else people call it.
    """

    canonical: Literal["zero", "lower", "upper"] = "zero"
    movable: tuple[str, ...] = ()
    yaw_degrees: float = Field(default=0.0, ge=-360.0, le=360.0)
    train: Share = None
    test: Share = None
    model_cat: tuple[str, ...] = ()
    aliases: tuple[str, ...] = ()

    def said(self) -> str:
        """What of it decides how an object stands and moves, as text."""
        return self.model_dump_json(include={"canonical", "movable", "yaw_degrees"})

    @field_validator("train", "test", mode="before")
    @classmethod
    def _ids_are_text(cls, value: object) -> object:
        if isinstance(value, list) and not all(isinstance(item, str) for item in value):
            raise ValueError('ids are text, in quotes: "10040"')
        return value

    @model_validator(mode="after")
    def _splits_make_sense(self) -> "CategorySettings":
        if isinstance(self.train, int) != isinstance(self.test, int):
            raise ValueError("train and test are both numbers, or neither is")
        if self.train == 0 and self.test == 0:
            raise ValueError("train and test are both 0")
        if isinstance(self.train, tuple) and isinstance(self.test, tuple):
            both = sorted(set(self.train) & set(self.test))
            if both:
                raise ValueError(f"object {both[0]!r} is in train and in test")
        return self


class SourceFile(Section):
    """One source.yaml.

    Attributes:
        origin: who made the models and where they are obtained.
        licence: under which terms.
        frame: the frame and unit of the models as they come, in words.
        reader: the module under articugen/sources that reads them.
        clip_to_limits: whether recipes that leave it to the source stay inside the URDF's limits.
        messy: (procedural only) write the objects as real data come.
        path: the folder of the models, absolute or relative to source.yaml; by default
            $ARTICUGEN_SOURCES/<source> where that exists, else the folder of source.yaml.
        categories: by name; of procedural objects, those that there are if not given.
    """

    origin: str
    licence: str
    frame: str
    reader: Reader = "urdf"
    clip_to_limits: bool = True
    messy: bool = False
    path: Path | None = None
    categories: dict[str, CategorySettings] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _procedural_has_its_own(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("reader") == "procedural":
            return {"categories": CATEGORIES, **data}
        return data

    @model_validator(mode="after")
    def _procedural_has_counts(self) -> "SourceFile":
        if self.reader == "procedural":
            for name, category in self.categories.items():
                if not isinstance(category.train, int):
                    raise ValueError(f"categories.{name}: a procedural category needs counts")
        return self


def read_source_file(path: Path) -> SourceFile:
    """Read and check one source.yaml.

    Raises:
        InvalidSource: unreadable, not YAML, an unknown key (with the nearest valid one), bad value.
    """
    data = read_yaml(path, InvalidSource)
    try:
        return SourceFile.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            section = CategorySettings if first["loc"][0] == "categories" else SourceFile
            hint = nearest(str(first["loc"][-1]), list(section.model_fields))
            raise InvalidSource(f"{path}: unknown key {where!r}{hint}") from None
        message = first["msg"].removeprefix("Value error, ")
        raise InvalidSource(f"{path}: {where or 'the file'}: {message}") from None
