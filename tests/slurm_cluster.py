"""A SLURM of two nodes on this machine, from Debian's packages: slurmctld, two slurmd and munge."""

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

Daemon = subprocess.Popen[bytes]
NODES = ("one", "two")

_CONFIG = """
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmctldParameters=enable_configless
AuthInfo=socket={folder}/munge.socket,cred_expire=5
SlurmUser=root
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
SlurmdSpoolDir={folder}/%n
SlurmdParameters=config_overrides
StateSaveLocation={folder}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SchedulerParameters=batch_sched_delay=0,sched_interval=1,sched_min_interval=0
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
KillWait=2
ReturnToService=0
NodeName={nodes[0]} NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2
NodeName={nodes[1]} NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2
PartitionName=all Nodes={nodes[0]},{nodes[1]} Default=YES MaxTime=INFINITE
"""
"""`cred_expire`: so many seconds after it was lost a task may begin again, 120 by default.
`ReturnToService`: a node that was said to be down stays down, whatever it said just before."""


@contextmanager
def slurm(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[dict[str, Daemon]]:
    """A cluster, which the environment leads to: the slurmd of each node. Skips the test where it
    cannot be made."""
    absent = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if not _which(name)]
    if absent:
        pytest.skip(f"there is no {absent[0]}: apt-get install slurm-wlm")
    if os.geteuid() != 0:
        pytest.skip("only root can start SLURM")
    config, key = folder / "slurm.conf", folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    folder.chmod(0o755)  # munged wants its socket where all can reach it
    config.write_text(
        _CONFIG.format(host=socket.gethostname(), folder=folder, nodes=NODES, ports=_ports(3))
    )
    patch.setenv("SLURM_CONF", str(config))
    munge = [f"--{name}={folder}/munge.{name}" for name in ("socket", "seed")]
    munge += [f"--key-file={key}", f"--pid-file={folder}/munge.pid"]
    with ExitStack() as stack:
        stack.enter_context(_daemon(folder, "munged", "--foreground", "--force", *munge))
        stack.enter_context(_daemon(folder, "slurmctld", "-D"))
        found = {n: stack.enter_context(_daemon(folder, "slurmd", "-D", "-N", n)) for n in NODES}
        _wait_for_nodes(folder)
        yield found


def said(*command: str) -> str:
    """What a command of SLURM prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def processes_of(array: str, task: int) -> list[int]:
    """Of one task of an array: the ids of its script and of all that this has started."""
    mine = (
        f"SLURM_CONF={os.environ['SLURM_CONF']}",
        f"SLURM_ARRAY_JOB_ID={array}",
        f"SLURM_ARRAY_TASK_ID={task}",
    )
    found = list[int]()
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if {*map(str.encode, mine)} <= {*(folder / "environ").read_bytes().split(b"\0")}:
                found.append(int(folder.name))
    return found


def _which(name: str) -> str | None:
    return shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/sbin")


@contextmanager
def _daemon(folder: Path, name: str, *options: str) -> Iterator[Daemon]:
    program = _which(name)
    assert program
    with (folder / "daemons.log").open("ab") as log:
        process = subprocess.Popen([program, *options], stdout=log, stderr=log)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(30)


def _ports(count: int) -> list[int]:
    """Some that nobody listens at."""
    with ExitStack() as stack:
        found = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in found:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in found]


def _wait_for_nodes(folder: Path) -> None:
    end = time.monotonic() + 30.0
    while True:
        done = subprocess.run(
            ["sinfo", "-h", "-N", "-o", "%t"], capture_output=True, text=True, check=False
        )
        if done.stdout.split() == ["idle"] * len(NODES):
            return
        log = (folder / "daemons.log").read_text()
        assert time.monotonic() < end, f"{done.stdout}{done.stderr}{log}"
        time.sleep(0.1)
