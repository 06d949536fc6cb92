"""What readers find and are given: where an object lies, and what its source says of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeInt, field_validator, model_validator

from articugen.core import content
from articugen.core.arrays import Floats
from articugen.core.geometry import rotation_about, transform
from articugen.core.records import ArticulatedObject, Joint, Link
from articugen.core.yaml_files import Section

NO_LICENCE = "not stated"  # of models that no source.yaml describes
NO_CATEGORY = "object"  # of models beside others that state theirs

Share = Annotated[NonNegativeInt, Field(le=1_000_000)] | tuple[str, ...] | None


@dataclass(frozen=True)
class Found:
    """A model on the disk.

    Attributes:
        object_id: what it is called; `listing.distinct` sees to it that no two share a name.
        location: the file or folder that its reader wants.
        group: objects of one group, which may share meshes, stay in one split.
        root: the folder that the object's files may not leave; None means the reader's default.
        category: what the model itself says that it is; "" where it does not.
        folder: the name of the folder of its category, where it lies in one.
        category_above: how many folders above the model its layout has the folder of its category.
        reader: the name of its layout in `readers.READERS`; filled in there.
    """

    object_id: str
    location: Path
    group: str
    root: Path | None = None
    category: str = ""
    folder: str = ""
    category_above: int = 1
    reader: str = ""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of its category: by its folder, then by itself, where either has one."""
        return tuple(filter(None, (self.folder, self.category)))


class CategorySettings(Section):
    """Settings of one category of a source.

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

    @property
    def turn(self) -> Floats:
        """(4, 4) the turn by `yaw_degrees`: the T_world_root of its models."""
        return transform(rotation_about((0.0, 0.0, 1.0), np.radians(self.yaw_degrees)))

    def said(self) -> str:
        """Return as text the settings that decide how an object stands and moves."""
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


@dataclass(frozen=True)
class ObjectRef:
    """Reference to one object, with all that its source says of it; cheap and picklable.

    Attributes:
        source: a source's name or the path of a file or folder.
        category: what it was asked for as.
        split: "train" or "test".
        location, root, reader: as in `Found`.
        top: the folder that somebody named, which packages of ROS may not leave; None where that
            was the model's file.
        is_made: whether it is made on demand, by a generator.
        messy: of objects that are made, how badly they are written: from 0 to 2.
        varied: of objects that are made, whether as various as those of others are.
        licence: the source's.
        settings: what the source says of its category, but for the splits.
    """

    source: str
    category: str
    object_id: str
    split: str
    location: Path
    root: Path | None = None
    top: Path | None = None
    reader: str = "urdf"
    is_made: bool = False
    messy: int = 0
    varied: bool = False
    licence: str = NO_LICENCE
    settings: CategorySettings = CategorySettings()  # noqa: RUF009 - it is frozen

    def object_of(
        self, settings: CategorySettings, links: Sequence[Link], joints: Sequence[Joint],
        sha256: str, notes: Sequence[str],
    ) -> ArticulatedObject:  # fmt: skip
        """Return the object that its reader has found so: see `ArticulatedObject`."""
        return ArticulatedObject(
            self.object_id, self.category, tuple(links), tuple(joints), settings.turn, sha256,
            self.source, tuple(notes),
        )  # fmt: skip

    @property
    def forms(self) -> tuple[str, ...]:
        """Forms of `content.FORMS` that it has."""
        return ("varied",) * self.varied + ("rough",) * (self.messy > 1)

    def generator_by(self, recipe: str) -> str:
        """Return the versions of our code that decide its data by a recipe of this text."""
        return content.declared(self.category if self.is_made else None, recipe, self.forms)
