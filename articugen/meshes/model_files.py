"""The files of one model: found by the names a URDF uses, confined to the model, read and hashed.

A model may come from a stranger, so a name that leads out of the model's folder is refused, through
symbolic links too. The one exception is ROS's `package://name/...`: it may lead into the folder of
that package, no higher than the folder that somebody named.
Only regular files are read, and none whose size has not been checked.
"""

import errno
import hashlib
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path

from articugen.core.errors import InvalidSource, machine_fault
from articugen.core.files import read_regular
from articugen.meshes.xml_strict import parse_xml

MAX_FILE_BYTES = 128 * 2**20  # no file of a model is larger; the largest real ones are a few MiB
MAX_MODEL_BYTES = 256 * 2**20  # nor are all files of a model together
MAX_TEXT_BYTES = 4 * 2**20
"""Nor are the files that describe it: URDF, JSON, package.xml; the largest real one has 1 MiB."""
MAX_HEADER_BYTES = 2**16  # of a PLY
MAX_NAME_BYTES = 255
"""Of a file on most file systems, and of what a shard calls an object, a joint or a part."""

_CURES = {
    errno.ENOENT: "put the file there",
    errno.EACCES: "make it readable",
    errno.EFBIG: "simplify it",
    errno.EINVAL: "put a regular file there",
}


class ModelFiles:
    """Finds, reads and remembers the files of one model.

    Args:
        folder: where relative names start, for instance the URDF's folder.
        root: the model's folder, which no file may leave; by default `folder`.
        top: the highest folder that may be the package of a `package://`; by default `root`.
    """

    def __init__(self, folder: Path, root: Path | None = None, top: Path | None = None) -> None:
        self.folder = _real(folder)
        self.root = _real(root or folder)
        self.top = _real(top) if top else self.root
        self._digests: dict[str, bytes] = {}
        self._packages: dict[str, Path] = {}
        self._bytes = 0

    def find(self, name: str, by: str = "") -> Path | None:
        """Return the real path of what a model calls `name`, or None where there is no such file.

        An absolute path from somebody else's machine stands for the file of that name in `folder`.

        Args:
            name: as the model has it.
            by: the file and element that name it, for messages; by default `folder`.

        Raises:
            InvalidSource: no file can have the name, it leads out of the model, or is of a scheme
                other than package:// and file://, or its package is unknown.
            MachineFault, MemoryError: the disk does not answer, or the like.
        """
        by = f"{by or self.folder}: file {quoted(name)}"
        try:
            longest = max(map(len, name.encode().split(b"/")))
        except UnicodeEncodeError:  # a lone surrogate
            longest = 0
        if not longest or "\0" in name:
            raise InvalidSource(f"{by} is no name of a file; correct it")
        if longest > MAX_NAME_BYTES:
            raise InvalidSource(f"{by} has a name of more than {MAX_NAME_BYTES} bytes; shorten it")
        scheme, separator, rest = name.partition("://")
        if not separator or scheme == "file":
            return self._find_path(rest if separator else name, by)
        if scheme == "package":
            package, _, inside = rest.partition("/")
            if package in ("", ".", ".."):
                raise InvalidSource(f"{by} has no name of a package after package://; add it")
            if package not in self._packages:
                self._packages[package] = self._search_package(package, by)
            folder = self._packages[package]
            return _existing(_confined(folder / inside, folder, by))
        if scheme in ("http", "https", "ftp"):
            raise InvalidSource(
                f"{by} is on the network, and nothing is fetched; save it in {self.folder} and name"
                " it by its relative path"
            )
        raise InvalidSource(
            f"{by} is of an unknown kind, {quoted(scheme)}; use a relative path or package://"
        )

    def read(self, path: Path, most_bytes: int | None = None) -> bytes:
        """Read a file of the model; they count in `sha256`.

        Args:
            path: what `find` gave, or a file that the model has by its layout.
            most_bytes: that it may have, by default MAX_FILE_BYTES.

        Raises:
            InvalidSource: no regular file, unreadable or too large, a symbolic link that leads out
                of the model, or all files of the model together are too large.
            MachineFault, MemoryError: the disk does not answer, or the like.
        """
        real = _real(path)
        if not any(real.is_relative_to(folder) for folder in (self.root, *self._packages.values())):
            raise InvalidSource(
                f"{path}: is a symbolic link out of the model's folder {self.root}; put the file "
                "itself there, or link the whole folder"
            )
        data = read_source(path, MAX_FILE_BYTES if most_bytes is None else most_bytes)
        relative = Path(os.path.relpath(real, self.root)).as_posix()
        self._bytes += 0 if relative in self._digests else len(data)
        if self._bytes > MAX_MODEL_BYTES:
            raise InvalidSource(
                f"{path}: with it the model's files have more than {MAX_MODEL_BYTES // 2**20} MiB; "
                "simplify its meshes"
            )
        self._digests[relative] = hashlib.sha256(data).digest()
        return data

    def sha256(self) -> str:
        """Return the hex digest over names (relative to the root) and bytes of every file read so
        far.

        Neither the order of reading nor the place of the model on the disk matters.
        """
        total = hashlib.sha256()
        for name, digest in sorted(self._digests.items()):
            total.update(name.encode(errors="surrogateescape") + b"\0" + digest)
        return total.hexdigest()

    def _find_path(self, name: str, by: str) -> Path | None:
        path = Path(name)
        if path.is_absolute():
            here = _real(path)
            if here.is_relative_to(self.root) and os.path.isfile(here):
                return here
            path = Path(path.name)
        return _existing(_confined(self.folder / path, self.root, by))

    def _search_package(self, name: str, by: str) -> Path:
        """Find the folder of a ROS package, in the root or one above it up to `top`: the nearest
        above the model whose package.xml says so, or one that is merely called like the package: a
        folder of the model's path, or one directly in the root or in a folder above."""
        above = [f for f in (self.folder, *self.folder.parents) if self._is_ours(f)]
        for folder in above:
            if _package_name(folder / "package.xml") == name:
                return folder
        beyond = [f for f in above if not f.is_relative_to(self.root)]
        called = [f for f in above if f not in beyond]
        called += [self.root / name, *(path for f in beyond for path in (f, f / name))]
        for folder in called:
            real = _real(folder)
            if folder.name == name and os.path.isdir(real) and self._is_ours(real):
                return real
        raise InvalidSource(
            f"{by} is of a package that is not found: no folder above, up to {self.top}, has a "
            f"package.xml of the name {quoted(name)}, is called so or holds such a folder; put the "
            "package there, or name its folder as the source"
        )

    def _is_ours(self, folder: Path) -> bool:
        return folder.is_relative_to(self.root) or folder.is_relative_to(self.top)


class FilesInMemory(ModelFiles):
    """The files of a model that is in no folder, by their names."""

    def __init__(self, contents: Mapping[str, bytes]) -> None:
        super().__init__(Path())
        self._contents = contents

    def find(self, name: str, by: str = "") -> Path | None:
        return Path(name) if name in self._contents else None

    def read(self, path: Path, most_bytes: int | None = None) -> bytes:
        data = self._contents[path.name]
        self._digests[path.name] = hashlib.sha256(data).digest()
        return data


def read_source(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a regular file; InvalidSource if it is none; or MachineFault."""
    try:
        return read_regular(path, most_bytes)
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> Exception:
    """Return the error to raise where the file `path` of a model cannot be read, by whose fault it
    is."""
    cure = _CURES.get(error.errno or 0, "correct it, or put a regular file there")
    return machine_fault(error) or InvalidSource(
        f"{path}: cannot be read: {error.strerror or error}; {cure}"
    )


def claimed_rows(data: bytes) -> dict[str, int]:
    """Return how many rows of each element the header of a PLY file claims, by the element's name.

    A row takes at least one byte a property, so that no header can claim more rows than the file
    has bytes.

    Raises:
        ValueError: there is no header, or it claims more than that.
    """
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    header = data[: end + 1].decode("ascii", "replace")
    if not header.startswith("ply"):
        raise ValueError("has no PLY header")
    claimed = {name: float(count) for name, count in re.findall(r"element (\w+) (\d+)", header)}
    if any(count > len(data) for count in claimed.values()):
        raise ValueError("its PLY header claims more than the file holds")
    return {name: int(count) for name, count in claimed.items()}


def quoted(text: str) -> str:
    """Return a stranger's text in quotes, on one line and not too long."""
    return repr(text if len(text) <= 100 else f"{text[:97]}...")


def _confined(path: Path, folder: Path, by: str) -> Path:
    real = _real(path)
    if not real.is_relative_to(folder):
        raise InvalidSource(
            f"{by} leads out of {folder}; copy the file into that folder and name it there"
        )
    return real


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _existing(path: Path) -> Path | None:
    """`path`, unless nothing or a folder is there; `read` refuses what else is no regular file."""
    try:
        return None if stat.S_ISDIR(os.stat(path).st_mode) else path
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise unreadable(path, error) from error


def _package_name(path: Path) -> str | None:
    """Return the name of a package by its package.xml; None where there is none that can be
    read."""
    try:
        return parse_xml(read_source(path, MAX_TEXT_BYTES), path).findtext("name", "").strip()
    except InvalidSource:
        return None
