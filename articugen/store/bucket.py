"""Folders in an object store, s3://bucket/prefix and the like (alone in knowing obstore).

What the store does not answer is asked again; what it refuses is one sentence. Keys and the address
of another server than Amazon's come from the environment: AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL.
"""

import os
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Protocol, TypeVar

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
"""Where the environment tells of another server, by scheme."""

_LIKE_A_URL = re.compile(r"([a-z][a-z0-9+]+)://.+", re.DOTALL)


def is_url(path: object) -> bool:
    """Return whether a path is of an object store's kind."""
    return isinstance(path, Remote) or bool(_LIKE_A_URL.fullmatch(str(path)))


def scheme_of(url: str) -> str:
    """What stands before ://, "" where nothing does."""
    match = _LIKE_A_URL.fullmatch(url)
    return match[1] if match else ""


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
    """What an error says of a request."""

    ABSENT = "there is no such file"
    REFUSED = "it may not be read, or written"
    SILENCE = "it was not heard, or is to be asked again"
    NONSENSE = "no store is at fault"


def tried(
    act: Callable[[], R],
    where: str,
    answer: Callable[[Exception], Answer],
    *,
    cure: str,
    times: int,
) -> R | None:
    """Return what `act`, a request for the file `where`, returns; None where there is no such file.
    It is tried again, `times` at most, where nobody answers; `answer` says what an error means.

    Raises:
        ArticugenError: access is refused; `cure` says what to do.
        MachineFault: the store does not answer.
        Exception: nonsense.
    """
    for left in reversed(range(times)):
        try:
            return act()
        except Exception as error:
            said = answer(error)
            if said is Answer.ABSENT:
                return None
            if said is Answer.REFUSED:
                raise ArticugenError(
                    f"{where}: access is refused; {cure} ({_first_line(error)})"
                ) from None
            if said is Answer.NONSENSE:
                raise
            if not left:
                raise MachineFault(
                    f"{where}: the store does not answer ({_first_line(error)}); see to it"
                ) from None
            time.sleep(PAUSE * 2 ** (times - 1 - left))
    raise AssertionError


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0][:200]


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


class Files(Protocol):
    """A folder elsewhere, to read: a `Bucket`, or what fsspec knows, see `remote.folder_at`."""

    url: str

    def read(self, name: str) -> bytes | None: ...

    def size(self, name: str) -> int | None: ...


class Bucket:
    """A folder in an object store, a `Place`. It can be sent to other processes; each connects for
    itself."""

    at_once = 16

    def __init__(self, url: str) -> None:
        """Raise MissingExtra without obstore, InvalidArgument where no store is called so."""
        self.url = url.rstrip("/")
        if scheme_of(url) not in READ_SCHEMES:
            kinds = ", ".join(f"{scheme}://" for scheme in READ_SCHEMES)
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
                client_options={"allow_http": True} if _is_plain(self.url) else {},
                retry_config={"max_retries": RETRIES},
            )
        except (obstore.exceptions.BaseError, ValueError) as error:
            raise InvalidArgument(f"{url}: {error}") from None

    def __reduce__(self) -> tuple[Any, ...]:
        return Bucket, (self.url,)

    def __str__(self) -> str:
        return self.url

    def read(self, name: str) -> bytes | None:
        """Return a file's bytes; None where there is none.

        Raises:
            MachineFault: the store does not answer, or refuses; so all others.
        """
        return self._tried(lambda: bytes(self._obstore.get(self._store, name).bytes()), name)

    def ranges(self, name: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes] | None:
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

    def write(self, name: str, data: bytes | Path) -> None:
        """Write a file, which is there as a whole or not at all."""
        self._tried(lambda: self._obstore.put(self._store, name, data, chunk_size=PART), name)

    def write_new(self, name: str, data: bytes) -> bool:
        """Write a file that was not there; whether it holds `data` now."""

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

    def list(self, under: str = "") -> Mapping[str, Listed]:
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
        cure = "see to the keys, AWS_ACCESS_KEY_ID and the like"
        where = f"{self.url}/{name}"
        return tried(act, where, self._answer, cure=cure, times=TRIES)

    def _answer(self, error: Exception) -> Answer:
        kinds = self._obstore.exceptions
        if isinstance(error, kinds.NotFoundError | FileNotFoundError):
            return Answer.ABSENT
        if isinstance(error, kinds.PermissionDeniedError | kinds.UnauthenticatedError):
            return Answer.REFUSED
        is_theirs = isinstance(error, kinds.BaseError | OSError)
        return Answer.SILENCE if is_theirs else Answer.NONSENSE
