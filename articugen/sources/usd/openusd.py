"""The way to OpenUSD's modules, of which type checkers know nothing."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any


def pxr(*names: str) -> list[Any]:
    """Modules of OpenUSD, by name."""
    return [import_module(f"pxr.{name}") for name in names]


def is_there() -> bool:
    """Return whether OpenUSD is installed."""
    try:
        return find_spec("pxr") is not None
    except ValueError:  # somebody has put None in its place
        return False
