"""A digest of a learner's state, to compare two by."""

import hashlib
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
