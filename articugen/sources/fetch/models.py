"""Which folders in an archive are models, and their way into a folder of ours."""

import gzip
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import IO

from articugen.core.errors import InvalidSource, MachineFault
from articugen.core.files import cannot_write
from articugen.sources.fetch.archives import Member, checked_members, contents, opened
from articugen.sources.usd.reader import LAYER_FOLDERS

_BLOCK = 2**20
_BELOW = ("urdf", "urdf_w_collider")  # folders of URDFs inside of a model's folder
_USD = (".usd", ".usda", ".usdc", ".usdz")


@dataclass(frozen=True)
class Unpacked:
    """A model that was unpacked: its folder in the archive, the SHA-256 of each file, by its name
    in there, and the bytes of all."""

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
        needed, free = sum(member.bytes for member in todo), shutil.disk_usage(into).free
        if needed > free:
            raise MachineFault(
                f"{into}: {needed / 1e6:,.0f} MB are to be unpacked from {path.name} and "
                f"{free / 1e6:,.0f} MB are free; free some, or choose a folder on another disk"
            )
        left, sizes = Counter(todo.values()), Counter[PurePosixPath]()
        listings: dict[PurePosixPath, dict[str, str]] = {root: {} for root in left}
        folder_of = {r: into / str(k) / (r.name or "model") for k, r in enumerate(sorted(left))}
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
    return roots


def _write(data: IO[bytes], member: Member, to: Path, path: Path) -> str:
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


def _roots(members: Sequence[Member]) -> dict[PurePosixPath, PurePosixPath]:
    """The model's folder of each file that lies in one; of folders in each other the inner one."""
    names = [
        member.name  # without what file managers leave behind
        for member in members
        if not any(part.startswith(".") or part == "__MACOSX" for part in member.name.parts)
    ]
    roots = {
        name.parent.parent if name.parent.name in _BELOW else name.parent
        for name in names
        if name.suffix.lower() == ".urdf"
        or name.name in ("motion_attributes.json", f"{name.parent.name}.articulations.json")
    } or _usd_roots(names)  # beside other marks USD files are meshes
    own = {name: next((f for f in name.parents if f in roots), None) for name in names}
    return {name: root for name, root in own.items() if root is not None}


def _usd_roots(names: Sequence[PurePosixPath]) -> set[PurePosixPath]:
    """The folders of USD files, without those in which the layers of another one's model lie."""
    folders = {n.parent for n in names if n.suffix.lower() in _USD}
    return {
        folder
        for folder in folders
        if not any(
            above.name.lower() in LAYER_FOLDERS and above.parent in folders
            for above in (folder, *folder.parents)
        )
    }
