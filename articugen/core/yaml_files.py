"""YAML files of any kind, and recipes among them, which may extend another file and are checked by
a pydantic model. What a file may hold is little: it may come from a stranger."""

import difflib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from articugen.core.content import RECIPES
from articugen.core.errors import ArticugenError, InvalidRecipe
from articugen.core.files import read_or_refuse

Model = TypeVar("Model", bound=BaseModel)


MAX_YAML_BYTES = 2**18
MAX_YAML_DEPTH = 16
MAX_EXTENDED = 16  # files that a recipe may extend, one the other
_MAX_DIGITS = 40  # of a number

LEARNER_KEYS = {"method", "schedule"}
"""One of these is in every training recipe, or in one that it extends; in no recipe of data."""


def known(*, learner: bool) -> list[str]:
    """Return the names of the recipes under recipes/, of data or of learners."""
    return [path.stem for path in sorted(RECIPES.glob("*.yaml")) if _is_learner(path) == learner]


def _is_learner(path: Path) -> bool:
    data = read_yaml(path, InvalidRecipe)
    if not isinstance(data, dict) or LEARNER_KEYS & data.keys():
        return isinstance(data, dict)
    base = RECIPES / f"{data.get('extends')}.yaml"
    return base.is_file() and base != path and _is_learner(base)


def find(name: str, *, learner: bool) -> Path:
    """Return the file of a recipe, by its name under recipes/ or a path; InvalidRecipe if none."""
    for path in (RECIPES / f"{name}.yaml", Path(name)):
        if os.path.exists(path) and not os.path.isdir(path):
            return path
    raise InvalidRecipe(unlisted("recipe", name, known(learner=learner)))


def resolved(
    path: Path, base_of: Callable[[str], Path], chain: tuple[Path, ...] = ()
) -> dict[str, Any]:
    """Return the keys of a file over those of what it `extends`, by `base_of`; or InvalidRecipe."""
    if path in chain or len(chain) > MAX_EXTENDED:
        raise InvalidRecipe(f"{path}: extends itself, or too many others; extend fewer")
    data = read_yaml(path, InvalidRecipe) or {}
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise InvalidRecipe(f"{path}: a recipe is a mapping of keys to values; write key: value")
    return resolved_mapping(data, base_of, (*chain, path))


def resolved_mapping(
    data: Mapping[str, Any], base_of: Callable[[str], Path], chain: tuple[Path, ...] = ()
) -> dict[str, Any]:
    """Do as `resolved`, with a mapping that is no file's: a notebook's recipe."""
    keys, base = {k: value for k, value in data.items() if k != "extends"}, data.get("extends")
    beside = os.path.join(chain[-1].parent, str(base)) if chain else ""
    base = beside if Path(beside).suffix and os.path.isfile(beside) else base
    return keys if base is None else _merged(resolved(base_of(str(base)), base_of, chain), keys)


def read_yaml(path: Path, refusal: type[ArticugenError]) -> Any:
    """Read a YAML file: mappings, lists, texts, numbers, true, false and null.

    Each key is given once; there are no aliases, no tags of Python's, no dates.

    Raises:
        refusal: it cannot be read, or is anything else; the sentence says what and where.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    return parsed_yaml(yaml_bytes(path, refusal), str(path), refusal)


def yaml_bytes(path: Path, refusal: type[ArticugenError]) -> bytes:
    """Return the bytes of a YAML file, for `parsed_yaml`; raises as `read_yaml`."""
    return read_or_refuse(path, MAX_YAML_BYTES, refusal, "correct it or name another file")


def parsed_yaml(data: bytes | str, where: str, refusal: type[ArticugenError]) -> Any:
    """Return what YAML holds, as `read_yaml` takes it; `where` is named in the `refusal`."""
    try:
        return yaml.load(data.decode() if isinstance(data, bytes) else data, _Loader)
    except (yaml.YAMLError, *_PYTHON_ERRORS) as error:
        reason = " ".join(str(error).split())[:300]
        raise refusal(f"{where}: not YAML that can be read: {reason}; correct it there") from None


_PYTHON_ERRORS = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError)
"""What the library raises over values that are not of their tag, such as !!int x."""


class _Loader(yaml.SafeLoader):
    """YAML without what a settings file has no use for and that is harmful or surprising."""

    yaml_implicit_resolvers = {  # noqa: RUF012 - declared so by the library
        first: [
            (tag, form) for tag, form in resolvers if not tag.endswith((":timestamp", ":merge"))
        ]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            self._refuse(self.peek_event(), "aliases (*name) are not read; write it out")
        if self.depth >= MAX_YAML_DEPTH:
            self._refuse(self.peek_event(), "it is nested too deeply; make it flatter")
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        keys = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        known: set[str] = set()
        for key in keys:
            if key.value in known:
                self._refuse(key, f"the key {key.value[:100]!r} is given twice; remove one")
            known.add(key.value)

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        if len(node.value) > _MAX_DIGITS:
            self._refuse(node, f"a number has {len(node.value):,} digits; write a shorter one")
        if node.tag.endswith(":int"):
            return self.construct_yaml_int(node)
        return self.construct_yaml_float(node)

    def _refuse(self, where: Any, problem: str) -> None:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=where.start_mark)


for kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{kind}", _Loader.construct_number)


class Section(BaseModel):
    """A section of a settings file: unknown keys are refused, numbers are finite, and true and
    false are no numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _bool_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        annotation = cls.model_fields[info.field_name or ""].annotation
        if bool in (annotation, *get_args(annotation)):
            return value
        inside = value if isinstance(value, list | tuple) else (value,)
        if any(isinstance(item, bool) for item in inside):
            raise ValueError(
                "true and false (yes, no, on, off) are no value for it; put text in quotes"
            )
        return value


def with_settings(recipe: Model, texts: Sequence[str]) -> Model:
    """Return `recipe` with other values, `section.key=value` as `--set` takes them, the value as in
    YAML; the last one of a key counts.

    Raises:
        InvalidRecipe: no such key (with the nearest valid one), or a bad value.
    """
    if not texts:
        return recipe
    data = recipe.model_dump()
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.strip()):
            raise InvalidRecipe(f"--set {text[:100]!r}: write it as section.key=value")
        *sections, last = (name.strip() for name in key.split(".")[:MAX_YAML_DEPTH])
        setting = {last: parsed_yaml(value, f"--set {text[:100]}", InvalidRecipe)}
        for name in reversed(sections):
            setting = {name: setting}
        data = _merged(data, setting)
    return validated(type(recipe), data, " ".join(f"--set {text}" for text in texts)[:200])


def validated(
    model: type[Model], data: Any, where: str, refusal: type[ArticugenError] = InvalidRecipe
) -> Model:
    """Return `data` as a `model`; the `refusal` names `where`, and the nearest valid key."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        for unknown in (f for f in error.errors() if f["type"] == "extra_forbidden"):
            key = ".".join(map(str, unknown["loc"]))[:100]
            hint = _nearest_key(model, unknown["loc"])
            raise refusal(f"{where}: unknown key {key!r}{hint}") from None
        raise refusal(f"{where}: {fault_in(error)}") from None
    except OverflowError:  # pydantic's, of an integer that no float can hold
        raise refusal(f"{where}: a number is too large; write a smaller one") from None


def fault_in(error: ValidationError) -> str:
    """Return the first fault, where it is and what is wrong there."""
    first = error.errors()[0]
    where, message = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
    return f"{where}: {message}" if where else message


def nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return the hint "; did you mean 'x'?", or nothing where no known name is near."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=cutoff)
    return f"; did you mean {close[0]!r}?" if close else ""


def unlisted(what: str, name: str, known: Iterable[str]) -> str:
    """Return a sentence on a name that nothing has, with the nearest of those known, and all."""
    there = list(known)
    return f"no {what} {name!r}{nearest(name, there)}; there are: {', '.join(there) or 'none'}"


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merged(base[key], value) if nested else value
    return merged


def _nearest_key(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """Return the hint for an unknown key: one of its section, or one of that very name in
    another."""
    *sections, key = location
    section = model
    for name in sections:
        if isinstance(name, str):  # numbers are places in a sequence
            section = _section(section, name) or section
    namesakes = [path for path in _paths(model) if path.rpartition(".")[2] == key]
    return nearest(str(key), list(section.model_fields)) or nearest(str(key), namesakes, 0.0)


def _section(model: type[BaseModel], key: str) -> type[BaseModel] | None:
    """Return the model of what stands at a key, or of each item there."""
    field = model.model_fields.get(key)
    annotation = field.annotation if field else None
    inner = [a for a in (annotation, *get_args(annotation)) if isinstance(a, type)]
    return next((a for a in inner if issubclass(a, BaseModel)), None)


def _paths(model: type[BaseModel]) -> Iterator[str]:
    """Yield every key, with the sections it is in: `sampling.grids`."""
    for key in model.model_fields:
        yield key
        section = _section(model, key)
        yield from (f"{key}.{path}" for path in (_paths(section) if section else ()))
