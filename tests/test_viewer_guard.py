"""The viewer answers its own pages alone: real requests, of a plain and of a websocket client."""

import http.client
from collections.abc import Iterator
from socket import create_connection
from types import SimpleNamespace

import pytest
from instances import SMALL, hinged_box
from ppd_data import shard

from articugen.core.errors import ArticugenError
from articugen.inspection.viewer.serve import Served, served
from articugen.inspection.viewer.sources import source_of

pytest.importorskip("viser", reason="viser is not installed; make viewer installs it")

import viser
from websockets.asyncio import server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    few = {"grids": (8,), "surface_points": 64, "uniform_points": 64, "near_points": 64}
    recipe = SMALL.model_copy(update={"sampling": SMALL.sampling.model_copy(update=few)})
    return str(shard(tmp_path_factory.mktemp("box") / "train-00000.h5", hinged_box(recipe=recipe)))


@pytest.fixture(scope="module")
def here(data: str) -> Iterator[Served]:
    with served(source_of(data)) as there:
        yield there


@pytest.fixture(scope="module")
def everywhere(data: str) -> Iterator[Served]:
    with served(source_of(data), host="0.0.0.0") as there:
        yield there


def port_of(there: Served) -> int:
    return int(there.url.rpartition(":")[2])


def page(there: Served, *headers: tuple[str, str]) -> tuple[int, str]:
    """The status and the text of the page, asked for with just these headers."""
    connection = http.client.HTTPConnection("127.0.0.1", port_of(there), timeout=60)
    connection.putrequest("GET", "/", skip_host=True, skip_accept_encoding=True)
    for name, value in headers:
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def websocket(there: Served, host: str, origin: str | None) -> int | None:
    """101 where a websocket opens and models come through it, else the status that refuses it."""
    try:
        with connect(
            f"ws://{host}",
            sock=create_connection(("127.0.0.1", port_of(there))),
            origin=origin,  # pyright: ignore[reportArgumentType]
            subprotocols=[f"viser-v{viser.__version__}"],  # pyright: ignore[reportArgumentType]
            proxy=None,
            max_size=None,
        ) as opened:
            assert len(opened.recv(timeout=60)) > 100
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


OTHERS = ("http://evil.example", "https://{host}", "http://{name}:1", "http://{name}", "null", "")


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]", "LOCALHOST"])
def test_its_own_pages_are_answered_and_those_of_other_sites_are_not(here, name) -> None:
    host = f"{name}:{port_of(here)}"
    assert page(here, ("Host", host))[0] == 200
    assert page(here, ("Host", host), ("Origin", f"http://{host}"))[0] == 200
    assert websocket(here, host, f"http://{host}") == 101
    assert websocket(here, host, None) == 101  # no page of a browser: those name their origin
    for other in OTHERS:
        origin = other.format(host=host, name=name)
        assert page(here, ("Host", host), ("Origin", origin))[0] == 403
        if origin:
            assert websocket(here, host, origin) == 403


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "10.1.2.3", "localhost.", "[::1", "[x]", ""]
)
def test_names_that_lead_here_from_elsewhere_are_refused(here, host) -> None:
    status, why = page(here, ("Host", host), ("Origin", f"http://{host}"))
    assert (status, "open the address that `articugen view` printed" in why) == (403, True)
    if host and "[" not in host:
        assert websocket(here, f"{host}:{port_of(here)}", None) == 403
        assert websocket(here, f"{host}:{port_of(here)}", f"http://{host}:{port_of(here)}") == 403


def test_a_request_names_one_host_and_one_origin(here) -> None:
    host = f"127.0.0.1:{port_of(here)}"
    assert page(here)[0] == 403
    assert page(here, ("Host", host), ("Host", "evil.example"))[0] == 403
    origin = ("Origin", f"http://{host}")
    assert page(here, ("Host", host), origin, origin)[0] == 403


def test_through_a_tunnel_the_port_is_another(here) -> None:
    assert websocket(here, "localhost:9000", "http://localhost:9000") == 101
    assert websocket(here, "localhost:9000", f"http://localhost:{port_of(here)}") == 403


def test_on_all_addresses_it_is_asked_by_address_and_not_by_any_name(everywhere) -> None:
    for host in ("192.0.2.7:80", "0.0.0.0", "[2001:db8::7]:80", "localhost"):
        assert page(everywhere, ("Host", host), ("Origin", f"http://{host}"))[0] == 200
        assert page(everywhere, ("Host", host), ("Origin", "http://192.0.2.8"))[0] == 403
    assert page(everywhere, ("Host", "evil.example"))[0] == 403
    assert websocket(everywhere, "evil.example", "http://evil.example") == 403


def test_a_host_that_was_named_is_answered(data: str) -> None:
    with served(source_of(data), host="127.0.0.5") as there:
        assert there.url.startswith("http://127.0.0.5:")
        connection = http.client.HTTPConnection("127.0.0.5", port_of(there), timeout=60)
        connection.request("GET", "/")
        assert connection.getresponse().status == 200
        connection.close()


def test_a_viser_that_serves_otherwise_does_not_serve(data: str, monkeypatch) -> None:
    bound = SimpleNamespace(asyncio=SimpleNamespace(server=SimpleNamespace(serve=server.serve)))
    for name in ("datastructures", "exceptions"):
        setattr(bound, name, getattr(viser.infra._infra.websockets, name))
    monkeypatch.setattr(viser.infra._infra, "websockets", bound)
    with (
        pytest.raises(ArticugenError, match="serves unguarded; install viser"),
        served(source_of(data)),
    ):
        pass
