"""The same content hash whatever processor numpy, OpenBLAS and numba find, or are told to find."""

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.golden import read

MAKE = """
import json, sys
from pathlib import Path
from tests.golden import SETS, data, own_models
with own_models(Path("models")):
    made = {name: data(name, Path(name).absolute()) for name in SETS}
print(json.dumps(made))
"""

COMPILE_FIRST = f"""
from articugen.compiling import compile_kernels
compile_kernels("generate", jobs=2)
{MAKE}
from numba.core.dispatcher import Dispatcher
for name, module in sys.modules.copy().items():
    for kernel in vars(module).values() if name.startswith("articugen.") else ():
        if isinstance(kernel, Dispatcher):
            assert not kernel.stats.cache_misses, kernel
"""

x86 = pytest.mark.skipif(platform.machine() != "x86_64", reason="names of x86-64 processors")


def _numpy_features() -> str:
    """All that numpy would choose kernels by here."""
    umath = np._core._multiarray_umath  # type: ignore[attr-defined]
    return " ".join(f for f in umath.__cpu_dispatch__ if umath.__cpu_features__.get(f))


def made_under(folder: Path, code: str = MAKE, **settings: str) -> dict[str, str]:
    """The content hash of each tiny set; the models are written anew as well."""
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    done = subprocess.run(  # noqa: PLW1510
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, **settings},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def usual() -> dict[str, str]:
    """What test_golden.py finds this code to make."""
    return read()["data"]


@x86
def test_another_openblas_does_not_show(usual, tmp_path):
    assert made_under(tmp_path, OPENBLAS_CORETYPE="Haswell", OPENBLAS_NUM_THREADS="2") == usual


@pytest.mark.slow
def test_the_plainest_processor_does_not_show(usual, tmp_path):
    """All libraries at once are told to make do with it; where this fails, tell them one by one."""
    told = {"NPY_DISABLE_CPU_FEATURES": _numpy_features()}
    if platform.machine() == "x86_64":
        plain = "-AVX512F,-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-AVX,-AVX_Usable"
        told |= {"OPENBLAS_CORETYPE": "Prescott", "GLIBC_TUNABLES": f"glibc.cpu.hwcaps={plain}"}
        told |= {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": ""}
    kernels = tmp_path / "kernels"
    made = made_under(tmp_path, COMPILE_FIRST, NUMBA_CACHE_DIR=str(kernels), **told)
    assert made == usual  # and it met no kernel that was not compiled first
    assert len(list(kernels.glob("compiled-generate-*"))) == 1
