"""A folder that hostile files are read in, with limits, and what notices whatever leaves it."""

import ctypes
import functools
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.fuzz.targets import Target

SECONDS = 5.0
"""Of one core, that any file of some kB may take."""
MEMORY = 2**30
"""Bytes of address space that it may take beside what is taken already."""
LONGEST_SENTENCE = 20_000
OUTSIDE = b"@OUTSIDE@"
"""Stands in an input for the path of a folder that nothing may be read from."""

_BY_THE_CLOCK = 40.0
_ONLY_LOOKS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_WRITING = {
    *("os.chmod", "os.chown", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir"),
    *("os.symlink", "os.truncate", "os.utime", "tempfile.mkstemp", "tempfile.mkdtemp"),
}
_LISTING = {"os.listdir", "os.scandir"}
_NEVER = {
    *("os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn", "os.system"),
    *("socket.connect", "socket.getaddrinfo", "subprocess.Popen", "urllib.Request"),
}


class TooLong(BaseException):
    """By the clock; no reader may swallow it."""


@dataclass(frozen=True)
class Escape:
    """What a reader did with an input that it may not do.

    Attributes:
        key: the same for inputs that do the same.
        sentence: what happened, and where.
    """

    key: str
    sentence: str


class Sandbox:
    """Reads inputs; a folder `model` to read in, a folder `outside` that nothing may touch."""

    def __init__(self, base: Path) -> None:
        self.base = Path(os.path.realpath(base))
        self.model, self.outside = self.base / "model", self.base / "outside"
        for folder in (self.model, self.outside):
            folder.mkdir(parents=True, exist_ok=True)
        for name in ("secret.obj", "secret.h5", "secret.bin", "secret.xml"):
            (self.outside / name).write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        self._outside = _Watch(self.outside, _OPENED | _CHANGED)
        self._base = _Watch(self.base, _CHANGED)
        self._model = _Watch(self.model, _CHANGED)
        self._prepared: Target | None = None
        self.accepted = 0
        """Inputs that were read without a refusal."""

    def close(self) -> None:
        for watch in (self._outside, self._base, self._model):
            watch.close()

    def run(self, target: Target, data: bytes) -> Escape | None:
        """Read one input as the target does; what was not as it should be, None where all was.

        Whoever is the first in a process to import a module may write its bytecode, to load a
        kernel may compile it, and look for both in any folder. That is done once, and what an input
        does it does again: what strays from these folders, or is slow, counts the second time.
        """
        escape, once = self._read(target, data)
        return self._read(target, data)[0] if once else escape

    def _read(self, target: Target, data: bytes) -> tuple[Escape | None, bool]:
        """What was not as it should be, and whether that may be so only the first time."""
        if self._prepared is not target or target.writes:
            shutil.rmtree(self.model)
            self.model.mkdir()
            self._model.look()
            target.around(self.model)
            self._prepared = target
        path = self.model / target.file
        _write(path, target.mended(data).replace(OUTSIDE, os.fsencode(self.outside)))
        for watch in (self._outside, self._base, self._model):
            watch.names()
        began = time.process_time()
        with _limited(), _audited(self.base, path) as strayed:
            escape = self._tried(target, path)
        if target.forks:
            strayed.remove("os.fork ()")
        took = time.process_time() - began
        here = [f"opened {name}" for name in self._outside.names()]
        here += [f"changed {name}" for name in self._base.names()]
        if not target.writes:
            here += [f"changed {name}" for name in self._model.names()]
        if all_of_it := strayed + here:
            sentence = "; ".join(all_of_it)
            return Escape(f"{target.name}: strayed: {all_of_it[0]}", sentence), not here
        if escape is None and took > SECONDS:
            return Escape(f"{target.name}: slow", f"took {took:.1f} s"), True
        return escape, False

    def _tried(self, target: Target, path: Path) -> Escape | None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                target.read(path)
            self.accepted += 1
        except target.refusals as refusal:
            text = str(refusal)
            if not text.isprintable() or not text or len(text) > LONGEST_SENTENCE:
                return Escape(f"{target.name}: said {_place(refusal)}", f"no sentence: {text!r}")
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # that it may raise anything is what this is about
            said = f"{type(error).__name__}: {error}"[:300]
            return Escape(f"{target.name}: {type(error).__name__} {_place(error)}", said)
        return None


def _write(path: Path, data: bytes) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        os.write(handle, data)
    finally:
        os.close(handle)


def _place(error: BaseException) -> str:
    """Where the innermost line of ours was."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "articugen" in f.filename and "fuzz" not in f.filename]
    frame = (ours or frames)[-1]
    return f"at {Path(frame.filename).name}:{frame.name}: {(frame.line or '')[:60]}"


@contextmanager
def sandbox() -> Iterator[Sandbox]:
    """One that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="articugen-fuzz-") as folder:
        room = Sandbox(Path(folder))
        try:
            yield room
        finally:
            room.close()


@functools.cache
def _statm() -> int:
    return os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)


@contextmanager
def _limited() -> Iterator[None]:
    """Limits of memory and of time by the clock."""

    def too_long(_number: int, _frame: Any) -> None:
        raise TooLong(f"more than {_BY_THE_CLOCK:g} s")

    taken = int(os.pread(_statm(), 100, 0).split()[0]) * resource.getpagesize()
    before, most = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, too_long)
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, most))
    signal.setitimer(signal.ITIMER_REAL, _BY_THE_CLOCK)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, (before, most))
        signal.signal(signal.SIGALRM, handler)


# What Python opens, by its audit events (PEP 578); a hook stays for as long as the process lives.

_seen: list[str] | None = None
_allowed: tuple[str, ...] = ()
_hooked = False
_input = ""


@contextmanager
def _audited(base: Path, file: Path) -> Iterator[list[str]]:
    """Meanwhile, what Python does with files outside of `base`; modules may be imported.

    Args:
        file: that is to be read.
    """
    global _seen, _allowed, _hooked, _input  # noqa: PLW0603 - hooks are the process's
    if not _hooked:
        sys.addaudithook(_hook)
        _hooked = True
    _allowed = (f"{base}/", *_modules((*sys.path, sys.prefix, sys.base_prefix)))
    _input = str(file)
    strayed: list[str] = []
    _seen = strayed
    try:
        yield strayed
    finally:
        _seen = None


@functools.lru_cache(4)
def _modules(paths: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted({f"{os.path.realpath(path)}/" for path in paths if path}))


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _seen is None:
        return
    if event == "open":
        name, _, flags = arguments
        writes = bool((flags or 0) & _ONLY_LOOKS)
    elif event in _WRITING:
        name, writes = arguments[0], True
    elif event in _LISTING:
        name, writes = arguments[0], False
    else:
        if event in _NEVER:
            _seen.append(f"{event} {str(arguments)[:200]}")
        return
    if isinstance(name, int) or name is None:
        return
    if not writes and os.fspath(name) == _input:  # which is no link
        return
    path = os.path.realpath(os.fsdecode(name)) + "/"
    if not path.startswith(_allowed[:1] if writes else _allowed):
        _seen.append(f"{event} {path[:-1]}{' to write' if writes else ''}")


# What anybody in the process opens, compiled code too: inotify(7), where there is such a thing.

_OPENED = 0x1 | 0x20  # IN_ACCESS, IN_OPEN
_CHANGED = 0x40 | 0x80 | 0x100 | 0x200 | 0x400  # IN_MOVED_FROM, _TO, IN_CREATE, _DELETE, _SELF


class _Watch:
    """What happens in a folder."""

    def __init__(self, folder: Path, mask: int) -> None:
        self._folder, self._mask, self._handle = folder, mask, -1
        if sys.platform == "linux":
            self._libc = ctypes.CDLL(None)
            self._handle = self._libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
            if self._handle < 0:  # it would see nothing, and all would seem well
                raise OSError("no inotify is left: raise fs.inotify.max_user_instances")
        self.look()

    def close(self) -> None:
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def look(self) -> None:
        """At the folder of that name: another one may have taken its place."""
        if self._handle >= 0:
            self._libc.inotify_add_watch(self._handle, os.fsencode(self._folder), self._mask)

    def names(self) -> list[str]:
        """Of the files that something has happened to since the last call."""
        try:
            data = os.read(self._handle, 1 << 16) if self._handle >= 0 else b""
        except BlockingIOError:
            return []
        found, at = [], 0
        while at < len(data):
            length = int.from_bytes(data[at + 12 : at + 16], sys.byteorder)
            found.append(data[at + 16 : at + 16 + length].rstrip(b"\0").decode(errors="replace"))
            at += 16 + length
        return [name for name in dict.fromkeys(found) if name]
