"""Workers that are killed, hang, swell or lose their parent, and the tasks of the others."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import python_process

from articugen.core import processes as module
from articugen.core.errors import InvalidArgument, MachineFault, MissingExtra
from articugen.core.memory import resident_bytes
from articugen.core.processes import Crew, Ended, Limit, each, in_order, report

Task = tuple[str, Any]
"""What to do, and with what: see `do`."""


def do(task: Task) -> Any:
    kind, value = task
    if kind == "sleep":
        time.sleep(value)
    elif kind == "die":
        os.kill(os.getpid(), value)
    elif kind == "die once":
        if not value.exists():
            value.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    elif kind == "swell":
        held = bytearray(os.urandom(1000) * (1000 * value))
        time.sleep(20)
        return len(held)
    elif kind == "no memory":
        raise MemoryError
    elif kind == "raise":
        raise value
    elif kind == "hold":
        return 10**10**9  # with the interpreter's lock, for hours
    elif kind == "who":
        return os.getpid()
    elif kind == "report":
        for message in value:
            report(message)
    elif kind == "library":
        raise MissingExtra("open3d", "open3d")  # cannot be pickled
    return value


def ended(tasks: list[Task], **settings: Any) -> dict[int, Ended[Any]]:
    return {e.number: e for e in each(do, tasks, **{"workers": 2, **settings})}


def test_tasks_end_in_any_order_or_in_theirs() -> None:
    tasks: list[Task] = [("sleep", 0.5), *(("say", n) for n in range(5))]
    assert {n: e.value for n, e in ended(tasks).items()} == dict(enumerate([0.5, 0, 1, 2, 3, 4]))
    for workers in (0, 2):
        assert list(in_order(do, tasks, workers=workers)) == [0.5, 0, 1, 2, 3, 4]


def test_less_than_no_worker_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="-1 worker processes; give 0 or"):
        ended([("say", 1)], workers=-1)


@pytest.mark.parametrize("processes", [0, 2])
def test_a_task_reports_before_it_ends(processes: int) -> None:
    heard: list[str] = []
    tasks: list[Task] = [("report", ["a1", "a2"]), ("report", ["b1", "b2", "b3"]), ("say", 4)]
    before_end: dict[int, list[str]] = {}
    with Crew(do, workers=processes, on_report=heard.append) as crew:
        for end in crew.each(tasks):
            before_end[end.number] = list(heard)
            report("from outside of any task, which nobody hears")
        assert [m for m in before_end[0] if m[0] == "a"] == ["a1", "a2"]
        assert [m for m in before_end[1] if m[0] == "b"] == ["b1", "b2", "b3"]
        assert sorted(heard) == ["a1", "a2", "b1", "b2", "b3"]
        assert list(crew.in_order(tasks)) == [tasks[0][1], tasks[1][1], 4]
        assert len(heard) == 10


def test_a_crew_keeps_its_workers_until_it_is_dismissed() -> None:
    with Crew(do, workers=1) as crew:
        first = list(crew.in_order([("who", None)] * 2))
        again = list(crew.in_order([("who", None)]))
        assert len({os.getpid(), *first, *again}) == 2, "this process and one other"
        assert alive(first[0])
    assert not alive(first[0])


def test_what_hears_a_report_may_end_all_tasks() -> None:
    def stop(message: str) -> None:
        raise KeyboardInterrupt(message)

    tasks: list[Task] = [("sleep", 60), ("report", ["enough"])]
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt, match="enough"), Crew(
        do, workers=2, on_report=stop
    ) as crew:  # fmt: skip
        list(crew.each(tasks))
    assert time.monotonic() - started < 30


def test_a_task_whose_worker_is_killed_is_tried_once_more_alone(tmp_path: Path) -> None:
    notices: list[str] = []
    tasks = [("die once", tmp_path / "died"), *[("say", n) for n in range(4)], ("die", 9)]
    found = ended(tasks, notice=notices.append, name=lambda task: task[0])
    assert [found[n].value for n in range(5)] == [tmp_path / "died", 0, 1, 2, 3]
    assert found[5] == Ended(5, lost="was killed (as systems do where memory runs out)")
    assert len(notices) == 2  # one a death, not one a try
    once = "at die once, which is tried once more at the end; 1 worker from now on"
    assert any(once in notice for notice in notices)


def test_other_ends_of_a_worker_have_their_names() -> None:
    found = ended([("die", signal.SIGSEGV), ("no memory", None), ("say", 1)])
    assert found[0].lost == "was ended by SIGSEGV"
    assert found[1].lost == "ran out of memory"
    assert found[2].value == 1
    assert ended([("no memory", None)], workers=0)[0].lost == "ran out of memory"
    with pytest.raises(MachineFault, match=r"5: its worker was ended by SIGSEGV when .* --jobs"):
        list(in_order(do, [("die", signal.SIGSEGV)], workers=1, name=lambda _: "5"))


def get_ready(hung: Path) -> None:
    if not hung.exists():
        hung.touch()
        time.sleep(600)


def test_a_worker_that_is_never_ready_is_lost(tmp_path, monkeypatch):
    """Off the clock of its task, whose limit it does not exceed."""
    monkeypatch.setattr(module, "LONGEST_START", 6.0)
    ready, notices = partial(get_ready, tmp_path / "hung"), list[str]()
    found = ended([("say", 0), ("say", 1)], workers=1, ready=ready, notice=notices.append)
    assert [found[n].value for n in range(2)] == [0, 1]
    assert len(notices) == 1
    assert notices[0].startswith("a worker was not ready after 6 s at ('say', 0), which is tried")


def test_no_more_is_tried_where_every_worker_is_lost() -> None:
    with pytest.raises(MachineFault, match="5 workers were lost and no task was done, the last "):
        ended([("no memory", None)] * 100)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_task_over_its_time_is_stopped_and_the_others_go_on(workers: int) -> None:
    started = time.monotonic()
    found = ended(
        [("sleep", 60), ("say", 1), ("say", 2)], workers=workers, limit=Limit(seconds=1.0)
    )
    assert found[0] == Ended(0, over="seconds")
    assert [found[n].value for n in (1, 2)] == [1, 2]
    assert time.monotonic() - started < 30


def test_a_task_that_ended_in_time_is_done_however_slow_we_are() -> None:
    """What we do with one outcome is no part of the other's time."""
    found = []
    for outcome in each(do, [("sleep", 0.1), ("sleep", 0.6)], workers=2, limit=Limit(seconds=1.5)):
        found.append(outcome)
        time.sleep(2.5 if len(found) == 1 else 0.0)
    assert [outcome.over for outcome in found] == [None, None]


def test_a_task_over_its_memory_is_stopped_and_the_others_go_on() -> None:
    found = ended([("swell", 400), ("say", 1)], limit=Limit(megabytes=200))
    assert found == {0: Ended(0, over="megabytes"), 1: Ended(1, value=1)}


TAKES = """
import sys
print(flush=True)
sys.stdin.readline()
taken = bytearray(b"x" * 50_000_000)
print(flush=True)
sys.stdin.readline()
"""


def test_resident_bytes_are_those_of_the_process() -> None:
    """Of another one: in this one other tests leave memory that may be reused or given back."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", TAKES], **pipes) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdout.readline()
        before = resident_bytes([child.pid, 2**22 + 1])
        child.stdin.write("\n")
        child.stdin.flush()
        child.stdout.readline()
        grown = resident_bytes([child.pid])[child.pid] - before[child.pid]
        child.communicate("\n")
    assert list(before) == [child.pid]
    assert 40e6 < grown < 150e6


def test_what_a_task_raises_ends_all_of_them() -> None:
    started = time.monotonic()
    with pytest.raises(ZeroDivisionError, match="twice"):
        ended([("sleep", 60), ("raise", ZeroDivisionError("twice"))])
    with pytest.raises(Exception, match=r"open3d is not installed; run: .*pip install"):
        ended([("library", None), ("say", 1)])
    assert time.monotonic() - started < 30


STOPPED = """
import sys
sys.path[:] = {path!r}
from functools import partial
from pathlib import Path
from articugen.core import processes as workers
from test_workers import do
workers.LONGEST_LOOK = 0.3
begun, limit = partial(Path.touch, Path({begun!r})), workers.Limit(seconds=1.6)
(told,) = workers.each(do, [("sleep", 0.9)], workers=1, limit=limit, ready=begun)
print(told.over)
"""


def test_no_task_is_over_its_time_because_all_was_stopped_for_a_while(tmp_path: Path) -> None:
    """As by Ctrl-Z and fg."""
    path, begun = [str(Path(__file__).parent), *sys.path], tmp_path / "begun"
    code = STOPPED.format(path=path, begun=str(begun))
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        while not begun.exists():
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(2.0)
        os.killpg(process.pid, signal.SIGCONT)
        assert process.communicate(timeout=60)[0] == "None\n"


FEW_FILES = """
import os, resource, sys
sys.path[:] = {path!r}
from articugen.core.processes import each
from test_workers import do
resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/dev/fd")) + {spare},) * 2)
told = each(do, [("say", n) for n in range(6)], workers=6)
print(sorted(ended.value for ended in told))
"""


def test_too_few_open_files_mean_fewer_workers_or_one_sentence() -> None:
    def said(spare: int) -> str:
        code = FEW_FILES.format(path=[str(Path(__file__).parent), *sys.path], spare=spare)
        done = python_process.ended("-c", code)
        return done.stdout + done.stderr.strip().split("\n")[-1]

    assert said(7) == "[0, 1, 2, 3, 4, 5]\n"
    assert "MachineFault: no worker process can be started: Too many open files; " in said(1)


ORPHANS = """
import sys
sys.path[:] = {path!r}
from articugen.core.processes import each
from test_workers import do, forget_the_signal
list(each(do, [{task}] * 2, workers=2, ready={ready}))
"""


def forget_the_signal() -> None:
    """As on a system that sends none."""
    ctypes.CDLL(None).prctl(1, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("task", "ready"), [(("hold", None), "print"), (("sleep", 60), "forget_the_signal")]
)
def test_workers_die_with_a_parent_that_is_killed(task: Task, ready: str) -> None:
    path = [str(Path(__file__).parent), *sys.path]
    code = ORPHANS.format(path=path, task=task, ready=ready)
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    workers = children(parent.pid, 2)
    time.sleep(0.5)  # they are at work
    assert all(map(alive, workers))
    parent.kill()
    parent.wait()
    killed = time.monotonic()
    while any(map(alive, workers)):
        assert time.monotonic() - killed < 2.0, "a worker outlives its parent"
        time.sleep(0.02)


def children(parent: int, count: int) -> list[int]:
    """The processes that `parent` started, once there are `count`."""
    listing = Path(f"/proc/{parent}/task/{parent}/children")
    for _ in range(400):
        found = [int(word) for word in listing.read_text().split()]
        if len(found) >= count:
            return found
        time.sleep(0.05)
    raise AssertionError("the workers did not start")


def alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
