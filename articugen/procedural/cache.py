"""Folders of bundled models on disk: written whole, sealed, and looked at before each use.

A model is made once and read many times, by several processes. Its folder holds a seal: what the
model is, the version of its shapes, and a digest of each of its files. A folder whose seal does not
fit is written again. A writer works in a hidden folder beside it, which it holds locked, so that
what a killed writer left differs from what a living one still needs.
"""

import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from articugen.core.bundled import CACHE
from articugen.core.errors import MachineFault
from articugen.core.files import cannot_write, make_folder, read_regular, sync

SEAL_NAME = "seal.json"

_WORK = re.compile(r"\.[a-z_]+_[0-9]{4,9}\.[a-z0-9_]{8}")
"""The names of the folders in which writers of objects work."""

_MOST_BYTES = 256 << 20
"""Of one of a model's files; ours have a hundredth of that."""

_READ_ONLY = (errno.EROFS, errno.EACCES, errno.EPERM)


def stored(folder: Path, identity: Mapping[str, str | int], write: Callable[[Path], None]) -> Path:
    """The folder in which `write` put a model's files: `folder`, as it is or written just now.

    Where `folder` cannot be written to it is one in the user's cache. Any number of processes may
    ask for the same folder at once.

    Args:
        identity: what the model is; it becomes part of the seal.
        write: puts the model's files, no folders among them, into the empty folder it is given.

    Raises:
        MachineFault: no memory, a full or broken disk, or the like.
    """
    try:
        if is_sealed(folder, identity):
            return folder
        try:
            _write(folder, identity, write)
        except OSError as error:
            if error.errno not in _READ_ONLY:
                raise
            folder = CACHE / _digest(str(folder).encode())[:16] / folder.name
            if not is_sealed(folder, identity):
                _write(folder, identity, write)
    except OSError as error:
        raise MachineFault(cannot_write(folder, error)) from error
    except MemoryError as error:
        raise MachineFault(f"{folder}: not written: no memory is left; use fewer jobs") from error
    return folder


def is_sealed(folder: Path, identity: Mapping[str, str | int]) -> bool:
    """Whether the folder holds this model, to the byte as it was written."""
    try:
        seal = json.loads(_bytes_of(folder / SEAL_NAME))
        return seal == _seal(folder, identity, seal["files"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return False


def _seal(folder: Path, identity: Mapping[str, str | int], names: Mapping | list[str]) -> dict:
    """What the seal of a folder with these files must say."""
    files = {name: _digest(_bytes_of(folder / _plain(name))) for name in sorted(names)}
    return {**identity, "files": files}


def _plain(name: str) -> str:
    if Path(name).name != name:
        raise ValueError(f"{name!r} is not the name of a file")
    return name


def _bytes_of(path: Path) -> bytes:
    return read_regular(path, _MOST_BYTES, follow=False)


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _write(folder: Path, identity: Mapping[str, str | int], write: Callable[[Path], None]) -> None:
    """Make the folder, or make it again."""
    make_folder(folder.parent)
    _remove_left_over(folder.parent)
    with _work_folder(folder) as work:
        write(work)
        seal = _seal(work, identity, os.listdir(work))
        (work / SEAL_NAME).write_text(json.dumps(seal, indent=1) + "\n")
        for path in work.iterdir():
            sync(path)
        sync(work)
        work.chmod(0o755)
        _name(work, folder, identity)
    sync(folder.parent)


def _name(work: Path, folder: Path, identity: Mapping[str, str | int]) -> None:
    """Give `work` the name `folder`, unless another process has already done so."""
    for _ in range(10):
        try:
            work.rename(folder)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
        if is_sealed(folder, identity):
            return
        aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            folder.rename(aside / "old")
        except FileNotFoundError:
            pass  # Another process was faster.
        finally:
            shutil.rmtree(aside, ignore_errors=True)
    raise OSError(errno.EBUSY, "other processes keep writing this folder; stop them")


@contextmanager
def _work_folder(folder: Path) -> Iterator[Path]:
    """A new folder beside `folder`, locked by this process until it is done with it."""
    while True:
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        handle = _locked(work, wait=True)
        if handle is not None and work.exists():
            break
        if handle is not None:  # Taken for left over before it was locked.
            os.close(handle)
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        os.close(handle)


def _locked(work: Path, *, wait: bool) -> int | None:
    """A handle that holds the folder's lock; None if it is gone or, without `wait`, if locked."""
    try:
        handle = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if not wait:
            os.close(handle)
            return None
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # Where there are no locks,
            os.close(handle)  # nobody can take this for left over either.
            raise
    return handle


def _remove_left_over(parent: Path) -> None:
    """Remove the folders of writers that are no more."""
    for entry in list(os.scandir(parent)):
        if _WORK.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
            handle = _locked(Path(entry.path), wait=False)
            if handle is not None:
                shutil.rmtree(entry.path, ignore_errors=True)
                os.close(handle)
