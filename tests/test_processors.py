"""The same content hash whatever processor numpy, OpenBLAS and numba find, or are told to find.

`python -m tests.chaos.determinism` tries every kind of processor, workers, kills, folders and more.
"""

import json
import os
import platform
import sys
from collections.abc import Collection
from pathlib import Path

import pytest

from tests.chaos.determinism import numpys_features
from tests.golden import CATEGORIES, read
from tests.python_process import printed

MAKE = """
import json, sys
from pathlib import Path
from tests.golden import data
made = {name: data(name, Path(name).absolute()) for name in sys.argv[1:]}
print(json.dumps(made))
"""

COMPILE_FIRST = """
from articugen.core.compiling import compile_kernels
compile_kernels("generate", jobs=2)
"""

ALL_WERE_COMPILED = """
from numba.core.dispatcher import Dispatcher
for name, module in sys.modules.copy().items():
    for kernel in vars(module).values() if name.startswith("articugen.") else ():
        if isinstance(kernel, Dispatcher):
            assert not kernel.stats.cache_misses, kernel
"""

x86 = pytest.mark.skipif(platform.machine() != "x86_64", reason="names of x86-64 processors")


def made_under(
    folder: Path, names: Collection[str], code: str = MAKE, **settings: str
) -> dict[str, str]:
    """The content hash of each tiny set."""
    folder.mkdir(exist_ok=True)
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    own = {"PYTHONPATH": path, **settings}
    return json.loads(printed("-c", code, *names, folder=folder, seconds=600, **own))


@pytest.fixture(scope="module")
def usual() -> dict[str, str]:
    """What test_golden.py finds this code to make."""
    return read()["data"]


@x86
def test_another_openblas_threads_and_hash_seed_do_not_show(usual, tmp_path):
    some = {name: usual[name] for name in ("eyeglasses", "boxes")}
    told = {"OPENBLAS_CORETYPE": "Haswell", "OPENBLAS_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "1"}
    told |= {"PYTHONHASHSEED": "12345", "OMP_NUM_THREADS": "3", "TZ": "Asia/Tokyo"}
    assert made_under(tmp_path, some, **told) == some


@pytest.mark.slow
def test_the_plainest_processor_does_not_show(usual, tmp_path):
    """All libraries at once are told to make do with it; where this fails, tell them one by one."""
    told = {"NPY_DISABLE_CPU_FEATURES": numpys_features()}
    if platform.machine() == "x86_64":
        plain = "-AVX512F,-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-AVX,-AVX_Usable"
        told |= {"OPENBLAS_CORETYPE": "Prescott", "GLIBC_TUNABLES": f"glibc.cpu.hwcaps={plain}"}
        told |= {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": ""}
    kernels = tmp_path / "kernels"
    told["NUMBA_CACHE_DIR"] = str(kernels)
    main_job = {name: made for name, made in usual.items() if name in CATEGORIES}
    first = COMPILE_FIRST + MAKE + ALL_WERE_COMPILED
    assert made_under(tmp_path / "main job", main_job, first, **told) == main_job
    assert len(list(kernels.glob("compiled-generate-*"))) == 1
    others = {name: made for name, made in usual.items() if name not in CATEGORIES}
    assert made_under(tmp_path / "others", others, **told) == others
