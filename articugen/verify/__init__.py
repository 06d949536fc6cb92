"""Whether data are what they claim: in their bytes, their geometry, and made once more.

`articugen.verify` is this package and, whatever was imported first, a function too: `check.check`.
"""

import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        from articugen.verify.check import check  # noqa: PLC0415 - numba takes a second

        return check(*args, **kwargs)


sys.modules[__name__].__class__ = _Callable
