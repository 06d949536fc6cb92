"""How kernels are compiled, the same for all: every option that is not needed costs seconds.

`kernel` is for what Python calls: kept on the disk, and other threads run meanwhile. `helper` is
for what kernels call: compiled as a part of them alone, while Python sees a plain function.
`inlined` is written into its callers word by word, which spares counting the references of arrays
but takes long to compile where there are many.

Dear in a kernel, at one to four seconds each: assigning an array to a slice, np.cross and others
that can raise errors, as numba compiles how those are worded; np.partition, np.append; arrays that
differ from one caller to the next in being read-only, or in their layout.

In kernels a vector is a tuple of three numbers, which costs nothing to hand on.
"""

from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
from numba import njit
from numba.extending import register_jitable

_njit: Any = njit
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}

helper: Any = register_jitable
inlined: Any = partial(_njit, inline="always")


def kernel(function: Any = None, /, **options: Any) -> Any:
    """Return the decorator of what Python calls; `options` are numba's."""
    if function is None:
        return partial(kernel, **options)
    try:
        compiled = _njit(cache=True, **_OPTIONS, **options)(function)
    except RuntimeError:  # neither this folder nor the user's cache can be written to
        return _njit(**_OPTIONS, **options)(function)
    if compiled is not function:  # as it is by NUMBA_DISABLE_JIT, for debuggers
        _drop_stale(function, Path(compiled.stats.cache_path))
    return compiled


def _drop_stale(function: FunctionType, folder: Path) -> None:
    """Remove numba's index of a kernel whose file changed, or that of a helper which is a part of
    it: numba checks the kernel's alone, and when it has read the index."""
    code, parts = function.__code__, set[FunctionType]()
    _add_parts(function, parts)
    with suppress(OSError):
        changed = max(Path(part.__code__.co_filename).stat().st_mtime_ns for part in parts)
        source = Path(code.co_filename).stem
        for index in folder.glob(f"{source}.{code.co_name}-{code.co_firstlineno}.*.nbi"):
            if index.stat().st_mtime_ns < changed:
                index.unlink(missing_ok=True)


def _add_parts(function: FunctionType, parts: set[FunctionType]) -> None:
    """Add a function, and all that it calls by a global name."""
    parts.add(function)
    for name in function.__code__.co_names:
        called = function.__globals__.get(name)
        called = getattr(called, "py_func", called)
        if isinstance(called, FunctionType) and called not in parts:
            _add_parts(called, parts)


@helper
def vector(rows, i):  # pragma: no cover - compiled
    return rows[i, 0], rows[i, 1], rows[i, 2]


@helper
def minus(a, b):  # pragma: no cover - compiled
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@helper
def dot(a, b):  # pragma: no cover - compiled
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def cross(u, v):  # pragma: no cover - compiled
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@helper
def squared(a, b):  # pragma: no cover - compiled
    """Return the square of the distance between two places."""
    way = minus(a, b)
    return dot(way, way)


@helper
def ahead(point, origin, normal):  # pragma: no cover - compiled
    """Return how far `point` lies in front of the plane through `origin`."""
    return dot(minus(point, origin), normal)


@helper
def plane_of(corners, f):  # pragma: no cover - compiled
    """Return the unit normal of a face, of all corners (F, 3, 3), and its offset."""
    a = vector(corners[f], 0)
    n = cross(minus(vector(corners[f], 1), a), minus(vector(corners[f], 2), a))
    length = max(np.sqrt(dot(n, n)), 1e-30)
    normal = (n[0] / length, n[1] / length, n[2] / length)
    return normal, dot(normal, a)


@helper
def between(p, q, here, there):  # pragma: no cover - compiled
    """Return the point between two at which a height, `here` and `there` at them, is 0."""
    t = here / (here - there)
    return p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1]), p[2] + t * (q[2] - p[2])


@helper
def root(above, i):  # pragma: no cover - compiled
    """Return the root of the tree that `i` is in; paths become shorter by it."""
    while above[i] != i:
        above[i] = above[above[i]]
        i = above[i]
    return i
