"""What a notebook shows of a data set and of a row: a picture, and what `repr` says.

The store knows nothing of pictures; importing this gives them to its classes. What draws them is
imported when the first is drawn.
"""

# ruff: noqa: PLC0415
import base64
import html

import numpy as np

from articugen.core.errors import ArticugenError
from articugen.store.dataset import DataSet, open
from articugen.store.rows import Row

__all__ = ["DataSet", "Row", "open"]

OBJECTS, STATES = 2, 4  # of a contact sheet: a glance, drawn in seconds


def of_data(data: DataSet) -> str:
    """Return a small contact sheet of the objects of a data set, as HTML."""
    from articugen.pictures.contact_sheet import drawn_sheet
    from articugen.pictures.layout import png

    try:
        return _page(png(drawn_sheet(data.shards, OBJECTS, STATES)), repr(data))
    except ArticugenError:  # no surface points, say: nothing to draw
        return _page(b"", repr(data))


def of_row(row: Row) -> str:
    """Return the surface points of a row, coloured by part, as HTML."""
    from articugen.pictures.layout import png
    from articugen.pictures.portrait import AZIMUTHS, instance_of, pooled, portrait, tile_camera

    if len(row.surface) < 2:
        return _page(b"", repr(row))
    instance = instance_of(row)
    points = np.asarray(row.surface.points, np.float64)
    camera = tile_camera(points, AZIMUTHS[0])
    drawn = portrait(pooled([instance]), instance, camera, float(points[:, 2].min()))
    return _page(png(drawn), repr(row))


def _page(picture: bytes, text: str) -> str:
    image = base64.b64encode(picture).decode()
    drawn = f'<img src="data:image/png;base64,{image}"/>' if picture else ""
    return f"<div>{drawn}<pre>{html.escape(text)}</pre></div>"


DataSet.draw = of_data
Row.draw = of_row
