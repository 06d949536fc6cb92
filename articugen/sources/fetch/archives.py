"""Archives from strangers: what is in a .zip or .tar.gz, examined whole before a byte is written.

An archive with a name that leads out of a folder, a link, a device, or more in it than a bound
allows is refused as a whole: what tries such a thing is not to be trusted with the rest.
"""

import gzip
import io
import stat
import sys
import tarfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Protocol

from articugen.core.errors import InvalidSource, machine_fault, printable
from articugen.core.files import open_regular
from articugen.meshes.model_files import MAX_NAME_BYTES, quoted

MAX_FILES = 1_000_000
"""In one archive; Artiverse's largest has 313,000."""
MAX_FILE_BYTES = 2**30
"""Of one file in it."""
MAX_RATIO = 200
"""How many times its own size an archive may unpack to; OBJ files and textures give 3 to 10."""
MAX_DEPTH = 32
MAX_FOLDERS = 250_000
"""In one archive, those included that only the names of others tell of."""
MAX_DENSITY = 16
"""Bytes of an archive that an entry takes at least, beyond the first `_ALWAYS_ENTRIES`; a header
and some content give more than 60."""

_ALWAYS_ENTRIES = 10_000
_BLOCK = tarfile.BLOCKSIZE
"""What a file takes at least, though it be empty."""
_ALWAYS_BYTES = 64 * 2**20
"""What any archive may unpack to, small as it is."""
_MOST_AT_ONCE = 2**20
"""Bytes read in one go: a header that claims a gigabyte of itself is refused."""

_DAMAGED = (zipfile.BadZipFile, tarfile.TarError, zlib.error, gzip.BadGzipFile, EOFError)
_OF_THE_NEXT = (
    *(tarfile.XHDTYPE, tarfile.SOLARIS_XHDTYPE),
    *(tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK),
)
"""Headers in a tar that tell more of the entry after them."""
_MOST_HEADERS = 8
"""Of these in a row; there is need of two."""


@dataclass(frozen=True)
class Member:
    """A file in an archive: its name, plain and relative, and its size."""

    name: PurePosixPath
    bytes: int


@dataclass(frozen=True)
class _Entry:
    """What an archive says of something in it; `odd` is what it is that is no file or folder."""

    name: str
    bytes: int
    folder: bool
    odd: str = ""


class Archive(Protocol):
    """An open archive."""

    def entries(self) -> Iterator[_Entry]:
        """All that is in it."""
        ...

    def contents(self) -> Iterator[tuple[_Entry, BinaryIO]]:
        """Return the same with their bytes; each must be read before the next."""
        ...


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
            file.seek(0)
            if start[:2] == b"PK":
                with zipfile.ZipFile(file) as archive:
                    yield _Zip(archive)
            elif start[:2] == b"\x1f\x8b":
                yield _TarGz(file)
            else:
                raise InvalidSource(f"{path}: is no .zip or .tar.gz; name one")
    except (*_DAMAGED, NotImplementedError, ValueError, RecursionError) as error:
        reason = printable(str(error) or type(error).__name__)[:200]
        raise InvalidSource(f"{path}: is damaged ({reason}); get it again") from error
    except OSError as error:
        raise machine_fault(error) or InvalidSource(
            f"{path}: cannot be read: {error.strerror or error}; correct its path"
        ) from error


def checked_members(archive: Archive, path: Path) -> list[Member]:
    """The files of an archive whose names and sizes are all in order, as `contents` will have them.

    Raises:
        InvalidSource: one is not, or together they break a bound; names the archive and the entry.
    """
    packed = path.stat().st_size
    most_bytes = max(_ALWAYS_BYTES, MAX_RATIO * packed)
    most_entries = min(MAX_FILES, _ALWAYS_ENTRIES + packed // MAX_DENSITY)
    members: list[Member] = []
    files: set[PurePosixPath] = set()
    folders: set[PurePosixPath] = set()
    total = 0
    for count, entry in enumerate(archive.entries(), 1):
        name = _plain_name(entry, path)
        total += max(entry.bytes, _BLOCK)
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
            raise _refused(path, entry.name, "is there twice")
        files.add(name)
        members.append(Member(name, entry.bytes))
    for name in files & folders:
        raise _refused(path, str(name), "is a file and a folder")
    return members


def contents(archive: Archive, path: Path) -> Iterator[tuple[Member, BinaryIO]]:
    """The files of an archive with their bytes, checked again; each must be read before the next.

    Raises:
        InvalidSource: as `checked_members`.
    """
    for entry, data in archive.contents():
        name = _plain_name(entry, path)
        if name is not None and not entry.folder:
            yield Member(name, entry.bytes), data


def _plain_name(entry: _Entry, path: Path) -> PurePosixPath | None:
    """The entry's name, where it is one that can only lie below a folder; None for the folder."""
    name = entry.name
    if entry.odd:
        raise _refused(path, name, f"is {entry.odd}")
    if name.startswith("/") or name[1:2] == ":":
        raise _refused(path, name, "is an absolute name")
    if "\\" in name or not name.isprintable():
        raise _refused(path, name, "has a backslash or a control character in its name")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if ".." in parts:
        raise _refused(path, name, "leads out of the folder")
    if len(parts) > MAX_DEPTH or any(len(part.encode()) > MAX_NAME_BYTES for part in parts):
        raise _refused(path, name, "has too long a name")
    if not 0 <= entry.bytes <= MAX_FILE_BYTES:
        raise _refused(path, name, f"has more than {MAX_FILE_BYTES // 2**20} MiB")
    return PurePosixPath(*parts) if parts else None


def _refused(path: Path, name: str, why: str) -> InvalidSource:
    return InvalidSource(
        f"{path}: its entry {quoted(printable(name))} {why}; nothing of it is unpacked, get it "
        "from its authors"
    )


class _Zip:
    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive

    def entries(self) -> Iterator[_Entry]:
        return map(_zip_entry, self._archive.infolist())

    def contents(self) -> Iterator[tuple[_Entry, BinaryIO]]:
        for info in self._archive.infolist():
            with self._archive.open(info) as data:
                yield _zip_entry(info), data  # pyright: ignore[reportReturnType]


def _zip_entry(info: zipfile.ZipInfo) -> _Entry:
    """`orig_filename` is the whole name: `filename` ends where a NUL hides the rest."""
    kind = stat.S_IFMT(info.external_attr >> 16)
    odd = ""
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        odd = "a link" if kind == stat.S_IFLNK else "a device"
    elif info.flag_bits & 0x1:
        odd = "encrypted"
    elif info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        odd = "packed in an unusual way"
    # `is_dir` of Python 3.11 stumbles over a name of no letters
    folder = info.filename.endswith("/")
    return _Entry(info.orig_filename, info.file_size, folder, odd)


class _TarGz:
    """Read from its beginning to its end. `tarfile` takes headers of one entry within each other,
    as deep as an archive has them, keeps all entries, and takes the square of a header's length."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def entries(self) -> Iterator[_Entry]:
        return (entry for entry, _ in self.contents())

    def contents(self) -> Iterator[tuple[_Entry, BinaryIO]]:
        file = _Bounded(self._file)
        further: dict[bytes, bytes] = {}
        headers = 0
        while any(block := file.read(_BLOCK)):
            info = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
            if info.type in (*_OF_THE_NEXT, tarfile.XGLTYPE):
                headers += 1
                if headers > _MOST_HEADERS or not 0 <= info.size <= _MOST_AT_ONCE:
                    raise tarfile.ReadError("a header of it claims too much")
                body = _Body(file, info.size)
                further |= _further(info, body.read(_MOST_AT_ONCE))
            else:
                entry = _tar_entry(info, further)
                further, headers = {}, 0
                body = _Body(file, 0 if entry.odd or entry.folder else entry.bytes)
                yield entry, body  # pyright: ignore[reportReturnType]
            body.skip()


class _Body:
    """The bytes after a header, up to the next one."""

    def __init__(self, file: "_Bounded", size: int) -> None:
        self._file, self._left, self._padding = file, size, -size % _BLOCK

    def read(self, most: int) -> bytes:
        data = self._file.read(min(most, self._left))
        if self._left and not data:
            raise EOFError("it is cut short")
        self._left -= len(data)
        return data

    def skip(self) -> None:
        while self._left:
            self.read(_MOST_AT_ONCE)
        self._file.read(self._padding)


def _further(info: tarfile.TarInfo, data: bytes) -> dict[bytes, bytes]:
    """What a header tells of the next entry, as POSIX's (pax) calls it; records of it that nothing
    here asks for are left out.

    Raises:
        ValueError: a record has no length, or ends elsewhere.
    """
    if info.type == tarfile.GNUTYPE_LONGNAME:
        return {b"path": data.partition(b"\0")[0]}
    found: dict[bytes, bytes] = {}
    at = 0
    while info.type in (tarfile.XHDTYPE, tarfile.SOLARIS_XHDTYPE) and at < len(data) and data[at]:
        space = data.index(b" ", at, at + 20)
        end = at + int(data[at:space])
        record = data[space + 1 : end]
        if not record.endswith(b"\n"):
            raise ValueError("a record of a header has another length")
        key, _, value = record[:-1].partition(b"=")
        if key in (b"path", b"size") or key.startswith(b"GNU.sparse."):
            found[key] = value
        at = end
    return found


def _tar_entry(info: tarfile.TarInfo, further: Mapping[bytes, bytes]) -> _Entry:
    folder = info.isdir()
    odd = ""
    plain = info.isreg() and info.type != tarfile.GNUTYPE_SPARSE
    if not folder and (not plain or any(key.startswith(b"GNU") for key in further)):
        odd = "a link" if info.issym() or info.islnk() else "a device, or packed in an unusual way"
    name = further.get(b"path", info.name.encode("utf-8", "surrogateescape"))
    size = int(further.get(b"size", info.size))
    return _Entry(name.decode("utf-8", "surrogateescape"), 0 if folder else size, folder, odd)


class _Bounded(gzip.GzipFile):
    """A .gz that is never read in large pieces, and never beyond what it may unpack to."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(fileobj=file, mode="rb")
        file.seek(0, io.SEEK_END)
        self._most = max(_ALWAYS_BYTES, MAX_RATIO * file.tell()) + _ALWAYS_BYTES
        file.seek(0)

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= _MOST_AT_ONCE or self.tell() > self._most:
            raise tarfile.ReadError("a header of it claims too much")
        return super().read(size)
