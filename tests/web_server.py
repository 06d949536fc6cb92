"""A web server of one folder, here: with parts of files, and as much of Hugging Face's hub as is
asked where a data set is read there."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any


class Site(ThreadingHTTPServer):
    """The folder `root`, at `url`, and as hf://datasets/some/set where that is the hub.

    Attributes:
        parts: whether parts of files are given.
        status: with which all is answered, where it is not 0.
        sent: bytes of files that were sent.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.parts, self.status, self.sent = root, True, 0, 0
        super().__init__(("127.0.0.1", 0), _Answers)
        self.url = f"http://127.0.0.1:{self.server_port}"


@contextmanager
def site(root: Path) -> Iterator[Site]:
    with Site(root) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


class _Answers(SimpleHTTPRequestHandler):
    server: Site

    def log_message(self, *_: Any) -> None:
        pass

    def do_GET(self) -> None:
        self._answer()

    def do_HEAD(self) -> None:
        self._answer()

    def _answer(self) -> None:
        path = self.path.partition("?")[0]
        if self.server.status:
            self.send_error(self.server.status)
        elif path.startswith("/api/datasets/some/set/tree/main"):
            self._listing(path.removeprefix("/api/datasets/some/set/tree/main").strip("/"))
        elif path.startswith("/api/datasets/some/set"):
            self._send(json.dumps({"id": "some/set", "sha": "0" * 40}).encode())
        else:
            name = path.removeprefix("/datasets/some/set/resolve/main").lstrip("/")
            self._file(self.server.root / name)

    def _listing(self, under: str) -> None:
        files = sorted((self.server.root / under).glob("*"))
        about = [
            {"type": "file", "path": f"{under}/{f.name}", "size": f.stat().st_size, "oid": "0" * 40}
            for f in files
        ]
        self._send(json.dumps(about).encode())

    def _file(self, path: Path) -> None:
        if not path.is_file():
            self.send_error(404)
            return
        data, wanted = path.read_bytes(), self.headers.get("Range")
        if not wanted or not self.server.parts:
            self._send(data)
            return
        first, last = map(int, wanted.removeprefix("bytes=").split("-"))
        part = data[first : last + 1]
        self._send(part, f"bytes {first}-{first + len(part) - 1}/{len(data)}")

    def _send(self, data: bytes, span: str = "") -> None:
        self.send_response(206 if span else 200)
        if span:
            self.send_header("Content-Range", span)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Last-Modified", self.date_time_string(0))
        self.end_headers()
        if self.command == "GET":
            self.server.sent += len(data)
            self.wfile.write(data)
