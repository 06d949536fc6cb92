"""A data set in an object store is the one on a disk, whatever befalls requests and processes."""

import pickle
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import test_pipeline
from bucket_server import BUCKET, Trouble, bucket_server
from command_line import run as articugen
from test_pipeline import TINY, contents, job

import articugen as ag
from articugen.core.errors import (
    ArticugenError,
    CorruptShard,
    InvalidArgument,
    MachineFault,
    MissingExtra,
)
from articugen.core.ledger import Ledger
from articugen.pipeline import run as pipeline
from articugen.pipeline.executors.local import Local
from articugen.pipeline.job import Job, Share
from articugen.pipeline.options import ObjectReport
from articugen.pipeline.run import started
from articugen.store import bucket as bucket_module
from articugen.store.bucket import Bucket, Remote
from articugen.store.manifest import MANIFEST_NAME, Manifest
from articugen.store.manifest_pages import is_page_name

obstore = pytest.importorskip("obstore", reason="obstore is not installed")
pytest.importorskip("obstore.store")
pytest.importorskip("flask_cors", reason="moto's server is not installed")

whole = test_pipeline.whole


@pytest.fixture(scope="module")
def server() -> Iterator[Trouble]:
    with pytest.MonkeyPatch.context() as patch, bucket_server(patch) as trouble:
        patch.setattr(bucket_module, "PAUSE", 0.01)
        patch.setattr(pipeline, "POLL_SECONDS", 0.2)
        yield trouble


@pytest.fixture(scope="module")
def stored(server: Trouble) -> str:
    """The same in the store, made while one of five requests fails. Look, do not touch."""
    url = f"s3://{BUCKET}/data/eyeglasses"
    server.every = 5
    finished(into(url))
    server.every = 0
    return url


def into(url: str, **changes: object) -> Job:
    return replace(job(Path(), **changes), out=Remote(url))


def finished(job: Job, share: str | None = None) -> tuple[Manifest | None, list[ObjectReport]]:
    told: list[ObjectReport] = []
    with started(replace(job, share=Share.of_text(share) if share else None)) as run:
        manifest = run.finish(Local(0), told.append).manifest
    return manifest, told


def files(url: str) -> dict[str, bytes | None]:
    """But for the manifest, which has timings, and for what lies beside."""
    bucket = Bucket(url)
    names = [name for name in bucket.list("") if not name.startswith(".articugen/")]
    return {name: bucket.read(name) for name in sorted(names) if name != MANIFEST_NAME}


def test_what_is_stored_is_what_lies_on_a_disk(stored: str, whole: Path, server: Trouble) -> None:
    assert min(server.spoilt[kind] for kind in ("503", "unheard", "unanswered")) >= 1
    assert files(stored) == contents(whole)
    assert not [n for n in Bucket(stored).list(".articugen") if n.startswith("claims")]
    manifest, told = finished(into(stored))
    assert [report.reused for report in told] == [True] * 4
    assert manifest is not None
    assert manifest.content_sha256 == Manifest.read(whole).content_sha256


def test_it_is_read_where_it_is(stored, whole, server):
    there, here = ag.open(stored), ag.open(whole)
    assert there.objects == here.objects
    assert there.splits == here.splits
    server.every = 4
    names = [name for name in here.fields if name != "object_id"]
    theirs, ours = there.batch(4, names, rng=1), here.batch(4, names, rng=1)
    server.every = 0
    for name in names:
        np.testing.assert_array_equal(theirs[name], ours[name])
    again = pickle.loads(pickle.dumps(there[:3]))
    assert again[0].object_id == here[0].object_id
    requests = server.seen["GET"]
    there.batch([5], names)
    assert server.seen["GET"] - requests <= 3  # an instance lies in one piece
    with pytest.raises(InvalidArgument, match="needs the files here; copy them"):
        ag.verify(there)
    assert len(ag.open(f"{stored}/test-00000.h5")) == 3


def test_an_interrupted_run_and_shares_go_on(server: Trouble, whole: Path) -> None:
    url = f"s3://{BUCKET}/cut/eyeglasses"

    def interrupt(report: ObjectReport) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), started(into(url)) as run:
        run.finish(Local(0), interrupt)
    with pytest.raises(CorruptShard, match=r"has no manifest.json; make it with generate"):
        ag.open(url)
    manifest, told = finished(into(url), "1/2")
    assert manifest is None
    assert len(told) == 2
    Bucket(url).delete(["train-00001.h5"])
    manifest, told = finished(into(url))
    assert manifest is not None
    assert sum(report.reused for report in told) in (1, 2)
    assert files(url) == contents(whole)
    with pytest.raises(ArticugenError, match=r"make another data set here \(another seed\)"):
        finished(into(url, seed=1))


def test_a_manifest_in_pages(server: Trouble, whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("articugen.store.manifest.PAGE_ENTRIES", 2)
    url = f"s3://{BUCKET}/pages/eyeglasses"
    server.every = 5
    manifest, _ = finished(into(url))
    server.every = 0
    assert manifest is not None
    assert manifest.content_sha256 == Manifest.read(whole).content_sha256
    pages = sorted(filter(is_page_name, Bucket(url).list("")))
    assert len(pages) == 2
    assert ag.open(url).manifest == manifest
    assert finished(into(url))[0] == manifest  # nothing is left to do
    first, second = (Bucket(url).read(name) or b"" for name in pages)
    Bucket(url).write(pages[0], second)
    with pytest.raises(CorruptShard, match=rf"{pages[0]}: .* other bytes .* delete manifest\.json"):
        ag.open(url)
    Bucket(url).delete(pages[:1])
    with pytest.raises(CorruptShard, match=f"{pages[0]}: a page of manifest.json: is not there"):
        finished(into(url))
    Bucket(url).delete([MANIFEST_NAME])
    again, told = finished(into(url))
    assert again is not None
    assert [report.reused for report in told] == [True] * 4
    assert Bucket(url).read(pages[0]) == first


def test_what_another_process_is_at_is_left_to_it(server: Trouble, whole: Path) -> None:
    """Two were killed at an object each; their claims run out, once that has been said: not before,
    however slow this machine is."""
    url = f"s3://{BUCKET}/claimed/eyeglasses"
    with started(into(url)) as run:
        names = [f"{key.split}/{key.object_id}" for key in run.plan.keys[:2]]
    theirs = Ledger(Bucket(url), who="theirs", lease=600.0)
    assert all(map(theirs.claim, names))
    told: list[str] = []
    with started(into(url)) as run:

        def on_notice(sentence: str) -> None:
            told.append(sentence)
            assert Ledger(Bucket(url)).known(names) == {}
            run.records.ledger = Ledger(Bucket(url), who=run.records.ledger.claims[0], lease=1.0)

        manifest = run.finish(Local(0), on_notice=on_notice).manifest
    assert told == ["other processes are at 2 of the objects; waiting"]  # once, however long
    assert manifest is not None
    assert manifest.content_sha256 == Manifest.read(whole).content_sha256


@pytest.mark.slow
def test_two_processes_share_out_the_objects(server: Trouble, whole: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "tiny.json"
    recipe.write_text(TINY.text())
    url = f"s3://{BUCKET}/two"
    command = ["generate", "-c", "eyeglasses", "-r", recipe, "-j", "0", "-o", url]
    with subprocess.Popen(
        [sys.executable, "-m", "articugen", *map(str, command)], stdout=subprocess.PIPE
    ) as other:
        while not Bucket(f"{url}/eyeglasses").list(""):
            assert other.poll() is None
            time.sleep(0.05)
        data = ag.generate("eyeglasses", out=url, recipe=TINY, jobs=0)
        assert other.wait(60) == 0
    assert len(data) == 12
    assert files(f"{url}/eyeglasses") == contents(whole)


@pytest.mark.parametrize("share", [None, "0/1"])
def test_a_shard_that_is_removed_during_the_run_is_told_of_and_made_again(server, whole, share):
    """Once as one made by this run, once as one that was there already."""
    url = f"s3://{BUCKET}/removed-{share}/eyeglasses"
    chosen = Share.of_text(share) if share else None
    for gone in ("train-00001.h5", "test-00000.h5"):
        with (
            pytest.raises(ArticugenError, match=f"1 shards were removed or .* \\({gone}"),
            started(into(url, share=chosen)) as run,
        ):
            run.finish(Local(0), lambda report, gone=gone: Bucket(url).delete([gone]))
        assert MANIFEST_NAME not in files(url)
    manifest, told = finished(into(url))
    assert manifest is not None
    assert [report.reused for report in told].count(False) == 1
    assert files(url) == contents(whole)


def test_nothing_in_a_store_is_replaced(server: Trouble) -> None:
    url = f"s3://{BUCKET}/replaced"
    with pytest.raises(InvalidArgument, match=r"with an object store: .* new --out"):
        ag.generate("eyeglasses", out=url, recipe=TINY, jobs=0, replace=True)
    told = articugen("generate", "-c", "eyeglasses", "-o", url, "--replace")
    assert (told.exit_code, "with an object store" in told.output) == (1, True)
    assert Bucket(url).list("") == {}


@pytest.mark.parametrize(
    ("url", "name", "server_at", "plain"),
    [
        ("s3://bucket/x", "AWS_ENDPOINT_URL", "http://127.0.0.1:9", True),
        ("s3://bucket/x", "AWS_ENDPOINT_URL", "https://127.0.0.1:9", False),
        ("s3://bucket/x", "GOOGLE_BASE_URL", "http://127.0.0.1:9", False),
        ("gs://bucket/x", "GOOGLE_BASE_URL", "http://127.0.0.1:9", True),
        ("http://127.0.0.1:9/x", "AWS_ENDPOINT_URL", "", True),
        ("https://127.0.0.1:9/x", "AWS_ENDPOINT_URL", "", False),
    ],
)
def test_http_is_spoken_only_where_somebody_asked_for_it(monkeypatch, url, name, server_at, plain):
    """`AWS_ENDPOINT_URL` of the environment of other tests does not count."""
    asked: list[dict[str, bool]] = []
    real = obstore.store.from_url

    def from_url(url: str, **options: Any) -> Any:
        asked.append(options["client_options"])
        return real(url, **options)

    monkeypatch.setattr(obstore.store, "from_url", from_url)
    monkeypatch.delenv("AWS_ENDPOINT_URL", raising=False)
    monkeypatch.setenv("GOOGLE_SKIP_SIGNATURE", "true")
    monkeypatch.setenv(name, server_at)
    Bucket(url)
    assert asked == [{"allow_http": True} if plain else {}]


def test_a_store_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    with pytest.raises(InvalidArgument, match=r"^az://box/x: .*Account must be specified$"):
        Bucket("az://box/x")
    with pytest.raises(InvalidArgument, match="no object store is called so; give s3://"):
        ag.open("s4://nowhere/at/all")
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(MissingExtra, match=r"pip install 'articugen\[s3\]'"):
        ag.open("s3://nowhere/at/all")


@pytest.mark.parametrize("ending", ["#2", "?v=2", "/../up", "/./x"])
def test_an_address_that_would_be_another_folder_is_refused(ending: str) -> None:
    with pytest.raises(InvalidArgument, match=r"holds no \?, # or folder \. or \.\."):
        Bucket(f"s3://{BUCKET}/runs{ending}")


def test_a_scheme_may_be_in_capitals() -> None:
    assert bucket_module.is_url("S3://shelf/x")
    assert bucket_module.scheme_of("S3://shelf/x") == "s3"


def test_what_was_not_written_is_no_success(server: Trouble, tmp_path: Path) -> None:
    with pytest.raises(ArticugenError, match="there is no such bucket, or no file to send"):
        Bucket(f"s3://{BUCKET}/x").write("s.h5", tmp_path / "vanished")


def test_a_store_that_goes_away_is_no_damage(server, stored, monkeypatch):
    data = ag.open(stored)
    monkeypatch.setattr(bucket_module.Bucket, "tries", 1)
    monkeypatch.setattr(bucket_module, "RETRIES", 0)
    for method in ("HEAD", "GET"):  # the second when HDF5 is reading
        server.deaf = method
        try:
            with pytest.raises(MachineFault, match="the store does not answer"):
                ag.open(f"{stored}/test-00000.h5")
        finally:
            server.deaf = ""
    assert data[0].stored("surface_points").any()
