"""A data set on the web, on a hub or in any other file system is the one on a disk."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from test_pipeline import TINY, job, made
from web_server import Site, site

import articugen as ag
from articugen.core.errors import ArticugenError, InvalidArgument, MachineFault, MissingExtra
from articugen.store import bucket, remote

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

ONE = TINY.with_options(objects=1, states=5)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One object. Look, do not touch."""
    out = tmp_path_factory.mktemp("whole") / "eyeglasses"
    made(job(out, recipe=ONE))
    return out


@pytest.fixture
def web(whole: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setattr(bucket, "PAUSE", 0.001)
    with site(whole.parent) as server:
        yield server


def opened(url: str, server: Site, monkeypatch: pytest.MonkeyPatch) -> ag.DataSet:
    if url.startswith("hf:"):
        pytest.importorskip("huggingface_hub")
        monkeypatch.setitem(fsspec.config.conf, "hf", {"endpoint": server.url})
    return ag.open(url)


@pytest.mark.parametrize("kind", ["http", "hf", "memory", "file"])
def test_it_is_read_where_it_is(kind, web, whole, monkeypatch):
    monkeypatch.setattr(remote, "BLOCK", 1024)
    if kind == "memory":
        fsspec.filesystem("memory").put(f"{whole}/", "/shelf/eyeglasses/", recursive=True)
    where = {
        "http": web.url,
        "hf": "hf://datasets/some/set",
        "memory": "memory://shelf",
        "file": f"file://{whole.parent}",
    }
    there, here = opened(f"{where[kind]}/eyeglasses", web, monkeypatch), ag.open(whole)
    assert there.objects == here.objects
    before = web.sent
    row = there[2].stored("surface_points")
    np.testing.assert_array_equal(row, here[2].stored("surface_points"))
    (shard,) = whole.glob("*.h5")
    assert web.sent - before < 0.8 * shard.stat().st_size
    names = [name for name in here.fields if name != "object_id"]
    theirs, ours = there.batch(3, names, rng=1), here.batch(3, names, rng=1)
    for name in names:
        np.testing.assert_array_equal(theirs[name], ours[name])


@pytest.mark.parametrize("kind", ["http", "hf"])
def test_what_a_server_refuses(kind, web, whole, monkeypatch):
    url = f"{web.url if kind == 'http' else 'hf://datasets/some/set'}/eyeglasses"
    (shard,) = whole.glob("*.h5")
    web.status = 403
    with pytest.raises(ArticugenError, match="access is refused; see to the keys"):
        opened(url, web, monkeypatch)
    web.status = 0
    with pytest.raises(ArticugenError, match=r"has no manifest.json"):
        opened(f"{url}/nothing", web, monkeypatch)
    web.parts = False
    with pytest.raises(MachineFault, match="copy the data set, and open the copy"):
        _ = opened(f"{url}/{shard.name}", web, monkeypatch)[0].surface.points


def test_what_cannot_be_read_says_what_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        InvalidArgument, match=r"no object store is called so; give s3://, .* hf://"
    ):
        ag.open("s4://nowhere/at/all")
    monkeypatch.setitem(sys.modules, "paramiko", None)
    with pytest.raises(ArticugenError, match=r"cannot read sftp:// yet; install .*paramiko"):
        ag.open("sftp://nowhere/at/all")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(MissingExtra, match=r"pip install 'articugen\[fsspec\]'"):
        ag.open("hf://datasets/nowhere/at/all")


def test_nothing_is_made_where_processes_cannot_share_out_objects() -> None:
    told = run("generate", "-c", "laptop", "-o", "hf://datasets/some/set")
    assert told.exit_code == 1
    assert "make it in a folder and copy that there" in " ".join(told.output.split())
