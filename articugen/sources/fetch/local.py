"""Archives that somebody has already: unpacked safely, checked, listed."""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path, PurePosixPath

from articugen.core.errors import InvalidSource, machine_fault, printable
from articugen.core.files import sha256_of
from articugen.sources.fetch.models import Unpacked, unpack
from articugen.sources.fetch.outcome import Fetched, outcome
from articugen.sources.fetch.target import Target
from articugen.sources.fetch.terms import terms_of

_FLAT = ("partnet-mobility", "articraft")
"""Data sets whose models have names of their own; others keep the folders of the archive."""


def fetch_archives(
    source: str,
    archives: Sequence[Path],
    out: Path,
    told: Callable[[int, int, str], None] = lambda *_: None,
    notice: Callable[[str], None] = lambda _: None,
) -> Fetched:
    """Unpack the models in archives that were downloaded by hand; those that are there are left.

    Args:
        source: a name of `terms.NAMES`.
        archives: .zip or .tar.gz, each of one model or of many.
        out: a new folder, or one to go on in.
        told: called with the archives that are done, all of them, and what is at hand.
        notice: called with a sentence for each folder that is set aside.

    Raises:
        InvalidArgument: no such data set.
        NotFetched: no archive gave a model.
        MachineFault, MemoryError: the disk is full, or the like.
    """
    places: list[str] = []
    new = 0
    with closing(Target(out, terms_of(source), notice)) as target:
        for number, path in enumerate(archives):
            told(number, len(archives), path.name)
            try:
                found, fresh = _unpacked(path, target)
            except InvalidSource as error:
                target.fail(path.name, error, path)
            else:
                places += found
                new += fresh
        return outcome(target, places, new)


def _unpacked(path: Path, target: Target) -> tuple[list[str], int]:
    """Return the models of an archive, by their places, and how many were not there."""
    try:
        digest = sha256_of(path)
    except OSError as error:
        raise machine_fault(error) or InvalidSource(
            f"{printable(str(path))}: cannot be read: {error.strerror}; correct its path"
        ) from error
    fresh = 0

    def place(root: PurePosixPath) -> PurePosixPath:
        if not root.parts:
            return PurePosixPath(path.name.removesuffix(".zip").removesuffix(".tar.gz"))
        return PurePosixPath(root.name) if target.terms.source in _FLAT else root

    def wanted(root: PurePosixPath) -> bool:
        return target.wants(place(root), digest, f"{digest}/{root}", str(path.name / root))

    def take_in(model: Unpacked, staged: Path) -> None:
        nonlocal fresh
        target.take_in(place(model.root), model, staged, printable(path.name), digest)
        fresh += 1

    with target.unpacking() as folder:
        roots = unpack(path, folder, wanted, take_in)
    return [str(place(root)) for root in roots], fresh
