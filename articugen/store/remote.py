"""Files elsewhere, to read from here and there: in object stores and on the web by obstore, on all
else, hf:// or sftp:// for instance, by fsspec (alone in knowing it).
"""

import io
from collections.abc import Sequence
from typing import Any

from articugen.core.errors import ArticugenError, InvalidArgument, MachineFault, MissingExtra
from articugen.store.bucket import READ_SCHEMES, SCHEMES, Answer, Bucket, Files, Remote, scheme_of

BLOCK = 1 << 16
"""Bytes that a file is read by, where it is read as one."""

TRIES = 2
"""Many implementations try again by themselves."""

_REFUSED, _ABSENT = (401, 403), (404, 410)
"""HTTP's statuses, which some implementations have in their errors."""


def folder_at(url: str) -> Files:
    """Return what reads files of the folder `url`; raises as `Bucket` and `FileSystem`."""
    return Bucket(url) if scheme_of(url) in READ_SCHEMES else FileSystem(url)


class FileSystem(Files):
    """A folder of any file system that fsspec knows, to read."""

    tries, keys = TRIES, "HF_TOKEN"

    def __init__(self, url: str) -> None:
        """Raise MissingExtra without fsspec, or ArticugenError without what it wants for this file
        system; InvalidArgument where it knows of none, or there is no such folder; MachineFault
        where it does not answer."""
        self.url = url.rstrip("/")
        try:
            import fsspec  # noqa: PLC0415 - optional
        except ImportError:
            raise MissingExtra("fsspec", "fsspec") from None
        scheme = scheme_of(url)
        if scheme not in fsspec.available_protocols():
            known = ", ".join(f"{name}://" for name in (*SCHEMES, "http", "hf"))
            raise InvalidArgument(
                f"{url}: no object store is called so; give {known}, or what else fsspec knows"
            )
        try:
            opened = self._tried("", lambda: fsspec.core.url_to_fs(self.url))
        except ImportError as error:
            raise ArticugenError(
                f"{url}: fsspec cannot read {scheme}:// yet; install what it wants ({error})"
            ) from None
        except ValueError as error:
            raise InvalidArgument(f"{url}: {error}") from None
        if opened is None:
            raise InvalidArgument(f"{url}: there is no such folder")
        self._fs, self._root = opened[0], opened[1].rstrip("/")

    def _read(self, name: str) -> bytes:
        return self._fs.cat_file(f"{self._root}/{name}")

    def _size(self, name: str) -> int:
        return self._fs.size(f"{self._root}/{name}")

    def _ranges(self, name: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        # without a cache, which would read megabytes ahead
        with self._fs.open(f"{self._root}/{name}", "rb", cache_type="none") as file:
            return [_part(file, at, size) for at, size in spans]

    def _answer(self, error: Exception) -> Answer:
        """Say what an error of an implementation means: they raise what they like."""
        response = getattr(error, "response", None)
        status = getattr(error, "status", None) or getattr(response, "status_code", None)
        if isinstance(error, PermissionError) or status in _REFUSED:
            return Answer.REFUSED
        if isinstance(error, FileNotFoundError) or status in _ABSENT:
            return Answer.ABSENT
        if isinstance(error, ImportError | ValueError | TypeError):
            return Answer.NONSENSE
        return Answer.SILENCE


def _part(file: Any, at: int, size: int) -> bytes:
    file.seek(at)
    return file.read(size)


class RangeFile(io.RawIOBase):
    """A remote file to read from here and there: only blocks that are asked for come over."""

    def __init__(self, file: Remote) -> None:
        """Raise FileNotFoundError where there is none; else as `folder_at`."""
        self._folder, self._name, self._at = folder_at(file.parent.url), file.name, 0
        size = self._folder.size(self._name)
        if size is None:
            raise FileNotFoundError(2, "No such file or directory", file.url)
        self.size, self.stamp, self._blocks = size, (size,), dict[int, bytes]()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size}[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        into = memoryview(buffer).cast("B")
        end = min(self._at + len(into), self.size)
        if end <= self._at:
            return 0
        wanted = range(self._at // BLOCK, (end - 1) // BLOCK + 1)
        missing = [n for n in wanted if n not in self._blocks]
        if missing:
            spans = [(n * BLOCK, min(BLOCK, self.size - n * BLOCK)) for n in missing]
            self._blocks |= zip(missing, self.read_spans(spans), strict=True)
        data = b"".join(self._blocks[n] for n in wanted)
        first = self._at - wanted[0] * BLOCK
        into[: end - self._at] = data[first : first + end - self._at]
        count, self._at = end - self._at, end
        return count

    def read_spans(self, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        """Return parts of the file, in as few requests as they take; OSError if it is gone."""
        wanted = [span for span in spans if span[1]]
        parts = self._folder.ranges(self._name, wanted)
        if parts is None:
            raise FileNotFoundError(2, "No such file or directory", self._name)
        if [len(part) for part in parts] != [size for _, size in wanted]:
            raise MachineFault(
                f"{self._folder.url}/{self._name}: parts of it come over as others than were asked "
                "for; copy the data set, and open the copy"
            )
        left = iter(parts)
        return [next(left) if size else b"" for _, size in spans]
