"""The metrics for TensorBoard as well, where it is installed; the JSON lines stay the truth.

`tensorboard --logdir runs` finds the files in each run's folder.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

MISSING = (
    "tensorboard is not installed, so metrics go to metrics.jsonl alone; "
    "for both: pip install 'articugen[tensorboard]'"
)


def is_installed() -> bool:
    return find_spec("tensorboard") is not None


@contextmanager
def board(folder: Path, after: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """What appends the numbers of a record of the metrics, by the names they have there.

    Args:
        after: what was written of later iterations before is dropped.
    """
    if not is_installed():
        yield lambda _: None
        return
    from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415

    with SummaryWriter(str(folder), purge_step=after + 1) as writer:

        def add(record: dict[str, Any]) -> None:
            numbers = {f"validation/{name}": x for name, x in record.get("validation", {}).items()}
            numbers |= {f"terms/{name}": x for name, x in record.get("terms", {}).items()}
            numbers |= {name: record[name] for name in ("learning_rate",) if name in record}
            for name, number in numbers.items():
                writer.add_scalar(name, number, record["iteration"])
            writer.flush()

        yield add
