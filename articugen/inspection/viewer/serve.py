"""A server for this machine alone that shows a source."""

import contextlib
import io
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

from articugen.core.errors import ArticugenError, MissingExtra
from articugen.inspection.viewer.guard import guarded
from articugen.inspection.viewer.session import Session
from articugen.inspection.viewer.sources import Source

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
PORT = 8080  # viser's own; the next free one where it is taken


@dataclass(frozen=True)
class Served:
    """A running viewer: `session` at `url`."""

    session: Session
    url: str


@contextlib.contextmanager
def served(source: Source, *, host: str = LOOPBACK, port: int | None = None) -> Iterator[Served]:
    """Show a source for as long as the context lasts.

    Args:
        port: None for viser's own, or the next that is free.

    Raises:
        MissingExtra: viser is not there.
        ArticugenError: the host or port cannot be listened on; the only object cannot be shown.
    """
    server = _server(host, port)
    session = Session(server, source)
    try:
        if len(source.objects) == 1 and session.wait(None) and session.seen is None:
            raise ArticugenError(session.fault)
        name = f"[{host}]" if ":" in host else host
        yield Served(session, f"http://{name}:{server.get_port()}")
    finally:
        session.end()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def _server(host: str, port: int | None) -> "viser.ViserServer":
    if find_spec("viser") is None:
        raise MissingExtra("viser", "view")
    import viser  # noqa: PLC0415 - optional

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port or 0), family=family).close()
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        where = host if port is None else f"{host}:{port}"
        cure = "another --host" if port is None else "another --port, or none for the next free one"
        raise ArticugenError(f"{where}: cannot listen there ({reason}); give {cure}") from None
    port = PORT if port is None else port
    with contextlib.redirect_stdout(io.StringIO()):  # the command says where it listens
        return guarded(host, lambda: viser.ViserServer(host=host, port=port, verbose=False))
