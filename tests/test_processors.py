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

x86 = pytest.mark.skipif(platform.machine() != "x86_64", reason="names of x86-64 processors")


def _numpy_features() -> str:
    """All that numpy would choose kernels by here."""
    umath = np._core._multiarray_umath  # type: ignore[attr-defined]
    return " ".join(f for f in umath.__cpu_dispatch__ if umath.__cpu_features__.get(f))


def made_under(folder: Path, **settings: str) -> dict[str, str]:
    """The content hash of each tiny set; the models are written anew as well."""
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    done = subprocess.run(  # noqa: PLW1510
        [sys.executable, "-c", MAKE],
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
@pytest.mark.parametrize("core", ["Prescott", "Haswell"])
def test_openblas_does_not_show(usual, tmp_path, core):
    assert made_under(tmp_path, OPENBLAS_CORETYPE=core, OPENBLAS_NUM_THREADS="2") == usual


def test_numpy_kernels_do_not_show(usual, tmp_path):
    assert made_under(tmp_path, NPY_DISABLE_CPU_FEATURES=_numpy_features()) == usual


@x86
def test_the_c_library_s_kernels_do_not_show(usual, tmp_path):
    plain = "glibc.cpu.hwcaps=-AVX512F,-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-AVX,-AVX_Usable"
    assert made_under(tmp_path, GLIBC_TUNABLES=plain) == usual


@x86
@pytest.mark.slow
def test_numba_s_processor_does_not_show(usual, tmp_path):
    cache = tmp_path / "kernels"
    told = {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(cache)}
    assert made_under(tmp_path, **told) == usual
