"""The layouts in which models come, one reader each.

A layout is one file beside this one and one line of READERS; or one file in another package, which
names it as an entry point of the group `articugen.readers`: see docs/extending.md.
"""

import hashlib
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from articugen.core import plugins
from articugen.core.errors import ArticugenError, InvalidSource, machine_fault, printable
from articugen.core.records import ArticulatedObject
from articugen.meshes.model_files import MAX_NAME_BYTES
from articugen.sources import (
    annotated_urdf,
    artiverse,
    partnet_mobility,
    procedural,
    shape2motion,
    urdf_files,
)
from articugen.sources.folders import visible
from articugen.sources.mjcf import reader as mjcf
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.usd import reader as usd

MAX_METRES = 1e6  # how far from its link's origin anything may lie


class Reader(Protocol):
    """One layout; a module with these functions is one.

    A module of another package must have a third one, `find(base) -> list[Found]`: the models in a
    folder of a source whose source.yaml names this reader. Of ours they are what `find_at(child)`,
    if there is one, or else `detect` makes of each thing in that folder.
    """

    def detect(self, path: Path) -> Found | None:
        """Return the model that a file or folder is, as it is named in a folder of others; None
        where it is none of this layout. Asked of everything in a folder: few names must do."""
        ...

    def load(self, ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
        """Read one.

        Args:
            settings: what the source says of its category; `turn` is its T_world_root.

        Raises:
            InvalidSource: anything amiss with its files; one sentence with file and cure.
        """
        ...


@runtime_checkable
class Maker(Reader, Protocol):
    """A reader whose objects are made on demand, any number of each category.

    Attributes:
        CATEGORIES: what it can make, of a source.yaml that names no categories: how many objects
            each split has unless more are asked for.
    """

    CATEGORIES: Mapping[str, Mapping[str, int]]

    def object_id(self, category: str, index: int) -> str:
        """Return the id of object number `index`, from 0."""
        ...

    def index_of(self, category: str, object_id: str) -> int | None:
        """Return the number of the object of that id; None where there is none."""
        ...


READERS: dict[str, Reader] = {
    "partnet_mobility": partnet_mobility,
    "shape2motion": shape2motion,
    "annotated_urdf": annotated_urdf,
    "artiverse": artiverse,
    "usd": usd,
    "mjcf": mjcf,
    "urdf": urdf_files,
    "procedural": procedural,
}
"""By the name that source.yaml gives; where two detect the same, the first one has it."""

UNWRITABLE = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")  # what no manifest can hold of a path

_TABLE = plugins.Table(
    "articugen.readers", READERS, ("detect", "find", "load"), "reader", InvalidSource
)
names, check_name = _TABLE.names, _TABLE.check


def reader(name: str) -> Reader:
    """Return the reader of that name; InvalidSource if there is none, BrokenPlugin if it is another
    package's and cannot be used."""
    return _TABLE.load(name)


def detect(path: Path) -> Found | None:
    """Return the model that a file or folder is, by the first reader that says so; InvalidSource
    where one fails at it."""
    for name, layout in (READERS | _TABLE.load_all()).items():
        with _examining(path, f"the reader {name!r} cannot examine it"):
            model = layout.detect(path)
        if model:
            return replace(model, reader=name)
    return None


def find(name: str, base: Path) -> list[Found]:
    """Return the models in `base` that the reader of that name finds; raises as `reader` and
    `detect`."""
    of_all = getattr(reader(name), "find", None)
    if of_all is None:
        return [model for child in visible(base) for model in find_at(name, child)]
    with _examining(base, f"the reader {name!r} cannot examine it"):
        return [replace(model, reader=name) for model in of_all(base)]


def find_at(name: str, child: Path) -> list[Found]:
    """Return what `find` makes of one thing in a folder, or InvalidSource; nothing where the reader
    is another package's, which knows whole folders alone."""
    if name not in READERS:
        return []
    more = getattr(READERS[name], "find_at", None)  # where there may be several, or other marks
    with _examining(child, f"the reader {name!r} cannot examine it"):
        models = more(child) if more else [READERS[name].detect(child)]
        return [replace(model, reader=name) for model in models if model]


@contextmanager
def _examining(path: Path, fault: str) -> Iterator[None]:
    """Make a refusal, with that `fault`, of whatever nobody thought of as `path` is examined."""
    try:
        yield
    except (ArticugenError, MemoryError):
        raise
    except Exception as error:
        reason = printable(f"{type(error).__name__}: {error}")[:200]
        cure = "correct it" if isinstance(error, ValueError) else "report it, please"
        raise machine_fault(error) or InvalidSource(
            f"{printable(str(path))}: {fault} ({reason}); leave it out, or {cure}"
        ) from error


def load(ref: ObjectRef, *, colours: bool = False) -> ArticulatedObject:
    """Read one object with its reader, or make it; with its `colours`, whose files count in its
    digest, where that is wanted. Of a stranger's model whatever nobody thought of
    is the model's fault, so that it takes no other object along.

    Its digest covers what source.yaml says of how it stands and moves.

    Raises:
        InvalidSource: anything amiss with its name or files.
        BrokenPlugin: the reader is another package's and cannot be used.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    from articugen.meshes.looks import with_looks  # noqa: PLC0415 - slow to import

    with with_looks(wanted=colours) as looks:
        obj = reader(ref.reader).load(ref, ref.settings) if ref.is_made else _read(ref)
    obj = replace(obj, notes=(*obj.notes, *map(printable, looks.notes())))
    settings = ref.settings.said()
    if settings == CategorySettings().said():
        return obj
    digest = hashlib.sha256(f"{obj.sha256} {settings}".encode()).hexdigest()
    return replace(obj, sha256=digest)


def digest(ref: ObjectRef, *, colours: bool = False) -> str:
    """Return the sha256 that `load` gives a sound object, without making anything of its meshes; of
    one whose meshes are unsound, some digest of its files. Raises as `load`."""
    from articugen.meshes.read import wanting  # noqa: PLC0415 - slow to import

    with wanting("hash"):
        return load(ref, colours=colours).sha256


def _read(ref: ObjectRef) -> ArticulatedObject:
    where = printable(str(ref.location))
    if UNWRITABLE.search(str(ref.location)):
        raise InvalidSource(
            f"{where}: its name has control characters or is not UTF-8; rename the file or folder"
        )
    if len(ref.object_id.encode()) > MAX_NAME_BYTES:
        raise InvalidSource(f"{where}: its id has more than {MAX_NAME_BYTES} bytes; shorten names")
    with _examining(ref.location, "cannot be read"):
        obj = reader(ref.reader).load(ref, ref.settings)
    check_sound(obj, where)
    return replace(obj, notes=tuple(map(printable, obj.notes)))


def check_sound(obj: ArticulatedObject, where: str) -> None:
    """Raise InvalidSource unless numbers are finite, of a size that floats can work with, and
    ranges have their ends in order, whatever reader has made them."""

    def check(sound: bool, what: str, name: str, sentence: str) -> None:
        if not sound:
            raise InvalidSource(f"{where}: {what} {printable(name)}: {sentence}")

    far = f"is not finite, or beyond {MAX_METRES:,.0f} metres; correct it"
    for link in obj.links:
        vertices, faces = link.mesh.vertices, link.mesh.faces
        near = bool((np.abs(vertices) <= MAX_METRES).all())
        check(near, "link", link.name, f"a coordinate {far}")
        there = not faces.size or 0 <= faces.min() <= faces.max() < len(vertices)
        check(there, "link", link.name, "a face names a vertex that is not there; correct it")
    for joint in obj.joints:
        near = bool((np.abs(joint.T_parent_joint) <= MAX_METRES).all())
        check(near, "joint", joint.name, f"where it stands {far}")
        ends = f"its range is {joint.lower:g} to {joint.upper:g}; name the lesser end first"
        check(joint.lower <= joint.upper, "joint", joint.name, ends)
