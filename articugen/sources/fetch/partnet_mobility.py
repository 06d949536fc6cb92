"""PartNet-Mobility where it is published: Hugging Face's hub, or SAPIEN's own site.

The hub has a file <id>.zip for each model and no list of categories: a model's category is read
from the meta.json in its .zip, where that lies, and remembered. SAPIEN's site (the route of
`sapien.asset.download_partnet_mobility`) gives models by id alone.
"""

import json
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from urllib.parse import quote

from pydantic import TypeAdapter

from articugen.core.errors import AccessRefused, InvalidArgument, MachineFault, NotFetched
from articugen.core.files import UnfitFile, cannot_write
from articugen.core.yaml_files import nearest
from articugen.meshes.model_files import MAX_TEXT_BYTES
from articugen.sources.fetch.target import TERMS_NAME, WORK_NAME, Target
from articugen.sources.fetch.web import Published, Server
from articugen.sources.source_file import common_categories, plain, unknown

REPOSITORY = "sapien-sim/PartNetMobility"

Models = Mapping[str, Published]  # the published .zip of each model, by its id
Progress = Callable[[int, int, str], None]

_CATEGORIES = f"{WORK_NAME}/categories.json"
_PAGES = 1_000
_BLOCK = 2**16
_MOST_BYTES = 2**28  # of an archive whose category is read
_TERMS = re.compile(r"(README|LICEN[CS]E|TERMS)[\w.-]{0,50}", re.IGNORECASE)
_HUB_CURE = (
    f"accept the terms of {REPOSITORY} with your account at the hub, and give its token with "
    "HF_TOKEN or --token"
)
_SITE_CURE = "give the token of your account at SAPIEN's site with SAPIEN_ACCESS_TOKEN or --token"


def at_site(ids: Collection[str], token: str | None) -> tuple[Server, Models]:
    """Return SAPIEN's site, $SAPIEN_ENDPOINT or its usual address, and models there; AccessRefused
    without a token."""
    token = token or os.environ.get("SAPIEN_ACCESS_TOKEN", "").strip()
    if not token:
        raise AccessRefused(f"SAPIEN's site wants a token; {_SITE_CURE}")
    for name in ids:
        if not re.fullmatch("[0-9]{1,9}", name):
            raise InvalidArgument(f"{name!r} is no id of PartNet-Mobility; they are numbers")
    base = os.environ.get("SAPIEN_ENDPOINT") or "https://sapien.ucsd.edu"
    query = f"?token={quote(token, safe='')}"
    return Server(base.rstrip("/"), cure=_SITE_CURE), {
        name: Published(f"/api/download/compressed/{name}.zip{query}", f"{name}.zip")
        for name in sorted(set(ids))
    }


def at_hub(
    target: Target,
    categories: Collection[str],
    ids: Collection[str],
    token: str | None,
    progress: Progress,
) -> tuple[Server, Models]:
    """Return the hub, $HF_ENDPOINT or its usual address, and the models there that are wanted;
    bring the publisher's terms."""
    base = os.environ.get("HF_ENDPOINT") or "https://huggingface.co"
    server = Server(base.rstrip("/"), token=token or _hub_token(), cure=_HUB_CURE)
    files = _files(server)
    models = {
        match[1]: file
        for name, file in files.items()
        if (match := re.fullmatch(r"(?:.*/)?([0-9]{1,9})\.zip", name))
    }
    for name in ids:
        if name not in models:
            raise InvalidArgument(
                f"PartNet-Mobility has no model {name!r}{nearest(name, list(models))}"
            )
    if ids:
        models = {name: file for name, file in models.items() if name in ids}
    if categories and "all" not in categories:
        category_of = _categories(server, models, target, progress)
        there = sorted(set(filter(None, category_of.values())))
        wanted: set[str] = set()
        for name in categories:
            words = common_categories().words(name)
            if not words.intersection(map(plain, there)):
                raise unknown("PartNet-Mobility", name, there)
            wanted |= words
        models = {name: f for name, f in models.items() if plain(category_of[name]) in wanted}
    for name, file in files.items():
        if _TERMS.fullmatch(name):
            target.place.write(f"{TERMS_NAME}/{name}", server.get(file.address)[0])
    return server, models


def _hub_token() -> str:
    """Return the token in $HF_TOKEN, or that which `hf auth login` has kept."""
    token = os.environ.get("HF_TOKEN", "").strip()
    home = os.environ.get("HF_HOME") or "~/.cache/huggingface"
    path = Path(os.environ.get("HF_TOKEN_PATH") or f"{home}/token").expanduser()
    try:
        return token or path.read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""


def _files(server: Server) -> Models:
    """Return all files of the data set as it is now, by name; AccessRefused or NotFetched if there
    is no list."""
    api = f"/api/datasets/{REPOSITORY}"
    files: dict[str, Published] = {}
    try:
        version = str(json.loads(server.get(f"{api}/revision/main")[0])["sha"])
        query = "recursive=true"
        for _ in range(_PAGES):
            page, link = server.get(f"{api}/tree/{quote(version)}?{query}")
            for entry in json.loads(page):
                name, large = entry["path"], entry.get("lfs") or {}
                if entry["type"] == "file" and name.isprintable():
                    files[name] = Published(
                        f"/datasets/{REPOSITORY}/resolve/{quote(version)}/{quote(name)}",
                        f"{REPOSITORY}@{version}/{name}",
                        int(large.get("size", entry["size"])),
                        large.get("oid"),
                    )
            following = re.search(r'<[^<>?]*\?([^<>]*)>; rel="next"', link)
            if not following:
                break
            query = following[1]  # of the same server, whatever address it stands in
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError):
        raise NotFetched(
            f"{server.base}: its list of {REPOSITORY} is not as expected; try again later, or "
            "download the files by hand and name them with --from"
        ) from None
    return dict(sorted(files.items()))


def _categories(
    server: Server, models: Models, target: Target, progress: Progress
) -> dict[str, str]:
    """Return the category of each model; those that were read once are remembered."""
    known: dict[str, str] = {}
    with suppress(UnfitFile, ValueError):  # which is no list of ours
        known = TypeAdapter(dict[str, str]).validate_json(target.place.read(_CATEGORIES) or b"")
    todo = [name for name in models if name not in known]
    try:
        with closing(server.each(lambda name: _category(server, models[name]), todo)) as coming:
            for done, (name, category) in enumerate(coming, 1 + len(models) - len(todo)):
                known[name] = category.result()
                progress(done, len(models), f"category of {name}")
    finally:
        if todo:
            sure = {name: category for name, category in known.items() if category}
            target.place.write(_CATEGORIES, json.dumps(sure, indent=0).encode())
    return known


def _category(server: Server, file: Published, tail: int = _BLOCK) -> str:
    """Return the category in the meta.json of a published .zip; "" where there is none.

    Only its end (`tail` bytes), where the list of its files is, and the place of meta.json are
    read, into a file with a hole for the rest.
    """
    size = min(file.size or 0, _MOST_BYTES)
    begin = max(0, size - tail)

    def bring(first: int, last: int) -> None:
        copy.seek(first)
        copy.write(server.get(file.address, range(first, last))[0])

    try:
        with TemporaryFile() as copy:
            copy.truncate(size)
            bring(begin, size)
            with zipfile.ZipFile(copy) as archive:
                there = [i for i in archive.infolist() if i.filename.split("/")[-1] == "meta.json"]
                info = min(there, key=lambda info: len(info.filename))
                if info.header_offset < begin:
                    bring(info.header_offset, min(info.header_offset + _BLOCK, size))
                if info.file_size <= MAX_TEXT_BYTES:
                    return str(json.loads(archive.read(info))["model_cat"])
    except zipfile.BadZipFile:
        if begin and tail == _BLOCK:  # a list of a thousand files is longer
            return _category(server, file, 16 * tail)
    except OSError as error:
        raise MachineFault(cannot_write(Path(gettempdir()), error)) from error
    except (zlib.error, EOFError, RuntimeError, ValueError, LookupError, TypeError):
        pass  # all that Python's readers of archives and JSON raise
    return ""
