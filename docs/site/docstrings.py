"""Docstrings are text for people in a terminal, and the reference takes them for Markdown.

In that, `<out>/<category>` would be elements of HTML, and vanish: they are escaped here. Functions
that take a record's fields (`pipeline.options.takes`) get the text and the arguments they have in
Python.
"""

import inspect
import re
from importlib import import_module
from typing import Any

import griffe

_CODE_OR_ANGLE = re.compile(r"(?P<code>`[^`]*`)|<(?=\w)")


class Plain(griffe.Extension):
    """Keeps what stands in angle brackets."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        if any(str(one.value).startswith("takes(") for one in func.decorators):
            real = getattr(import_module(func.module.path), func.name)
            func.docstring = griffe.Docstring(escaped(inspect.getdoc(real) or ""), parent=func)
            func.parameters = griffe.Parameters(*map(parameter, _arguments(real)))

    def on_instance(self, *, obj: Any, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = escaped(obj.docstring.value)


def escaped(docstring: str) -> str:
    """The docstring with what would begin an element of HTML spelt out, but not in code."""
    return _CODE_OR_ANGLE.sub(lambda match: match["code"] or "&lt;", docstring)


def _arguments(function: Any) -> list[inspect.Parameter]:
    return list(inspect.signature(function).parameters.values())


def parameter(real: inspect.Parameter) -> griffe.Parameter:
    """Return an argument of a Python function as the reference has it."""
    default = getattr(real.default, "__name__", repr(real.default))
    default = None if real.default is real.empty else default
    kind = griffe.ParameterKind(real.kind.description)
    return griffe.Parameter(
        real.name, annotation=inspect.formatannotation(real.annotation), kind=kind, default=default
    )
