"""The options of `generate`, declared once: command line and Python function follow.

It imports nothing that takes time: `articugen generate --help` reads it.
"""

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, MISSING, dataclass, field, fields
from functools import wraps
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, Union

from articugen.core.errors import InvalidArgument

if TYPE_CHECKING:
    from articugen.core.recipe import Recipe

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")

Folder = str | os.PathLike[str]
RecipeLike = Union[str, Path, Mapping[str, Any], "Recipe", None]


@dataclass(frozen=True)
class ObjectReport:
    """Outcome of one object.

    Attributes:
        shard: its file, "" where there is none.
        instances: 0 where there is no shard.
        seconds: of one worker.
        rejected, skipped, failed: why there is none, or None: see `Outcome`.
        reused: whether it was there already, or another process made it.
    """

    object_id: str
    split: str
    shard: str
    instances: int
    seconds: float
    rejected: str | None
    reused: bool
    skipped: str | None = None
    failed: str | None = None


OnObject = Callable[[ObjectReport], None]
OnNotice = Callable[[str], None]


def ignore(_: object) -> None:
    """Do nothing, where nobody wants to be called."""


def option(default: Any, sentence: str, *flags: str, **shown: Any) -> Any:
    """Return a field with a default, or MISSING, and its help, its flags besides --<name>, or
    instead of that, and further arguments of `typer.Option`."""
    return field(default=default, metadata={"help": sentence, "flags": flags, "shown": shown})


CHANGES = option(
    (),
    "Another value than the recipe's, as YAML; may be given several times.",
    "--set",
    metavar="SECTION.KEY=VALUE",
    show_default="none",
)


def whole(name: str, value: Any) -> int:
    """Return a whole number, numpy's too, as Python's; InvalidArgument where it is none."""
    if issubclass(type(value), Real) and value % 1 == 0:
        return int(value)
    raise InvalidArgument(f"{name} is {value!r}; give a whole number")


@dataclass(frozen=True)
class Options:
    """Options of `generate`."""

    category: str | Sequence[str] = option(
        MISSING,
        "What to make, as `articugen sources` lists it; several, or `all`: each into its own "
        "folder.",
        "-c",
    )
    source: Folder = option("procedural", "A source's name, or a folder of URDFs.", "-s")
    out: Folder = option(
        "data",
        "The data set goes to a folder <category> in here; also s3://bucket/prefix, where any "
        "number of processes share out the objects.",
        "-o",
    )
    recipe: RecipeLike = option(
        None, "A name under recipes/ or a file.", "-r", show_default="category's"
    )
    _: KW_ONLY
    changes: Sequence[str] = CHANGES
    objects: int | None = option(
        None, "How many objects, in the splits' ratio.", "-n", min=1, show_default="all"
    )
    ids: Sequence[str] = option((), "These objects alone: 10040,10101.", show_default="all")
    exclude: Sequence[str] = option((), "But not these.", show_default="none")
    joints: Sequence[str] = option(
        (),
        "Only objects all of whose joints that move, as the model has them, are of these kinds: "
        "revolute, continuous, prismatic.",
        show_default="any",
    )
    movable: Sequence[str] = option(
        (),
        "Joints or parts that move, as patterns: 'drawer*,*door'.",
        show_default="recipe's, else source's",
    )
    canonical: str | None = option(
        None,
        "The joint value that is state 0: zero, lower or upper (limit).",
        show_default="recipe's, else source's",
    )
    states: int | None = option(
        None,
        "Random joint states an object, besides the canonical pose.",
        min=0,
        show_default="recipe's",
    )
    jobs: int | None = option(
        None,
        "Worker processes; 0 works in this one, without limits, for debugging.",
        "-j",
        min=0,
        show_default="all cores",
    )
    max_rejected: float | None = option(
        None,
        "Share of the objects that may be rejected before the run counts as failed.",
        min=0.0,
        max=1.0,
        metavar="FRACTION",
        show_default="recipe's",
    )
    seed: int = option(0, "The master seed; 0 is one like any other.")
    replace: bool = option(False, "Replace data that was made in another way.", "--replace")
    scheduler: str | None = option(
        None,
        "Of a Dask cluster, tcp://host:8786, whose workers make the objects; or slurm, "
        "slurm://partition?tasks=100, for an array of jobs. --out must be a folder that all of "
        "them see.",
        metavar="ADDRESS",
        show_default="this machine",
    )
    on_object: OnObject = field(
        default=ignore,
        metadata={"help": "Called for each object, those that were there already first."},
    )

    def __post_init__(self) -> None:
        """Take a text for a list of it, and numbers for texts."""
        for name in (one.name for one in fields(self) if one.type == Sequence[str]):
            value = getattr(self, name)
            texts = (value,) if isinstance(value, str) else () if value is None else value
            object.__setattr__(self, name, tuple(map(str, texts)))


def takes(record: Callable[P, T]) -> Callable[[Callable[[T], R]], Callable[P, R]]:
    """Return a decorator: a function of one record becomes one of the record's fields, with their
    defaults and, in its docstring, their help."""

    def decorated(function: Callable[[T], R]) -> Callable[P, R]:
        @wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            return function(record(*args, **kwargs))

        described: Any = record
        lines = [f"    {one.name}: {one.metadata['help']}" for one in fields(described)]
        called.__doc__ = "\n".join([inspect.getdoc(function) or "", "", "Args:", *lines])
        returned = inspect.signature(function).return_annotation
        as_record = inspect.signature(record).replace(return_annotation=returned)
        called.__signature__ = as_record  # type: ignore[attr-defined]
        return called

    return decorated
