"""Commands: functions whose parameters, or a record of theirs, say by `option` what is asked."""

import inspect
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import MISSING, Field, field, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer

from articugen.cli.app import app
from articugen.cli.saying import said
from articugen.pipeline.options import option


def argument(sentence: str, default: Any = MISSING, **shown: Any) -> Any:
    """Return the same as `option` for what is given by its place."""
    return field(default=default, metadata={"help": sentence, "flags": None, "shown": shown})


DATA = option(MISSING, "The folder of the data set.", "-d")
DATA_SETS = argument("The folder of a data set, or one of such folders.")
DEVICE = option("cpu", "cpu, cuda or cuda:1.")
JOBS = option(None, "Worker processes.", "-j", min=1, show_default="all cores")
RUN = argument("A run's folder, or that of a category's runs.")
THREADS = option(0, "CPU threads; 0 leaves it to torch.", min=0)


def offered(
    *examples: str, interrupted: str = "interrupted", **settings: Any
) -> Callable[[Callable[..., int | None]], Callable[..., None]]:
    """Return a decorator: a function becomes a command of its name, which ends with the exit status
    that it returns, and with our errors in one sentence.

    Args:
        examples: commands, and words on them, for its help.
        interrupted: the message where it is interrupted.
        settings: further ones of `app.command`.
    """
    heading = "Example: " if len(examples) == 1 else "Examples:\n\n"
    epilog = heading + "\n\n".join(examples) if examples else None

    def decorated(function: Callable[..., int | None]) -> Callable[..., None]:
        signature = inspect.signature(function)
        wanted = list(_asked(signature))
        kinds = {p.name: p.annotation for p in signature.parameters.values()}
        records: dict[str, Any] = {name: kind for name, kind in kinds.items() if is_dataclass(kind)}

        @wraps(function)
        def called(**values: Any) -> None:
            arguments = {one.name: _value(one, values.get(one.name)) for one in wanted}
            for place, record in records.items():
                names = [one.name for one in fields(record) if one.name in arguments]
                arguments[place] = record(**{name: arguments.pop(name) for name in names})
            with said(interrupted):
                status = function(**arguments)
            if status:
                raise typer.Exit(status)

        parameters = [*map(_parameter, wanted)]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in parameters}
        app.command(epilog=epilog, **settings)(called)
        return called

    return decorated


def _asked(signature: inspect.Signature) -> Iterator[Field[Any]]:
    """Yield what can be asked, by name and type, in the order of the help."""
    for parameter in signature.parameters.values():
        if is_dataclass(parameter.annotation):
            yield from (one for one in fields(parameter.annotation) if "flags" in one.metadata)
        else:
            one = copy(parameter.default)
            one.name, one.type = parameter.name, parameter.annotation
            yield one


def _parameter(one: Field[Any]) -> inspect.Parameter:
    """Return it as a parameter that typer understands: texts, a number, a flag, or a text."""
    kind: Any = _kind(one)
    kind = list[kind] if _is_several(one) else kind
    flags, default = one.metadata["flags"], None if one.default == () else one.default
    about = {"help": one.metadata["help"], **one.metadata["shown"]}
    if flags is None:
        shown = typer.Argument(**about)
    else:
        is_named = any(flag.startswith("--") for flag in flags)
        flags = flags if is_named else (f"--{one.name.replace('_', '-')}", *flags)
        shown = typer.Option(*flags, **about)
    return inspect.Parameter(
        one.name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default=inspect.Parameter.empty if default is MISSING else default,
        annotation=Annotated[kind if default is not None else kind | None, shown],
    )


def _kind(one: Field[Any]) -> type:
    """Return the type of its value, or of each of its values."""
    kinds = [one.type, *get_args(one.type)]
    kinds += [inner for kind in kinds for inner in get_args(kind)]
    return next((kind for kind in (bool, float, int, str) if kind in kinds), Path)


def _is_several(one: Field[Any]) -> bool:
    return Sequence in map(get_origin, (one.type, *get_args(one.type)))


def _value(one: Field[Any], value: Any) -> Any:
    """Return what a function is called with; names are parted by commas, settings and paths are
    not."""
    if value is None:
        return one.default
    for path in value if isinstance(value, list) else [value]:
        if isinstance(path, Path) and ":/" in str(path) and not path.exists():
            raise typer.BadParameter(f"{path}: an address; copy it to a folder, and name that")
    if _is_several(one) and _kind(one) is str and one.name != "changes":
        return [name.strip() for text in value for name in text.split(",") if name.strip()]
    return value
