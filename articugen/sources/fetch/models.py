"""Which folders in an archive are models, and their way into a folder of ours."""

import gzip
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from articugen.core.errors import InvalidSource, MachineFault
from articugen.core.files import cannot_write
from articugen.sources.fetch.archives import Archive, Member, checked_members, contents, opened
from articugen.sources.usd.reader import LAYER_FOLDERS

_BLOCK = 2**20
_BELOW = ("urdf", "urdf_w_collider")
"""Folders of URDFs inside of a model's folder."""
_USD = (".usd", ".usda", ".usdc", ".usdz")


@dataclass(frozen=True)
class Unpacked:
    """A model that has been unpacked: its folder in the archive, and what came of it.

    Attributes:
        listing: the SHA-256 of each file, by its name in the model's folder.
        bytes: of all files.
    """

    root: PurePosixPath
    listing: Mapping[str, str]
    bytes: int


def unpack(
    path: Path,
    into: Path,
    wanted: Callable[[PurePosixPath], bool],
    on_model: Callable[[Unpacked, Path], None],
) -> list[PurePosixPath]:
    """Unpack the models of an archive, one after the other; nothing before all of it was examined.

    Args:
        into: an empty folder; a model is unpacked to a folder in it, which `on_model` may move.
        wanted: whether to unpack the model of a folder in the archive; asked of all before any is.
        on_model: called once all files of a model are there.

    Returns:
        the folders of all models in it; `.` is the archive itself.

    Raises:
        InvalidSource: unsafe, damaged, or without a model.
        MachineFault, MemoryError: the disk is full, or the like.
    """
    with opened(path) as archive:
        members = checked_members(archive, path)
        root_of = _roots(members)
        roots = sorted(set(root_of.values()))
        if not roots:
            raise InvalidSource(
                f"{path}: holds no URDF and no motion_attributes.json, nor USD; name another"
            )
        chosen = {root for root in roots if wanted(root)}
        todo = {m: root for m in members if (root := root_of.get(m.name)) in chosen}
        _check_room(path, into, sum(member.bytes for member in todo))
        _unpack(archive, path, into, todo, on_model)
    return roots


def _unpack(
    archive: Archive,
    path: Path,
    into: Path,
    todo: Mapping[Member, PurePosixPath],
    on_model: Callable[[Unpacked, Path], None],
) -> None:
    left = Counter(todo.values())
    sizes: Counter[PurePosixPath] = Counter()
    listings: dict[PurePosixPath, dict[str, str]] = {root: {} for root in left}
    folder_of = {
        root: into / str(number) / (root.name or "model")
        for number, root in enumerate(sorted(left))
    }
    for member, data in contents(archive, path) if todo else ():
        root = todo.get(member)
        if root is None:
            continue
        name = member.name.relative_to(root)
        listings[root][str(name)] = _write(data, member, folder_of[root] / name, path)
        left[root] -= 1
        sizes[root] += member.bytes
        if left[root] == 0:
            on_model(Unpacked(root, listings.pop(root), sizes[root]), folder_of[root])


def _write(data: BinaryIO, member: Member, to: Path, path: Path) -> str:
    written, digest = 0, sha256()
    try:
        to.parent.mkdir(parents=True, exist_ok=True)
        with to.open("xb") as file:
            while block := data.read(_BLOCK):  # to the end, where the checksum is compared
                written += file.write(block)
                digest.update(block)
    except gzip.BadGzipFile:
        raise
    except OSError as error:
        raise MachineFault(cannot_write(to, error, member.bytes)) from error
    if written != member.bytes:
        raise InvalidSource(f"{path}: is damaged ({member.name} is cut short); get it again")
    return digest.hexdigest()


def _check_room(path: Path, into: Path, wanted: int) -> None:
    free = shutil.disk_usage(into).free
    if wanted > free:
        raise MachineFault(
            f"{into}: {wanted / 1e6:,.0f} MB are to be unpacked from {path.name} and "
            f"{free / 1e6:,.0f} MB are free; free some, or choose a folder on another disk"
        )


def _roots(members: Sequence[Member]) -> dict[PurePosixPath, PurePosixPath]:
    """The model's folder of each file that lies in one; of folders in each other the inner one."""
    roots = {root for member in members if (root := _root_marked(member.name)) is not None}
    if not roots:  # beside other marks USD files are meshes
        roots = _usd_roots([member.name for member in members])
    found = {}
    for member in members:
        own = next((folder for folder in member.name.parents if folder in roots), None)
        if own is not None and not _is_hidden(member.name):
            found[member.name] = own
    return found


def _root_marked(name: PurePosixPath) -> PurePosixPath | None:
    """Return the folder of the model that a file of this name shows to be there."""
    marks = name.suffix.lower() == ".urdf" or name.name == "motion_attributes.json"
    marks = marks or name.name == f"{name.parent.name}.articulations.json"
    if not marks or _is_hidden(name):
        return None
    return name.parent.parent if name.parent.name in _BELOW else name.parent


def _usd_roots(names: Sequence[PurePosixPath]) -> set[PurePosixPath]:
    """The folders of USD files, without those in which the layers of another one's model lie."""
    folders = {n.parent for n in names if n.suffix.lower() in _USD and not _is_hidden(n)}
    return {
        folder
        for folder in folders
        if not any(
            above.name.lower() in LAYER_FOLDERS and above.parent in folders
            for above in (folder, *folder.parents)
        )
    }


def _is_hidden(name: PurePosixPath) -> bool:
    """What file managers leave behind."""
    return any(part.startswith(".") or part == "__MACOSX" for part in name.parts)
