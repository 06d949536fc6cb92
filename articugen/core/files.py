"""Files that are either whole under their final name or not there at all."""

import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from articugen.core.errors import ArticugenError, MachineFault, machine_fault

_CURES = {
    errno.ENOSPC: "the disk is full{room}; free some space or choose another output folder",
    errno.EDQUOT: "the disk quota is used up{room}; free some space or choose another folder",
    errno.EFBIG: "files may not grow so large here; raise the limit (ulimit -f) or choose a folder "
    "on another file system",
    errno.ENOENT: "its folder does not exist; make it first",
}
_CURES |= dict.fromkeys(
    (errno.EEXIST, errno.ENOTDIR),
    "a file is in the way; move it away or choose another output folder",
)
_CURES |= dict.fromkeys(
    (errno.EACCES, errno.EPERM, errno.EROFS),
    "the folder cannot be written to; change its permissions or choose another output folder",
)


_PARTIAL = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{8}\.partial", re.DOTALL)

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFLNK: "a symbolic link",
}


DYING_SECONDS = 1.0
"""The workers of a killed run hold its lock for so long at most: see `processes.die_with`."""


class UnfitFile(OSError):
    """Error for a path that is no file of ours: no regular file, or too large.

    An OSError with a `strerror`, so that one handler makes a sentence of all that can go wrong with
    a file, but unlike other OSErrors never a fault of the machine.
    """


def read_regular(path: Path, most_bytes: int, *, follow: bool = True) -> bytes:
    """Return the bytes of a regular file; its kind and size are examined before anything is read.

    Args:
        path: a name that may be hostile: of a FIFO, a device, a file of many gigabytes.
        most_bytes: that it may have.
        follow: whether it may be a symbolic link to such a file.

    Raises:
        UnfitFile: it is no regular file, or larger.
        OSError: it cannot be read.
    """
    with open_regular(path, most_bytes, follow=follow) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1)  # of a larger number room would be made at once
        if len(data) > size:  # it has grown, or lies in /proc, where sizes are 0
            data += file.read(most_bytes)
    if len(data) > most_bytes:
        raise UnfitFile(errno.EFBIG, f"more than the {most_bytes:,} bytes that it may have")
    return data


def read_or_refuse(path: Path, most_bytes: int, refusal: type[ArticugenError], cure: str) -> bytes:
    """Return the same; where it cannot be read, raise a `refusal` with its cure or a fault of the
    machine."""
    try:
        return read_regular(path, most_bytes)
    except OSError as error:
        raise machine_fault(error) or refusal(
            f"{path}: cannot be read: {error.strerror}; {cure}"
        ) from error


def open_regular(path: Path, most_bytes: int, *, follow: bool = True) -> BinaryIO:
    """Return a file that is better not read as a whole, examined likewise and open."""
    try:
        _check_regular(os.stat(path, follow_symlinks=follow), most_bytes)
        # Whatever has taken its place meanwhile, opening it does not wait for a writer.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | (0 if follow else os.O_NOFOLLOW))
    except ValueError:  # NUL, or a lone surrogate
        raise UnfitFile(errno.EINVAL, "no file can have that name") from None
    try:
        _check_regular(os.fstat(handle), most_bytes)
    except OSError:
        os.close(handle)
        raise
    return os.fdopen(handle, "rb")


def is_plain_file(path: Path) -> bool:
    """Return whether a regular file is there, no link to one."""
    return path.is_file() and not path.is_symlink()


def within(folder: Path, name: str) -> Path:
    """Return the path of `name`, with slashes, in a folder: never outside, and through no symbolic
    link.

    The folder itself may be one, since it is what somebody named.

    Raises:
        UnfitFile: the name is absolute, has an empty step or "..", or a step is a link.
    """
    steps = name.split("/")
    if "\0" in name or not all(step.strip(".") for step in steps):
        raise UnfitFile(errno.EINVAL, f"{name!r} is no name of a file in it")
    path = folder
    for step in steps:
        path = path / step
        if path.is_symlink():
            raise UnfitFile(errno.ELOOP, f"{step!r} in it is a symbolic link, which nobody follows")
    return path


def _check_regular(status: os.stat_result, most_bytes: int) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "a device")
        raise UnfitFile(errno.EINVAL, f"it is {kind}, not a regular file")
    if status.st_size > most_bytes:
        raise UnfitFile(
            errno.EFBIG, f"{status.st_size:,} bytes, more than the {most_bytes:,} that it may have"
        )


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` so that `path` is what it was or all of it; MachineFault where that fails."""
    with written_atomically(path, size=len(data)) as file:
        file.write(data)


@contextmanager
def written_atomically(
    path: Path, *, check: Callable[[Path], None] | None = None, size: int = 0
) -> Iterator[BinaryIO]:
    """A file to write and read; once the block has ended without an error, `path` is all of it.

    The bytes go to a temporary name in the same folder and to the disk (fsync); `check` examines
    that file and raises where it is not as it should be; only then it gets its name, and the folder
    is synchronised, so that the name survives a power cut as well. Where anything fails `path` is
    what it was, and the temporary file is gone. `size`, where it is known, is named if the disk is
    full.

    Raises:
        MachineFault: the disk is full, the folder cannot be written to, or the like.
    """
    temporary = path.with_name(partial_name(path.name))
    try:
        try:
            with temporary.open("x+b") as file:  # never through a link that someone put there
                yield file
                size = file.seek(0, os.SEEK_END)
                file.flush()
                os.fsync(file.fileno())
            if check is not None:
                check(temporary)
            temporary.replace(path)
            sync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise MachineFault(cannot_write(path, error, size)) from error


def check_place(path: Path) -> None:
    """Raise MachineFault where no file can be written there, before there is much work for it."""
    temporary = path.with_name(partial_name(path.name))
    with writing(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "a folder has that name")
        temporary.open("xb").close()
        temporary.unlink()


@contextmanager
def writing(path: Path, size: int = 0) -> Iterator[None]:
    """Raise MachineFault where what is done within cannot write `path`, of `size` bytes."""
    try:
        yield
    except OSError as error:
        raise MachineFault(cannot_write(path, error, size)) from error


def partial_name(name: str) -> str:
    """Return the name of a file until it is whole: `.<name>.<8 random hex digits>.partial`.

    Each write has a name of its own, so that two writers, a run and what a killed one left behind,
    never write into the same file.
    """
    return f".{name}.{secrets.token_hex(4)}.partial"


def whole_name(name: str) -> str | None:
    """Return the name that the partial file `name` gets once it is whole; None of any other
    file."""
    match = _PARTIAL.fullmatch(name)
    return match["name"] if match else None


def cannot_write(path: Path, error: OSError, size: int = 0) -> str:
    """Return one sentence on why `path` (of `size` bytes) could not be written, with the cure."""
    cure = _CURES.get(error.errno or 0)
    if cure is None:
        cure = f"{error.strerror or error}; choose another output folder"
    elif "{room}" in cure:
        words = [f"{megabytes(size)} are needed"] if size else []
        with suppress(OSError):
            words.append(f"{megabytes(room_at(path))} are free")
        cure = cure.format(room=f" ({', '.join(words)})" if words else "")
    return f"{path}: not written: {cure}"


def room_at(path: Path) -> int:
    """Return the bytes that are free where a path is, or will be; OSError if that is unknown."""
    path = path.absolute()
    disk = shutil.disk_usage(next(p for p in (path, *path.parents) if p.exists()))
    if not disk.total:  # as file systems say that do not know
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    return disk.free


def megabytes(count: float) -> str:
    """Bytes as sentences have them."""
    return f"{count / 1e6:,.{0 if count >= 1e7 else 1}f} MB"


def make_folder(folder: Path) -> None:
    """Make a folder, and what is missing above it, as durable as what will be in it; or
    MachineFault."""
    with writing(folder):
        missing = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        for path in missing:
            with suppress(PermissionError):  # one may write to a folder that one may not read
                sync(path.parent)


def sync(path: Path) -> None:
    """Make the bytes of a file durable, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256_of(path: Path) -> str:
    """Return the hex digest of a regular file's bytes."""
    digest = hashlib.sha256()
    with open_regular(path, sys.maxsize) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def lock_folder(folder: Path, kind: int = fcntl.LOCK_EX) -> int:
    """Make a folder where it is missing, and return a handle that keeps other runs out (or lets
    ranks in alone) for as long as anybody holds it open.

    Raises:
        ArticugenError: another run holds one.
        MachineFault: the folder cannot be made or opened.
    """
    with writing(folder):
        make_folder(folder)
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    patience = time.monotonic() + DYING_SECONDS
    while True:
        try:
            fcntl.flock(handle, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() < patience:
                time.sleep(0.05)
                continue
            os.close(handle)
            raise ArticugenError(
                f"{folder}: another run is writing here; wait for it or choose another output "
                "folder"
            ) from None
        except OSError:
            pass  # a file system without locks: there the user must see to it
        return handle


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder within; raises as `lock_folder`."""
    handle = lock_folder(folder)
    try:
        yield
    finally:
        os.close(handle)
