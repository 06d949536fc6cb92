"""What is asked for: a data set, where it goes, and which part of it a process makes."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from articugen.core import plugins
from articugen.core.errors import InvalidArgument, InvalidRecipe, printable
from articugen.core.place import Folder
from articugen.core.recipe import Recipe, check_category
from articugen.store.bucket import Bucket, Remote

_HERE = "articugen.pipeline.executors"
EXECUTORS = {
    "": f"{_HERE}.local:Local",
    "slurm": f"{_HERE}.slurm:Slurm",
    **dict.fromkeys(("tcp", "tls", "ucx", "ws", "wss"), f"{_HERE}.dask:Dask"),
}
"""The classes of executors, by the scheme of `--scheduler`; "" is this machine."""

_TABLE = plugins.Table(
    "articugen.executors",
    EXECUTORS,
    ("of", "records", "width", "ends"),
    "scheduler",
    InvalidArgument,
)


@dataclass(frozen=True)
class Share:
    """The objects whose place in the plan leaves `number` when it is divided by `of`."""

    number: int
    of: int

    @staticmethod
    def of_text(text: str) -> "Share":
        """Return the share that is written so; InvalidArgument unless it is like 3/8, below 8/8."""
        match = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text)
        number, of = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 0 <= number < of <= 1_000_000:
            raise InvalidArgument(
                f"no share {text!r}; give i/n, counted from 0: 0/8 to 7/8 are all of eight"
            )
        return Share(number, of)

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def has(self, place: int) -> bool:
        return place % self.of == self.number


@dataclass(frozen=True)
class Job:
    """A data set to make: `recipe.objects` objects of `category` from `source` into `out`.

    Attributes:
        out: a folder, or a folder of an object store.
        jobs: worker processes. With 0 this process makes all, without the recipe's limits of time
            and memory: for debugging.
        ids, exclude, joints: choose among the objects and change nothing of those that are made.
        scheduler: the address of a Dask cluster or of SLURM, whose workers all see `out`.
        share: of the objects, for a process beside others; None for all.
    """

    source: str
    category: str
    recipe: Recipe
    seed: int
    out: Path | Remote
    jobs: int
    ids: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    scheduler: str = ""
    share: Share | None = None

    def __post_init__(self) -> None:
        """Raise InvalidRecipe for what no folder, shard or manifest can be called or hold."""
        check_category(self.category)
        if not -(2**63) <= self.seed < 2**63:
            raise InvalidRecipe(f"the seed is {self.seed}; choose one of at most 18 digits")
        if printable(self.source) != self.source:
            raise InvalidRecipe(f"{printable(self.source)}: rename it to plain text")

    @property
    def place(self) -> Folder | Bucket:
        """The place where the data set goes; raises as `Bucket`."""
        return Bucket(self.out.url) if isinstance(self.out, Remote) else Folder(self.out)

    @property
    def folder(self) -> Path:
        """The folder of a data set that goes to one."""
        assert isinstance(self.out, Path)
        return self.out

    @property
    def executor(self) -> type[Any]:
        """The class of who makes it, an `executors.work.Executor`.

        Raises:
            InvalidArgument: there is none of that scheme; names those that there are.
            BrokenPlugin: it is another package's and cannot be used.
        """
        return _TABLE.load(self.scheduler.partition(":")[0])

    @property
    def is_shared(self) -> bool:
        """True where other processes, unknown to this one, may work on the same objects."""
        return bool(self.share or isinstance(self.out, Remote) or self.executor.records)
