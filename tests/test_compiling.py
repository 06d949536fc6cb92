"""What numba keeps of compiled kernels, after their files have changed."""

import os
import pickle

import pytest
from python_process import printed

KERNEL = """
from articugen.core.jit import kernel


@kernel
def twice(x):
    return 2 * x
"""
MOVED = b"carticugen.no_such_module\nBvh\n."


@pytest.mark.parametrize("hours", [1, -1])
def test_an_index_of_modules_that_moved_is_dropped_where_the_file_is_newer(tmp_path, hours):
    source = tmp_path / "ours.py"
    source.write_text(KERNEL)
    own = {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    command = ("-c", "import ours; print(ours.twice(21))")
    assert printed(*command, folder=tmp_path, NUMBA_CACHE_DIR="", **own).split() == ["42"]
    (index,) = tmp_path.rglob("*.nbi")
    head = pickle.dumps(pickle.loads(index.read_bytes()))
    index.write_bytes(head + MOVED)
    now = index.stat().st_mtime
    os.utime(source, (now + 3600 * hours, now + 3600 * hours))
    if hours > 0:
        assert printed(*command, folder=tmp_path, NUMBA_CACHE_DIR="", **own).split() == ["42"]
    else:  # as numba does by itself
        with pytest.raises(AssertionError, match="no_such_module"):
            printed(*command, folder=tmp_path, NUMBA_CACHE_DIR="", **own)


def test_a_kernel_is_compiled_again_where_a_helpers_file_changed(tmp_path):
    """What a helper says is a part of the kernel; numba asks for the date of the kernel's file."""
    (tmp_path / "ours.py").write_text(
        "from articugen.core.jit import kernel\nfrom parts import times\n\n\n"
        "@kernel\ndef many(x):\n    return times(x)\n"
    )
    helper = tmp_path / "parts.py"
    own = {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    for hours, factor in ((0, 2), (1, 3)):
        helper.write_text(
            "from articugen.core.jit import helper\n\n\n"
            f"@helper\ndef times(x):\n    return {factor} * x\n"
        )
        later = helper.stat().st_mtime + 3600 * hours
        os.utime(helper, (later, later))
        command = ("-c", "import ours; print(ours.many(7))")
        said = printed(*command, folder=tmp_path, NUMBA_CACHE_DIR="", **own)
        assert said.split() == [str(7 * factor)]


def test_a_debugger_may_step_through_kernels():
    code = (
        "import numpy as np\nfrom articugen.core.near import any_within, by_cell\n"
        "print(any_within(by_cell(np.eye(3)), np.eye(3)[:1] + 0.01, 0.1).tolist())"
    )
    assert printed("-c", code, NUMBA_DISABLE_JIT="1").split() == ["[True]"]
