"""PartNet-Mobility from where it is published: Hugging Face's hub, or SAPIEN's own site.

The hub has a file <id>.zip for each model and no list of categories: which a model has is read from
the meta.json in its .zip, where it lies, and remembered. SAPIEN's site (the route of
`sapien.asset.download_partnet_mobility`) gives models by id alone.
"""

import json
import os
import re
import zipfile
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import PurePosixPath
from urllib.parse import quote

from articugen.core.errors import AccessRefused, InvalidArgument, InvalidSource, NotFetched
from articugen.core.files import read_regular, write_atomically
from articugen.core.yaml_files import nearest
from articugen.meshes.model_files import MAX_TEXT_BYTES
from articugen.sources.fetch.hub import files, hub
from articugen.sources.fetch.target import (
    CATEGORIES_NAME,
    TERMS_NAME,
    WORK_NAME,
    Fetched,
    Target,
)
from articugen.sources.fetch.web import Published, RemoteFile, Server
from articugen.sources.source_file import common_categories, plain, unknown

REPOSITORY = "sapien-sim/PartNetMobility"
ROUTES = ("hub", "sapien")

_AT_ONCE = 4
_LOOKS_AT_ONCE = 8
_TERMS = re.compile(r"(README|LICEN[CS]E|TERMS)[\w.-]{0,50}", re.IGNORECASE)
_MAX_TERMS_BYTES = 2**20
_HUB_CURE = (
    f"accept the terms of {REPOSITORY} with your account at the hub, and give its token with "
    "HF_TOKEN or --token"
)
_SITE_CURE = "give the token of your account at SAPIEN's site with SAPIEN_ACCESS_TOKEN or --token"

Told = Callable[[int, int, str], None]


Models = Mapping[str, Published]  # the published .zip of each model, by its id


def check_wishes(categories: Collection[str], ids: Collection[str], via: str | None) -> None:
    """Raise InvalidArgument where nothing is chosen, or there is no such route."""
    if via is not None and via not in ROUTES:
        raise InvalidArgument(f"no route {via!r}; there are: {', '.join(ROUTES)}")
    if not categories and not ids:
        raise InvalidArgument("nothing is chosen; name --category (or 'all', 3.3 GB) or --ids")


def fetch_partnet_mobility(
    target: Target,
    categories: Collection[str],
    ids: Collection[str],
    token: str | None,
    via: str | None,
    told: Told,
    notice: Callable[[str], None],
) -> Fetched:
    """Download models, or what is missing of them, as `door.fetch` says; each becomes <out>/<id>.

    Raises:
        InvalidArgument: there is no such model or category.
        AccessRefused, NotFetched: what is wanted cannot be got.
        MachineFault, MemoryError: the disk is full, or the like.
    """
    if via != "sapien":
        try:
            server = hub(token, _HUB_CURE)
            return _fetched(server, _at_hub(server, target, categories, ids, told), target, told)
        except NotFetched as error:
            second = via is None and ids and not categories
            if not second or not os.environ.get("SAPIEN_ACCESS_TOKEN"):
                raise
            notice(f"{error}; trying SAPIEN's own site")
            token = None
    token = token or os.environ.get("SAPIEN_ACCESS_TOKEN", "").strip()
    if categories:
        raise InvalidArgument("SAPIEN's site gives models by id alone; name --ids, or --via hub")
    if not token:
        raise AccessRefused(f"SAPIEN's site wants a token; {_SITE_CURE}")
    for name in ids:
        if not re.fullmatch("[0-9]{1,9}", name):
            raise InvalidArgument(f"{name!r} is no id of PartNet-Mobility; they are numbers")
    base = os.environ.get("SAPIEN_ENDPOINT") or "https://sapien.ucsd.edu"
    address = "/api/download/compressed/{}.zip?token=" + quote(token, safe="")
    models = {
        i: Published(f"{i}.zip", address.format(i), called=f"{i}.zip") for i in sorted(set(ids))
    }
    return _fetched(Server(base.rstrip("/"), cure=_SITE_CURE), models, target, told)


def _at_hub(
    server: Server,
    target: Target,
    categories: Collection[str],
    ids: Collection[str],
    told: Told,
) -> Models:
    """Return the chosen models, and bring the publisher's terms."""
    listed = files(server, REPOSITORY)
    models = {
        match[1]: file
        for file in listed
        if (match := re.fullmatch(r"(?:.*/)?([0-9]{1,9})\.zip", file.name))
    }
    for name in ids:
        if name not in models:
            raise InvalidArgument(
                f"PartNet-Mobility has no model {name!r}{nearest(name, list(models))}"
            )
    if ids:
        models = {name: file for name, file in models.items() if name in ids}
    if categories and "all" not in categories:
        category_of = _categories(server, models, target, told)
        wanted: set[str] = set()
        for name in categories:
            words = common_categories().words(name)
            there = sorted(set(filter(None, category_of.values())))
            if not words.intersection(map(plain, there)):
                raise unknown("PartNet-Mobility", name, there)
            wanted |= words
        models = {name: f for name, f in models.items() if plain(category_of[name]) in wanted}
    for file in listed:
        if _TERMS.fullmatch(file.name) and (file.size or 0) <= _MAX_TERMS_BYTES:
            server.download(file, target.path(f"{TERMS_NAME}/{file.name}"))
    return models


def _fetched(server: Server, models: Models, target: Target, told: Told) -> Fetched:
    """Download, unpack and check what is missing, some files at once. What is wrong with one stops
    no other, but a token that is refused does."""
    todo = deque(i for i, f in models.items() if target.lacks(PurePosixPath(i), f.sha256, i))
    new, there = 0, len(models) - len(todo)
    told(there, len(models), "")
    folder = target.path(f"{WORK_NAME}/downloads")
    coming: dict[Future[str], str] = {}
    with _threads(_AT_ONCE, server) as pool:
        while todo or coming:
            while todo and len(coming) < 2 * _AT_ONCE:
                name = todo.popleft()
                coming[pool.submit(server.download, models[name], folder / f"{name}.zip")] = name
            for future in wait(coming, return_when=FIRST_COMPLETED).done:
                name = coming.pop(future)
                path, place = folder / f"{name}.zip", PurePosixPath(name)
                try:
                    digest = future.result()
                    new += target.take(path, models[name].called, digest, lambda _, to=place: to)[1]
                except AccessRefused:
                    raise
                except (NotFetched, InvalidSource) as error:
                    target.fail(name, error, path)
                path.unlink(missing_ok=True)
                there += 1
                told(there, len(models), name)
    return target.outcome(models, new)


@contextmanager
def _threads(count: int, server: Server) -> Iterator[ThreadPoolExecutor]:
    """Threads that ask a server. After an error no more is asked for; after Ctrl-C, or the like, it
    is not even waited for what is under way: a server that says nothing is no reason to stay."""
    pool = ThreadPoolExecutor(count)
    try:
        yield pool
    except BaseException as error:
        server.stop.set()
        pool.shutdown(wait=isinstance(error, Exception), cancel_futures=True)
        raise
    pool.shutdown()


def _categories(server: Server, models: Models, target: Target, told: Told) -> dict[str, str]:
    """Return the category of each model; what was looked up before is not asked for again."""
    path = target.work / CATEGORIES_NAME
    try:
        known = {str(k): str(v) for k, v in json.loads(read_regular(path, 2**24)).items()}
    except (OSError, ValueError, AttributeError, RecursionError):
        known = {}
    keys = {name: f"{name} {file.sha256}" for name, file in models.items()}
    todo = [name for name in models if keys[name] not in known]
    try:
        with _threads(_LOOKS_AT_ONCE, server) as pool:
            found = pool.map(lambda name: _category(server, models[name]), todo)
            for done, name in enumerate(todo, 1 + len(models) - len(todo)):
                known[keys[name]] = next(found)
                told(done, len(models), f"which is what: {name}")
    finally:
        if todo:
            write_atomically(path, json.dumps(known, indent=0, sort_keys=True).encode())
    return {name: known[key] for name, key in keys.items()}


_NO_WORD = (
    *(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError),
    *(ValueError, KeyError, TypeError),
)
"""What Python's readers of archives and JSON raise; a RecursionError is a RuntimeError."""


def _category(server: Server, file: Published) -> str:
    """Return what meta.json in a published .zip calls its model; "" where it does not say."""
    try:
        with zipfile.ZipFile(RemoteFile(server, file.address, file.size or 0)) as archive:
            there = [i for i in archive.infolist() if PurePosixPath(i.filename).name == "meta.json"]
            info = min(there, key=lambda info: len(info.filename))
            usual = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
            if info.file_size > MAX_TEXT_BYTES or info.compress_type not in usual:
                return ""
            return str(json.loads(archive.read(info))["model_cat"])
    except _NO_WORD:
        return ""
