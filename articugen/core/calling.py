"""Packages that are called like the function of their name, as `articugen.verify(...)` is."""

import inspect
import sys
from importlib import import_module
from types import ModuleType
from typing import Any


def called_as(package: str, module: str, function: str) -> None:
    """Let a package be called, whatever was imported first, and have that function's text and
    signature; it is imported when one of these is wanted, since that takes a second."""

    def found() -> Any:
        return getattr(import_module(f"{package}.{module}"), function)

    class Called(ModuleType):
        __doc__ = property(lambda _: found().__doc__)  # pyright: ignore[reportAssignmentType]
        __signature__ = property(lambda _: inspect.signature(found()))

        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            return found()(*args, **kwargs)

    sys.modules[package].__class__ = Called
