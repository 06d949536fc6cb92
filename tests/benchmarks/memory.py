"""The most memory that a method takes, in a process of its own: python -m tests.benchmarks.memory

    ours <category> <index> <states>               as a worker: reads, prepares, makes instances
    peer <number> <mesh.npz> <quick: 0 or 1>       from a mesh to labels
    peer none <mesh.npz> <quick: 0 or 1>           the same without a method

Prints megabytes. A process of its own, because memory that another method took would count too.
"""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np


def measure(*arguments: object) -> float | None:
    """What `main` prints for these arguments, run as a child; None where that fails."""
    command = [sys.executable, "-m", "tests.benchmarks.memory", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return float(done.stdout.split()[-1]) if done.returncode == 0 else None


def main(kind: str, *arguments: str) -> None:
    (_ours if kind == "ours" else _peer)(*arguments)
    sys.stdout.write(f"{_peak():.0f}\n")


def _ours(category: str, index: str, states: str) -> None:
    from articugen.instance import make, preparing  # noqa: PLC0415 - only what the method needs
    from tests.benchmarks import cases  # noqa: PLC0415

    model = cases.bundled(category, int(index), messy=False)
    prepared = preparing.prepare(model.obj, model.recipe, 0)
    _ = [make.make_instance(prepared, state) for state in range(1, int(states) + 1)]


def _peer(number: str, mesh_path: str, quick: str) -> None:
    from tests.benchmarks.cases import soup  # noqa: PLC0415 - only what the method needs
    from tests.benchmarks.options import dense  # noqa: PLC0415
    from tests.benchmarks.peers import peers  # noqa: PLC0415

    stored = np.load(Path(mesh_path))
    mesh = soup([(stored["vertices"], stored["faces"])])
    methods = peers(dense(bool(int(quick))))
    if number != "none":
        methods[int(number)].build(mesh).inside(stored["asked"])


def _peak() -> float:
    try:  # unlike ru_maxrss it knows nothing of the process that this one was forked from
        status = Path("/proc/self/status").read_text().split()
        return int(status[status.index("VmHWM:") + 1]) / 1024
    except (OSError, ValueError):
        unit = 2**20 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


if __name__ == "__main__":
    main(*sys.argv[1:])
