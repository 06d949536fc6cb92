"""The errors a user can meet. Each message is one sentence that names the file and the cure."""

import errno
import os
import shlex
import sys
from collections.abc import Iterator
from shutil import which

_LONGEST = 2000  # letters of a sentence; the cure stands at its end


class ArticugenError(Exception):
    """Base of every error that the command line prints as one sentence, without a traceback.

    Whatever a stranger's file put into it, it stays on one line, moves no cursor and has an end.
    """

    def __str__(self) -> str:
        text = super().__str__()
        if len(text) > _LONGEST:
            text = f"{text[: _LONGEST - 500]} ... {text[-400:]}"
        return spelt_out(text)


class InvalidSource(ArticugenError):
    """A source, a URDF or a mesh cannot be read."""


class InvalidRecipe(ArticugenError):
    """A recipe file or a command-line setting makes no sense."""


class InvalidArgument(ArticugenError, ValueError):
    """A function is asked for what there is not: a field, a split, a joint, a state."""


class NotFetched(ArticugenError):
    """Something cannot be got from where it is published."""


class AccessRefused(NotFetched):
    """Its publisher wants another token, or terms to be accepted first."""


class RejectedInstance(ArticugenError):
    """One object or instance cannot be made into data; the others can."""


class NotOfCategory(ArticugenError):
    """An object has nothing to articulate in the recipe's sense: it is skipped, no fault."""


class MachineFault(ArticugenError):
    """The machine failed, not the data: no memory, a full or broken disk, a killed worker.

    Never an object's verdict: what was not made because of it is tried again by the next run.
    """


class CorruptShard(ArticugenError):
    """A shard or manifest is damaged, of another version, or not one of ours."""


def installing(extra: str) -> str:
    """Return the command that brings an extra to the Python at work, wherever articugen came
    from."""
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - slow to import

    beside = os.path.join(os.path.dirname(sys.executable), "pip")
    pip = "pip" if which("pip") == beside else f"{shlex.quote(sys.executable)} -m pip"
    where = "articugen"  # pip finds an installed one, which is published nowhere
    try:
        version(where)
    except PackageNotFoundError:  # a checkout on the path
        where = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    return f"{pip} install {shlex.quote(f'{where}[{extra}]')}"


class UnfitData(ArticugenError):
    """Data are sound, but not what a learner must be given: too few points, no such split."""


class MissingExtra(ArticugenError):
    """An optional library is not installed."""

    def __init__(self, library: str, extra: str) -> None:
        super().__init__(f"{library} is not installed; run: {installing(extra)}")


class MissingDriver(ArticugenError):
    """An optional library is installed, but a system library or driver that it needs is not."""


class BrokenPlugin(ArticugenError):
    """Plugin of another package that cannot be used."""


class InvalidCheckpoint(ArticugenError):
    """A checkpoint or run folder is damaged, not one of ours, or of another recipe."""


class TrainingDiverged(ArticugenError):
    """A loss or a gradient is no longer a finite number."""


_MACHINE = {
    errno.EMFILE: "raise the limit of open files (ulimit -n) or use fewer --jobs",
    errno.ENFILE: "end other programs, or use fewer --jobs",
    errno.EIO: "the disk or the network does not answer; see to it",
    errno.ENOSPC: "free some space on the disk",
    errno.EDQUOT: "the disk quota is used up; free some space",
    errno.EROFS: "the file system cannot be written to; choose another folder",
    errno.EAGAIN: "end other programs, or use fewer --jobs",
    errno.ESTALE: "the network's disk has lost it; see to it",
    errno.ETIMEDOUT: "the network's disk does not answer; see to it",
    **dict.fromkeys((errno.ENODEV, errno.ENOTCONN, errno.EHOSTDOWN), "the disk is gone; see to it"),
}
"""Errors of the system that are no file's fault, and the cure."""

_NO_LIBRARY_FOR_WANT_OF_MEMORY = ("Cannot allocate memory", "failed to map segment")


def machine_fault(error: BaseException) -> MachineFault | MemoryError | None:
    """Return the fault of the machine that `error` is, or that it was raised over; None where it is
    none.

    Readers turn whatever they meet into an `InvalidSource`; what they met shows whose fault it was.
    """
    for cause in _behind(error):
        if isinstance(cause, MachineFault | MemoryError):
            return cause
        text = str(cause)
        if isinstance(cause, ImportError) and any(
            words in text for words in _NO_LIBRARY_FOR_WANT_OF_MEMORY
        ):
            return MemoryError(text)
        if isinstance(cause, OSError):
            if cause.errno == errno.ENOMEM:
                return MemoryError(text)
            cure = _MACHINE.get(cause.errno or 0)
            if cure is not None:
                where = f"{cause.filename}: " if cause.filename else ""
                return MachineFault(printable(f"{where}{cause.strerror}; {cure}"))
    return None


def _behind(error: BaseException | None) -> Iterator[BaseException]:
    """`error`, and what was being handled as it was raised, and so on."""
    known: set[int] = set()
    while error is not None and id(error) not in known:
        known.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


def printable(text: str) -> str:
    """`text` on one line that any file and terminal takes: what is no character is spelt out."""
    return spelt_out(" ".join(text.encode("utf-8", "backslashreplace").decode().split()))


def spelt_out(text: str) -> str:
    """`text` with each character that cannot be printed as its escape: \\n, \\x1b, \\u202e."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
