"""What decides an object's data, beside its files, the recipe and the seed: a number a stage.

Whoever changes what a stage makes raises its number here, and data made before are then made again.
Comments, tidied code and new backends change no data and raise nothing. `tests/golden.py` keeps
digests of a tiny set: where they change and no number was raised, a test fails and says what to do.

They stand in one light table, since a run is planned without importing numba and the stages.
Bundled recipes and sources lie beside the package in a checkout, else inside of it.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from platformdirs import user_cache_path

VERSION = "0.1.0"  # of articugen; `articugen.__version__`

STAGES = {
    "sources": 1,  # how files become an object; not the shapes of bundled models
    "articulation": 1,
    "swept": 1,
    "rendering": 1,  # whatever the backend
    "fusion": 1,
    "sampling": 1,
    "sharp": 2,  # of recipes that ask for sharp points alone
    "instance": 2,  # how the stages are put together: frames, counts, what is drawn from what
    "vocabulary": 1,  # geometry, portable, records, seeding: what all of them compute with
}

MODELS = {
    "box": 2, "drawer": 2, "eyeglasses": 2, "laptop": 2, "microwave": 1, "oven": 1,
    "refrigerator": 1, "washing_machine": 1,
}  # fmt: skip
"""The same for the shapes of bundled models, by category: models and their data are made again."""

FORMS = {"varied": 3, "rough": 2}  # the same for all models drawn, or written, in such a form

KEYS = {
    "partial_cameras": 3, "kinect_metres": 2, "signed_distance": 1, "surface_color": 4,
    "colours": 4, "one_at_a_time": 1,
}  # fmt: skip
"""The same for recipes that have such a key."""

_INSTALLED = Path(__file__).resolve().parents[1] / "_bundled"
_ROOT = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parent.parent

RECIPES = _ROOT / "recipes"
SOURCES = _ROOT / "urdf_sources"
CACHE = user_cache_path("articugen", appauthor=False)  # of the user
_DRAWN_BY = _INSTALLED.parent / "procedural"


def model_version(category: str) -> int | str:
    """Return the version of a category's bundled models: its number in MODELS. A category without
    one is still being drawn: a digest of its module, so that each change shows at once."""
    if category in MODELS:
        return MODELS[category]
    files = sorted((_DRAWN_BY / category).rglob("*.py")) or [_DRAWN_BY / f"{category}.py"]
    code = b"".join(file.read_bytes() for file in files if file.is_file())
    return f"draft {hashlib.sha256(code).hexdigest()[:12]}"


def declared(models: str | None, recipe: str, forms: Iterable[str] = ()) -> str:
    """Return all numbers that decide an object's data, as text.

    Args:
        models: the category of which it is a bundled model; None for any other object.
        recipe: its text, which names what it asks for besides and nothing else of that.
        forms: which of FORMS it has.
    """
    models_of = {f"{models} models": model_version(models)} if models else {}
    models_of |= {f"{form} models": FORMS[form] for form in forms}
    asks = '"sharp_points":' in recipe
    numbers = {n: v for n, v in (STAGES | models_of).items() if asks or n != "sharp"}
    numbers |= {name: v for name, v in KEYS.items() if f'"{name}":' in recipe}
    return ", ".join(f"{name} {number}" for name, number in numbers.items())
