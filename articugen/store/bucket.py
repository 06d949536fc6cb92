"""Folders in an object store, s3://bucket/prefix and the like (alone in knowing obstore).

What the store does not answer is asked again; what it refuses is one sentence. Keys and the address
of another server than Amazon's come from the environment: AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL.
"""

import os
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

from articugen.core.errors import ArticugenError, InvalidArgument, MachineFault, MissingExtra
from articugen.core.place import Listed

R = TypeVar("R")

SCHEMES = ("s3", "gs", "az", "abfs")
READ_SCHEMES = (*SCHEMES, "http", "https")
"""Web servers keep no two processes from writing the same file."""
RETRIES = 4
"""Of obstore's own, which are quick."""
TRIES, PAUSE = 6, 0.2
"""Of a request that is not answered; seconds before the second try, twice as many each time."""
PART = 1 << 26
"""Bytes above which a file is sent in parts, each a request."""

_ENDPOINTS = {
    "s3": ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"),
    "gs": ("GOOGLE_BASE_URL",),
    "az": ("AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"),
    "abfs": ("AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"),
}
"""Where the environment names another server, by scheme."""

_LIKE_A_URL = re.compile(r"([a-z][a-z0-9+_-]+)://(.+)", re.DOTALL | re.IGNORECASE)


def is_url(path: object) -> bool:
    """Return whether a path is of an object store's kind."""
    return isinstance(path, Remote) or bool(_LIKE_A_URL.fullmatch(str(path)))


def scheme_of(url: str) -> str:
    """Return the scheme of a URL, "" where it has none."""
    match = _LIKE_A_URL.fullmatch(url)
    return match[1].lower() if match else ""


def _is_plain(url: str) -> bool:
    """Return whether somebody has asked for http, which anybody on the way can read and change."""
    names = _ENDPOINTS.get(scheme_of(url), ())
    return any(at.startswith("http://") for at in (url, *(os.environ.get(n, "") for n in names)))


def check_can_be_shared(url: str) -> None:
    """Raise InvalidArgument where processes cannot share out objects."""
    if scheme_of(url) not in SCHEMES:
        kinds = ", ".join(f"{scheme}://" for scheme in SCHEMES)
        raise InvalidArgument(
            f"{url}: data sets are made in a folder, or in {kinds}, where a file is created by one "
            "process alone; make it in a folder and copy that there"
        )


class Answer(Enum):
    """Meaning of an error for a request."""

    ABSENT = "there is no such file"
    REFUSED = "it may not be read, or written"
    SILENCE = "it was not heard, or is to be asked again"
    NONSENSE = "no store is at fault"


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


class Files(ABC):
    """A folder elsewhere, to read: a `Bucket`, or what fsspec knows, see `remote.folder_at`.

    Raises:
        MachineFault: nobody answers, however often it is asked; so all methods.
        ArticugenError: access is refused; so all methods.

    Attributes:
        url: of the folder.
        tries: of a request that is not answered.
        keys: that decide on access, for people.
    """

    url: str
    tries: int
    keys: str

    def read(self, name: str) -> bytes | None:
        """Return a file's bytes; None where there is none."""
        return self._tried(name, lambda: self._read(name))

    def size(self, name: str) -> int | None:
        """Bytes of a file; None where there is none."""
        return self._tried(name, lambda: self._size(name))

    def ranges(self, name: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes] | None:
        """Parts of a file, each by its first byte and length; None where there is no such file."""
        return self._tried(name, lambda: self._ranges(name, spans))

    @abstractmethod
    def _read(self, name: str) -> bytes: ...
    @abstractmethod
    def _size(self, name: str) -> int: ...
    @abstractmethod
    def _ranges(self, name: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]: ...
    @abstractmethod
    def _answer(self, error: Exception) -> Answer:
        """Say what an error means."""

    def _tried(self, name: str, act: Callable[[], R]) -> R | None:
        """Call `act`, again where the store does not answer; return None where there is no such
        file."""
        where = f"{self.url}/{name}".rstrip("/")
        for left in reversed(range(self.tries)):
            try:
                return act()
            except Exception as error:
                meant, line = self._answer(error), str(error).strip().split("\n")[0][:200]
                if meant is Answer.ABSENT:
                    return None
                if meant is Answer.REFUSED:
                    raise ArticugenError(
                        f"{where}: access is refused; see to the keys, {self.keys} and the like "
                        f"({line})"
                    ) from None
                if meant is Answer.NONSENSE:
                    raise
                if not left:
                    raise MachineFault(
                        f"{where}: the store does not answer ({line}); see to it"
                    ) from None
                time.sleep(PAUSE * 2 ** (self.tries - 1 - left))
        raise AssertionError


class Bucket(Files):
    """A folder in an object store, a `Place`. It can be sent to other processes; each connects for
    itself."""

    at_once = 16
    tries, keys = TRIES, "AWS_ACCESS_KEY_ID"

    def __init__(self, url: str) -> None:
        """Raise MissingExtra without obstore, InvalidArgument where no store is called so."""
        self.url = url.rstrip("/")
        if scheme_of(url) not in READ_SCHEMES:
            kinds = ", ".join(f"{scheme}://" for scheme in READ_SCHEMES)
            raise InvalidArgument(f"{url}: no object store is called so; give {kinds}")
        if {"?", "#"} & {*url} or {".", ".."} & {*url.split("/")}:  # it would be another folder
            raise InvalidArgument(f"{url}: an address holds no ?, # or folder . or ..; name it so")
        try:
            import obstore  # noqa: PLC0415 - optional
            from obstore.store import from_url  # noqa: PLC0415
        except ImportError:
            raise MissingExtra("obstore", "s3") from None
        self._obstore = obstore
        try:
            self._store: Any = from_url(
                self.url,
                client_options={"allow_http": True} if _is_plain(self.url) else {},
                retry_config={"max_retries": RETRIES},
            )
        except (obstore.exceptions.BaseError, ValueError) as error:
            raise InvalidArgument(f"{url}: {str(error).splitlines()[0]}") from None

    def __reduce__(self) -> tuple[Any, ...]:
        return Bucket, (self.url,)

    def __str__(self) -> str:
        return self.url

    def write(self, name: str, data: bytes | Path) -> None:
        """Write a file, which is there as a whole or not at all."""
        put = self._obstore.put
        if not self._tried(name, lambda: put(self._store, name, data, chunk_size=PART)):
            raise ArticugenError(f"{self.url}/{name}: there is no such bucket, or no file to send")

    def write_new(self, name: str, data: bytes) -> bool:
        """Write a file that was not there; whether it holds `data` now."""

        def put() -> bool:
            try:
                self._obstore.put(self._store, name, data, mode="create", use_multipart=False)
            except self._obstore.exceptions.AlreadyExistsError:
                # the answer to an earlier try may have been lost on its way
                return self._obstore.get(self._store, name).bytes() == data
            return True

        return bool(self._tried(name, put))

    def delete(self, names: Iterable[str]) -> None:
        """Remove files; one that is not there is no fault."""
        for name in names:
            self._tried(name, lambda name=name: self._obstore.delete(self._store, name))

    def list(self, under: str = "") -> Mapping[str, Listed]:
        """Return the files whose names begin with the folder `under`, "" for all, without that
        folder."""

        def listing() -> dict[str, Listed]:
            files: dict[str, Listed] = {}
            for some in self._obstore.list(self._store, prefix=under or None):
                for entry in some:
                    name = entry["path"].removeprefix(under).removeprefix("/")
                    files[name] = Listed(entry["size"], entry["last_modified"].timestamp())
            return files

        return self._tried(under, listing) or {}

    def _read(self, name: str) -> bytes:
        return bytes(self._obstore.get(self._store, name).bytes())

    def _size(self, name: str) -> int:
        return self._obstore.head(self._store, name)["size"]

    def _ranges(self, name: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        starts, lengths = [at for at, _ in spans], [size for _, size in spans]
        try:
            parts = self._obstore.get_ranges(self._store, name, starts=starts, lengths=lengths)
        except self._obstore.exceptions.NotSupportedError:
            return ()  # of a web server that gives no parts; `RangeFile` tells what to do
        return list(map(bytes, parts))

    def _answer(self, error: Exception) -> Answer:
        kinds = self._obstore.exceptions
        if isinstance(error, kinds.NotFoundError | FileNotFoundError):
            return Answer.ABSENT
        if isinstance(error, kinds.PermissionDeniedError | kinds.UnauthenticatedError):
            return Answer.REFUSED
        return Answer.SILENCE if isinstance(error, kinds.BaseError | OSError) else Answer.NONSENSE
