"""A web server's files: resumed where a connection is cut, compared with their digest.

The standard library does it: Hugging Face's own client (2.4) begins a file again once its process
has ended, examines sizes alone, and knows no other publisher.
"""

import http.client
import re
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple, TypeVar
from urllib.parse import urlsplit

from articugen.core.errors import AccessRefused, NotFetched, printable
from articugen.core.files import sha256_of, writing

MAX_FILE_BYTES = 4 * 2**30  # of a file, whatever size its publisher states

WAITS = (1.0, 2.0, 4.0, 8.0)
"""Seconds before each further try, where a connection is cut or the server is busy."""

_AT_ONCE = 8  # requests
_MAX_ANSWER_BYTES = 16 * 2**20
_BLOCK = 2**18
_SECONDS = 30.0
_LONGEST_WAIT = 300.0
_BUSY = (408, 429, 500, 502, 503, 504)
_REFUSALS = {
    401: ("the token is missing or wrong (401); {cure}", AccessRefused),
    403: ("access is not granted (403); {cure}", AccessRefused),
    404: ("is not there (404); look for its name at the publisher's", NotFetched),
}
_TOO_LARGE = "is larger than it should be; report it to its publisher"
_OTHER = "the server answers {code}; try again later"
_CUT = (
    *(urllib.error.URLError, http.client.HTTPException, ssl.SSLError),
    *(ConnectionError, TimeoutError),
)
_Answer = TypeVar("_Answer")


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Redirects to other servers, where files lie, without the token, and within a server with it;
    never from https to http, nor to what is neither."""

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


class Published(NamedTuple):
    """A file as it is published: where on its server, its name in the list of what came, and what
    is stated of it."""

    address: str
    called: str
    size: int | None = None
    sha256: str | None = None


@dataclass(frozen=True)
class Server:
    """A publisher's server.

    Attributes:
        base: its address.
        token: sent as `Authorization: Bearer`, to no other server, and shown to nobody.
        cure: what to do where it refuses access.
        stop: once it is set, what is under way ends with the present block.
    """

    base: str
    token: str = field(default="", repr=False)
    cure: str = ""
    stop: Event = field(default_factory=Event, repr=False, compare=False)

    def each(
        self, ask: Callable[[str], _Answer], names: Iterable[str]
    ) -> Generator[tuple[str, Future[_Answer]], None, None]:
        """Ask for names, some at once, and yield what each one gives as it comes; to be closed.

        After an error no more is asked for, and nobody waits for what is under way: a silent server
        is no reason to stay.
        """
        pool, waiting = ThreadPoolExecutor(_AT_ONCE), iter(names)
        coming: dict[Future[_Answer], str] = {}
        try:
            while True:
                for name in islice(waiting, 2 * _AT_ONCE - len(coming)):
                    coming[pool.submit(ask, name)] = name
                if not coming:
                    break
                for future in wait(coming, return_when=FIRST_COMPLETED).done:
                    yield coming.pop(future), future
        except BaseException:
            self.stop.set()
            raise
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    def get(self, address: str, part: range | None = None) -> tuple[bytes, str]:
        """Return what an address answers, or the bytes `part` of it, and the header `Link` that
        comes with it; AccessRefused or NotFetched where it does not answer, or not with these."""
        headers = {"Range": f"bytes={part.start}-{part.stop - 1}"} if part else {}
        most = len(part) if part else _MAX_ANSWER_BYTES

        def once() -> tuple[bytes, str]:
            with self._ask(address, headers) as response:
                if part and response.status != 206:
                    raise self._not_fetched(address, "no part of the file is given")
                data = response.read(most)
                if response.length and len(data) < most:
                    raise ConnectionError("the connection was cut")
                return data, response.headers.get("Link", "")

        return self._persist(address, once)

    def download(self, file: Published, to: Path) -> None:
        """Get a file, or what is missing of it.

        What came before a cut, or before a process was killed, is kept and completed; of a file
        whose digest nobody states, only what came within this call.

        Raises:
            AccessRefused, NotFetched: it does not come, or is another than it should be.
            MachineFault: the disk is full, or the like.
        """
        if (file.size or 0) > MAX_FILE_BYTES:
            raise self._not_fetched(file.address, _TOO_LARGE)
        with writing(to, file.size or 0):
            to.parent.mkdir(parents=True, exist_ok=True)
            if file.sha256 is None:
                to.unlink(missing_ok=True)
            self._persist(file.address, lambda: self._continue(file, to), lambda: _length(to))
            if file.sha256 not in (None, sha256_of(to)):
                to.unlink()
                raise self._not_fetched(
                    file.address,
                    "came with another digest than its publisher states; try again, and report "
                    "it to them if it stays so",
                )

    def _continue(self, file: Published, to: Path) -> None:
        """Ask for what is missing of a file and append it."""
        have, size = _length(to), file.size
        if size is not None and 0 < size <= have:
            return
        most = MAX_FILE_BYTES if size is None else size
        with self._ask(file.address, {"Range": f"bytes={have}-"} if have else {}) as response:
            resumed = response.status == 206
            have = have if resumed else 0
            with to.open("ab" if resumed else "wb") as out:
                while have <= most and (block := response.read(_BLOCK)):
                    have += out.write(block)
                    self._check_stop(file.address)
            rest = response.length or 0
        if have > most:
            to.unlink()
            raise self._not_fetched(file.address, _TOO_LARGE)
        if rest or have < (size or 0):
            raise ConnectionError("the connection was cut")

    def _ask(self, address: str, headers: Mapping[str, str]) -> Any:
        try:
            request = urllib.request.Request(self.base + address, headers=dict(headers))
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
        """Return what `once` gives, tried again after a cut; while more comes (`have`) without
        end."""
        failures = 0
        while True:
            before, pause = have(), 0.0
            try:
                return once()
            except urllib.error.HTTPError as error:
                error.close()
                if error.code not in _BUSY:
                    why, kind = _REFUSALS.get(error.code, (_OTHER, NotFetched))
                    why = why.format(code=error.code, cure=self.cure)
                    raise kind(f"{_shown(self.base + address)}: {why}") from None
                reason = f"it answers {error.code}"
                after = error.headers.get("Retry-After", "") if error.headers else ""
                pause = min(float(after), _LONGEST_WAIT) if after.isdecimal() else 0.0
            except _CUT as error:
                reason = printable(str(getattr(error, "reason", "") or error))[:100]
            failures = 0 if have() > before else failures + 1
            if failures > len(WAITS):
                raise self._not_fetched(
                    address,
                    f"cannot be got ({reason}); what came is kept, run the same command later",
                )
            self.stop.wait(max(pause, WAITS[max(failures, 1) - 1]))
            self._check_stop(address)

    def _check_stop(self, address: str) -> None:
        if self.stop.is_set():
            raise self._not_fetched(address, "interrupted; what came is kept")

    def _not_fetched(self, address: str, why: str) -> NotFetched:
        return NotFetched(f"{_shown(self.base + address)}: {why}")


def _length(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _shown(address: str) -> str:
    """Return an address without what may be secret in it: user, password and query."""
    return printable(re.sub(r"//[^/]*@", "//", address.partition("?")[0]))
