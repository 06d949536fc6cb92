"""Captioned pictures in rows."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from articugen.core.errors import InvalidArgument
from articugen.core.files import check_place, write_atomically
from articugen.pictures.shading import PAPER, Picture

INK, GREY = "#333333", "#8a8a8a"

TILE, MARGIN, CAPTION, GAP = 288, 10, 22, 12

Caption = Sequence[tuple[str, str]]  # texts, each after a dot of its colour


@dataclass(frozen=True, eq=False)
class Row:
    """A title above, pictures of TILE x TILE pixels, and a caption under each."""

    title: str
    pictures: Sequence[Picture]
    captions: Sequence[Caption]


def sheet(rows: Sequence[Row]) -> Picture:
    """Return the rows under each other; captions wider than a tile take several lines."""
    columns = max(len(row.pictures) for row in rows)
    captions = [[_lines(caption) for caption in row.captions] for row in rows]
    heights = [TILE + CAPTION * (1 + max(map(len, row), default=1)) for row in captions]
    canvas = Image.new("RGB", (2 * MARGIN + columns * TILE, 2 * MARGIN + sum(heights)), PAPER)
    pen = ImageDraw.Draw(canvas)
    for r, row in enumerate(rows):
        top = MARGIN + sum(heights[:r])
        pen.text((MARGIN + 6, top + 2), row.title, GREY, ImageFont.load_default(14))
        for c, (picture, lines) in enumerate(zip(row.pictures, captions[r], strict=True)):
            x = MARGIN + c * TILE
            canvas.paste(picture, (x, top + CAPTION))
            for k, line in enumerate(lines):
                _write(pen, line, x + TILE // 2, top + CAPTION * (1 + k) + TILE)
    return canvas


def in_columns(sheets: Sequence[Picture], columns: int) -> Picture:
    """Return sheets in rows of `columns`, each as far from the next as its margin says."""
    width = max(sheet.width for sheet in sheets)
    rows = [sheets[at : at + columns] for at in range(0, len(sheets), columns)]
    heights = [max(sheet.height for sheet in row) for row in rows]
    canvas = Image.new("RGB", (width * min(columns, len(sheets)), sum(heights)), PAPER)
    for r, row in enumerate(rows):
        for c, sheet in enumerate(row):
            canvas.paste(sheet, (c * width, sum(heights[:r])))
    return canvas


def check_picture(path: Path) -> None:
    """Raise an error, before any work, where no PNG can be written."""
    if path.suffix.lower() != ".png":  # it may be somebody's data
        raise InvalidArgument(f"{path}: pictures are PNGs; give it a name ending in .png")
    check_place(path)


def save(picture: Picture, path: Path) -> None:
    """Write a PNG, in place of what is called so: a link to elsewhere, say; or MachineFault."""
    write_atomically(path, png(picture))


def png(picture: Picture, *, level: int = 6) -> bytes:
    """Return a picture as a PNG, compressed by zlib, which chooses its kernels by processor; not at
    all with `level` 0, for bytes that are hashed."""
    file = io.BytesIO()
    picture.save(file, "PNG", compress_level=level)
    return file.getvalue()


def png_of(pixels: NDArray[np.unsignedinteger]) -> bytes:
    """Return pixels (h, w, 3 or 4) of uint8, or (h, w) of uint16, as a PNG."""
    return png(Image.fromarray(pixels))


def _lines(caption: Caption) -> list[Caption]:
    """Return the caption in lines that are no wider than a tile, as even as can be."""
    widths = [_width(text) for text, _ in caption]
    most = max(int((TILE + GAP) / (max(widths, default=0.0) + GAP)), 1)
    if sum(widths) + GAP * (len(widths) - 1) <= TILE:
        most = len(caption)
    count = -(-len(caption) // most) if caption else 1
    width = -(-len(caption) // count)
    return [caption[k * width : (k + 1) * width] for k in range(count)]


def _width(text: str) -> float:
    return 16 + ImageFont.load_default(14).getlength(text)


def _write(pen: ImageDraw.ImageDraw, line: Caption, middle: int, top: int) -> None:
    font = ImageFont.load_default(14)
    widths = [_width(text) for text, _ in line]
    x = middle - (sum(widths) + GAP * (len(widths) - 1)) / 2
    for (text, colour), width in zip(line, widths, strict=True):
        pen.ellipse((x, top + 4, x + 10, top + 14), colour)
        pen.text((x + 16, top), text, INK, font)
        x += width + GAP
