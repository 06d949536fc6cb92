"""A server of S3 in this process, which can be made to fail."""

import socket
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

BUCKET = "shelf"


class Trouble:
    """What stands before the server: it counts requests, and spoils some of them.

    Attributes:
        every: of so many requests one is spoilt, by turns: answered by 503 without being heard, cut
            off before it is heard, or cut off once it was done; 0 spoils none.
        deaf: a method, requests of which are all answered by 503.
        seen: how many requests of each method came.
        sent: bytes that GET requests were answered with.
    """

    def __init__(self, app: Callable[..., Iterable[bytes]]) -> None:
        self._app, self._count, self._turn = app, 0, 0
        self.every, self.deaf, self.sent, self.spoilt = 0, "", 0, Counter[str]()
        self.seen = Counter[str]()

    def __call__(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        self._count += 1
        self.seen[environ["REQUEST_METHOD"]] += 1
        kind = ""
        if self.every and self._count % self.every == 0:
            kind = ("503", "unheard", "unanswered")[self._turn % 3]
            self._turn += 1
            self.spoilt[kind] += 1
        if kind == "503" or environ["REQUEST_METHOD"] == self.deaf:
            start("503 Slow Down", [("Content-Length", "0")])
            return [b""]
        if kind == "unheard":
            return self._cut(environ)
        answer = b"".join(self._app(environ, start))
        if kind == "unanswered":
            return self._cut(environ)
        self.sent += len(answer) * (environ["REQUEST_METHOD"] == "GET")
        return [answer]

    @staticmethod
    def _cut(environ: dict[str, Any]) -> Iterable[bytes]:
        environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
        raise ConnectionAbortedError


@contextmanager
def bucket_server(patch: pytest.MonkeyPatch) -> Iterator[Trouble]:
    """A server with an empty bucket, which the environment leads to."""
    server_module = pytest.importorskip("moto.moto_server.threaded_moto_server", reason="no moto")
    found: list[Trouble] = []

    class Guarded(server_module.DomainDispatcherApplication):  # type: ignore[misc]
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            found.append(Trouble(super().__call__))

        def __call__(self, environ: Any, start: Any) -> Any:
            return found[0](environ, start)

    patch.setattr(server_module, "DomainDispatcherApplication", Guarded)
    server = server_module.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "some",
        "AWS_SECRET_ACCESS_KEY": "key",
        "AWS_REGION": "us-east-1",
    }.items():
        patch.setenv(name, value)
    with socket.create_connection((host, port)) as line:
        line.sendall(f"PUT /{BUCKET} HTTP/1.0\r\nHost: s3.amazonaws.com\r\n\r\n".encode())
        assert b" 200 " in line.recv(100)
    try:
        yield found[0]
    finally:
        server.stop()
