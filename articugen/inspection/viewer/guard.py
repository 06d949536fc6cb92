"""What stands before viser's server, which by itself answers whoever asks.

A page of another site that is open in the same browser could otherwise read models and move sliders
through a websocket, or by a name of its own that leads here (DNS rebinding).
"""

import socket
from collections.abc import Callable
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from articugen.core.errors import ArticugenError

LOOPBACK_NAMES = {"127.0.0.1", "localhost", "::1"}

EVERYWHERE = {"", "0.0.0.0", "::"}  # hosts that stand for all addresses of a machine


def guarded(host: str, start: Callable[[], Any]) -> Any:
    """Have viser's server, that `start` starts, refuse the pages of other sites, with 403.

    viser lets nobody examine requests, so this comes between it and the function that it serves
    with.

    Raises:
        ArticugenError: it serves with another one.
    """
    from websockets.asyncio import server  # noqa: PLC0415 - comes with viser

    plain, started = server.serve, []

    def serve(*args: Any, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if why := refusal(host, connection.local_address[0], request.headers):
                return connection.respond(403, f"{why}\n")
            return process_request(connection, request)

        started.append(host)
        return plain(*args, process_request=answer, **options)

    server.serve = serve
    try:
        shown = start()
    finally:
        server.serve = plain
    if not started:
        shown.stop()
        raise ArticugenError("viser: this version serves unguarded; install viser 1.1")
    return shown


def refusal(host: str, address: str, headers: Any) -> str:
    """Return the sentence that says why a request is not answered; "" where it is.

    Args:
        host: where the server listens.
        address: where this request came in.
        headers: of the request.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _leads_here(hosts[0], host, address):
        return (
            "This host is not where the viewer listens; open the address that `articugen view` "
            "printed, or start it with --host and this name."
        )
    if [origin.lower() for origin in origins] not in ([], [f"http://{hosts[0].lower()}"]):
        return "A page of another site asks for this; open the viewer's own address."
    return ""


def _leads_here(header: str, host: str, address: str) -> bool:
    """Return whether a Host header names this server. Its port may be another's, that of a
    tunnel."""
    try:
        name = urlsplit(f"//{header}").hostname or ""
    except ValueError:
        return False
    if name in LOOPBACK_NAMES | {host.lower(), address}:
        return True
    try:
        ip_address(name)  # nobody can have an address, unlike a name, lead elsewhere
    except ValueError:
        return host in EVERYWHERE and name == socket.gethostname().lower()
    return host in EVERYWHERE
