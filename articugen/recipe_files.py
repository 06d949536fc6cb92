"""Recipe files of any kind: YAML that may extend another file, checked by a pydantic model."""

import difflib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from articugen.errors import InvalidRecipe

RECIPE_FOLDER = Path(__file__).resolve().parent.parent / "recipes"

Model = TypeVar("Model", bound=BaseModel)


LEARNER = "ppd_"
"""What the names of training recipes begin with; those of data recipes do not."""


def known(*, learner: bool) -> list[str]:
    """The names of the recipes under recipes/, of data or of the learner."""
    names = sorted(path.stem for path in RECIPE_FOLDER.glob("*.yaml"))
    return [name for name in names if name.startswith(LEARNER) == learner]


def find(name: str, *, learner: bool) -> Path:
    """The file that `name` stands for: a name under recipes/, or a path.

    Raises:
        InvalidRecipe: there is none.
    """
    for path in (RECIPE_FOLDER / f"{name}.yaml", Path(name)):
        if path.is_file():
            return path
    names = known(learner=learner)
    raise InvalidRecipe(f"no recipe {name!r}{nearest(name, names)}; there are: {', '.join(names)}")


def resolved(
    path: Path, base_of: Callable[[str], Path], chain: tuple[Path, ...] = ()
) -> dict[str, Any]:
    """The keys of a file over those of what it says it `extends`; `base_of` finds that.

    Raises:
        InvalidRecipe: it cannot be read, is not YAML, no mapping, or extends itself.
    """
    if path in chain:
        raise InvalidRecipe(f"{path}: extends itself")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except OSError as error:
        raise InvalidRecipe(f"{path}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidRecipe(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise InvalidRecipe(f"{path}: a recipe is a mapping of keys to values")
    base = data.pop("extends", None)
    if base is None:
        return data
    return _merged(resolved(base_of(str(base)), base_of, (*chain, path)), data)


def validated(model: type[Model], data: dict[str, Any], where: str) -> Model:
    """`data` as a `model`; `where` is named in errors.

    Raises:
        InvalidRecipe: an unknown key (with the nearest valid one) or a bad value.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        faults = error.errors()
        first = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
        key = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            hint = nearest(str(first["loc"][-1]), _keys_at(model, first["loc"][:-1]))
            raise InvalidRecipe(f"{where}: unknown key {key!r}{hint}") from None
        message = first["msg"].removeprefix("Value error, ")
        raise InvalidRecipe(f"{where}: {key}: {message}") from None


def nearest(name: str, known: list[str]) -> str:
    """The hint "; did you mean 'x'?", or nothing where no known name is near."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merged(base[key], value) if nested else value
    return merged


def _keys_at(section: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The keys of the section at `location`; numbers in it are places in a sequence."""
    for name in location:
        if isinstance(name, int):
            continue
        annotation = section.model_fields[name].annotation
        inner = [a for a in (annotation, *get_args(annotation)) if isinstance(a, type)]
        section = next((a for a in inner if issubclass(a, BaseModel)), section)
    return list(section.model_fields)
