"""What becomes of memory that is freed.

glibc keeps blocks for later, by and by those of up to 32 MiB, and what else is in use between them
keeps their room from ever going back to the system.

Elsewhere than on glibc nothing changes.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LARGEST = 32 << 20
"""Of the blocks that glibc keeps."""


def give_back(block: int) -> None:
    """From now on blocks of so many bytes or more go back to the system as soon as they are freed.
    Asking for them again takes longer."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_TRIM_THRESHOLD, 2 * block)  # glibc's own ratio
        mallopt(_M_MMAP_THRESHOLD, block)


@contextmanager
def given_back(block: int) -> Iterator[None]:
    """The same while the context lasts; then only blocks that are larger than glibc ever keeps."""
    give_back(block)
    try:
        yield
    finally:
        give_back(_LARGEST)
