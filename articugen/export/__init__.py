"""Data sets in the formats that others' trainers, viewers and simulators read: a file a format.

`articugen.export` is this package and, whatever was imported first, a function too: `run.export`.
"""

import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        from articugen.export.run import export  # noqa: PLC0415 - h5py takes a while

        return export(*args, **kwargs)


sys.modules[__name__].__class__ = _Callable
