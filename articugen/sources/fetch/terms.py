"""Whose the models are, and on which terms; shown before they are fetched, and kept beside them."""

from typing import NamedTuple

from articugen.core.errors import InvalidArgument
from articugen.core.yaml_files import unlisted
from articugen.sources.source_file import plain, read_source_file, source_files


class Terms(NamedTuple):
    """Origin and licence of one data set."""

    source: str
    origin: str
    licence: str


_OTHERS = {
    "articraft": (
        "Articraft-10K (arXiv 2605.15187), camvsl/Articraft-10K at Hugging Face, compiled URDFs",
        "CC BY 4.0",
    ),
    "artiverse": (
        "Artiverse (arXiv 2605.24403), 3dlg-hcvc/artiverse at Hugging Face",
        "gated; each model under the licence of the data set that it comes from",
    ),
    "artiatlas": (
        "ArtiAtlas (SIGGRAPH Asia 2026), Moon-bow/ArtiAtlas at Hugging Face",
        "gated; each model under the licence of the data set that it comes from",
    ),
    "artvip": (
        "ArtVIP (ICLR 2026, arXiv 2506.04941), x-humanoid-robomind/ArtVIP at Hugging Face, USD",
        "Apache-2.0",
    ),
    "sketchmobility": (
        "SketchMobility (arXiv 2604.25781), Arlo397/SketchMobility at Hugging Face",
        "gated; CC BY 4.0 or, of models from Shape2Motion, GPL-3.0, as its LICENSE_MAP.json says",
    ),
}

NAMES = ("partnet-mobility", "shape2motion", *_OTHERS)


def terms_of(name: str) -> Terms:
    """Return the terms of a data set, by its name in any writing; InvalidArgument if there is
    none."""
    source = next((known for known in NAMES if plain(known) == plain(name)), None)
    if source is None:
        raise InvalidArgument(unlisted("data set", name, NAMES))
    if source in _OTHERS:
        return Terms(source, *_OTHERS[source])
    file = read_source_file(source_files()[source.replace("-", "_")])
    return Terms(source, file.origin, file.licence)
