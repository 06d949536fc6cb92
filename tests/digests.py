"""A digest of a learner's state, to compare two by; a training that must resume exactly."""

import hashlib
from dataclasses import replace
from typing import Any


def digest(state: dict[str, Any]) -> str:
    """Return the SHA-256 of all in nested dicts."""
    import torch  # noqa: PLC0415 - tests without torch are skipped once they have asked for it

    hashed = hashlib.sha256()

    def tell(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value):
                tell(f"{name}.{key}", value[key])
        else:
            hashed.update(f"{name}\0".encode())
            if isinstance(value, torch.Tensor):
                hashed.update(
                    value.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
                )
            else:
                hashed.update(repr(value).encode())

    tell("", state)
    return hashed.hexdigest()


def curve(run: Any) -> list[dict[str, Any]]:
    """Return all that a run has logged, but for the seconds that it took."""
    return [{k: v for k, v in line.items() if k != "seconds"} for line in run.metrics()]


def same_state(one: Any, other: Any) -> bool:
    """Return whether two runs have come to the same."""
    from articugen.learning.run_folder import LATEST, read_checkpoint  # noqa: PLC0415 - see above

    ours, theirs = (digest(read_checkpoint(run.path / LATEST).state) for run in (one, other))
    return ours == theirs


def resumed_exactly(what: Any, *stops: int) -> Any:
    """Train, and again with a stop after so many iterations, which must come to the same curve and
    state; return the run that was not stopped."""
    from articugen.learning.loop import train  # noqa: PLC0415 - see above

    whole = train(what)
    for stop in stops:
        run = train(replace(what, resume=train(what, stop_after=stop).path))
        assert curve(run) == curve(whole)
        assert same_state(run, whole)
    return whole
