"""HTML in which nothing needs to be escaped by hand: a text becomes a text, whatever it holds.

Drawings are in SVG, which follow the page's colours by their classes.
"""

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import printable


class Markup(str):
    """HTML. A plain str that is put inside of an element is text."""

    __slots__ = ()


def el(name: str, /, *inside: object, **attributes: object) -> Markup:
    """Return an element. An attribute of None or False is left out, of True stands without a value;
    a trailing _ of its name is dropped, other underscores become hyphens."""
    written = "".join(
        f" {key.rstrip('_').replace('_', '-')}" + ("" if value is True else f'="{text(value)}"')
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    if name in _VOID:
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{join(*inside)}</{name}>")


def join(*inside: object) -> Markup:
    """Texts and HTML after each other; None is nothing."""
    return Markup("".join(text(piece) for piece in inside if piece is not None))


def text(value: object) -> Markup:
    """Return a text as HTML: nothing in it is a tag, a quote or a sign that turns what follows
    around."""
    if isinstance(value, Markup):
        return value
    return Markup(escape(printable(str(value)), quote=True))


def hint(*inside: object) -> Markup:
    """Return a paragraph in small print."""
    return el("p", *inside, class_="hint")


def card(*inside: object) -> Markup:
    """Return a box on the page."""
    return el("div", *inside, class_="card")


MOST_ROWS = 1000  # of a table; a page of more helps nobody
SPACE = Markup(" ")  # between elements, where a text's own would be taken off


_VOID = {"meta", "img", "input", "br"}


def table(head: Sequence[str], rows: Sequence[Sequence[object]], name: str) -> Markup:
    """Return a table that scrolls by itself where it is too wide.

    Args:
        head: titles; > before one means a column of numbers, ~ one of sentences.
    """
    kinds = [{">": "n", "~": "w"}.get(title[:1]) for title in head]
    titles = [el("th", title.lstrip(">~"), scope="col", class_=kind)
              for title, kind in zip(head, kinds, strict=True)]  # fmt: skip
    lines = [
        el("tr", el("th", row[0], scope="row"),
           *(el("td", cell, class_=kind) for cell, kind in zip(row[1:], kinds[1:], strict=True)))
        for row in rows
    ]  # fmt: skip
    whole = el("table", el("thead", el("tr", *titles)), el("tbody", *lines))
    return el("div", whole, class_="scroll", tabindex="0", role="region", aria_label=name)


def folded(title: str, inside: Markup, rows: int) -> Markup:
    more = f"; the first {MOST_ROWS:,}" if rows > MOST_ROWS else ""
    return el("details", el("summary", title + more), inside, class_="card")


def keys(lines: Iterable[tuple[str, object]], kind: str = "keys") -> Markup:
    return el("dl", *(join(el("dt", key), el("dd", value)) for key, value in lines), class_=kind)


WIDTH, HEIGHT = 320, 96
BINS = 20


def histogram(
    values: Floats, low: float, high: float, ends: tuple[str, str], *, colour: str, title: str,
    even: bool = False,
) -> Markup:  # fmt: skip
    """Return how many of `values` lie where between `low` and `high`, as bars.

    Args:
        ends: what is written below the two ends.
        title: for a reader who sees no picture.
        even: draw the height that bars of evenly spread values have.
    """
    span = high - low if high > low else 1.0
    counts, _ = np.histogram(values, BINS, (low, low + span))
    most = max(int(counts.max()), 1)
    step, top, base = WIDTH / BINS, 12, HEIGHT - 18
    bars = [
        el("rect", x=f"{n * step + 1:.1f}", y=f"{base - h:.1f}", width=f"{step - 2:.1f}",
           height=f"{h:.1f}", rx="1.5", fill=colour)
        for n, count in enumerate(counts.tolist())
        if (h := (base - top) * count / most) > 0
    ]  # fmt: skip
    expected = base - (base - top) * len(values) / BINS / most
    line = el("line", x1="0", x2=str(WIDTH), y1=f"{expected:.1f}", y2=f"{expected:.1f}",
              class_="even")  # fmt: skip
    return el(
        "svg",
        el("title", title),
        el("line", x1="0", x2=str(WIDTH), y1=str(base), y2=str(base), class_="axis"),
        *bars,
        line if even and len(values) else None,
        el("text", ends[0], x="0", y=str(HEIGHT - 3)),
        el("text", ends[1], x=str(WIDTH), y=str(HEIGHT - 3), text_anchor="end"),
        viewBox=f"0 0 {WIDTH} {HEIGHT}",
        role="img",
        class_="chart",
    )


def share_bar(shares: Sequence[tuple[float, str]], title: str) -> Markup:
    """Shares of a whole beside each other, each in its colour."""
    total = sum(share for share, _ in shares) or 1.0
    x, pieces = 0.0, []
    for share, colour in shares:
        width = WIDTH * share / total
        pieces.append(
            el("rect", x=f"{x:.2f}", y="0", width=f"{width:.2f}", height="14", fill=colour)
        )
        x += width
    return el("svg", el("title", title), *pieces, viewBox=f"0 0 {WIDTH} 14", role="img",
              class_="share", preserveAspectRatio="none")  # fmt: skip


def dot(colour: str) -> Markup:
    """Return the mark of a part."""
    circle = el("circle", cx="5", cy="5", r="4.5", fill=colour, class_="rim")
    return el("svg", circle, viewBox="0 0 10 10", class_="dot", aria_hidden="true")
