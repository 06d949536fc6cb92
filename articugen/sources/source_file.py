"""The schema of `urdf_sources/<source>/source.yaml`, which describes one source.

Names of categories match whatever their case and whether words are joined by _, -, a space or
nothing.
"""

import os
from collections.abc import Collection
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from articugen.core.content import SOURCES
from articugen.core.errors import InvalidSource
from articugen.core.yaml_files import Section, nearest, parsed_yaml, validated, yaml_bytes
from articugen.sources.readers import Maker, check_name, names, reader
from articugen.sources.refs import CategorySettings


class SourceFile(Section):
    """One source.yaml.

    Attributes:
        origin: who made the models and where they are obtained.
        licence: under which terms.
        frame: the frame and unit of the models as they come, in words.
        reader: the layout they are in, a name of `readers.READERS` or of another package's.
        clip_to_limits: whether recipes that leave it to the source stay inside the URDF's limits.
        messy: (procedural only) write the objects as badly as real data come: 1, or as rough: 2.
        varied: (procedural only) draw them as various as those of others are.
        path: the folder of the models, absolute or relative to source.yaml; by default
            $ARTICUGEN_SOURCES/<source> where that exists, else the folder of source.yaml.
        categories: by name; of procedural objects, those that there are if not given.
    """

    origin: str
    licence: str
    frame: str
    reader: str = "urdf"
    clip_to_limits: bool = True
    messy: int = Field(0, ge=0, le=2)
    varied: bool = False
    path: Path | None = None
    categories: dict[str, CategorySettings] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _a_maker_knows_its_categories(cls, data: Any) -> Any:
        name = data.get("reader") if isinstance(data, dict) else None
        known = reader(name) if name in names() else None
        return {"categories": known.CATEGORIES, **data} if isinstance(known, Maker) else data

    @field_validator("reader")
    @classmethod
    def _reader_is_known(cls, name: str) -> str:
        try:
            check_name(name)
        except InvalidSource as error:
            raise ValueError(str(error)) from None
        return name

    @property
    def maker(self) -> Maker | None:
        """The reader, where it makes its objects on demand; BrokenPlugin if it is another package's
        and cannot be used."""
        known = reader(self.reader)
        return known if isinstance(known, Maker) else None

    @model_validator(mode="after")
    def _made_objects_are_counted(self) -> "SourceFile":
        for name, category in self.categories.items() if self.maker else ():
            if not isinstance(category.train, int):
                raise ValueError(f"categories.{name}: a {self.reader} category needs counts")
        return self

    def own_name(self, name: str) -> str | None:
        """Return what the source calls the category that somebody calls `name`, or None.

        The source's own names go first, then what meta.json calls categories, then other names.
        """
        categories, wanted = self.categories.items(), plain(name)
        ranked = [
            *((listed, (listed,)) for listed, _ in categories),
            *((listed, c.model_cat) for listed, c in categories if len(c.model_cat) == 1),
            *((listed, (*c.model_cat, *c.aliases)) for listed, c in categories),
        ]
        return next((listed for listed, names in ranked if wanted in map(plain, names)), None)

    def words(self, name: str) -> set[str]:
        """Return all that the category called `name` may be called, as `plain` has it."""
        listed = self.own_name(name)
        if listed is None:
            return {plain(name)}
        settings = self.categories[listed]
        return {*map(plain, (name, listed, *settings.model_cat, *settings.aliases))}


def plain(name: str) -> str:
    """Return a name as it is compared: "Washing_Machine" is "washingmachine"."""
    return "".join(filter(str.isalnum, name)).lower()


def unknown(where: str, name: str, there: Collection[str]) -> InvalidSource:
    """Return the refusal of a category that is not there; it names the nearest and all."""
    hint = nearest(name.lower(), [other.lower() for other in there])
    return InvalidSource(f"{where} has no category {name!r}{hint}; there are: {', '.join(there)}")


def read_source_file(path: Path) -> SourceFile:
    """Read and check one source.yaml; InvalidSource if it is unreadable, not YAML, or has an
    unknown key (with the nearest valid one) or a bad value."""
    data = _parsed(str(path), yaml_bytes(path, InvalidSource))
    return validated(SourceFile, data, str(path), InvalidSource)


@lru_cache(64)
def _parsed(path: str, data: bytes) -> Any:
    """Return what these bytes say: they are parsed once, not once for each object."""
    return parsed_yaml(data, path, InvalidSource)


def source_files() -> dict[str, Path]:
    """Return every source.yaml by the source's name; $ARTICUGEN_SOURCES goes first, InvalidSource
    if that is no folder."""
    paths: dict[str, Path] = {}
    for root in filter(None, (users_folder(), SOURCES)):
        for path in sorted(root.glob("*/source.yaml")):
            paths.setdefault(path.parent.name, path)
    return paths


def users_folder() -> Path | None:
    """Return the folder in $ARTICUGEN_SOURCES, None if that is unset; InvalidSource if it is
    none."""
    text = os.environ.get("ARTICUGEN_SOURCES")
    if text and not Path(text).is_dir():
        raise InvalidSource(f"ARTICUGEN_SOURCES={text} is not a folder; correct or unset it")
    return Path(text) if text else None


def common_categories() -> SourceFile:
    """Return PartNet-Mobility's, whose names of categories are those that folders of models have;
    InvalidSource if its source.yaml is wrong."""
    return read_source_file(source_files()["partnet_mobility"])
