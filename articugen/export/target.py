"""The folder that an export goes to: whose it is, what is finished in it, files written whole."""

import fcntl
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from articugen.core.errors import ArticugenError, MachineFault
from articugen.core.files import (
    UnfitFile,
    cannot_write,
    make_folder,
    read_regular,
    sha256_of,
    whole_name,
    within,
    write_atomically,
    written_atomically,
)
from articugen.export.items import Options
from articugen.export.parts import PartMeshes

JOURNAL_NAME = ".articugen-export.jsonl"
REPORT_NAME = "export.json"
_MOST_BYTES = 1 << 30


@dataclass(frozen=True)
class Written:
    """A file of an export: its name from the folder on, with slashes; its size and digest."""

    name: str
    bytes: int
    sha256: str

    @staticmethod
    def of(noted: Mapping[str, Any]) -> "Written":
        """Read a record; ValueError if it leads out of the folder."""
        name = PurePosixPath(noted["name"])
        if name.is_absolute() or ".." in name.parts:
            raise ValueError(f"{name} is not in the folder")
        return Written(str(noted["name"]), int(noted["bytes"]), str(noted["sha256"]))


@dataclass(frozen=True)
class Done:
    """An item that is finished: the files it became, or why it was left out."""

    files: tuple[Written, ...]
    left_out: str | None = None


class Target:
    """A folder that one export, and no other, writes to.

    Attributes:
        folder: where it is.
        options: what was chosen.
        meshes: the parts of the objects.
        done: by the item's key.
    """

    def __init__(
        self, folder: Path, about: Mapping[str, Any], options: Options, meshes: PartMeshes
    ) -> None:
        """Take the folder, which may hold a part of the same export.

        Args:
            about: what tells this export from others: format, data, options.

        Raises:
            ArticugenError: it holds something else, or another process exports into it.
            MachineFault: it cannot be written to.
        """
        self.folder, self.options, self.meshes = folder, options, meshes
        self.done: dict[str, Done] = {}
        self.complete = False
        self._about = {**about, "options": asdict(options)}
        self._files: list[Written] = []
        self._names: set[str] = set()
        self._journal: BinaryIO | None = None
        self._is_new = not folder.exists()
        try:
            make_folder(folder)
            self._take()
        except OSError as error:
            raise MachineFault(cannot_write(folder, error)) from error

    def _take(self) -> None:
        names = sorted(os.listdir(self.folder))
        if REPORT_NAME in names:
            self._take_over(self.folder / REPORT_NAME)
            if JOURNAL_NAME in names:  # the run that wrote the report was cut short after it
                with suppress(OSError):
                    self._tidy()
                    (self.folder / JOURNAL_NAME).unlink()
            return
        if JOURNAL_NAME not in names:
            self._refuse(names)
        # Whatever lies there, no other file is written to, and nobody is waited for.
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        self._journal = os.fdopen(os.open(self.folder / JOURNAL_NAME, flags, 0o666), "a+b")
        try:
            fcntl.flock(self._journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise ArticugenError(
                f"{self.folder}: another export is writing there; wait for it, or choose another "
                "folder"
            ) from None
        self._journal.seek(0)
        lines = self._journal.read().split(b"\n")
        if len(lines) == 1:  # new, or cut short before its first line was whole
            self._refuse(names)
            self._journal.truncate(0)
            self._note(self._about)
            return
        try:
            self._check(json.loads(lines[0]))
            for line in lines[1:-1]:
                self._believe(json.loads(line))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            self.close()
            raise ArticugenError(
                f"{self.folder / JOURNAL_NAME}: is damaged; delete the folder and export again"
            ) from None
        self._journal.truncate(sum(len(line) + 1 for line in lines[:-1]))  # what a kill tore
        self._tidy()

    def _refuse(self, names: list[str]) -> None:
        """See to it that nothing but a journal is there."""
        others = [name for name in names if name != JOURNAL_NAME]
        if others:
            self.close()
            raise ArticugenError(
                f"{self.folder}: holds something else ({others[0]}); choose an empty or new folder"
            )

    def _take_over(self, path: Path) -> None:
        """Read the record of a finished export; a foreign export.json may hold anything."""
        try:
            report = json.loads(read_regular(path, _MOST_BYTES))
            self._check(report["about"])
            files = tuple(map(Written.of, report["files"]))
            self.done = {"": Done(files)} | {k: Done((), v) for k, v in report["left_out"].items()}
        except (UnfitFile, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            self._check(None)
        self.complete = True

    def _check(self, found: object) -> None:
        if found != json.loads(json.dumps(self._about)):
            raise ArticugenError(
                f"{self.folder}: holds an export of other data or to another format, or with other "
                "options; choose another folder"
            )

    def _believe(self, noted: Mapping[str, Any]) -> None:
        """An item counts as done while its files are there in full."""
        files = tuple(map(Written.of, noted["files"]))
        for file in files:
            try:
                path = within(self.folder, file.name)
            except UnfitFile:
                return
            if not path.is_file() or path.stat().st_size != file.bytes:
                return
        self.done[noted["item"]] = Done(files, noted["left_out"])
        self._names |= {file.name for file in files}

    def _tidy(self) -> None:
        """Remove what a killed run was writing."""
        for path in self.folder.rglob(".*.partial"):
            if whole_name(path.name) and path.is_file():
                path.unlink()

    def close(self) -> None:
        """Let others into the folder."""
        if self._journal is not None:
            with suppress(OSError):  # a full disk does not take what is left to be written
                self._journal.close()
            self._journal = None

    def withdraw(self) -> None:
        """Leave nothing if nothing was written: no journal, and no folder that was not there."""
        with suppress(OSError):
            if self._journal is not None and os.listdir(self.folder) == [JOURNAL_NAME]:
                (self.folder / JOURNAL_NAME).unlink()
                if self._is_new:
                    self.folder.rmdir()

    def write(self, name: str, data: bytes) -> None:
        """Write a file of the item at hand; `name` is from the folder on, with slashes."""
        path = self._path(name)
        write_atomically(path, data)
        self._files.append(Written(name, len(data), hashlib.sha256(data).hexdigest()))

    def write_arrays(self, name: str, arrays: Mapping[str, ArrayLike]) -> None:
        """Write an .npz of arrays, the same bytes for the same arrays."""
        data = io.BytesIO()
        plain: dict[str, Any] = {key: np.asarray(value) for key, value in arrays.items()}
        np.savez(data, **plain)
        self.write(name, data.getvalue())

    @contextmanager
    def opened(self, name: str) -> Iterator[BinaryIO]:
        """A file of the item at hand, to write and read, for what is larger than one instance."""
        path = self._path(name)
        with written_atomically(path) as file:
            yield file
        self.adopt(name)

    def adopt(self, name: str) -> None:
        """Count a file that a library wrote as one of the item at hand."""
        path = self.folder / name
        self._files.append(Written(name, path.stat().st_size, sha256_of(path)))

    def _path(self, name: str) -> Path:
        """Where a file goes: into the folder, through no link, in the place of no other file."""
        try:
            path = within(self.folder, name)
            make_folder(path.parent)
        except UnfitFile as error:
            raise ArticugenError(f"{self.folder}: not written: {error.strerror}") from None
        except OSError as error:
            raise MachineFault(cannot_write(self.folder / name, error)) from error
        if name in self._names or name in (REPORT_NAME, JOURNAL_NAME):
            raise ArticugenError(
                f"{path}: two things would be called so; rename an object or a split, or export "
                "the splits one by one"
            )
        self._names.add(name)
        return path

    def finished(self, item: str, left_out: str | None = None) -> None:
        """Note that an item is done: with the files written since the last one."""
        files = () if left_out else tuple(self._files)
        self._files = []
        self.done[item] = Done(files, left_out)
        noted = {"item": item, "files": [asdict(file) for file in files], "left_out": left_out}
        self._note(noted)

    def _note(self, line: Mapping[str, Any]) -> None:
        assert self._journal is not None
        try:
            self._journal.write(json.dumps(line).encode() + b"\n")
            self._journal.flush()
            os.fsync(self._journal.fileno())
        except OSError as error:
            raise MachineFault(cannot_write(self.folder / JOURNAL_NAME, error)) from error

    @property
    def written(self) -> list[Written]:
        """The files of all items that are done, and those written since, by name."""
        files = [file for done in self.done.values() for file in done.files]
        return sorted({f.name: f for f in [*files, *self._files]}.values(), key=lambda f: f.name)

    def seal(self) -> None:
        """Write the report, after which the export counts as complete."""
        report = {
            "about": self._about,
            "files": [asdict(file) for file in self.written],
            "left_out": {key: done.left_out for key, done in self.done.items() if done.left_out},
        }
        text = json.dumps(report, indent=1, ensure_ascii=False) + "\n"
        write_atomically(self.folder / REPORT_NAME, text.encode())
        self.close()
        with suppress(FileNotFoundError):
            (self.folder / JOURNAL_NAME).unlink()
