"""Hugging Face's hub: which files a data set has there, with their digests."""

import os
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from articugen.core.errors import NotFetched
from articugen.sources.fetch.web import Published, Server

_PAGES = 1_000


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
    token = token or os.environ.get("HF_TOKEN", "").strip()
    if not token:
        home = os.environ.get("HF_HOME") or "~/.cache/huggingface"
        path = Path(os.environ.get("HF_TOKEN_PATH") or f"{home}/token").expanduser()
        try:
            token = path.read_text(encoding="utf-8").strip()
        except (OSError, ValueError):
            token = ""
    return Server(base.rstrip("/"), token=token, cure=cure)


def files(server: Server, repository: str) -> list[Published]:
    """Return all files of a data set as it is now, by name; AccessRefused or NotFetched if there is
    no list."""
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
            file.path,
            f"/datasets/{repository}/resolve/{version}/{quote(file.path)}",
            file.lfs.size if file.lfs else file.size,
            file.lfs.oid if file.lfs else None,
            f"{repository}@{version}/{file.path}",
        )
        for file in sorted(listed, key=lambda file: file.path)
        if file.type == "file" and file.path.isprintable()
    ]
