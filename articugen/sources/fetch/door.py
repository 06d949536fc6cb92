"""The function that the command `fetch` calls."""

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path, PurePosixPath

from articugen.core.errors import (
    AccessRefused,
    InvalidArgument,
    InvalidSource,
    NotFetched,
    printable,
)
from articugen.sources.fetch.partnet_mobility import Models, Progress, at_hub, at_site
from articugen.sources.fetch.target import WORK_NAME, Fetched, Target
from articugen.sources.fetch.terms import terms_of
from articugen.sources.fetch.web import Server

Folder = str | os.PathLike[str]

_ROUTES = ("hub", "sapien")
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
    on_progress: Progress = lambda *_: None,
    on_notice: Callable[[str], None] = lambda _: None,
) -> Fetched:
    """Get models of others, check them and list them; called again it resumes.

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
            name of the next or last.
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
    if not archives and terms.source != "partnet-mobility":
        raise InvalidArgument(
            f"{terms.source} is not downloaded from here; get its archives from its authors, "
            "and name them with --from"
        )
    if via not in (None, *_ROUTES):
        raise InvalidArgument(f"no route {via!r}; there are: {', '.join(_ROUTES)}")
    if not (archives or category or ids):
        raise InvalidArgument("nothing is chosen; name --category (or 'all', 3.3 GB) or --ids")
    with closing(Target(Path(out), terms, on_notice)) as target:
        if archives:
            return _unpacked(target, list(map(Path, archives)), on_progress)
        if via != "sapien":
            try:
                return _downloaded(
                    target, *at_hub(target, category, ids, token, on_progress), on_progress
                )
            except NotFetched as error:
                second = via is None and ids and not category
                if not second or not os.environ.get("SAPIEN_ACCESS_TOKEN"):
                    raise
                on_notice(f"{error}; trying SAPIEN's own site")
                token = None
        if category:
            raise InvalidArgument(
                "SAPIEN's site gives models by id alone; name --ids, or --via hub"
            )
        return _downloaded(target, *at_site(ids, token), on_progress)


def _downloaded(target: Target, server: Server, models: Models, progress: Progress) -> Fetched:
    """Download, unpack and check what is missing, some files at once. What is wrong with one stops
    no other, but a token that is refused does."""
    todo = [i for i, f in models.items() if target.lacks(PurePosixPath(i), f.sha256, i)]
    places = {name: target.path(f"{WORK_NAME}/downloads/{name}.zip") for name in todo}
    there = len(models) - len(todo)
    progress(there, len(models), "")
    with closing(server.each(lambda i: server.download(models[i], places[i]), todo)) as coming:
        for done, (name, download) in enumerate(coming, there + 1):
            path = places[name]
            try:
                download.result()
                target.take(path, models[name].called, lambda _, name=name: PurePosixPath(name))
            except AccessRefused:
                raise
            except (NotFetched, InvalidSource) as error:
                target.fail(name, str(error), path)
            if not download.exception():  # or what came of it is kept
                path.unlink()
            progress(done, len(models), name)
    return target.outcome(models)


def _unpacked(target: Target, paths: Sequence[Path], progress: Progress) -> Fetched:
    """Unpack archives that are here."""
    places: list[str] = []
    for number, path in enumerate(paths):
        progress(number, len(paths), path.name)

        def place(root: PurePosixPath, name: str = path.name) -> PurePosixPath:
            if not root.parts:
                return PurePosixPath(name.removesuffix(".zip").removesuffix(".tar.gz"))
            return PurePosixPath(root.name) if target.terms.source in _FLAT else root

        try:
            places += target.take(path, printable(path.name), place)
        except InvalidSource as error:
            target.fail(path.name, str(error), path)
    return target.outcome(places)
