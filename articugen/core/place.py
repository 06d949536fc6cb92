"""Places that files are kept in: a folder here, an object store in `store.bucket`."""

import errno
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Protocol, TypeVar

from articugen.core.errors import MachineFault
from articugen.core.files import (
    UnfitFile,
    cannot_write,
    make_folder,
    partial_name,
    read_regular,
    sync,
    within,
    write_atomically,
    writing,
)

R = TypeVar("R")

_MOST_BYTES = 1 << 28  # of a file that is read as a whole
_TRIES = 50  # of a write whose folder somebody else has just emptied and removed


@dataclass(frozen=True)
class Listed:
    """A listed file: its size, and when it was written by the place's own clock."""

    bytes: int
    written: float


class Place(Protocol):
    """A folder of files that are whole or not there. Names have slashes, from the folder on.

    Whatever fails for the machine's sake is raised as `MachineFault`.

    Attributes:
        at_once: requests worth having under way at the same time.
    """

    at_once: int

    def __str__(self) -> str:
        """Name the place for people: a path, an address."""
        ...

    def read(self, name: str) -> bytes | None:
        """Read a file; None where there is none.

        Raises:
            UnfitFile: it is no regular file, or lies behind a link.
        """
        ...

    def write(self, name: str, data: bytes) -> None:
        """Write a file, instead of any that was there."""
        ...

    def write_new(self, name: str, data: bytes) -> bool:
        """Write a file unless there is one; whether it holds `data` now. Of many processes that do
        so at once, with different data, one is answered True."""
        ...

    def list(self, under: str = "") -> Mapping[str, Listed]:
        """List the files below the folder `under`, by their names from there on."""
        ...

    def delete(self, names: Iterable[str]) -> None:
        """Remove files in this order; one that is not there is no fault."""
        ...


def read_all(place: Place, names: Iterable[str]) -> Iterator[bytes | None]:
    """Read many small files, in their order; b"" stands for what cannot be read as a file."""

    def read(name: str) -> bytes | None:
        try:
            return place.read(name)
        except UnfitFile:
            return b""

    if place.at_once == 1:
        yield from map(read, names)
        return
    with ThreadPoolExecutor(place.at_once) as pool:
        yield from pool.map(read, names)


@dataclass(frozen=True)
class Folder:
    """A folder of this machine, or of a network's file system. No link in it is followed."""

    path: Path
    at_once = 1

    def __str__(self) -> str:
        return str(self.path)

    def read(self, name: str) -> bytes | None:
        path = within(self.path, name)
        try:
            return read_regular(path, _MOST_BYTES, follow=False)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except UnfitFile:
            raise
        except OSError as error:
            raise MachineFault(f"{path}: cannot be read ({error.strerror})") from None

    def write(self, name: str, data: bytes) -> None:
        self._in_its_folder(name, data, lambda path: write_atomically(path, data))

    def write_new(self, name: str, data: bytes) -> bool:
        return self._in_its_folder(name, data, lambda path: self._write_new(path, name, data))

    def _write_new(self, path: Path, name: str, data: bytes) -> bool:
        aside = path.with_name(partial_name(path.name))
        try:
            try:
                _write_exclusively(aside, data)
                try:
                    os.link(aside, path)
                except FileExistsError:
                    return self.read(name) == data
                except OSError as error:
                    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOENT):
                        raise
                    _write_exclusively(path, data)  # a file system without links
            finally:
                aside.unlink(missing_ok=True)
            sync(path.parent)
        except FileExistsError:
            return self.read(name) == data
        except UnfitFile:
            return False
        except OSError as error:
            raise MachineFault(cannot_write(path, error, len(data))) from error
        return True

    def list(self, under: str = "") -> Mapping[str, Listed]:
        files: dict[str, Listed] = {}

        def add(folder: Path, before: str) -> None:
            for entry in os.scandir(folder):
                if entry.is_dir(follow_symlinks=False):
                    add(folder / entry.name, f"{before}{entry.name}/")
                elif entry.is_file(follow_symlinks=False):
                    with suppress(FileNotFoundError):
                        about = entry.stat(follow_symlinks=False)
                        files[before + entry.name] = Listed(about.st_size, about.st_mtime)

        try:
            with suppress(FileNotFoundError, NotADirectoryError):
                add(within(self.path, under) if under else self.path, "")
        except OSError as error:
            where = self.path / under
            raise MachineFault(f"{where}: cannot be read ({error.strerror})") from None
        return files

    def delete(self, names: Iterable[str]) -> None:
        folders: set[Path] = set()
        with writing(self.path):
            for folder, paths in groupby(map(self._path, names), lambda path: path.parent):
                for path in paths:
                    with suppress(FileNotFoundError, NotADirectoryError):
                        path.unlink()
                folders.update(p for p in (folder, *folder.parents) if self.path in p.parents)
                with suppress(FileNotFoundError, NotADirectoryError):
                    sync(folder)
            for folder in sorted(folders, reverse=True):
                with suppress(OSError):  # others have files in it
                    folder.rmdir()

    def _in_its_folder(self, name: str, data: bytes, act: Callable[[Path], R]) -> R:
        """Call `act` with the path of a file to write, once its folder is there; again where
        another process has removed that, empty, in between."""
        tries = _TRIES
        while True:
            try:
                with writing(self.path / name, len(data)):
                    path = self._path(name)
                    make_folder(path.parent)
                return act(path)
            except MachineFault as fault:
                tries -= 1
                if not (tries and isinstance(fault.__cause__, FileNotFoundError)):
                    raise

    def _path(self, name: str) -> Path:
        """Return the path of a file to replace or remove: a link itself, not where it leads."""
        above, _, last = name.rpartition("/")
        if "\0" in last or not last.strip("."):
            raise UnfitFile(errno.EINVAL, f"{name!r} is no name of a file in it")
        return (within(self.path, above) if above else self.path) / last


def _write_exclusively(path: Path, data: bytes) -> None:
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
