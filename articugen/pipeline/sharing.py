"""Many numbered things of one piece of work, made by its owner and by helpers beside it.

Whoever is free makes the next thing that nobody has. The owner gives all of them in order, its own
and those that helpers left in a folder, so that nothing shows who made what. Locks on single bytes
of a file say who is at what. They end with the process that holds them: a helper that is killed
holds nothing up, and helpers whose owner is gone stop.
"""

import fcntl
import os
import pickle
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

_OWNER, _FIRST = 0, 1
"""Bytes of the file: the first is locked as long as there is an owner; one for each thing follows
once the owner knows how many there are."""

_FREE, _LEFT, _HAD = b"\0\1\2"
"""What such a byte is: nobody has made the thing, a helper has left it, the owner has it."""

_MOST_LEFT, _MOST_EARLY = 16, 2
"""So many things at most wait for the owner: in the folder, and in its memory."""

_LOOK = 0.002
"""Seconds between two checks of what others are at."""

_SOON = 0.5
"""Seconds in which a helper that was quicker waits for the owner to begin."""

PATIENCE = 10.0
"""Seconds after which the owner makes what a helper is at, which may hang."""


@contextmanager
def owned(folder: Path | None) -> Iterator["Owner"]:
    """The work that is shared in this folder, which is made and deleted here. Without one, or where
    nothing can be written, the owner makes all."""
    if folder is None:
        yield Owner(None)
        return
    shutil.rmtree(folder, ignore_errors=True)
    claims = None
    with suppress(OSError):
        folder.mkdir()
        claims = _Claims(folder)
        fcntl.lockf(claims.file, fcntl.LOCK_EX, 1, _OWNER)  # helpers hold it for a moment at most
    try:
        yield Owner(claims)
    finally:
        if claims is not None:
            os.close(claims.file)
        shutil.rmtree(folder, ignore_errors=True)


def help_with(folder: Path, count: int, make: Callable[[int], object]) -> int:
    """Make things of the work in `folder` that nobody has, as long as there are some, and an owner.

    Args:
        folder: as `owned`.
        count: of things.
        make: what the owner would make, of the same number; it can be pickled.

    Returns:
        How many things it made.

    Raises:
        OSError: nothing can be written there.
    """
    made = 0
    if not _is_owned(folder):
        return made
    with suppress(FileNotFoundError):  # the owner has ended
        claims = _Claims(folder)
        try:
            while claims.has_owner():
                states = claims.states()
                if len(states) < count or states.count(_LEFT) >= _MOST_LEFT:
                    time.sleep(_LOOK)
                    continue
                number = claims.first()
                if number is None:
                    break
                claims.leave(number, make(number))
                made += 1
        finally:
            os.close(claims.file)
    return made


def _is_owned(folder: Path) -> bool:
    """Return whether there is an owner, or is soon."""
    until = time.monotonic() + _SOON
    while True:
        with suppress(FileNotFoundError):
            claims = _Claims(folder)
            try:
                if claims.has_owner():
                    return True
            finally:
                os.close(claims.file)
        if time.monotonic() > until:
            return False
        time.sleep(_LOOK)


class Owner:
    """See `owned`."""

    def __init__(self, claims: "_Claims | None") -> None:
        self._claims = claims

    def in_order(self, count: int, make: Callable[[int], T]) -> Iterator[T]:
        """All things in order; once. `make` gives the same here and in helpers."""
        if self._claims is None or not self._claims.begin(count):
            yield from map(make, range(count))
            return
        early: dict[int, T] = {}
        for number in range(count):
            since = time.monotonic()
            while number not in early:
                self._one_more(number, early, make, since)
            yield early.pop(number)

    def _one_more(
        self, number: int, early: dict[int, T], make: Callable[[int], T], since: float
    ) -> None:
        """Have thing `number`, or make another meanwhile, or wait a moment."""
        claims = self._claims
        assert claims is not None
        if claims.states()[number] == _LEFT:
            left = claims.received(number)
            early[number] = make(number) if left is None else left
            return
        mine = claims.first(range(number, number + 1) if len(early) == _MOST_EARLY else None)
        if mine is None and time.monotonic() - since > PATIENCE:
            mine = number
        if mine is None:
            time.sleep(_LOOK)
        else:
            early[mine] = make(mine)
            claims.end(mine, _HAD)


class _Claims:
    """The file that says who is at what. A process has one of a folder at most: closing a file
    ends all its locks, whichever way it was opened."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.file = os.open(folder / "claims", os.O_RDWR | os.O_CREAT, 0o600)

    def begin(self, count: int) -> bool:
        """Make room for the states of so many things; False where there is none."""
        try:
            return os.pwrite(self.file, bytes([_FREE]) * count, _FIRST) == count
        except OSError:
            return False

    def states(self) -> bytes:
        """Of each thing; fewer as long as the owner has not begun."""
        return os.pread(self.file, os.fstat(self.file).st_size, _FIRST)

    def has_owner(self) -> bool:
        if not self._lock(_OWNER):
            return True
        self._unlock(_OWNER)
        return False

    def first(self, among: range | None = None) -> int | None:
        """The first thing, of all or `among` some, that nobody has or is at; it is ours to make."""
        states = self.states()
        for number in among or range(len(states)):
            if states[number] == _FREE and self._lock(_FIRST + number):
                if self.states()[number] == _FREE:
                    return number
                self._unlock(_FIRST + number)
        return None

    def end(self, number: int, state: int) -> None:
        """It is made, and nobody is at it any more."""
        os.pwrite(self.file, bytes([state]), _FIRST + number)
        self._unlock(_FIRST + number)

    def leave(self, number: int, thing: object) -> None:
        """Leave it for the owner. It is written aside first, as the owner may read at any time."""
        aside = self._folder / f"{number}-{os.getpid()}"
        aside.write_bytes(pickle.dumps(thing, protocol=5))
        aside.replace(self._folder / str(number))
        self.end(number, _LEFT)

    def received(self, number: int) -> Any:
        """What a helper has left; None where it cannot be read."""
        thing, path = None, self._folder / str(number)
        with suppress(OSError, EOFError, pickle.UnpicklingError):
            thing = pickle.loads(path.read_bytes())
            path.unlink()
        self.end(number, _HAD)
        return thing

    def _lock(self, byte: int) -> bool:
        """Return whether this byte is ours now."""
        try:
            fcntl.lockf(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
        except OSError:
            return False
        return True

    def _unlock(self, byte: int) -> None:
        fcntl.lockf(self.file, fcntl.LOCK_UN, 1, byte)
