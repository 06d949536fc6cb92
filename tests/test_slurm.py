"""An array of SLURM makes what one machine makes, whatever becomes of its tasks."""

import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest
from command_line import run
from python_process import ended
from slurm_cluster import Daemon, processes_of, said, slurm
from test_pipeline import PACKAGE, TINY, contents, job, made

import articugen as ag
from articugen.core.errors import ArticugenError, InvalidArgument, MachineFault, MissingExtra
from articugen.core.ledger import Ledger
from articugen.core.place import Folder
from articugen.pipeline import door
from articugen.pipeline.executors import slurm as slurm_module
from articugen.pipeline.executors.slurm import Array
from articugen.pipeline.job import Job
from articugen.pipeline.options import ObjectReport
from articugen.pipeline.plan import objects_of
from articugen.sources.source import open_source
from articugen.store.manifest import Manifest

MANY = TINY.with_options(objects=9, states=2)
LONG = TINY.with_options(objects=9, states=8)
"""With tasks that are not done before one can harm them."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Daemon]]:
    pytest.importorskip("submitit", reason="submitit is not installed")
    with (
        pytest.MonkeyPatch.context() as patch,
        slurm(tmp_path_factory.mktemp("slurm"), patch) as nodes,
    ):
        patch.setattr(slurm_module, "POLL_SECONDS", 0.2)
        yield nodes


def on_slurm(out: Path, query: str = "tasks=3&cpus=1", **changes: object) -> Job:
    return job(out, **{"recipe": MANY, "scheduler": f"slurm://all?{query}"} | changes)


def finished(job: Job) -> tuple[Manifest, list[ObjectReport], list[str]]:
    reports: list[ObjectReport] = []
    notices: list[str] = []
    manifest = door.make(job, on_object=reports.append, on_notice=notices.append)
    return manifest, reports, notices


def running() -> dict[int, tuple[str, str]]:
    """Of each task that has started and not ended: the array that it is of, and its node."""
    told = said("squeue", "-h", "-r", "-t", "R", "-o", "%K %F %N").split("\n")
    rows = [line.split() for line in told if line]
    return {int(task): (array, node) for task, array, node in rows}


def recorded_by(out: Path, task: int) -> bool:
    """Whether one of three tasks has recorded an object."""
    refs = objects_of(on_slurm(out, recipe=LONG), open_source("procedural"))
    names = [f"{ref.split}/{ref.object_id}" for ref in refs[task::3]]
    return bool(Ledger(Folder(out)).known(names))


def harm(out: Path, nodes: dict[str, Daemon]) -> None:
    """Kill task 0, and cut off the node of task 1, which works on. SLURM must have heard of the
    first by then: a task whose node it loses it begins again itself. Task 1 stands still until all
    that is done, however long it takes."""
    array = node = ""
    stopped = list[int]()

    def wait_until(so: Callable[[dict[int, tuple[str, str]]], bool]) -> None:
        nonlocal array, node
        end = time.monotonic() + 300.0
        while not so(tasks := running()):
            assert time.monotonic() < end, tasks
            array = next((its_array for its_array, _ in tasks.values()), array)
            if 1 in tasks and not stopped and recorded_by(out, 1):
                node = tasks[1][1]
                stopped.extend(processes_of(array, 1))
                signalled(stopped, signal.SIGSTOP)
            time.sleep(0.01)

    wait_until(lambda tasks: 0 in tasks and recorded_by(out, 0))
    signalled(processes_of(array, 0), signal.SIGKILL)
    wait_until(lambda tasks: 0 not in tasks and bool(stopped))
    nodes[node].kill()
    said("scontrol", "update", f"nodename={node}", "state=down", "reason=cut-off")
    signalled(stopped, signal.SIGCONT)


def signalled(processes: list[int], number: signal.Signals) -> None:
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, number)


@pytest.mark.slow
def test_one_task_is_killed_and_one_is_cut_off(cluster: dict[str, Daemon], tmp_path: Path) -> None:
    out = tmp_path / "array"
    with ThreadPoolExecutor(1) as pool:
        harmed = pool.submit(harm, out, cluster)
        manifest, reports, notices = finished(on_slurm(out, recipe=LONG))
        harmed.result()
    arrays = [re.sub(r"\d+", "N", notice, count=1) for notice in notices]
    assert arrays == [f"SLURM has job N, an array of {n}" for n in ("3 tasks", "1 task")]
    first = re.findall(r"\d+", notices[0])[0]
    assert "Restarts=1" in said("scontrol", "show", "job", f"{first}_1")
    here, _ = made(job(tmp_path / "here", recipe=LONG))
    assert manifest.content_sha256 == here.content_sha256
    assert contents(out) == contents(tmp_path / "here")
    assert len(reports) == 9
    assert manifest.timings.workers == 3


@pytest.mark.slow
def test_it_is_followed_again_and_interrupted(cluster: dict[str, Daemon], tmp_path: Path) -> None:
    out = tmp_path / "eyeglasses"
    script = (
        "import os, sys; from pathlib import Path; from test_slurm import finished, on_slurm\n"
        "from articugen.pipeline import door\n"
        "door.make(on_slurm(Path(sys.argv[1])), on_notice=lambda _: os.kill(os.getpid(), 9))"
    )
    path = os.pathsep.join([str(Path(__file__).parent), str(PACKAGE.parent)])
    assert ended("-c", script, out, PYTHONPATH=path).returncode == -signal.SIGKILL
    (first,) = set(said("squeue", "-h", "-o", "%F").split())

    def interrupt(report: ObjectReport) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # nothing is submitted
        door.make(on_slurm(out), on_object=interrupt, on_notice=pytest.fail)
    while said("squeue", "-h", "-j", first):
        time.sleep(0.1)
    manifest, reports, _ = finished(on_slurm(out))
    assert sum(report.reused for report in reports) >= 1
    assert len(reports) == len(manifest.objects) == 9
    data = ag.generate("eyeglasses", out=tmp_path, recipe=MANY, scheduler="slurm")
    assert data.manifest == manifest


def test_what_makes_nothing_is_not_submitted_for_ever(cluster, tmp_path):
    with pytest.raises(ArticugenError, match=r"sbatch refuses the array \(.*partition name"):
        finished(job(tmp_path, recipe=MANY, scheduler="slurm://nowhere"))
    stuck = on_slurm(tmp_path, "tasks=2&cpus=1&input=/nowhere/at/all")
    with pytest.raises(MachineFault, match=r"3 arrays, .* 9 of 9 objects are missing"):
        finished(stuck)


def test_addresses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Array.of_address("slurm") == Array.of_address("slurm://") == Array()
    asked = Array.of_address("slurm://gpu?tasks=7&time=30&account=me")
    assert asked == Array("gpu", tasks=7, time=30, others={"account": "me"})
    for wrong in (
        "slurm://a?tasks=0",
        "slurm://a?cpus=two",
        "slurm:a",
        "slurm://a?time=1",
        "slurm://?x",
    ):
        with pytest.raises(InvalidArgument, match=r"give slurm, or slurm://partition\?tasks=100"):
            Array.of_address(wrong)
    command = ("generate", "-c", "laptop", "-o", tmp_path, "--scheduler", "slurm")
    told = run(*command, "--replace")
    assert told.exit_code == 1
    assert "--replace (replace=True) with slurm: " in told.output
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(MissingExtra, match=r"pip install 'articugen\[cluster\]'"):
        finished(on_slurm(tmp_path))


def test_where_there_is_no_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit", reason="submitit is not installed")
    monkeypatch.setattr(slurm_module.shutil, "which", lambda _: None)
    with pytest.raises(ArticugenError, match="there is no sbatch here; run this where jobs"):
        finished(on_slurm(tmp_path))
