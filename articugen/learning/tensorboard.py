"""The metrics for TensorBoard as well, where it is installed; the JSON lines stay the truth.

`tensorboard --logdir runs` finds the file in each run's folder. A record is appended at once, so
that nothing is lost, left open or kept by a thread when training stops.
"""

import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

MISSING = (
    "tensorboard is not installed, so metrics go to metrics.jsonl alone; "
    "for both: pip install 'articugen[tensorboard]'"
)
EVENTS = "events.out.tfevents.articugen"


def is_installed() -> bool:
    return find_spec("tensorboard") is not None


def add(folder: Path, record: dict[str, Any]) -> None:
    """Append the numbers of a record of the metrics, by the names they have there."""
    if not is_installed():
        return
    numbers = {f"validation/{name}": x for name, x in record.get("validation", {}).items()}
    numbers |= {f"terms/{name}": x for name, x in record.get("terms", {}).items()}
    numbers |= {name: record[name] for name in ("learning_rate",) if name in record}
    values = [{"tag": name, "simple_value": number} for name, number in numbers.items()]
    _append(folder, step=record["iteration"], summary={"value": values})


def forget_after(folder: Path, iteration: int) -> None:
    """Tell TensorBoard to drop what was written of later iterations."""
    if not is_installed():
        return
    _append(folder, step=iteration + 1, session_log={"status": "START"})


def _append(folder: Path, **event: Any) -> None:
    from tensorboard.compat.proto import event_pb2  # noqa: PLC0415
    from tensorboard.summary.writer.record_writer import RecordWriter  # noqa: PLC0415

    protocol: Any = event_pb2  # its names are made when it is imported
    path = folder / EVENTS
    new = not path.exists()
    with path.open("ab") as file:
        writer = RecordWriter(file)
        if new:
            first = protocol.Event(wall_time=time.time(), file_version="brain.Event:2")
            writer.write(first.SerializeToString())
        writer.write(protocol.Event(wall_time=time.time(), **event).SerializeToString())
