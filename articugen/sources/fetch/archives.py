"""Archives from strangers: what is in a .zip or .tar.gz, examined whole before a byte is written.

An archive with a name that leads out of a folder, a link, a device, or more in it than a bound
allows is refused as a whole: what tries such a thing is not to be trusted with the rest.
"""

import gzip
import stat
import sys
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO, NoReturn

from articugen.core.errors import InvalidSource, machine_fault, printable
from articugen.core.files import open_regular
from articugen.meshes.model_files import MAX_NAME_BYTES, quoted

MAX_FILES = 1_000_000  # in one archive; Artiverse's largest has 313,000
MAX_FILE_BYTES = 2**30  # of one file in it
MAX_RATIO = 200
"""How many times its own size an archive may unpack to; OBJ files and textures give 3 to 10."""
MAX_DEPTH = 32
MAX_FOLDERS = 250_000  # in one archive, those included that only the names of others tell of
MAX_DENSITY = 16
"""Bytes of an archive that an entry takes at least, beyond the first `_ALWAYS_ENTRIES`; a header
and some content give more than 60."""

_ALWAYS_ENTRIES = 10_000
_ALWAYS_BYTES = 64 * 2**20  # what any archive may unpack to, small as it is
_MOST_HEADER_BYTES = 2**16
"""Of what a tar tells before one entry: names of 8 kB, attributes of files. `tarfile` takes headers
within each other and the square of a header's length; it is not let to read more."""

_DAMAGED = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, gzip.BadGzipFile, EOFError),
    *(NotImplementedError, ValueError, OverflowError, RecursionError),
)


@dataclass(frozen=True)
class Member:
    """A file in an archive: its name, plain and relative, and its size."""

    name: PurePosixPath
    bytes: int


@dataclass(frozen=True)
class _Entry:
    """What an archive says of something in it; `odd` is what it is that is no file or folder."""

    name: str
    size: int
    folder: bool
    odd: str
    open: Callable[[], IO[bytes] | None]


Archive = Callable[[], Iterator[_Entry]]
"""Goes through an open archive; an entry's bytes are to be read before the next is asked for."""


@contextmanager
def opened(path: Path) -> Iterator[Archive]:
    """An archive, by what its first bytes say that it is.

    Raises:
        InvalidSource: it is none, or damaged; also what its reading raises within the block.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    try:
        with open_regular(path, sys.maxsize) as file:
            start = file.read(4)
            if start[:2] == b"PK":
                with zipfile.ZipFile(file) as archive:
                    yield partial(_zip_entries, archive)
            elif start[:2] == b"\x1f\x8b":
                yield partial(_tar_entries, file)
            else:
                raise InvalidSource(f"{path}: is no .zip or .tar.gz; name one")
    except _DAMAGED as error:
        reason = printable(str(error) or type(error).__name__)[:200]
        raise InvalidSource(f"{path}: is damaged ({reason}); get it again") from error
    except OSError as error:
        raise machine_fault(error) or InvalidSource(
            f"{path}: cannot be read: {error.strerror or error}; correct its path"
        ) from error


def checked_members(archive: Archive, path: Path) -> list[Member]:
    """Return the files of an archive whose names and sizes are all in order, as `contents` will
    have them; InvalidSource, with the entry, if one is not, or together they break a bound."""
    packed = path.stat().st_size
    most_bytes = max(_ALWAYS_BYTES, MAX_RATIO * packed)
    most_entries = min(MAX_FILES, _ALWAYS_ENTRIES + packed // MAX_DENSITY)
    members: list[Member] = []
    files: set[PurePosixPath] = set()
    folders: set[PurePosixPath] = set()
    total = 0
    for count, entry in enumerate(archive(), 1):
        name = _plain_name(entry, path)
        total += max(entry.size, tarfile.BLOCKSIZE)
        if count > most_entries or len(folders) > MAX_FOLDERS:
            raise InvalidSource(
                f"{path}: holds more than {most_entries:,} files or {MAX_FOLDERS:,} folders; "
                "split it, or get it from its authors"
            )
        if total > most_bytes:
            raise InvalidSource(
                f"{path}: unpacks to more than {MAX_RATIO} times its size; it is a trap, or made "
                "wrongly: get it from its authors"
            )
        if name is None:
            continue
        for folder in (name, *name.parents) if entry.folder else name.parents:
            if folder in folders:  # and so are those above it
                break
            folders.add(folder)
        if entry.folder:
            continue
        if name in files:
            _refuse(path, entry.name, "is there twice")
        files.add(name)
        members.append(Member(name, entry.size))
    for name in files & folders:
        _refuse(path, str(name), "is a file and a folder")
    return members


def contents(archive: Archive, path: Path) -> Iterator[tuple[Member, IO[bytes]]]:
    """Yield the files of an archive with their bytes, checked again as by `checked_members`; each
    must be read before the next."""
    for entry in archive():
        name = _plain_name(entry, path)
        if name is not None and not entry.folder and (data := entry.open()):
            with data:
                yield Member(name, entry.size), data


def _plain_name(entry: _Entry, path: Path) -> PurePosixPath | None:
    """The entry's name, where it is one that can only lie below a folder; None for the folder."""
    name = entry.name
    if entry.odd:
        _refuse(path, name, f"is {entry.odd}")
    if name.startswith("/") or name[1:2] == ":":
        _refuse(path, name, "is an absolute name")
    if "\\" in name or not name.isprintable():
        _refuse(path, name, "has a backslash or a control character in its name")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if ".." in parts:
        _refuse(path, name, "leads out of the folder")
    if len(parts) > MAX_DEPTH or any(len(part.encode()) > MAX_NAME_BYTES for part in parts):
        _refuse(path, name, "has too long a name")
    if not 0 <= entry.size <= MAX_FILE_BYTES:
        _refuse(path, name, f"has more than {MAX_FILE_BYTES // 2**20} MiB")
    return PurePosixPath(*parts) if parts else None


def _refuse(path: Path, name: str, why: str) -> NoReturn:
    raise InvalidSource(
        f"{path}: its entry {quoted(printable(name))} {why}; nothing of it is unpacked, get it "
        "from its authors"
    )


def _zip_entries(archive: zipfile.ZipFile) -> Iterator[_Entry]:
    for info in archive.infolist():
        kind = stat.S_IFMT(info.external_attr >> 16)
        odd = ""
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            odd = "a link" if kind == stat.S_IFLNK else "a device"
        elif info.flag_bits & 0x1:
            odd = "encrypted"
        elif info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            odd = "packed in an unusual way"
        # `filename` ends where a NUL hides the rest; `is_dir` of 3.11 stumbles over no letters
        folder = info.filename.endswith("/")
        yield _Entry(info.orig_filename, info.file_size, folder, odd, partial(archive.open, info))


def _tar_entries(packed: BinaryIO) -> Iterator[_Entry]:
    packed.seek(0)
    file = _Allowed(fileobj=packed, mode="rb")
    archive = tarfile.TarFile(fileobj=file, encoding="utf-8", errors="surrogateescape")
    while info := archive.next():
        archive.members.clear()  # pyright: ignore[reportAttributeAccessIssue] - it would keep all
        sparse = any(key.startswith("GNU.sparse") for key in info.pax_headers)
        odd = ""
        if info.issym() or info.islnk():
            odd = "a link"
        elif not (info.isdir() or info.isreg()) or info.sparse is not None or sparse:
            odd = "a device, or packed in an unusual way"
        file.allowed = max(0, info.size)
        yield _Entry(info.name, info.size, info.isdir(), odd, partial(archive.extractfile, info))
        file.allowed = _MOST_HEADER_BYTES
    file.allowed = sys.maxsize
    while block := file.read(2**18):  # to the end, where gzip has its checksum
        if any(block):  # `tarfile` ends at a damaged header as at the last
            raise tarfile.ReadError("a header of it is damaged")


class _Allowed(gzip.GzipFile):
    """A .gz of which `allowed` bytes are read, and no more; whoever claims more is refused."""

    allowed = _MOST_HEADER_BYTES

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= self.allowed:
            raise tarfile.ReadError("a header of it claims too much")
        data = super().read(size)
        self.allowed -= len(data)
        return data
