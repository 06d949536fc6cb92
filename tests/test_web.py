"""Files of servers that behave badly, as `articugen fetch` reads them."""

import io
import os
import zipfile

import pytest
import test_fetch
from test_fetch import run, whole

import articugen as ag
from articugen.core.errors import AccessRefused, NotFetched
from articugen.core.ledger import Ledger
from articugen.core.place import Folder
from articugen.sources.fetch import partnet_mobility, web
from articugen.sources.fetch.web import Published, RemoteFile, Server
from tests.published import TOKEN

hub, site = test_fetch.hub, test_fetch.site


def test_a_remote_file_reads_like_the_file(hub):
    data = os.urandom(200_000)
    hub.cdn.files["r.bin"] = hub.files["r.bin"] = data
    file = RemoteFile(Server(hub.base, token=TOKEN), "/r.bin", len(data))
    for start, count in ((199_990, 10), (0, 5), (5, 100_000), (150_000, 99_999), (200_000, 1)):
        file.seek(start)
        got = b""
        while len(got) < count and (part := file.read(count - len(got))):
            got += part
        assert got == data[start : start + count]
    assert file.seek(-3, 2) == 199_997
    assert file.read(10) == data[-3:]


def test_a_list_that_leads_to_another_server_is_not_followed(hub):
    own = Server(hub.base, token=TOKEN)
    hub.base = hub.base.replace("127.0.0.1", "127.0.0.2")
    with pytest.raises(NotFetched, match="leads on to another server"):
        own.json("/api/datasets/x/tree/main?recursive=true")


def test_user_and_password_in_an_address_are_not_shown(hub):
    server = Server("http://me:secret@127.0.0.1:9")
    with pytest.raises(NotFetched) as told:
        server.json("/list?token=secret")
    assert "secret" not in str(told.value)


def test_a_refusal_is_not_asked_again(hub):
    hub.token = "other"
    before = len(hub.asked)
    with pytest.raises(AccessRefused):
        Server(hub.base, token=TOKEN).part("/9748.zip", 0, 9)
    assert len(hub.asked) == before + 1


@pytest.mark.parametrize("harm", ["deep", "damaged", "encrypted"])
def test_what_a_published_archive_calls_its_model_may_be_anything(monkeypatch, harm):
    text = b"[" * 100_000 if harm == "deep" else b"{}"
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("1/meta.json", text)
    image = bytearray(data.getvalue())
    if harm == "damaged":
        image[30 + len("1/meta.json")] = 0xFF
    if harm == "encrypted":
        image[6] |= 1
        image[image.index(b"PK\1\2") + 8] |= 1
    monkeypatch.setattr(partnet_mobility, "RemoteFile", lambda *_: io.BytesIO(image))
    file = Published("1.zip", "/1.zip", len(image), None)
    assert partnet_mobility._category(Server("http://127.0.0.1:1"), file) == ""


def test_a_receipt_that_is_deep_is_none(hub, tmp_path):
    assert ag.fetch("partnet-mobility", tmp_path, ids=["9748"]).new == 1
    Ledger(Folder(tmp_path)).record("9748", b"[" * 100_000)
    again = ag.fetch("partnet-mobility", tmp_path, ids=["9748"])
    assert (again.models, again.new) == (1, 1)


def test_an_empty_file_of_terms_is_one(hub, tmp_path):
    hub.files["LICENSE"] = hub.cdn.files["LICENSE"] = b""
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert (tmp_path / "terms" / "LICENSE").read_bytes() == b""


@pytest.mark.parametrize("claim", [str(10**15), "9" * 5000, "-1"])
def test_no_length_that_a_server_claims_lifts_the_bound(site, tmp_path, monkeypatch, claim):
    monkeypatch.setattr(web, "MAX_FILE_BYTES", 50_000)
    site.claims["9748.zip"] = claim
    with pytest.raises(NotFetched, match=r"9748\.zip: is larger than it should be"):
        ag.fetch("partnet-mobility", tmp_path, ids=["9748"], via="sapien", token="sapien-secret")
    assert not list((tmp_path / ".fetch" / "downloads").iterdir())


def test_no_size_that_the_list_claims_lifts_the_bound(hub, tmp_path):
    hub.sizes |= {"9748.zip": 10**15, "7138.zip": 10**15}
    done = run("partnet-mobility", "--ids", "9748,10040", "-o", tmp_path)
    assert done.exit_code == 3
    assert "9748.zip: is larger than it should be" in done.output
    assert whole(tmp_path, "10040")
    assert not hub.cdn.bytes_of("9748.zip")


@pytest.mark.parametrize(
    "to", ["ftp://127.0.0.1/9748.zip", "http://[::1", "http://127.0.0.1:x/", "file:///etc/passwd"]
)
def test_a_server_leads_to_no_other_kind_of_address(hub, tmp_path, to):
    hub.leads["9748.zip"] = to
    done = run("partnet-mobility", "--ids", "9748,10040", "-o", tmp_path)
    assert done.exit_code == 3
    assert done.output.count("not fetched 9748: http://127.0.0.1") == 1
    assert whole(tmp_path, "10040")


def test_the_body_of_what_leads_on_is_not_read(hub, tmp_path):
    hub.leads["9748.zip"] = f"{hub.cdn.base}/lfs/9748.zip"
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")


@pytest.mark.parametrize(
    ("base", "token"),
    [
        ("http://[::1", ""),
        ("http://127.0.0.1:x", ""),
        ("ftp://127.0.0.1", ""),
        ("file:///etc", ""),
        ("127.0.0.1", ""),
        ("http://\udcff", ""),
        ("http://" + "a" * 80 + ".example", ""),
        ("http://127.0.0.1:9", "secret\nX-Y: z"),
        ("http://127.0.0.1:9", "secret\udcff"),
    ],
)
def test_a_malformed_address_or_token_is_told_in_a_sentence(tmp_path, monkeypatch, base, token):
    monkeypatch.setenv("HF_ENDPOINT", base)
    with pytest.raises(NotFetched, match=r"malformed; correct what names it, HF_ENDPOINT") as told:
        ag.fetch("partnet-mobility", tmp_path, ids=["9748"], token=token or "hf_x")
    assert "secret" not in str(told.value)


@pytest.mark.parametrize("link", ["<" * 60_000, "<" * 6_000 + ">;" + " " * 50_000, "<http://[::1>"])
def test_a_link_of_any_kind_is_read_in_linear_time(hub, link):
    hub.link = f'{link}; rel="next"'
    server = Server(hub.base, token=TOKEN)
    if "[" in link:
        with pytest.raises(NotFetched, match="leads on to another server"):
            server.json("/api/datasets/x/tree/main?recursive=true")
    else:
        assert server.json("/api/datasets/x/tree/main?recursive=true")[1] == ""


def test_names_that_a_list_of_files_may_hold(hub, tmp_path):
    """Ids of 5,000 digits, terms of any name: no such file is asked for."""
    odd = ("9" * 5000 + ".zip", "README\0", "LICENSE\n", "TERMS" + "x" * 300, "README\x1b[2J")
    hub.files |= dict.fromkeys((*odd, "\ud800/1.zip", "README\ud800"), b"x")
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert {p.name for p in (tmp_path / "terms").iterdir()} == {"README.md"}


def test_a_remote_file_makes_no_room_for_what_an_archive_claims(hub):
    file = RemoteFile(Server(hub.base, token=TOKEN), "/9748.zip", len(hub.files["9748.zip"]))
    with pytest.raises(ValueError, match="has no such size"):
        file.read(10**15)
