"""The folder of a data set: what of it runs have put there, by name and by content."""

import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from articugen.core.errors import ArticugenError, CorruptShard, MachineFault, machine_fault
from articugen.core.files import is_plain_file, whole_name
from articugen.core.ledger import LEDGER
from articugen.core.recipe import Recipe
from articugen.pipeline.common import CommonPlan
from articugen.store.croissant import NAME as CROISSANT_NAME
from articugen.store.manifest import MANIFEST_NAME
from articugen.store.manifest_pages import is_page_name
from articugen.store.outcome import Outcome, is_shard_name
from articugen.store.shards import content_sha256, open_shard

_SHARD = re.compile(r"(?P<split>.+)-(?P<number>\d{5,})\.h5")


def listed(folder: Path) -> list[str]:
    """Return what a folder itself holds; MachineFault where it cannot be read."""
    try:
        return sorted(os.listdir(folder))
    except OSError as error:
        raise MachineFault(f"{folder}: cannot be read ({error.strerror})") from None


def is_shard_of_ours(folder: Path, name: str, about: CommonPlan | None = None) -> bool:
    """Return whether a file is a shard that runs wrote, of the split in its name and made for
    `about`: a record is a file like any other, and may name somebody else's file."""
    called = _SHARD.fullmatch(name)
    if called is None or not is_plain_file(folder / name):
        return False
    wanted: dict[str, str | int] = {"split": called["split"]}
    if about:
        recipe = Recipe.of_text(about.recipe)  # None where it is of another version
        wanted |= {"category": about.category, "seed": about.seed}
        wanted["recipe_sha256"] = recipe.for_one_object().sha256() if recipe else ""
    try:
        with open_shard(folder / name) as shard:
            return all(shard.attributes[key] == value for key, value in wanted.items())
    except CorruptShard:
        return False


def is_whole(folder: Path, outcome: Outcome, *, sizes_only: bool) -> bool:
    """Check that a shard is the file that was recorded, or that with a group `user` besides."""
    assert outcome.shard
    assert outcome.made
    path = folder / outcome.shard.name
    try:
        if sizes_only:
            return path.stat().st_size == outcome.shard.bytes
        if outcome.shard.is_of(path):
            return True
        with open_shard(path) as shard:
            content = [row for row in shard.content() if row[0] == outcome.key.object_id]
            return shard.extended and content_sha256(content) == outcome.made.content_sha256
    except (OSError, CorruptShard) as error:
        if fault := machine_fault(error):
            raise fault from error
        return False


def called_otherwise(folder: Path, terms: Mapping[str, str], name: str) -> str | None:
    """Return which of a shard's attributes are not these, in words; None for a damaged one too."""
    with suppress(CorruptShard), open_shard(folder / name) as shard:
        was = shard.attributes
        other = [f"the {n} was {was[n]}, is {now}" for n, now in terms.items() if was[n] != now]
        return " and ".join(other) or None


def is_of_plan(folder: Path, name: str, about: CommonPlan | None) -> bool:
    """Return whether a shard that no record names was made for the plan of a run that was
    killed."""
    called = _SHARD.fullmatch(name)
    if called is None or about is None or int(called["number"]) >= about.objects:
        return False
    return is_shard_of_ours(folder, name, about)


def data_sets(path: Path, *, follow: bool = True) -> list[Path]:
    """Return the data set in `path`, or those in its folders, whole or not.

    Args:
        path: a folder; the link to one is followed, since it was named.
        follow: whether links in it are; not where something is written or removed.

    Raises:
        CorruptShard: there is none.
        ArticugenError: a data set would have to be followed to.
    """
    folders = [path]
    if not _is_data_set(path):
        inside = sorted(path.iterdir()) if path.is_dir() else []
        folders = [folder for folder in inside if _is_data_set(folder)]
        links = [] if follow else [folder for folder in folders if folder.is_symlink()]
        if links:
            raise ArticugenError(f"{links[0]}: a link to elsewhere; name that folder itself")
    if not folders:
        raise CorruptShard(f"{path}: holds no data set; make one with: articugen generate")
    return folders


def _is_data_set(folder: Path) -> bool:
    """Return whether a run has been at work in a folder, or shards lie there."""
    names = os.listdir(folder) if folder.is_dir() else []
    return any(
        name in (MANIFEST_NAME, LEDGER) or is_temporary(name) or is_shard_name(name)
        for name in names
    )


def is_temporary(name: str) -> bool:
    """Return whether a run gives a file this name until it is whole."""
    whole = whole_name(name)
    if whole is None:
        return False
    return is_shard_name(whole) or is_page_name(whole) or whole in (MANIFEST_NAME, CROISSANT_NAME)
