"""The folder that an export goes to: whose it is, what is finished in it, files written whole."""

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
from articugen.core.ledger import LEDGER, Ledger
from articugen.core.place import Folder
from articugen.export.items import Options

REPORT_NAME = "export.json"
_MOST_BYTES = 1 << 30
_DAMAGED = (ValueError, KeyError, TypeError, AttributeError, RecursionError)
"""Raised by JSON that is not ours."""

_TWICE = (
    "{}: two things would be called so; rename an object or a split, or export the splits one by "
    "one"
)


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


def npz(arrays: Mapping[str, ArrayLike], *, compressed: bool = False) -> bytes:
    """Return an .npz file, the same bytes for the same arrays: those of `np.savez` depend on the
    version of Python, whose headers of files that may be large have changed."""
    data, how = io.BytesIO(), zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(data, "w") as file:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array))
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getbuffer(), how)
    return data.getvalue()


class Files:
    """Files that are written to the folder of an export, each whole.

    Attributes:
        folder: where it is.
        options: what was chosen.
        files: those that are written.
    """

    def __init__(self, folder: Path, options: Options) -> None:
        self.folder, self.options = folder, options
        self.files: list[Written] = []
        self._names: set[str] = set()

    def write(self, name: str, data: bytes) -> None:
        """Write a file of the item; `name` is from the folder on, with slashes."""
        path = self._path(name)
        write_atomically(path, data)
        self.files.append(Written(name, len(data), hashlib.sha256(data).hexdigest()))

    def write_arrays(self, name: str, arrays: Mapping[str, ArrayLike]) -> None:
        """Write an .npz of arrays, the same bytes for the same arrays."""
        self.write(name, npz(arrays))

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file, indented."""
        self.write(name, json.dumps(value, indent=1).encode() + b"\n")

    def write_lines(self, name: str, lines: Iterable[str]) -> None:
        """Write a text file of lines."""
        self.write(name, "".join(f"{line}\n" for line in lines).encode())

    @contextmanager
    def opened(self, name: str) -> Iterator[BinaryIO]:
        """Yield a file of the item, to write and read, for data larger than one instance."""
        path = self._path(name)
        with written_atomically(path) as file:
            yield file
        self.files.append(Written(name, path.stat().st_size, sha256_of(path)))

    def _path(self, name: str) -> Path:
        """Return the path of a file in the folder: through no link, in place of no other file of
        the item; `Target.finished` compares items."""
        try:
            path = within(self.folder, name)
            make_folder(path.parent)
        except UnfitFile as error:
            raise ArticugenError(f"{self.folder}: not written: {error.strerror}") from None
        except OSError as error:
            raise MachineFault(cannot_write(self.folder / name, error)) from error
        if name.split("/", maxsplit=1)[0] in (REPORT_NAME, LEDGER):
            raise ArticugenError(_TWICE.format(path))
        self._claim(name)
        return path

    def _claim(self, name: str) -> None:
        if name in self._names:
            raise ArticugenError(_TWICE.format(self.folder / name))
        self._names.add(name)


class Target(Files):
    """A folder that one export, and no other, writes to: whoever makes this keeps it `locked`.

    Attributes:
        done: by the item's key.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], options: Options) -> None:
        """Take the folder, which is there and may hold a part of the same export.

        Args:
            about: what distinguishes this export from others: format, data, options.

        Raises:
            ArticugenError: it holds something else.
            MachineFault: it cannot be written to.
        """
        super().__init__(folder, options)
        self.done: dict[str, Done] = {}
        self.complete = False
        self._about = {**about, "options": asdict(options)}
        self._ledger = Ledger(Folder(folder))
        self._resume(set(os.listdir(folder)))

    def _resume(self, names: set[str]) -> None:
        """Read what is finished already, and remove what a killed run was writing."""
        if REPORT_NAME in names:
            self._read_report(self.folder / REPORT_NAME)
            if LEDGER in names:  # the run that wrote the report was killed after it
                self._remove_partial_files()
                self._ledger.seal(())
            return
        others = names - {LEDGER}
        if others and self._ledger.agreed() is None:
            raise ArticugenError(
                f"{self.folder}: holds something else ({min(others)}); choose an empty or new "
                "folder"
            )
        about = json.dumps(self._about).encode()
        self._check(None if self._ledger.agree(about) != about else self._about)
        for item, record in self._ledger.known().items():
            with suppress(*_DAMAGED):  # then the item is written again
                self._believe(item, json.loads(record))
        self._remove_partial_files()

    def _read_report(self, path: Path) -> None:
        """Read the report of a finished export; export.json of others may hold anything."""
        try:
            report = json.loads(read_regular(path, _MOST_BYTES))
            self._check(report["about"])
            files = tuple(map(Written.of, report["files"]))
            self.done = {"": Done(files)} | {k: Done((), v) for k, v in report["left_out"].items()}
        except (UnfitFile, *_DAMAGED):
            self._check(None)
        self.complete = True

    def _check(self, about: object) -> None:
        if about != json.loads(json.dumps(self._about)):
            raise ArticugenError(
                f"{self.folder}: holds an export of other data or to another format, or with other "
                "options; choose another folder"
            )

    def _believe(self, item: str, record: Mapping[str, Any]) -> None:
        """Count an item as done while its files are there in full."""
        files = tuple(map(Written.of, record["files"]))
        for file in files:
            try:
                path = within(self.folder, file.name)
            except UnfitFile:
                return
            if not path.is_file() or path.stat().st_size != file.bytes:
                return
        self.done[item] = Done(files, record["left_out"])
        self._names |= {file.name for file in files}

    def _remove_partial_files(self) -> None:
        for path in self.folder.rglob(".*.partial"):
            if whole_name(path.name) and path.is_file():
                path.unlink(missing_ok=True)

    def withdraw(self, *, is_new: bool) -> None:
        """Leave nothing if nothing was written: no ledger, and no folder that was not there."""
        with suppress(OSError, ArticugenError):
            if os.listdir(self.folder) == [LEDGER]:
                self._ledger.seal(())
                if is_new:
                    self.folder.rmdir()

    def finished(self, item: str, files: Sequence[Written], left_out: str | None) -> None:
        """Note that an item is done, with its files; ArticugenError if another one has such a
        file."""
        for file in files:
            self._claim(file.name)
        self.done[item] = Done(tuple(files), left_out)
        record = {"files": [asdict(file) for file in files], "left_out": left_out}
        self._ledger.record(item, json.dumps(record).encode())

    @property
    def written(self) -> list[Written]:
        """The files of all items that are done, and those of none, by name."""
        files = [file for done in self.done.values() for file in done.files]
        return sorted({f.name: f for f in [*files, *self.files]}.values(), key=lambda f: f.name)

    def seal(self) -> None:
        """Write the report, after which the export counts as complete."""
        report = {
            "about": self._about,
            "files": [asdict(file) for file in self.written],
            "left_out": {key: done.left_out for key, done in self.done.items() if done.left_out},
        }
        text = json.dumps(report, indent=1, ensure_ascii=False) + "\n"
        self._ledger.seal([(REPORT_NAME, text.encode())])
