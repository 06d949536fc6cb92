"""Pages of a large manifest: files beside it, each with the entries of some of its objects.

The manifest then has, in place of its lists of entries, the name, size and digest of each page. A
page's name states its place and its content, so that no page is ever written over another: pages
come first and the manifest last, and until then the one that was there stays whole.
"""

import hashlib
import os
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError, model_validator

from articugen.core.errors import MachineFault
from articugen.core.files import UnfitFile, is_plain_file, read_regular

MOST_BYTES = 1 << 28
"""That a manifest or a page may have."""
MOST_HEAD_BYTES = 1 << 24
"""That a manifest may have which lists pages."""
MOST_PAGED_BYTES = 1 << 32
"""That all pages together may have: two million objects of 2 kB."""
MOST_PAGES = 1000

_NAME = re.compile(r"manifest-[0-9]{5}-[0-9a-f]{16}\.json")


class Page(BaseModel):
    """A page as the manifest lists it: its name in the manifest's folder, the entries of all lists
    together, size and digest of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    name: str
    entries: int = Field(gt=0)
    bytes: int = Field(gt=0, le=MOST_BYTES)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


def page_of(number: int, data: bytes, entries: int) -> Page:
    """Return a page as a manifest lists it."""
    sha256 = hashlib.sha256(data).hexdigest()
    name = _page_name(number, sha256)
    return Page(name=name, entries=entries, bytes=len(data), sha256=sha256)


class Head(BaseModel):
    """A manifest that lists pages; `model_extra` is what else it says, not examined yet."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True, allow_inf_nan=False)

    pages: Annotated[
        tuple[Page, ...], Field(min_length=1, max_length=MOST_PAGES), FailFast(fail_fast=True)
    ]

    @model_validator(mode="after")
    def _is_in_order(self) -> "Head":
        for number, page in enumerate(self.pages):
            if page.name != _page_name(number, page.sha256):
                raise ValueError(f"page {number} is not called by its number and digest")
        if sum(page.bytes for page in self.pages) > MOST_PAGED_BYTES:
            raise ValueError(f"pages of more than the {MOST_PAGED_BYTES:,} bytes they may have")
        return self


class _Pages(BaseModel):
    pages: Any = None


def head_in(text: bytes) -> Head | None:
    """Return what a manifest says that lists pages, or ValidationError if it does so wrongly; None
    where it has its entries in it."""
    try:
        if len(text) > MOST_HEAD_BYTES or _Pages.model_validate_json(text).pages is None:
            return None
    except ValidationError:
        return None
    return Head.model_validate_json(text)


def is_page_name(name: str) -> bool:
    """Return whether a page of a manifest may be called so."""
    return _NAME.fullmatch(name) is not None


def stale_pages(manifest: Path) -> list[str]:
    """Return the names of pages in a manifest's folder that it does not list, of an earlier one or
    of one that was not written to the end; without a manifest all. MachineFault if the folder
    cannot be read."""
    try:
        there = sorted(filter(is_page_name, os.listdir(manifest.parent)))
        listed = listed_pages(manifest) if there else set[str]()
    except OSError as error:
        raise MachineFault(f"{manifest.parent}: cannot be read ({error.strerror})") from None
    return [n for n in there if n not in listed and is_plain_file(manifest.parent / n)]


def listed_pages(manifest: Path) -> set[str]:
    """Return the names of the pages that a manifest lists; none where it is damaged or not there,
    OSError where it cannot be read."""
    try:
        head = head_in(read_regular(manifest, MOST_HEAD_BYTES))
    except (FileNotFoundError, UnfitFile, ValidationError):
        return set()
    return {page.name for page in head.pages} if head else set()


def _page_name(number: int, sha256: str) -> str:
    return f"manifest-{number:05d}-{sha256[:16]}.json"
