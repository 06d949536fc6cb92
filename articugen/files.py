"""Files that are either whole under their final name or not there at all."""

import errno
import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from articugen.errors import MachineFault

_CURES = {
    errno.ENOSPC: "the disk is full; free {megabytes:.0f} MB or choose another output folder",
    errno.EDQUOT: "the disk quota is used up; free {megabytes:.0f} MB or choose another folder",
    errno.EFBIG: "files may not grow so large here; raise the limit (ulimit -f) or choose a folder "
    "on another file system",
    errno.ENOENT: "its folder does not exist; make it first",
}
_CURES |= dict.fromkeys(
    (errno.EACCES, errno.EPERM, errno.EROFS),
    "the folder cannot be written to; change its permissions or choose another output folder",
)


def write_atomically(
    path: Path, data: bytes, *, check: Callable[[Path], None] | None = None
) -> None:
    """Write `data` so that `path` is at any moment what it was before, or all of `data`.

    Raises:
        MachineFault: the disk is full, the folder cannot be written to, or the like.
    """
    with written_atomically(path, check=check) as file:
        file.write(data)


@contextmanager
def written_atomically(
    path: Path, *, check: Callable[[Path], None] | None = None
) -> Iterator[BinaryIO]:
    """A file to write and read; once the block has ended without an error, `path` is all of it.

    The bytes go to a temporary name in the same folder and to the disk (fsync); `check` looks at
    that file and raises where it is not as it should be; only then it gets its name, and the folder
    is synchronised, so that the name survives a power cut as well. Where anything fails `path` is
    what it was, and the temporary file is gone.

    Raises:
        MachineFault: the disk is full, the folder cannot be written to, or the like.
    """
    temporary = path.with_name(partial_name(path.name))
    size = 0
    try:
        try:
            with temporary.open("w+b") as file:
                yield file
                size = file.seek(0, os.SEEK_END)
                file.flush()
                os.fsync(file.fileno())
            if check is not None:
                check(temporary)
            temporary.replace(path)
            sync_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise MachineFault(cannot_write(path, error, size)) from error


def partial_name(name: str) -> str:
    """What a file is called until it is whole; the same each time, so that none are left over."""
    return f".{name}.partial"


def cannot_write(path: Path, error: OSError, size: int = 0) -> str:
    """One sentence on why `path` (of `size` bytes) could not be written, with the cure."""
    cure = _CURES.get(error.errno or 0, f"{error.strerror or error}; choose another output folder")
    return f"{path}: not written: {cure.format(megabytes=max(size, 1e6) / 1e6)}"


def sync_folder(folder: Path) -> None:
    """Make the names in `folder` as durable as the bytes behind them."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256_of(path: Path) -> str:
    """The hex digest of a file's bytes."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
