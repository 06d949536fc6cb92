"""Files of servers that behave badly, as `articugen fetch` reads them."""

import io
import zipfile

import pytest
import test_fetch
from test_fetch import partnet, whole

import articugen as ag
from articugen.core.errors import AccessRefused, NotFetched
from articugen.sources.fetch import partnet_mobility, web
from articugen.sources.fetch.web import Published, Server
from tests.published import TOKEN

hub, site, patience = test_fetch.hub, test_fetch.site, test_fetch.patience


def test_user_and_password_in_an_address_are_not_shown(hub):
    server = Server("http://me:secret@127.0.0.1:9")
    with pytest.raises(NotFetched) as told:
        server.get("/list?token=secret")
    assert "secret" not in str(told.value)


def test_a_refusal_is_not_asked_again(hub):
    hub.token = "other"
    before = len(hub.asked)
    with pytest.raises(AccessRefused):
        Server(hub.base, token=TOKEN).get("/9748.zip", range(10))
    assert len(hub.asked) == before + 1


@pytest.mark.parametrize("harm", ["deep", "damaged", "encrypted", "long"])
def test_what_a_published_archive_calls_its_model_may_be_anything(hub, harm):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "1/meta.json", "[" * 100_000 if harm == "deep" else '{"model_cat": "Oven"}'
        )
        for number in range(2000 if harm == "long" else 0):  # its list is longer than what is read
            archive.writestr(f"1/{number}.obj", b"")
    image = bytearray(data.getvalue())
    if harm == "damaged":
        image[30 + len("1/meta.json")] = 0xFF
    if harm == "encrypted":
        image[6] |= 1
        image[image.index(b"PK\1\2") + 8] |= 1
    hub.files["m.zip"] = hub.cdn.files["m.zip"] = bytes(image)
    server = Server(hub.base, token=TOKEN)
    category = partnet_mobility._category(server, Published("/m.zip", "m.zip", len(image)))
    assert category == ("Oven" if harm == "long" else "")


@pytest.mark.parametrize("claim", [str(10**15), "9" * 5000, "-1"])
def test_no_length_that_a_server_claims_lifts_the_bound(site, tmp_path, monkeypatch, claim):
    monkeypatch.setattr(web, "MAX_FILE_BYTES", 50_000)
    site.claims["9748.zip"] = claim
    with pytest.raises(NotFetched, match=r"9748\.zip: is larger than it should be"):
        ag.fetch("partnet-mobility", tmp_path, ids=["9748"], via="sapien", token="sapien-secret")
    assert not list((tmp_path / ".fetch" / "downloads").iterdir())


def test_no_size_that_the_list_claims_lifts_the_bound(hub, tmp_path):
    hub.sizes |= {"9748.zip": 10**15, "7138.zip": 10**15}
    done = partnet(tmp_path, "9748,10040")
    assert done.exit_code == 3
    assert "9748.zip: is larger than it should be" in done.output
    assert whole(tmp_path, "10040")
    assert not hub.cdn.bytes_of("9748.zip")


@pytest.mark.parametrize(
    "to", ["ftp://127.0.0.1/9748.zip", "http://[::1", "http://127.0.0.1:x/", "file:///etc/passwd"]
)
def test_a_server_leads_to_no_other_kind_of_address(hub, tmp_path, to):
    hub.leads["9748.zip"] = to
    done = partnet(tmp_path, "9748,10040")
    assert done.exit_code == 3
    assert done.output.count("not fetched 9748: http://127.0.0.1") == 1
    assert whole(tmp_path, "10040")


def test_the_body_of_what_leads_on_is_not_read(hub, tmp_path):
    hub.leads["9748.zip"] = f"{hub.cdn.base}/lfs/9748.zip"
    assert partnet(tmp_path).exit_code == 0
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


@pytest.mark.parametrize(
    "link", ["<" * 60_000, "<" * 6_000 + ">;" + " " * 50_000, "<http://[::1>", ""]
)
def test_a_link_of_any_kind_is_read_in_linear_time(hub, link):
    """Nor is it followed to another server."""
    hub.link = link and f'{link}; rel="next"'
    own, hub.base = Server(hub.base, token=TOKEN), "http://127.0.0.2"
    assert ("9748.zip" in partnet_mobility._files(own)) is (not link)


def test_names_that_a_list_of_files_may_hold(hub, tmp_path):
    """Ids of 5,000 digits, terms of any name: no such file is asked for."""
    odd = ("9" * 5000 + ".zip", "README\0", "LICENSE\n", "TERMS" + "x" * 300, "README\x1b[2J")
    hub.files |= dict.fromkeys((*odd, "\ud800/1.zip", "README\ud800"), b"x")
    hub.files["LICENSE"] = hub.cdn.files["LICENSE"] = b""
    assert partnet(tmp_path).exit_code == 0
    assert {p.name for p in (tmp_path / "terms").iterdir()} == {"README.md", "LICENSE"}
