"""Hugging Face's hub: which files a data set has there, with their digests."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from articugen.core.errors import NotFetched
from articugen.sources.fetch.web import Server

_PAGES = 1_000


@dataclass(frozen=True)
class Published:
    """A file as it is published.

    Attributes:
        name: from the data set's folder on.
        address: where its server has it.
        size, sha256: None where nobody tells.
        version: of the data set.
    """

    name: str
    address: str
    size: int | None
    sha256: str | None
    version: str = ""


class _Large(BaseModel):
    oid: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    size: Annotated[int, Field(ge=0)]


class _Listed(BaseModel):
    type: str
    path: str
    size: Annotated[int, Field(ge=0)] = 0
    lfs: _Large | None = None


class _Revision(BaseModel):
    sha: Annotated[str, Field(pattern="^[0-9a-f]{7,64}$")]


_LISTED = TypeAdapter(list[_Listed])


def hub(token: str | None, cure: str) -> Server:
    """Return the hub at $HF_ENDPOINT or at its usual address, with a token: that one, $HF_TOKEN's,
    or what `hf auth login` has kept."""
    base = os.environ.get("HF_ENDPOINT") or "https://huggingface.co"
    return Server(base.rstrip("/"), token=token or _own_token(), cure=cure)


def files(server: Server, repository: str) -> list[Published]:
    """All files of a data set as it is now, by name.

    Raises:
        AccessRefused, NotFetched: it is not told.
    """
    about, _ = server.json(f"/api/datasets/{repository}/revision/main")
    listed: list[_Listed] = []
    try:
        version = _Revision.model_validate(about).sha
        page = f"/api/datasets/{repository}/tree/{version}?recursive=true"
        for _ in range(_PAGES):
            part, page = server.json(page)
            listed += _LISTED.validate_python(part)
            if not page:
                break
    except ValidationError:
        raise NotFetched(
            f"{server.base}: its list of {repository} is not as expected; update articugen, or "
            "download the files by hand and name them with --from"
        ) from None
    return [
        Published(
            each.path,
            f"/datasets/{repository}/resolve/{version}/{quote(each.path)}",
            each.lfs.size if each.lfs else each.size,
            each.lfs.oid if each.lfs else None,
            version,
        )
        for each in sorted(listed, key=lambda each: each.path)
        if each.type == "file" and each.path.isprintable()
    ]


def _own_token() -> str:
    if os.environ.get("HF_TOKEN"):
        return os.environ["HF_TOKEN"].strip()
    home = os.environ.get("HF_HOME") or "~/.cache/huggingface"
    path = Path(os.environ.get("HF_TOKEN_PATH") or f"{home}/token").expanduser()
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""
