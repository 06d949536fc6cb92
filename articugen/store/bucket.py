"""Folders in an object store, s3://bucket/prefix and the like (alone in knowing obstore).

What the store does not answer is asked again; what it refuses is one sentence. Keys and the address
of another server than Amazon's come from the environment: AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL.
"""

import io
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from articugen.errors import ArticugenError, InvalidArgument, MachineFault, MissingExtra

R = TypeVar("R")

SCHEMES = ("s3", "gs", "az", "abfs")
RETRIES = 4
"""Of obstore's own, which are quick."""
TRIES, PAUSE = 6, 0.2
"""Of a request that is not answered; seconds before the second try, twice as many each time."""
AT_ONCE = 16
PART = 1 << 26
"""Bytes above which a file is sent in parts, each a request."""
BLOCK = 1 << 16
"""Bytes that a file is read by, where it is read as one."""

_LIKE_A_URL = re.compile(r"([a-z][a-z0-9+]+)://.+", re.DOTALL)


def is_url(path: object) -> bool:
    """Whether a path is of an object store's kind."""
    return isinstance(path, Remote) or bool(_LIKE_A_URL.fullmatch(str(path)))


@dataclass(frozen=True)
class Remote:
    """A file or folder in an object store, as pathlib's paths are of a disk's."""

    url: str

    def __truediv__(self, name: str) -> "Remote":
        return Remote(f"{self.url.rstrip('/')}/{name}")

    @property
    def name(self) -> str:
        return self.url.rstrip("/").rpartition("/")[2]

    @property
    def parent(self) -> "Remote":
        return Remote(self.url.rstrip("/").rpartition("/")[0])

    def __str__(self) -> str:
        return self.url


@dataclass(frozen=True)
class Listed:
    """A file that a listing tells of: its size, and when it was written by the store's clock."""

    bytes: int
    written: float


class Bucket:
    """A folder in an object store. It can be sent to other processes; each connects for itself."""

    def __init__(self, url: str) -> None:
        """
        Raises:
            MissingExtra: obstore is not installed.
            InvalidArgument: no store is called so.
        """
        self.url = url.rstrip("/")
        match = _LIKE_A_URL.fullmatch(url)
        if match is None or match[1] not in SCHEMES:
            kinds = ", ".join(f"{scheme}://" for scheme in SCHEMES)
            raise InvalidArgument(f"{url}: no object store is called so; give {kinds}")
        try:
            import obstore  # noqa: PLC0415 - optional
            from obstore.store import from_url  # noqa: PLC0415
        except ImportError:
            raise MissingExtra("obstore", "s3") from None
        self._obstore = obstore
        try:
            self._store: Any = from_url(
                self.url,
                client_options={"allow_http": True},
                retry_config={"max_retries": RETRIES},
            )
        except (obstore.exceptions.BaseError, ValueError) as error:
            raise InvalidArgument(f"{url}: {error}") from None

    def __reduce__(self) -> tuple[Any, ...]:
        return Bucket, (self.url,)

    def get(self, name: str) -> bytes | None:
        """A file's bytes; None where there is none.

        Raises:
            MachineFault: the store does not answer, or refuses; so all others.
        """
        return self._tried(lambda: bytes(self._obstore.get(self._store, name).bytes()), name)

    def get_all(self, names: Sequence[str]) -> list[bytes | None]:
        """Many small files."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            return list(pool.map(self.get, names))

    def ranges(self, name: str, spans: Sequence[tuple[int, int]]) -> list[bytes] | None:
        """Parts of a file, each by its first byte and length; None where there is no such file."""
        starts, lengths = [at for at, _ in spans], [size for _, size in spans]
        return self._tried(
            lambda: [
                bytes(part)
                for part in self._obstore.get_ranges(
                    self._store, name, starts=starts, lengths=lengths
                )
            ],
            name,
        )

    def size(self, name: str) -> int | None:
        """Bytes of a file; None where there is none."""
        return self._tried(lambda: self._obstore.head(self._store, name)["size"], name)

    def put(self, name: str, data: bytes | Path) -> None:
        """Write a file, which is there as a whole or not at all."""
        self._tried(lambda: self._obstore.put(self._store, name, data, chunk_size=PART), name)

    def put_new(self, name: str, data: bytes) -> bool:
        """Write a file that was not there; whether it is ours. `data` is unlike any other's."""

        def put() -> bool:
            try:
                self._obstore.put(self._store, name, data, mode="create", use_multipart=False)
            except self._obstore.exceptions.AlreadyExistsError:
                # the answer to an earlier try may have been lost on its way
                return self._obstore.get(self._store, name).bytes() == data
            return True

        return bool(self._tried(put, name))

    def delete(self, names: Iterable[str]) -> None:
        """Remove files; one that is not there is no fault."""
        for name in names:
            self._tried(lambda name=name: self._obstore.delete(self._store, name), name)

    def listed(self, under: str) -> Mapping[str, Listed]:
        """The files whose names begin with the folder `under`, "" for all, without that folder."""

        def listing() -> dict[str, Listed]:
            found: dict[str, Listed] = {}
            for some in self._obstore.list(self._store, prefix=under or None):
                for each in some:
                    name = each["path"].removeprefix(under).removeprefix("/")
                    found[name] = Listed(each["size"], each["last_modified"].timestamp())
            return found

        return self._tried(listing, under) or {}

    def _tried(self, act: Callable[[], R], name: str) -> R | None:
        """What `act` returns, tried again where the store does not answer; None where there is no
        such file."""
        refused = self._obstore.exceptions
        where = f"{self.url}/{name}"
        for left in reversed(range(TRIES)):
            try:
                return act()
            except (refused.NotFoundError, FileNotFoundError):
                return None
            except (refused.PermissionDeniedError, refused.UnauthenticatedError) as error:
                raise ArticugenError(
                    f"{where}: access is refused; see to the keys, AWS_ACCESS_KEY_ID and the like "
                    f"({_first_line(error)})"
                ) from None
            except (refused.BaseError, OSError) as error:
                if not left:
                    raise MachineFault(
                        f"{where}: the store does not answer ({_first_line(error)}); see to it"
                    ) from None
                time.sleep(PAUSE * 2 ** (TRIES - 1 - left))
        raise AssertionError


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0][:200]


class RangeFile(io.RawIOBase):
    """A remote file to read from here and there: only blocks that are asked for come over."""

    def __init__(self, file: Remote) -> None:
        """
        Raises:
            FileNotFoundError: there is none.
            MachineFault, MissingExtra, InvalidArgument: as `Bucket`.
        """
        self._bucket, self._name, self._at = Bucket(file.parent.url), file.name, 0
        size = self._bucket.size(self._name)
        if size is None:
            raise FileNotFoundError(2, "No such file or directory", file.url)
        self.size, self._blocks = size, dict[int, bytes]()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

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

    def read_spans(self, spans: Sequence[tuple[int, int]]) -> list[bytes]:
        """Parts of the file, in as few requests as they take.

        Raises:
            OSError: it is gone.
        """
        parts = self._bucket.ranges(self._name, spans)
        if parts is None:
            raise FileNotFoundError(2, "No such file or directory", self._name)
        return parts
