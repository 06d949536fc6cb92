"""What the command `fetch` does, as a function that a notebook calls."""

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path, PurePosixPath

from articugen.core.errors import InvalidArgument, InvalidSource, machine_fault, printable
from articugen.core.files import sha256_of
from articugen.sources.fetch.partnet_mobility import Told, check_wishes, fetch_partnet_mobility
from articugen.sources.fetch.target import Fetched, Target
from articugen.sources.fetch.terms import terms_of

Folder = str | os.PathLike[str]

_FLAT = ("partnet-mobility", "articraft")
"""Data sets whose models have names of their own; others keep the folders of the archive."""


def fetch(
    source: str,
    out: Folder,
    *,
    category: Sequence[str] = (),
    ids: Sequence[str] = (),
    token: str | None = None,
    via: str | None = None,
    archives: Sequence[Folder] = (),
    on_progress: Told = lambda *_: None,
    on_notice: Callable[[str], None] = lambda _: None,
) -> Fetched:
    """Get models of others, check them and list them; called again it goes on.

    Args:
        source: "partnet-mobility", which is downloaded; with archives also "shape2motion",
            "articraft", "artiverse", "artiatlas", "sketchmobility" or "artvip".
        out: a new folder, or one to go on in.
        category: models of these categories, by any of their names; "all" is every one.
        ids: these models; with categories, those of them that are of one.
        token: of one's account at the publisher's; None is that of HF_TOKEN, of `hf auth login` or
            of SAPIEN_ACCESS_TOKEN. Written nowhere.
        via: "hub" (Hugging Face) or "sapien" (SAPIEN's own site, by ids); None is the hub, and the
            site where that refuses and there is a SAPIEN_ACCESS_TOKEN.
        archives: unpack these .zip or .tar.gz instead, whole.
        on_progress: called with how many models or archives are done, how many there are, and the
            name of what is at hand.
        on_notice: called with a sentence where the second route is taken, or a folder is set aside.

    Returns:
        What is there now; `terms.licence` says on which terms, `refused` and `failed` what cannot
        be used and what did not come, each with its reason.

    Raises:
        InvalidArgument: no such data set, category, model or route, or nothing is chosen.
        AccessRefused, NotFetched: what is wanted cannot be got.
        MachineFault, MemoryError: the disk is full, or the like.
    """
    terms = terms_of(source)
    for name, chosen in (("category", category), ("ids", ids)):
        if isinstance(chosen, str):
            raise InvalidArgument(f"{name}={chosen!r}: must be a list: {name}=[{chosen!r}]")
    if archives and (category or ids or token or via):
        raise InvalidArgument(
            "--from takes all models of an archive; leave --category, --ids, --token and --via out"
        )
    if not archives:
        if terms.source != "partnet-mobility":
            raise InvalidArgument(
                f"{terms.source} is not downloaded from here; get its archives from its authors, "
                "and name them with --from"
            )
        check_wishes(category, ids, via)
    with closing(Target(Path(out), terms, on_notice)) as target:
        if not archives:
            return fetch_partnet_mobility(target, category, ids, token, via, on_progress, on_notice)
        places: list[str] = []
        new = 0
        for number, path in enumerate(map(Path, archives)):
            on_progress(number, len(archives), path.name)
            try:
                found, fresh = _unpacked(path, target)
            except InvalidSource as error:
                target.fail(path.name, error, path)
            else:
                places += found
                new += fresh
        return target.outcome(places, new)


def _unpacked(path: Path, target: Target) -> tuple[list[str], int]:
    """Return the models of an archive, by their places, and how many were not there."""
    try:
        digest = sha256_of(path)
    except OSError as error:
        raise machine_fault(error) or InvalidSource(
            f"{printable(str(path))}: cannot be read: {error.strerror}; correct its path"
        ) from error

    def place(root: PurePosixPath) -> PurePosixPath:
        if not root.parts:
            return PurePosixPath(path.name.removesuffix(".zip").removesuffix(".tar.gz"))
        return PurePosixPath(root.name) if target.terms.source in _FLAT else root

    return target.take(path, printable(path.name), digest, place)
