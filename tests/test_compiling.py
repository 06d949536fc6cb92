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
