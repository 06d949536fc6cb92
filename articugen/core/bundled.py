"""Where the recipes and sources that come with articugen lie, and the user's cache folder.

In a checkout they lie beside the package, in an installed package inside of it.
"""

from pathlib import Path

from platformdirs import user_cache_path

_INSTALLED = Path(__file__).resolve().parents[1] / "_bundled"
_ROOT = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parent.parent

RECIPES = _ROOT / "recipes"
SOURCES = _ROOT / "urdf_sources"

CACHE = user_cache_path("articugen", appauthor=False)
