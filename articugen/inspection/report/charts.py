"""Drawings in SVG, which follow the page's colours by their classes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from articugen.inspection.report.markup import Markup, el

Array = NDArray[np.float64]

WIDTH, HEIGHT = 320, 96
BINS = 20


def histogram(
    values: Array, low: float, high: float, ends: tuple[str, str], *, colour: str, title: str,
    even: bool = False,
) -> Markup:  # fmt: skip
    """Return how many of `values` lie where between `low` and `high`, as bars.

    Args:
        ends: what is written below the two ends.
        title: what a reader who sees no picture is told.
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
