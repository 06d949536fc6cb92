"""One random generator for each (seed, object, state, stage), whatever worker makes it."""

import hashlib

import numpy as np


def generator(seed: int, *path: str | int) -> np.random.Generator:
    """Return a generator that depends on `seed` and on `path` alone.

    Args:
        seed: the master seed; every integer counts, 0 included.
        path: what is drawn, for instance (object_id, state_index, "surface").
    """
    # numpy's integers count as Python's, and 1 is not "1"
    parts = (repr(part) if isinstance(part, str) else repr(int(part)) for part in (seed, *path))
    text = "\x1f".join(parts)
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))
