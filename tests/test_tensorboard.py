"""What TensorBoard reads is what the JSON lines say, also after a resume."""

import resource

import pytest

pytest.importorskip("tensorboard", reason="an extra")

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from articugen.core.errors import MachineFault
from articugen.learning import run_folder
from articugen.learning.run_folder import METRICS, RunFolder


def records(first: int, last: int, shift: float = 0.0) -> list[dict]:
    return [
        {
            "iteration": i,
            "stage": 0,
            "terms": {"rec": 1.0 / i + shift, "vol": 2.0 * i},
            "learning_rate": 0.5,
        }
        for i in range(first, last + 1)
    ] + [{"iteration": last, "validation": {"iou": 0.25 + shift}}]


def test_tensorboard_shows_the_json_lines(tmp_path):
    run = RunFolder(tmp_path)
    with run.metrics_from(0) as log:
        for record in records(1, 4, shift=9.0):
            log(record)
    with run.metrics_from(2) as log:
        for record in records(3, 5):
            log(record)
    shown = EventAccumulator(str(tmp_path)).Reload()
    wanted: dict[str, list] = {}
    for record in run.metrics():
        for group in ("terms", "validation"):
            for name, value in record.get(group, {}).items():
                wanted.setdefault(f"{group}/{name}", []).append((record["iteration"], value))
    wanted["learning_rate"] = [(i, 0.5) for i in range(1, 6)]
    assert set(shown.Tags()["scalars"]) == set(wanted)
    for tag, points in wanted.items():
        told = [(event.step, event.value) for event in shown.Scalars(tag)]
        assert told == [(step, pytest.approx(value)) for step, value in points], tag


def test_a_disk_that_is_full_is_one_error_and_no_traceback_of_a_thread(tmp_path, capfd):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with RunFolder(tmp_path).metrics_from(0) as log:
            size = max(path.stat().st_size for path in tmp_path.iterdir())
            resource.setrlimit(resource.RLIMIT_FSIZE, (size + 20, before[1]))
            with pytest.raises(MachineFault, match=r"tfevents\S+: not written"):
                log({"iteration": 1, "learning_rate": 0.5})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert capfd.readouterr().err == ""


def test_without_it_the_json_lines_are_all(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "find_spec", lambda _: None)
    run = RunFolder(tmp_path)
    with run.metrics_from(0) as log:
        log(records(1, 1)[0])
    assert [path.name for path in tmp_path.iterdir()] == [METRICS]
