"""The sources that have a name: folders with a source.yaml, here or in $ARTICUGEN_SOURCES."""

import os
from dataclasses import dataclass
from pathlib import Path

from articugen.core.content import SOURCES
from articugen.core.errors import InvalidSource
from articugen.sources.categories import own_name, unknown
from articugen.sources.source_file import SourceFile, read_source_file


@dataclass(frozen=True)
class NamedSource:
    """A source.yaml and the folder of its models."""

    name: str
    yaml: Path
    file: SourceFile
    folder: Path

    def category(self, name: str) -> str:
        """The source's own name of a category.

        Raises:
            InvalidSource: it has no such category.
        """
        own = own_name(self.file, name)
        if own is None:
            raise unknown(f"source {self.name!r}", name, list(self.file.categories))
        return own


def source_files() -> dict[str, Path]:
    """Every source.yaml by the source's name; $ARTICUGEN_SOURCES goes first.

    Raises:
        InvalidSource: that is no folder.
    """
    found: dict[str, Path] = {}
    for root in filter(None, (_own_sources(), SOURCES)):
        for path in sorted(root.glob("*/source.yaml")):
            found.setdefault(path.parent.name, path)
    return found


def source_named(name: str) -> NamedSource | None:
    """The source of that name, or None.

    Raises:
        InvalidSource: its source.yaml is wrong.
    """
    path = source_files().get(name)
    if path is None:
        return None
    file = read_source_file(path)
    own = _own_sources()
    if file.path is not None:
        folder = path.parent / file.path
    elif own and (own / name).is_dir():
        folder = own / name
    else:
        folder = path.parent
    return NamedSource(name, path, file, folder)


def common_categories() -> SourceFile | None:
    """PartNet-Mobility's categories, whose names are those that folders of models have."""
    like = source_named("partnet_mobility")
    return like.file if like else None


def _own_sources() -> Path | None:
    """The folder that $ARTICUGEN_SOURCES names, or None."""
    text = os.environ.get("ARTICUGEN_SOURCES")
    if not text:
        return None
    if not Path(text).is_dir():
        raise InvalidSource(f"ARTICUGEN_SOURCES={text} is not a folder; correct or unset it")
    return Path(text)
