"""Options that several commands take, and those of a record as options of a command."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import MISSING, Field, fields
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer

Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        help="Another value than the recipe's, as YAML; may be given several times.",
        show_default="none",
    ),
]
Data = Annotated[Path, typer.Option("--data", "-d", help="The folder of the data set.")]
DataSets = Annotated[Path, typer.Argument(help="The folder of a data set, or one of such folders.")]
Device = Annotated[str, typer.Option(help="cpu, cuda or cuda:1.")]
Run = Annotated[Path, typer.Argument(help="A run's folder, or that of a category's runs.")]
Threads = Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves it to torch.")]


def listed(texts: list[str] | None) -> list[str]:
    """Return the names in options that may be given several times, with several names each."""
    return [name.strip() for text in texts or () for name in text.split(",") if name.strip()]


def with_options_of(record: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator: a command whose first parameter is a record has an option for each of its
    fields that tells of flags."""
    chosen = {one.name: one for one in fields(record) if "flags" in one.metadata}

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        @wraps(command)
        def called(**values: Any) -> None:
            given = {name: _value(one, values.pop(name)) for name, one in chosen.items()}
            command(record(**given), **values)

        rest = list(inspect.signature(command).parameters.values())[1:]
        parameters = [*map(_parameter, chosen.values()), *rest]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in parameters}
        return called

    return decorated


def _parameter(one: Field[Any]) -> inspect.Parameter:
    """Return a field as a parameter that typer understands: texts, a number, a flag, or a text."""
    kinds = (one.type, *get_args(one.type))
    kind: Any = next((kind for kind in (bool, float, int) if kind in kinds), str)
    kind = list[str] if _is_several(one) else kind
    flags, default = one.metadata["flags"], None if one.default == () else one.default
    if not any(flag.startswith("--") for flag in flags):
        flags = (f"--{one.name.replace('_', '-')}", *flags)
    offered = typer.Option(*flags, help=one.metadata["help"], **one.metadata["shown"])
    return inspect.Parameter(
        one.name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default=inspect.Parameter.empty if default is MISSING else default,
        annotation=Annotated[kind if default is not None else kind | None, offered],
    )


def _is_several(one: Field[Any]) -> bool:
    return Sequence in map(get_origin, (one.type, *get_args(one.type)))


def _value(one: Field[Any], value: Any) -> Any:
    """Return what the field holds; names are parted by commas, settings are not."""
    if _is_several(one) and one.name != "changes":
        return listed(value)
    return one.default if value is None else value
