"""OpenUSD's modules, each imported when it is first used; type checkers know nothing of them."""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(name)
    return import_module(f"pxr.{name}")
