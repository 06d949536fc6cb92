"""The metrics for TensorBoard as well, where it is installed; the JSON lines stay the truth.

`tensorboard --logdir runs` finds the files in each run's folder. They are written here and not by
torch's SummaryWriter, whose thread meets a full disk where nobody hears of it.
"""

import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from articugen.core.errors import MachineFault, installing
from articugen.core.files import cannot_write, make_folder

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
    from tensorboard.compat.proto import event_pb2, summary_pb2  # noqa: PLC0415
    from tensorboard.summary.writer.record_writer import RecordWriter  # noqa: PLC0415

    # made when they are imported, as protobuf does
    Event, SessionLog = (getattr(event_pb2, name) for name in ("Event", "SessionLog"))
    Summary = getattr(summary_pb2, "Summary")  # noqa: B009
    own = f"{time.time():.6f}.{platform.node()}.{os.getpid()}"  # they are read in this order
    path = folder / f"events.out.tfevents.{own}"

    def write(*events: Any) -> None:
        try:
            with path.open("ab", buffering=1 << 20) as file:
                for event in events:
                    RecordWriter(file).write(event.SerializeToString())
        except OSError as error:
            raise MachineFault(cannot_write(path, error)) from None

    def add(record: dict[str, Any]) -> None:
        numbers = {f"validation/{name}": x for name, x in record.get("validation", {}).items()}
        numbers |= {f"terms/{name}": x for name, x in record.get("terms", {}).items()}
        numbers |= {name: record[name] for name in ("learning_rate",) if name in record}
        values = [Summary.Value(tag=name, simple_value=x) for name, x in numbers.items()]
        summary = Summary(value=values)
        write(Event(wall_time=time.time(), step=record["iteration"], summary=summary))

    try:
        make_folder(folder)
    except OSError as error:
        raise MachineFault(cannot_write(folder, error)) from None
    drop = SessionLog(status=SessionLog.START)
    write(
        Event(wall_time=time.time(), file_version="brain.Event:2"),
        Event(wall_time=time.time(), step=after + 1, session_log=drop),
    )
    yield add
