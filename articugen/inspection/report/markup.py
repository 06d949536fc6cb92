"""HTML in which nothing needs to be escaped by hand: a text becomes a text, whatever it holds."""

from html import escape

from articugen.core.errors import printable


class Markup(str):
    """HTML. A plain str that is put inside of an element is text."""

    __slots__ = ()


def el(name: str, /, *inside: object, **attributes: object) -> Markup:
    """Return an element. An attribute of None or False is left out, of True stands without a value;
    a trailing _ of its name is dropped, other underscores become hyphens."""
    written = "".join(
        f" {_attribute(key)}" + ("" if value is True else f'="{text(value)}"')
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    if name in _VOID:
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{join(*inside)}</{name}>")


def join(*inside: object) -> Markup:
    """Texts and HTML after each other; None is nothing."""
    return Markup("".join(text(each) for each in inside if each is not None))


def text(value: object) -> Markup:
    """A text as HTML: nothing in it is a tag, a quote or a sign that turns what follows around."""
    if isinstance(value, Markup):
        return value
    return Markup(escape(printable(str(value)), quote=True))


SPACE = Markup(" ")
"""Between elements, where a text's own would be taken off."""


def _attribute(key: str) -> str:
    return key.rstrip("_").replace("_", "-")


_VOID = {"meta", "img", "input", "br"}
