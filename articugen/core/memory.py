"""The memory of processes: what becomes of what is freed, and how much they hold.

glibc keeps blocks for later, by and by those of up to 32 MiB, and what else is in use between them
keeps their room from ever going back to the system. Elsewhere than on glibc nothing changes.
"""

import ctypes
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LARGEST = 32 << 20  # of the blocks that glibc keeps


def give_back(block: int) -> None:
    """From now on blocks of this many bytes or more go back to the system as soon as they are
    freed. Asking for them again takes longer."""
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


def resident_bytes(pids: Sequence[int]) -> dict[int, int]:
    """Return the memory that processes hold, by their id; without those that are gone."""
    if Path("/proc/self/statm").exists():
        resident = {}
        for pid in pids:
            with suppress(OSError, IndexError):
                pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
                resident[pid] = pages * os.sysconf("SC_PAGE_SIZE")
        return resident
    command = ["ps", "-o", "pid=,rss=", "-p", ",".join(map(str, pids))]
    listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    numbers = list(map(int, listed))
    return {pid: 1024 * resident for pid, resident in zip(numbers[::2], numbers[1::2], strict=True)}
