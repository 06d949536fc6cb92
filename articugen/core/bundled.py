"""Where the recipes and sources that come with articugen lie, and where bundled models are written.

In a checkout they lie beside the package, and models below urdf_sources/; in an installed package
inside of it, where nothing is ever written: there models go to the user's cache folder.
"""

from pathlib import Path

from platformdirs import user_cache_path

_INSTALLED = Path(__file__).resolve().parents[1] / "_bundled"
_ROOT = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parent.parent

RECIPES = _ROOT / "recipes"
SOURCES = _ROOT / "urdf_sources"


CACHE = user_cache_path("articugen", appauthor=False) / "models"


def model_folder(source: str) -> Path:
    """The folder for the models of a source that are written on demand; it need not exist yet."""
    if _ROOT == _INSTALLED:
        return CACHE / source
    return SOURCES / source
