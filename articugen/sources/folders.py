"""What readers examine in a folder of models; nothing here opens a model."""

import json
import os
from os.path import isdir
from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.meshes.model_files import MAX_TEXT_BYTES, ModelFiles, unreadable
from articugen.sources.refs import Found


def visible(base: Path) -> list[Path]:
    """Return what a folder has in it, by name, without hidden things; nothing of what is no folder.
    InvalidSource if it cannot be listed, or MachineFault or MemoryError."""
    if not isdir(base):
        return []
    try:
        return [base / name for name in sorted(os.listdir(base)) if not name.startswith(".")]
    except OSError as error:
        raise unreadable(base, error) from error


def ending_in(folder: Path, suffix: str) -> list[Path]:
    """Return the paths in a folder that end in `suffix`, such as .urdf, in letters of either case;
    the shortest name first."""
    paths = (path for path in folder.glob("*") if path.suffix.lower() == suffix)
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def has_urdf(folder: Path) -> bool:
    """Return whether a URDF is in a folder: files beside it are its mesh or copy."""
    return any(path.suffix.lower() == ".urdf" for path in visible(folder))


def model_in(folder: Path) -> Found:
    """Return the model that a folder is, of the category that it states."""
    return Found(folder.name, folder, folder.name, category=meta_category(folder))


def meta_category(folder: Path) -> str:
    """Return the category that the meta.json of a model's folder gives, as PartNet-Mobility's do;
    "" where it gives none."""
    try:
        text = ModelFiles(folder).read(folder / "meta.json", MAX_TEXT_BYTES)
        return str(json.loads(text)["model_cat"])
    except (InvalidSource, ValueError, KeyError, TypeError, RecursionError):
        return ""
