"""The same content hash however a data set is made: workers, resumes, threads, hash seeds, folders,
fresh kernels, processors.

`python -m tests.chaos.determinism` makes a small real data set each way, and the sets of golden.py
as processors of several kinds would.
"""

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.golden import SETS, read
from tests.python_process import ended

Row = tuple[str, int, int]

MAKE = """
import json, os, signal, sys
from pathlib import Path
from articugen.pipeline import door as api
from articugen.pipeline.job import Job
from tests.chaos.corruptions import RECIPE
jobs, die = map(int, sys.argv[1:])
def told(report):
    if die and not report.reused:
        os.kill(os.getpid(), signal.SIGKILL)
job = Job("procedural", "eyeglasses", RECIPE, 0, Path("made").absolute(), jobs)
print(api.make(job, on_object=told).content_sha256)
"""

MAKE_GOLDEN = """
import json, sys
from pathlib import Path
from tests.golden import CATEGORIES, SETS, data
made = {}
def make(names):
    made.update({name: data(name, Path(name).absolute()) for name in names})
"""


@dataclass(frozen=True)
class Way:
    """A way to make a data set.

    Attributes:
        jobs: worker processes.
        killed: after the first object; then the run goes on with other workers.
        settings: of the environment; in them {here} is the folder that it is made in.
        folder: its name.
    """

    jobs: int = 0
    killed: bool = False
    settings: dict[str, str] = field(default_factory=dict)
    folder: str = "here"


_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")

WAYS = {
    "this process": Way(),
    "1 worker": Way(jobs=1),
    "2 workers": Way(jobs=2),
    "8 workers": Way(jobs=8),
    "1 worker, killed, resumed by 8": Way(jobs=1, killed=True),
    "8 workers, killed, resumed by 1": Way(jobs=8, killed=True),
    "1 thread": Way(settings=dict.fromkeys(_THREADS, "1")),
    "as many threads as cores": Way(settings=dict.fromkeys(_THREADS, str(os.cpu_count()))),
    "another hash seed": Way(settings={"PYTHONHASHSEED": "12345"}),
    "without hash seed": Way(settings={"PYTHONHASHSEED": "0"}),
    "another folder": Way(folder="wo anders/Ж"),
    "another locale and clock": Way(settings={"LC_ALL": "C", "TZ": "Asia/Tokyo"}),
    "fresh kernels": Way(settings={"NUMBA_CACHE_DIR": "{here}/kernels"}),
}  # fmt: skip


def made(way: Way, work: Path) -> str:
    """The content hash of a small data set made that way."""
    folder = work / way.folder
    folder.mkdir(parents=True)
    settings = {name: value.format(here=folder) for name, value in way.settings.items()}
    if way.killed:
        died = _run(MAKE, [str(way.jobs), "1"], folder, settings)
        assert died.returncode == -signal.SIGKILL, died.stderr
        assert not (folder / "made" / "manifest.json").exists()
    jobs = 9 - way.jobs if way.killed else way.jobs
    done = _run(MAKE, [str(jobs), "0"], folder, settings)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def _run(
    code: str, arguments: Collection[str], folder: Path, settings: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    own = {"PYTHONPATH": path, **settings}
    return ended("-c", code, *arguments, folder=folder, seconds=1800, **own)


# --- processors


def numpys_features(*kept: str) -> str:
    """What numpy would choose kernels by here, but for what is kept."""
    umath = np._core._multiarray_umath  # type: ignore[attr-defined]
    found = umath.__cpu_features__
    return " ".join(f for f in umath.__cpu_dispatch__ if found.get(f) and f not in kept)


_NO_AVX512 = "-AVX512F,-AVX512VL,-AVX512BW,-AVX512CD,-AVX512DQ"
_NO_AVX = f"{_NO_AVX512},-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-AVX,-AVX_Usable"


def _told(kernels: str, features: str, blas: str, c_library: str) -> dict[str, str]:
    return {
        "NUMBA_CPU_NAME": kernels,
        "NUMBA_CPU_FEATURES": "",
        "NPY_DISABLE_CPU_FEATURES": features,
        "OPENBLAS_CORETYPE": blas,
        "GLIBC_TUNABLES": f"glibc.cpu.hwcaps={c_library}",
    }


def processors() -> dict[str, dict[str, str]]:
    """Settings with which the libraries compile and choose code for processors of this kind; those
    that this one can stand for. numpy itself takes no less than SSE4.2 since its version 2.4."""
    if platform.machine() != "x86_64":
        return {}
    found = np._core._multiarray_umath.__cpu_features__  # type: ignore[attr-defined]
    kinds = {"SSE2": _told("x86-64", numpys_features(), "Prescott", _NO_AVX)}
    if found.get("AVX2"):
        kept = [f for f in ("X86_V3", "AVX2", "FMA3") if found.get(f)]
        kinds["AVX2"] = _told("haswell", numpys_features(*kept), "Haswell", _NO_AVX512)
    if found.get("AVX512_SKX") or found.get("X86_V4"):
        kinds["AVX-512"] = {"NUMBA_CPU_NAME": "skylake-avx512", "NUMBA_CPU_FEATURES": ""}
        kinds["AVX-512"] |= {"OPENBLAS_CORETYPE": "SkylakeX"}
    return kinds


def golden(settings: dict[str, str], work: Path, code: str) -> dict[str, str]:
    """The content hash of each of golden.py's sets that the code makes, its models made anew."""
    work.mkdir(parents=True, exist_ok=True)
    done = _run(f"{MAKE_GOLDEN}{code}\nprint(json.dumps(made))", [], work, settings)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def rows(quick: bool) -> list[Row]:
    """(way, data sets made, of which so many had the hash of the first way, or the golden one)."""
    table: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        work, wanted = Path(folder), ""
        for number, (name, way) in enumerate(WAYS.items()):
            hash_ = made(way, work / f"way-{number}")
            wanted = wanted or hash_
            table.append((name, 1, int(hash_ == wanted)))
        names, right = ("eyeglasses", "boxes") if quick else tuple(SETS), read()["data"]
        for kind, settings in processors().items():
            anew = settings | {"NUMBA_CACHE_DIR": str(work / kind / "kernels")}
            found = golden(anew, work / kind, f"make({names})")
            same = sum(found[name] == right[name] for name in names)
            table.append((f"{kind} processor", len(names), same))
    return table


def main() -> str | None:
    parser = argparse.ArgumentParser(prog="python -m tests.chaos.determinism", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two sets a processor, not all")
    table = rows(parser.parse_args().quick)
    sys.stdout.write("| how | data sets made | hash equal |\n|---|---|---|\n")
    for row in table:
        sys.stdout.write(f"| {' | '.join(map(str, row))} |\n")
    return None if all(tried == same for _, tried, same in table) else "not all hashes are equal"


if __name__ == "__main__":
    sys.exit(main())
