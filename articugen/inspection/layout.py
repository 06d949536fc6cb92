"""Captioned pictures in rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from articugen.errors import ArticugenError
from articugen.inspection.shading import PAPER, Picture

INK, GREY = "#333333", "#8a8a8a"

TILE, MARGIN, CAPTION = 288, 10, 22

Caption = Sequence[tuple[str, str]]
"""Texts, each after a dot of its colour, if it has one."""


@dataclass(frozen=True, eq=False)
class Row:
    """A title above, pictures of TILE x TILE pixels, and a caption under each."""

    title: str
    pictures: Sequence[Picture]
    captions: Sequence[Caption]


def sheet(rows: Sequence[Row]) -> Picture:
    """The rows under each other."""
    columns = max(len(row.pictures) for row in rows)
    height = TILE + 2 * CAPTION
    canvas = Image.new("RGB", (2 * MARGIN + columns * TILE, 2 * MARGIN + len(rows) * height), PAPER)
    pen = ImageDraw.Draw(canvas)
    for r, row in enumerate(rows):
        top = MARGIN + r * height
        pen.text((MARGIN + 6, top + 2), row.title, GREY, ImageFont.load_default(14))
        for c, (picture, caption) in enumerate(zip(row.pictures, row.captions, strict=True)):
            x = MARGIN + c * TILE
            canvas.paste(picture, (x, top + CAPTION))
            _write(pen, caption, x + TILE // 2, top + CAPTION + TILE)
    return canvas


def save(picture: Picture, path: Path) -> None:
    """Write a PNG.

    Raises:
        ArticugenError: `path` cannot be written.
    """
    try:
        picture.save(path, "PNG", optimize=True)
    except OSError as error:
        raise ArticugenError(f"{path}: cannot be written: {error.strerror}") from None


def _write(pen: ImageDraw.ImageDraw, caption: Caption, middle: int, top: int) -> None:
    font = ImageFont.load_default(14)
    widths = [16 * bool(colour) + pen.textlength(text, font) for text, colour in caption]
    x = middle - (sum(widths) + 12 * (len(widths) - 1)) / 2
    for (text, colour), width in zip(caption, widths, strict=True):
        if colour:
            pen.ellipse((x, top + 4, x + 10, top + 14), colour)
        pen.text((x + 16 * bool(colour), top), text, INK, font)
        x += width + 12
