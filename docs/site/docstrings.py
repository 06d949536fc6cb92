"""Docstrings are text for people in a terminal, and the reference takes them for Markdown.

In that, `<out>/<category>` would be elements of HTML, and vanish: they are escaped here.
"""

import re
from typing import Any

import griffe

_CODE_OR_ANGLE = re.compile(r"(?P<code>`[^`]*`)|<(?=\w)")


class Plain(griffe.Extension):
    """Keeps what stands in angle brackets."""

    def on_instance(self, *, obj: Any, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = escaped(obj.docstring.value)


def escaped(docstring: str) -> str:
    """The docstring with what would begin an element of HTML spelt out, but not in code."""
    return _CODE_OR_ANGLE.sub(lambda match: match["code"] or "&lt;", docstring)
