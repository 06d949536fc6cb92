"""The same content hash whatever processor numpy, OpenBLAS and numba find, or are told to find.

`python -m tests.chaos.determinism` tries every kind of processor, workers, kills, folders and more.
"""

import platform

import pytest

from tests.chaos.determinism import golden, numpys_features
from tests.golden import read

COMPILE_FIRST = """
from articugen.core.compiling import compile_kernels
compile_kernels("generate", jobs=2)
make(CATEGORIES)
from numba.core.dispatcher import Dispatcher
for name, module in sys.modules.copy().items():
    for kernel in vars(module).values() if name.startswith("articugen.") else ():
        if isinstance(kernel, Dispatcher):
            assert not kernel.stats.cache_misses, kernel
make(name for name in SETS if name not in CATEGORIES)
"""
"""All kernels of the main job have been compiled before it begins; other rules have more."""

x86 = pytest.mark.skipif(platform.machine() != "x86_64", reason="names of x86-64 processors")


@x86
def test_another_openblas_threads_and_hash_seed_do_not_show(tmp_path):
    told = {"OPENBLAS_CORETYPE": "Haswell", "OPENBLAS_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "1"}
    told |= {"PYTHONHASHSEED": "12345", "OMP_NUM_THREADS": "3", "TZ": "Asia/Tokyo"}
    found = golden(told, tmp_path, "make(('eyeglasses', 'boxes'))")
    assert found == {name: read()["data"][name] for name in ("eyeglasses", "boxes")}


@pytest.mark.slow
def test_the_plainest_processor_does_not_show(tmp_path):
    """All libraries at once are told to make do with it; where this fails, tell them one by one."""
    told = {"NPY_DISABLE_CPU_FEATURES": numpys_features()}
    if platform.machine() == "x86_64":
        plain = "-AVX512F,-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-AVX,-AVX_Usable"
        told |= {"OPENBLAS_CORETYPE": "Prescott", "GLIBC_TUNABLES": f"glibc.cpu.hwcaps={plain}"}
        told |= {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": ""}
    kernels = tmp_path / "kernels"
    told["NUMBA_CACHE_DIR"] = str(kernels)
    assert golden(told, tmp_path, COMPILE_FIRST) == read()["data"]
    assert len(list(kernels.glob("compiled-generate-*"))) == 1
