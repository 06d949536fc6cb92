"""The metrics for TensorBoard as well, where it is installed; the JSON lines stay the truth.

`tensorboard --logdir runs` finds the files in each run's folder.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from articugen.core.errors import MachineFault, installing
from articugen.core.files import cannot_write

MISSING = (
    "tensorboard is not installed, so metrics go to metrics.jsonl alone; "
    f"for both: {installing('tensorboard')}"
)


def is_installed() -> bool:
    return find_spec("tensorboard") is not None


@contextmanager
def board(folder: Path, after: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """What appends the numbers of a record of the metrics, by the names they have there.

    Args:
        after: what was written of later iterations before is dropped.

    Raises:
        MachineFault: the disk is full, or the like.
    """
    if not is_installed():
        yield lambda _: None
        return
    from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - takes a second

    try:
        writer = SummaryWriter(str(folder), purge_step=after + 1)
    except OSError as error:
        raise MachineFault(cannot_write(folder, error)) from None

    def add(record: dict[str, Any]) -> None:
        groups = [(f"{group}/", record.get(group, {})) for group in ("validation", "terms")]
        rate = {name: record[name] for name in ("learning_rate",) if name in record}
        try:
            for group, numbers in (*groups, ("", rate)):
                for name, value in numbers.items():
                    writer.add_scalar(f"{group}{name}", value, record["iteration"])
            writer.flush()  # a process that is killed leaves no gap in the curve
        except OSError as error:
            raise MachineFault(cannot_write(folder, error)) from None

    try:
        yield add
    finally:
        with suppress(OSError):  # where the disk is full the JSON lines are what says so
            writer.close()
