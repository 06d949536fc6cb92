"""A web server's files: resumed where a connection is cut, checked against their digest.

The standard library does it: Hugging Face's own client (2.4) begins a file again once its process
has ended, examines sizes alone, and knows no other publisher.
"""

import http.client
import io
import json
import re
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any, TypeVar
from urllib.parse import urljoin, urlsplit

from articugen.core.errors import AccessRefused, MachineFault, NotFetched, printable
from articugen.core.files import cannot_write, sha256_of, within

MAX_FILE_BYTES = 4 * 2**30  # of a file, whatever size is told

WAITS = (1.0, 2.0, 4.0, 8.0)
"""Seconds before each further try, where a connection is cut or the server is busy."""

_MAX_JSON_BYTES = 16 * 2**20
_BLOCK = 2**18
_MOST_DIGITS = 20
_TAIL = 2**16
_SECONDS = 30.0
_LONGEST_WAIT = 300.0
_BUSY = (408, 429, 500, 502, 503, 504)
_CUT = (
    urllib.error.URLError,
    http.client.HTTPException,
    ConnectionError,
    TimeoutError,
    ssl.SSLError,
)
_Answer = TypeVar("_Answer")


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Leads on to other servers, where files lie, without the token, and to other places of the
    same server with it; never from https to http, nor to what is neither."""

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        old, new = urlsplit(req.full_url), urlsplit(newurl)
        if new.scheme not in ("https", old.scheme):
            raise NotFetched(f"{_shown(req.full_url)}: leads on to an address that is not secure")
        after = super().redirect_request(req, fp, code, msg, headers, newurl)
        token = req.unredirected_hdrs.get("Authorization")
        if after is not None and token and (old.scheme, old.netloc) == (new.scheme, new.netloc):
            after.add_unredirected_header("Authorization", token)
        return after

    def http_error_302(self, req: Any, fp: Any, code: int, msg: str, headers: Any) -> Any:
        fp.close()  # urllib would read all that comes with it
        return super().http_error_302(req, fp, code, msg, headers)

    http_error_301 = http_error_303 = http_error_307 = http_error_308 = http_error_302


_OPENER = urllib.request.build_opener(_Redirects)


@dataclass(frozen=True)
class Published:
    """A file as it is published.

    Attributes:
        name: from the data set's folder on.
        address: where its server has it.
        size, sha256: None where nobody tells.
        called: its name in the list of what came, with the version of the data set.
    """

    name: str
    address: str
    size: int | None = None
    sha256: str | None = None
    called: str = ""


@dataclass(frozen=True)
class Server:
    """Where files are published.

    Attributes:
        base: its address.
        token: sent as `Authorization: Bearer`, to no other server, and told to nobody.
        cure: what to do where it refuses access.
        stop: once it is set, what is under way ends with the block that is at hand.
    """

    base: str
    token: str = field(default="", repr=False)
    cure: str = ""
    stop: Event = field(default_factory=Event, repr=False, compare=False)

    def json(self, address: str) -> tuple[Any, str]:
        """Return what an address answers, and the address of the next page, "" after the last;
        AccessRefused or NotFetched where it does not answer, or with something else."""

        def once() -> tuple[bytes, str]:
            with self._ask(address) as response:
                return response.read(_MAX_JSON_BYTES), response.headers.get("Link", "")

        data, link = self._persist(address, once)
        try:
            answer = json.loads(data)
        except (ValueError, RecursionError):
            raise self._not_fetched(address, "answers what is no JSON; try again later") from None
        following = re.search(r'<([^<>]*)>;\s*rel="next"', link)
        if not following:
            return answer, ""
        try:
            whole = urljoin(self.base, following[1])
        except ValueError:
            whole = ""
        if not whole.startswith(f"{self.base}/"):
            raise NotFetched(f"{_shown(self.base)}: leads on to another server; try again later")
        return answer, whole.removeprefix(self.base)

    def part(self, address: str, first: int, last: int) -> bytes:
        """Return the bytes `first` to `last` of a file, both counted; AccessRefused or NotFetched
        where it does not answer, or not with these."""

        def once() -> bytes:
            with self._ask(address, {"Range": f"bytes={first}-{last}"}) as response:
                if response.status != 206:
                    raise self._not_fetched(address, "no part of the file is given")
                data = response.read(last - first + 1)
            if len(data) <= last - first:
                raise ConnectionError("the connection was cut")
            return data

        return self._persist(address, once)

    def download(self, file: Published, to: Path) -> str:
        """Get a file, or what is missing of it; its digest.

        What came before a cut, or before a process was killed, is kept beside `to` and gone on
        from; of a file whose digest nobody tells, only what came within this call.

        Raises:
            AccessRefused, NotFetched: it does not come, or is another than it should be.
            MachineFault: the disk is full, or the like.
        """
        address, size = file.address, file.size
        if size is not None and size > MAX_FILE_BYTES:
            raise self._too_large(address)
        marks: dict[str, str] = {}
        try:
            to.parent.mkdir(parents=True, exist_ok=True)
            part = within(to.parent, f".{to.name}.part")
            if file.sha256 is None or (size is not None and _length(part) > size):
                part.unlink(missing_ok=True)
            if size is None or not part.exists() or _length(part) != size:
                self._persist(
                    address,
                    lambda: self._continue(address, part, size, marks),
                    lambda: _length(part),
                )
            digest = sha256_of(part)
            if file.sha256 not in (None, digest):
                part.unlink()
                raise self._not_fetched(
                    address,
                    "came with another digest than its publisher tells; try again, and tell them "
                    "if it stays so",
                )
            part.replace(to)
        except OSError as error:
            raise MachineFault(cannot_write(to, error, size or 0)) from error
        return digest

    def _continue(self, address: str, part: Path, size: int | None, marks: dict[str, str]) -> None:
        """Ask for what is missing of a file and append it; `marks` is what the server called the
        version that came so far."""
        have = _length(part)
        headers = {"Range": f"bytes={have}-"} if have else {}
        if have and marks.get("ETag"):
            headers["If-Range"] = marks["ETag"]
        try:
            response = self._ask(address, headers)
        except urllib.error.HTTPError as error:
            if error.code == 416:  # it has become shorter than what came
                error.close()
                part.unlink()
                raise ConnectionError("the file has changed") from None
            raise
        with response:
            told = response.headers
            resumed = response.status == 206
            resumed = resumed and told.get("Content-Range", "").startswith(f"bytes {have}-")
            have = have if resumed else 0
            mark = told.get("ETag", "")
            marks["ETag"] = "" if mark.startswith("W/") else mark
            rest = told.get("Content-Length", "")
            whole = size
            if size is None and rest.isdecimal() and len(rest) < _MOST_DIGITS:
                whole = have + int(rest)
            most = MAX_FILE_BYTES if size is None else size
            with part.open("ab" if resumed else "wb") as file:
                while have <= most and (block := response.read(_BLOCK)):
                    file.write(block)
                    have += len(block)
                    self._go_on(address)
        if have > most:
            part.unlink()
            raise self._too_large(address)
        if whole is not None and have < whole:
            raise ConnectionError("the connection was cut")

    def _ask(self, address: str, headers: Mapping[str, str] | None = None) -> Any:
        try:
            request = urllib.request.Request(self.base + address, headers=dict(headers or {}))
            if request.type not in ("http", "https"):
                raise ValueError(request.type)
            request.add_header("User-Agent", "articugen")
            if self.token:
                request.add_unredirected_header("Authorization", f"Bearer {self.token}")
            return _OPENER.open(request, timeout=_SECONDS)
        except (ValueError, http.client.InvalidURL):  # whose words may hold the token
            raise self._not_fetched(
                address,
                "cannot be asked, for its address, the one it leads on to, or the token is "
                "malformed; correct what names it, HF_ENDPOINT or SAPIEN_ENDPOINT, or the token",
            ) from None

    def _persist(
        self, address: str, once: Callable[[], _Answer], have: Callable[[], int] = lambda: 0
    ) -> _Answer:
        """What `once` gives, tried again after a cut; while more comes (`have`) without end."""
        failures = 0
        while True:
            before, wait = have(), 0.0
            try:
                return once()
            except urllib.error.HTTPError as error:
                error.close()
                if error.code not in _BUSY:
                    raise self._refusal(address, error.code) from None
                reason = f"it answers {error.code}"
                after = error.headers.get("Retry-After", "") if error.headers else ""
                wait = min(float(after), _LONGEST_WAIT) if after.isdecimal() else 0.0
            except _CUT as error:
                reason = printable(str(getattr(error, "reason", "") or error))[:100]
            failures = 0 if have() > before else failures + 1
            if failures > len(WAITS):
                raise self._not_fetched(
                    address,
                    f"cannot be got ({reason}); what came is kept, run the same command later",
                )
            self.stop.wait(max(wait, WAITS[max(failures, 1) - 1]))
            self._go_on(address)

    def _go_on(self, address: str) -> None:
        if self.stop.is_set():
            raise self._not_fetched(address, "interrupted; what came is kept")

    def _too_large(self, address: str) -> NotFetched:
        return self._not_fetched(address, "is larger than it should be; tell its publisher")

    def _refusal(self, address: str, code: int) -> NotFetched:
        if code in (401, 403):
            why = "the token is missing or wrong" if code == 401 else "access is not granted"
            return AccessRefused(f"{_shown(self.base + address)}: {why} ({code}); {self.cure}")
        why = f"the server answers {code}; try again later"
        if code == 404:
            why = "is not there (404); look for its name at the publisher's"
        return self._not_fetched(address, why)

    def _not_fetched(self, address: str, why: str) -> NotFetched:
        return NotFetched(f"{_shown(self.base + address)}: {why}")


class RemoteFile(io.RawIOBase):
    """A published file that is read where it lies, a part at a time; its end first, where archives
    have their list."""

    def __init__(self, server: Server, address: str, size: int) -> None:
        self._server, self._address, self._size = server, address, size
        self._at, self._first = 0, max(0, size - _TAIL)
        self._held = server.part(address, self._first, size - 1) if size else b""

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def read(self, size: int = -1) -> bytes:
        if size > _MAX_JSON_BYTES:  # room would be made at once
            raise ValueError("an archive's list of files has no such size")
        return super().read(size) or b""

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        last = min(self._at + len(buffer), self._size) - 1
        if last < self._at:
            return 0
        if self._at < self._first or last >= self._first + len(self._held):
            self._held = self._server.part(
                self._address, self._at, max(last, min(self._at + _TAIL, self._size) - 1)
            )
            self._first = self._at
        data = self._held[self._at - self._first : last + 1 - self._first]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def _length(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _shown(address: str) -> str:
    """Return an address without what may be secret in it: user, password and query."""
    try:
        parts = urlsplit(address)
        host = f"{parts.hostname or ''}:{parts.port}" if parts.port else parts.hostname or ""
    except ValueError:
        return printable(address.partition("?")[0].rpartition("@")[2])
    return printable(f"{parts.scheme}://{host}{parts.path}")
