"""The files of one model: found by the names a URDF uses, confined to the model, read and hashed.

A model may come from a stranger, so a name that leads out of the model's folder is refused, through
symbolic links too. The one exception is ROS's `package://name/...`: it may lead into the folder
above the URDF that has a package.xml of that name.
"""

import hashlib
import os
from pathlib import Path

from articugen.errors import InvalidSource
from articugen.sources.xml_strict import parse_xml

MAX_FILE_BYTES = 256 * 2**20
"""No file of a model is larger; the largest real ones are a few MiB."""


class ModelFiles:
    """Finds, reads and remembers the files of one model.

    Args:
        folder: where relative names start, for instance the URDF's folder.
        root: the model's folder, which no file may leave; by default `folder`.
    """

    def __init__(self, folder: Path, root: Path | None = None) -> None:
        self.folder = _real(folder)
        self.root = _real(root or folder)
        self._digests: dict[str, bytes] = {}
        self._packages: dict[str, Path] = {}

    def find(self, name: str) -> Path | None:
        """The real path of the file a URDF calls `name`, or None where there is no such file.

        An absolute path from somebody else's machine stands for the file of that name in `folder`.

        Raises:
            InvalidSource: the name leads out of the model, or is of a scheme other than package://
                and file://, or its package is unknown.
        """
        scheme, separator, rest = name.partition("://")
        if not separator:
            return self._find_path(name)
        if scheme == "file":
            return self._find_path(rest)
        if scheme == "package":
            package, _, inside = rest.partition("/")
            folder = self._package(package)
            return _existing(self._confined(folder / inside, folder, name))
        raise InvalidSource(
            f"{self.folder}: mesh {name!r} is of an unknown kind; use a relative path or package://"
        )

    def read(self, path: Path) -> bytes:
        """The bytes of a file that `find` gave; they count in `sha256`.

        Raises:
            InvalidSource: unreadable, or larger than MAX_FILE_BYTES.
        """
        try:
            with path.open("rb") as file:
                data = file.read(MAX_FILE_BYTES + 1)
        except OSError as error:
            raise InvalidSource(f"{path}: cannot be read: {error.strerror}") from None
        if len(data) > MAX_FILE_BYTES:
            limit = MAX_FILE_BYTES // 2**20
            raise InvalidSource(f"{path}: larger than {limit} MiB; simplify it")
        relative = Path(os.path.relpath(path, self.root)).as_posix()
        self._digests[relative] = hashlib.sha256(data).digest()
        return data

    def sha256(self) -> str:
        """The hex digest over names (relative to the root) and bytes of every file read so far.

        Neither the order of reading nor the place of the model on the disk matters.
        """
        total = hashlib.sha256()
        for name, digest in sorted(self._digests.items()):
            total.update(name.encode(errors="surrogateescape") + b"\0" + digest)
        return total.hexdigest()

    def _find_path(self, name: str) -> Path | None:
        path = Path(name)
        if path.is_absolute():
            here = _real(path)
            if here.is_relative_to(self.root) and here.is_file():
                return here
            path = Path(path.name)
        return _existing(self._confined(self.folder / path, self.root, name))

    def _confined(self, path: Path, folder: Path, name: str) -> Path:
        real = _real(path)
        if not real.is_relative_to(folder):
            raise InvalidSource(
                f"{self.folder}: mesh {name!r} leads out of {folder}; copy it into that folder"
            )
        return real

    def _package(self, name: str) -> Path:
        """The folder of a ROS package: an ancestor whose package.xml says so, or one in the root.

        A folder that is merely called like the package counts only where it cannot lead out: the
        root, a folder between it and the URDF, or a folder directly in the root.
        """
        if name in ("", ".", ".."):
            raise InvalidSource(f"{self.folder}: package:// path without the name of a package")
        if name not in self._packages:
            self._packages[name] = self._search_package(name)
        return self._packages[name]

    def _search_package(self, name: str) -> Path:
        ancestors = (self.folder, *self.folder.parents)
        for folder in ancestors:
            if _package_name(folder / "package.xml") == name:
                return folder
        for folder in ancestors:
            if folder.name == name and folder.is_relative_to(self.root):
                return folder
        inside = _real(self.root / name)
        if inside.is_dir() and inside.is_relative_to(self.root):
            return inside
        raise InvalidSource(
            f"{self.folder}: package {name!r} not found: no folder above has a package.xml of that"
            f" name, and there is no folder {self.root / name}; put the package there"
        )


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _existing(path: Path) -> Path | None:
    return path if path.is_file() else None


def _package_name(path: Path) -> str | None:
    """What a package.xml calls its package; None where there is none that can be read."""
    try:
        return parse_xml(path.read_bytes(), path).findtext("name", "").strip()
    except (OSError, InvalidSource):
        return None
