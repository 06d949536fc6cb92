"""A Dask cluster makes what one machine makes, whatever becomes of its workers."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import pytest
from test_pipeline import TINY, contents, job, made

from articugen.core.errors import ArticugenError, MachineFault, MissingExtra
from articugen.core.ledger import LEDGER
from articugen.pipeline import door
from articugen.pipeline.executors import dask as cluster
from articugen.pipeline.executors.work import Elsewhere, Work
from articugen.pipeline.job import Job
from articugen.pipeline.making import Task
from articugen.pipeline.options import ObjectReport

dask = pytest.importorskip("dask", reason="dask is not installed")
distributed = pytest.importorskip("distributed", reason="distributed is not installed")

MANY = TINY.with_options(objects=6, states=0)


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    """A scheduler that misses no worker soon, however busy this machine is."""
    with (
        dask.config.set({"distributed.scheduler.worker-ttl": "600s"}),
        distributed.LocalCluster(
            n_workers=0, processes=True, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as cluster,
    ):
        yield cluster


def miss(local: Any, name: str) -> None:
    """Let the scheduler find that it has not heard of a worker for too long."""

    async def look() -> None:
        (worker,) = (w for w in local.scheduler.workers.values() if w.name == name)
        worker.last_seen -= 1000.0
        await local.scheduler.check_worker_ttl()

    local.loop.add_callback(look)


@contextmanager
def worker(address: str, name: str) -> Iterator[subprocess.Popen[bytes]]:
    """One of one thread, as `dask worker` starts it."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        command = [
            sys.executable, "-m", "distributed.cli.dask_worker", address, "--name", name,
            "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1",
            "--local-directory", scratch,
        ]  # fmt: skip
        with subprocess.Popen(command, stderr=subprocess.DEVNULL, env=os.environ) as process:
            try:
                yield process
            finally:
                process.kill()


def wait_for(found: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not found():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.05)


def on(address: str, out: Path, **changes: object) -> Job:
    return job(out, recipe=MANY, scheduler=address, **changes)


def test_one_worker_is_killed_and_one_is_cut_off(local: Any, tmp_path: Path) -> None:
    address = local.scheduler_address
    told: list[ObjectReport] = []
    out = tmp_path / "cluster"
    with ExitStack() as stack:
        names = ("killed", "cut off", "left")
        workers = [stack.enter_context(worker(address, name)) for name in names]
        wait_for(lambda: cluster.Dask(address).width(0) == 3)

        def on_object(report: ObjectReport) -> None:
            told.append(report)
            if len(told) == 1:
                workers[0].kill()
                workers[1].send_signal(signal.SIGSTOP)  # its connections stay, and say nothing
                miss(local, "cut off")

        manifest = door.make(on(address, out), replace=True, on_object=on_object)
        assert manifest.timings.workers == 1
        nobody = cast(Task, None)
        work = Elsewhere.of(Work(on(address, out), 6))
        for code, folder, sentence in (
            ("1.0+other", out, r"has articugen .*, this is 1.0\+other; install the same"),
            (work.code, tmp_path / "nowhere", r"does not see .*nowhere; --out must be on"),
        ):
            job_there = replace(work.work.job, out=folder)
            other = Elsewhere(replace(work.work, job=job_there), code, patience=0.0)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(Elsewhere, "of", lambda _, other=other: other)
                with pytest.raises(ArticugenError, match=sentence):
                    list(cluster.Dask(address).ends(other.work, [nobody], lambda _: None))
    here, _ = made(job(tmp_path / "here", recipe=MANY))
    assert manifest.content_sha256 == here.content_sha256
    assert contents(out) == contents(tmp_path / "here")
    assert len(told) == 6
    assert not (out / LEDGER).exists()


def test_a_scheduler_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    with pytest.raises(MachineFault, match=r"127.0.0.1:9: no scheduler answers .*dask scheduler"):
        made(on("tcp://127.0.0.1:9", tmp_path))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"pip install 'articugen\[cluster\]'"):
        made(on("tcp://127.0.0.1:9", tmp_path))
