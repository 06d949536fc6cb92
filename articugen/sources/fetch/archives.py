"""Archives from strangers: models in a .zip or .tar.gz, examined before a byte is written.

An archive with a name that leads out of a folder, a link, a device, or more in it than a bound
allows is refused as a whole: what tries such a thing is not to be trusted with the rest. (The
filters of `tarfile` work file by file, bound no sizes and let links within the folder pass.)
"""

import gzip
import io
import shutil
import stat
import sys
import tarfile
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO, NamedTuple, NoReturn

from articugen.core.errors import InvalidSource, MachineFault, machine_fault, printable
from articugen.core.files import cannot_write, megabytes, open_regular, room_at, sha256_of
from articugen.meshes.model_files import MAX_NAME_BYTES, quoted
from articugen.sources.usd.layers import SUFFIXES
from articugen.sources.usd.reader import LAYER_FOLDERS

MAX_FILES = 1_000_000  # and folders in one archive; Artiverse's largest has 313,000
MAX_FILE_BYTES = 2**30  # of one file in it
MAX_RATIO = 200  # of its bytes unpacked and packed; OBJ files and textures give 3 to 10
MAX_DEPTH = 32
MAX_DENSITY = 16  # bytes that a name takes at least; a header and some content give more than 60

_ALWAYS_FILES = 10_000  # which any archive may hold, small as it is
_ALWAYS_BYTES = 64 * 2**20
_MOST_HEADER_BYTES = 2**16
"""Of what a tar says before one entry: names of 8 kB, attributes of files. `tarfile` takes headers
within each other and the square of a header's length; it is not let to read more."""

_DAMAGED = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, gzip.BadGzipFile, EOFError),
    *(NotImplementedError, ValueError, OverflowError, RecursionError),
)
_BELOW = ("urdf", "urdf_w_collider")  # folders of URDFs inside of a model's folder


class Entry(NamedTuple):
    """A file or folder in an archive, whose bytes are to be read before the next is asked for;
    `plain` is whether it is one, packed as usual."""

    name: str
    size: int
    folder: bool
    plain: bool
    open: Callable[[], IO[bytes] | None]


Archive = Callable[[], Iterator[Entry]]  # goes through an open one


class Unpacked(NamedTuple):
    """A model that was unpacked: the archive's digest, its folder there, the size of each file by
    its name in that, and where it is now."""

    sha256: str
    root: PurePosixPath
    sizes: dict[str, int]
    folder: Path


def unpack(
    path: Path, into: Path, wanted: Callable[[str, PurePosixPath], bool]
) -> Iterator[Unpacked]:
    """Unpack the models of an archive, one after the other; nothing before all of it was examined.

    Args:
        into: a folder; a model is unpacked to a new folder in it, which may then be moved.
        wanted: whether to unpack a model, by the archive's digest and its folder there (`.` is the
            archive itself); asked of all before any is.

    Raises:
        InvalidSource: unsafe, damaged, or without a model.
        MachineFault, MemoryError: the disk is full, or the like.
    """
    with _opened(path) as archive:
        sha256 = sha256_of(path)
        sizes = _examined(archive, path)
        root_of = _roots(sizes)
        roots = sorted(set(root_of.values()))
        if not roots:
            raise InvalidSource(
                f"{path}: holds no URDF and no motion_attributes.json, nor USD; name another"
            )
        models = {
            root: Unpacked(sha256, root, {}, into / str(number) / (root.name or "model"))
            for number, root in enumerate(roots)
            if wanted(sha256, root)
        }
        left = Counter(root for root in root_of.values() if root in models)
        needed = sum(sizes[name] for name, root in root_of.items() if root in models)
        with suppress(OSError):  # nobody knows how much is free
            if needed > (free := room_at(into)):
                raise MachineFault(
                    f"{into}: {megabytes(needed)} are to be unpacked from {path.name} and "
                    f"{megabytes(free)} are free; free some, or choose a folder on another disk"
                )
        for name, entry in _named(archive, path) if models else ():
            model = models.get(root_of[name]) if name in root_of else None
            if model is None:
                continue
            inner = name.relative_to(model.root)
            with entry.open() or io.BytesIO() as data:
                _write(data, model.folder / inner, entry.size, path)
            model.sizes[str(inner)] = entry.size
            left[model.root] -= 1
            if not left[model.root]:
                yield models.pop(model.root)


def _write(data: IO[bytes], to: Path, size: int, path: Path) -> None:
    try:
        to.parent.mkdir(parents=True, exist_ok=True)
        with to.open("xb") as file:
            shutil.copyfileobj(data, file)  # to the end, where the checksum is compared
            if file.tell() != size:
                raise InvalidSource(f"{path}: is damaged ({to.name} is cut short); get it again")
    except gzip.BadGzipFile:
        raise
    except OSError as error:
        raise MachineFault(cannot_write(to, error, size)) from error


@contextmanager
def _opened(path: Path) -> Iterator[Archive]:
    """An archive, by what its first bytes say that it is; InvalidSource where it is none, or
    whatever reads it within the block finds it damaged."""
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


def _examined(archive: Archive, path: Path) -> dict[PurePosixPath, int]:
    """Return the sizes of an archive's files, by their names; InvalidSource, with the entry, if one
    is not in order, or together they break a bound."""
    packed = path.stat().st_size
    most_bytes = max(_ALWAYS_BYTES, MAX_RATIO * packed)
    most_names = min(MAX_FILES, _ALWAYS_FILES + packed // MAX_DENSITY)
    sizes: dict[PurePosixPath, int] = {}
    folders: set[PurePosixPath] = set()  # those too that only the names of files imply
    total = 0
    for count, (name, entry) in enumerate(_named(archive, path), 1):
        if not entry.folder and name.parts:
            if name in sizes:
                _refuse(path, entry.name, "is there twice")
            sizes[name] = entry.size
        for folder in (name, *name.parents) if entry.folder else name.parents:
            if folder in folders:  # and so are those above it
                break
            folders.add(folder)
        total += max(entry.size, tarfile.BLOCKSIZE)
        if max(count, len(sizes) + len(folders)) > most_names or total > most_bytes:
            raise InvalidSource(
                f"{path}: holds more than {most_names:,} files and folders, or unpacks to more "
                f"than {MAX_RATIO} times its size; split it, or get it from its authors"
            )
    for name in sizes.keys() & folders:
        _refuse(path, str(name), "is a file and a folder")
    return sizes


def _named(archive: Archive, path: Path) -> Iterator[tuple[PurePosixPath, Entry]]:
    """Yield what is in an archive, with names that can only lie below a folder."""
    for entry in archive():
        name = entry.name
        parts = [part for part in name.split("/") if part not in ("", ".")]
        if not entry.plain:
            _refuse(path, name, "is a link, a device, encrypted or packed in an unusual way")
        if name.startswith("/") or name[1:2] == ":":
            _refuse(path, name, "is an absolute name")
        if "\\" in name or not name.isprintable():
            _refuse(path, name, "has a backslash or a control character in its name")
        if ".." in parts:
            _refuse(path, name, "leads out of the folder")
        if len(parts) > MAX_DEPTH or any(len(part.encode()) > MAX_NAME_BYTES for part in parts):
            _refuse(path, name, "has too long a name")
        if not 0 <= entry.size <= MAX_FILE_BYTES:
            _refuse(path, name, f"has more than {MAX_FILE_BYTES // 2**20} MiB")
        yield PurePosixPath(*parts), entry


def _refuse(path: Path, name: str, why: str) -> NoReturn:
    raise InvalidSource(
        f"{path}: its entry {quoted(printable(name))} {why}; nothing of it is unpacked, get it "
        "from its authors"
    )


def _zip_entries(archive: zipfile.ZipFile) -> Iterator[Entry]:
    for info in archive.infolist():
        plain = (
            stat.S_IFMT(info.external_attr >> 16) in (0, stat.S_IFREG, stat.S_IFDIR)
            and not info.flag_bits & 0x1
            and info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        )
        # `filename` ends where a NUL hides the rest; `is_dir` of 3.11 stumbles over no letters
        folder = info.filename.endswith("/")
        yield Entry(info.orig_filename, info.file_size, folder, plain, partial(archive.open, info))


def _tar_entries(packed: BinaryIO) -> Iterator[Entry]:
    packed.seek(0)
    file = _Allowed(fileobj=packed, mode="rb")
    archive = tarfile.TarFile(fileobj=file, encoding="utf-8", errors="surrogateescape")
    while info := archive.next():
        archive.members.clear()  # pyright: ignore[reportAttributeAccessIssue] - it would keep all
        sparse = info.sparse is not None or any(
            k.startswith("GNU.sparse") for k in info.pax_headers
        )
        plain = (info.isdir() or info.isreg()) and not sparse
        file.allowed = max(0, info.size)
        yield Entry(info.name, info.size, info.isdir(), plain, partial(archive.extractfile, info))
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


def _roots(files: Iterable[PurePosixPath]) -> dict[PurePosixPath, PurePosixPath]:
    """Return the model's folder of each file that lies in one; of folders in each other the inner
    one."""
    names = [  # without what file managers leave behind
        n for n in files if not any(p.startswith(".") or p == "__MACOSX" for p in n.parts)
    ]
    roots = {
        name.parent.parent if name.parent.name in _BELOW else name.parent
        for name in names
        if name.suffix.lower() == ".urdf"
        or name.name in ("motion_attributes.json", f"{name.parent.name}.articulations.json")
    }
    if not roots:  # beside other marks USD files are meshes, and so are layers of another's model
        folders = {name.parent for name in names if name.suffix.lower() in SUFFIXES}
        roots = {
            folder
            for folder in folders
            if not any(
                above.name.lower() in LAYER_FOLDERS and above.parent in folders
                for above in (folder, *folder.parents)
            )
        }
    nearest = {name: next((f for f in name.parents if f in roots), None) for name in names}
    return {name: root for name, root in nearest.items() if root is not None}
