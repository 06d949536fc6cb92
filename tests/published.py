"""Publishers on this machine: servers of loopback that speak as the hub and SAPIEN's site do."""

import contextlib
import hashlib
import io
import json
import threading
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

TOKEN = "hf_aVeryGoodSecret"
VERSION = "ee0aa3ef1df16181d76d83f7415aa8c94ed1da8f"
REPOSITORY = "sapien-sim/PartNetMobility"

URDF = """<robot name="partnet"><link name="base"/>
  <link name="link_0"><visual><geometry><mesh filename="textured_objs/a.obj"/></geometry></visual>
  </link>
  <link name="link_1"><visual><geometry><mesh filename="textured_objs/a.obj"/></geometry></visual>
  </link>
  <joint name="joint_0" type="revolute"><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
    <parent link="link_1"/><child link="link_0"/><limit lower="0" upper="1.5"/></joint>
  <joint name="joint_1" type="fixed"><parent link="base"/><child link="link_1"/></joint>
</robot>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def model_files(category: str = "Laptop") -> dict[str, bytes]:
    """The files of a model in PartNet-Mobility's layout."""
    return {
        "mobility.urdf": URDF.encode(),
        "meta.json": json.dumps({"model_cat": category}).encode(),
        "semantics.txt": b"link_0 hinge screen\nlink_1 free base_body\n",
        "textured_objs/a.obj": TETRAHEDRON.encode(),
        "images/a.png": hashlib.sha256(category.encode()).digest() * 3000,  # 96 kB
    }


def zipped(files: Mapping[str, bytes], folder: str = "") -> bytes:
    """A .zip, the same for the same files."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(f"{folder}{name}"), content)
    return data.getvalue()


@dataclass
class Publisher:
    """What a server of models has and how it behaves.

    Attributes:
        files: by name.
        cut: of a file, after how many bytes the connection is cut, once for each number.
        stall: of a file, after how many bytes nothing more comes.
        status: of a file, what it is answered with.
        moved: files that are elsewhere on the same server.
        leads: of a file, where the server says that it is, with a body that has no end.
        claims: of a file, what its Content-Length says.
        sizes: of a file, how large the list says that it is.
        link: what the header of that name says of the list.
        busy: so many requests are told to come again.
        asked: all requests: path, query and headers.
        cdn: the second server, which has the files, as the hub's do.
    """

    files: dict[str, bytes]
    token: str = TOKEN
    cut: dict[str, list[int]] = field(default_factory=dict)
    stall: dict[str, int] = field(default_factory=dict)
    status: dict[str, int] = field(default_factory=dict)
    moved: set[str] = field(default_factory=set)
    leads: dict[str, str] = field(default_factory=dict)
    claims: dict[str, str] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)
    link: str = ""
    busy: int = 0
    ranges: bool = True
    asked: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    base: str = ""
    cdn: "Publisher | None" = None

    def bytes_of(self, name: str) -> list[str]:
        """The ranges of a file that were asked for, "" for all of it."""
        return [h.get("Range", "") for path, h in self.asked if urlsplit(path).path.endswith(name)]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Any

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        own: Publisher = self.server.publisher
        own.asked.append((self.path, dict(self.headers)))
        if own.busy > 0:
            own.busy -= 1
            return self.answer(503, b"busy", {"Retry-After": "0"})
        path = urlsplit(self.path).path
        if path.startswith("/api/datasets/"):
            return self.listing(own, path)
        return self.file(own, path)

    def listing(self, own: Publisher, path: str) -> None:
        if path.endswith("/revision/main"):
            return self.answer(200, json.dumps({"sha": VERSION, "gated": "manual"}).encode())
        names = sorted(own.files)
        half = (len(names) + 1) // 2
        first = "cursor" not in parse_qs(urlsplit(self.path).query)
        page = names[:half] if first else names[half:]
        more = own.link or f'<{own.base}{path}?recursive=true&cursor=x>; rel="next"'
        entries = [self.entry(own, name) for name in page]
        return self.answer(200, json.dumps(entries).encode(), {"Link": more} if first else {})

    def entry(self, own: Publisher, name: str) -> dict[str, object]:
        data = own.files[name]
        entry: dict[str, object] = {
            "type": "file",
            "path": name,
            "size": own.sizes.get(name, len(data)),
            "oid": "0" * 40,
        }
        if name.endswith(".zip"):
            oid = hashlib.sha256(data).hexdigest()
            entry["lfs"] = {"oid": oid, "size": own.sizes.get(name, len(data)), "pointerSize": 134}
        return entry

    def file(self, own: Publisher, path: str) -> None:
        name = path.rpartition("/")[2]
        query = parse_qs(urlsplit(self.path).query)
        given = self.headers.get("Authorization", "").removeprefix("Bearer ")
        given = query.get("token", [given])[0]
        if own.token and given != own.token:
            return self.answer(403 if given else 401, b"no")
        if name in own.status or name not in own.files:
            return self.answer(own.status.get(name, 404), b"not here")
        if name in own.leads:
            self.send_response(302)
            self.send_header("Location", own.leads[name])
            self.end_headers()
            self.close_connection = True
            with contextlib.suppress(OSError):
                while True:
                    self.wfile.write(bytes(2**20))
        if name in own.moved and not path.startswith("/moved/"):
            return self.answer(307, b"", {"Location": f"/moved/{name}"})
        if own.cdn is not None:
            return self.answer(302, b"", {"Location": f"{own.cdn.base}/lfs/{name}"})
        return self.send(own, name)

    def send(self, own: Publisher, name: str) -> None:
        data, first, last = own.files[name], 0, len(own.files[name]) - 1
        headers = {"ETag": f'"{hashlib.sha256(data).hexdigest()[:16]}"'}
        asked = self.headers.get("Range", "")
        if asked and own.ranges:
            start, _, end = asked.removeprefix("bytes=").partition("-")
            first, last = int(start), min(int(end), last) if end else last
            if first > last:
                return self.answer(416, b"")
            headers["Content-Range"] = f"bytes {first}-{last}/{len(data)}"
        part = data[first : last + 1]
        if name in own.claims:
            self.close_connection = True
            return self.answer(200, part, {"Content-Length": own.claims[name]})
        cuts = own.cut.get(name, [])
        if not cuts and name not in own.stall:
            return self.answer(206 if "Content-Range" in headers else 200, part, headers)
        self.send_response(206 if "Content-Range" in headers else 200)
        for key, value in {**headers, "Content-Length": str(len(part))}.items():
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(part[: cuts.pop(0) if cuts else own.stall[name]])
        self.wfile.flush()
        if name in own.stall:
            self.connection.settimeout(10.0)
            self.rfile.read(1)  # until the other side is gone
        self.close_connection = True
        return None

    def answer(self, status: int, data: bytes, headers: Mapping[str, str] | None = None) -> None:
        self.send_response(status)
        for key, value in {"Content-Length": str(len(data)), **(headers or {})}.items():
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(data)


@contextmanager
def serving(publisher: Publisher) -> Iterator[Publisher]:
    """A server for a publisher, and one for its second server where it has one."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    server.publisher = publisher  # pyright: ignore[reportAttributeAccessIssue]
    publisher.base = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        if publisher.cdn is None:
            yield publisher
        else:
            with serving(publisher.cdn):
                yield publisher
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
