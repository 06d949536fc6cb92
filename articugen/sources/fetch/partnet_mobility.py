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
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from urllib.parse import quote

from articugen.core.errors import AccessRefused, InvalidArgument, InvalidSource, NotFetched
from articugen.core.files import UnfitFile, read_regular, write_atomically
from articugen.core.yaml_files import nearest
from articugen.meshes.model_files import MAX_TEXT_BYTES
from articugen.sources.fetch.hub import Published, files, hub
from articugen.sources.fetch.models import Unpacked, unpack
from articugen.sources.fetch.outcome import Fetched, outcome
from articugen.sources.fetch.target import CATEGORIES_NAME, TERMS_NAME, WORK_NAME, Target
from articugen.sources.fetch.terms import terms_of
from articugen.sources.fetch.web import RemoteFile, Server
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


@dataclass(frozen=True)
class _Model:
    object_id: str
    file: Published


def fetch_partnet_mobility(
    out: Path,
    *,
    categories: Collection[str] = (),
    ids: Collection[str] = (),
    token: str | None = None,
    via: str | None = None,
    told: Told = lambda *_: None,
    notice: Callable[[str], None] = lambda _: None,
) -> Fetched:
    """Download models, or what is missing of them.

    Args:
        out: a new folder, or one to go on in; each model becomes <out>/<id>.
        categories: by any of their names; "all" is every one.
        ids: these models; with categories, those of them that are of one.
        token: of the hub, or of SAPIEN's site; by default HF_TOKEN, or what `hf auth login` has
            kept; SAPIEN_ACCESS_TOKEN. Written nowhere.
        via: "hub" or "sapien"; by default the hub and, where that refuses and there is a
            SAPIEN_ACCESS_TOKEN, the site.
        told: called with the models that are done, all of them, and what is at hand.
        notice: called with a sentence where the second route is taken, or a folder is set aside.

    Raises:
        InvalidArgument: nothing is chosen, or there is no such model, category or route.
        AccessRefused, NotFetched: what is wanted cannot be got.
        MachineFault, MemoryError: the disk is full, or the like.
    """
    if via is not None and via not in ROUTES:
        raise InvalidArgument(f"no route {via!r}; there are: {', '.join(ROUTES)}")
    if not categories and not ids:
        raise InvalidArgument("nothing is chosen; name --category (or 'all', 3.3 GB) or --ids")
    with closing(Target(out, terms_of("partnet-mobility"), notice)) as target:
        if via != "sapien":
            try:
                return _from_hub(target, categories, ids, token, told)
            except NotFetched as error:
                second = via is None and ids and not categories
                if not second or not os.environ.get("SAPIEN_ACCESS_TOKEN"):
                    raise
                notice(f"{error}; trying SAPIEN's own site")
                token = None
        return _from_site(target, categories, ids, token, told)


def _from_hub(
    target: Target,
    categories: Collection[str],
    ids: Collection[str],
    token: str | None,
    told: Told,
) -> Fetched:
    server = hub(token, _HUB_CURE)
    listed = files(server, REPOSITORY)
    models = {
        match[1]: _Model(match[1], each)
        for each in listed
        if (match := re.fullmatch(r"(?:.*/)?([0-9]{1,9})\.zip", each.name))
    }
    for name in ids:
        if name not in models:
            raise InvalidArgument(
                f"PartNet-Mobility has no model {name!r}{nearest(name, list(models))}"
            )
    chosen = [m for name, m in models.items() if not ids or name in ids]
    if categories and "all" not in categories:
        chosen = _of_categories(chosen, categories, server, target, told)
    for each in listed:
        if _TERMS.fullmatch(each.name) and (each.size or 0) <= _MAX_TERMS_BYTES:
            to = target.path(f"{TERMS_NAME}/{each.name}")
            server.download(each.address, to, size=each.size, sha256=each.sha256)
    return _fetched(server, chosen, target, told)


def _from_site(
    target: Target,
    categories: Collection[str],
    ids: Collection[str],
    token: str | None,
    told: Told,
) -> Fetched:
    token = token or os.environ.get("SAPIEN_ACCESS_TOKEN", "").strip()
    if categories:
        raise InvalidArgument("SAPIEN's site gives models by id alone; name --ids, or --via hub")
    if not token:
        raise AccessRefused(f"SAPIEN's site wants a token; {_SITE_CURE}")
    for name in ids:
        if not re.fullmatch("[0-9]{1,9}", name):
            raise InvalidArgument(f"{name!r} is no id of PartNet-Mobility; they are numbers")
    base = os.environ.get("SAPIEN_ENDPOINT") or "https://sapien.ucsd.edu"
    server = Server(base.rstrip("/"), cure=_SITE_CURE)
    address = "/api/download/compressed/{}.zip?token=" + quote(token, safe="")
    models = [
        _Model(name, Published(f"{name}.zip", address.format(name), None, None))
        for name in sorted(set(ids))
    ]
    return _fetched(server, models, target, told)


def _fetched(server: Server, models: Sequence[_Model], target: Target, told: Told) -> Fetched:
    """Download, unpack and check what is missing, some files at once."""
    todo = [
        m
        for m in models
        if target.wants(PurePosixPath(m.object_id), m.file.sha256, m.object_id, m.object_id)
    ]
    new, there = 0, len(models) - len(todo)
    told(there, len(models), "")
    folder = target.path(f"{WORK_NAME}/downloads")
    queue = iter(todo)
    with _threads(_AT_ONCE, server) as pool:

        def started(how_many: int) -> dict[Future[str], _Model]:
            return {
                pool.submit(_download, server, m.file, folder / f"{m.object_id}.zip"): m
                for m in islice(queue, how_many)
            }

        running = started(2 * _AT_ONCE)
        while running:
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                model = running.pop(future)
                new += _taken_in(future, model, folder / f"{model.object_id}.zip", target)
                there += 1
                told(there, len(models), model.object_id)
            running |= started(len(ended))
    return outcome(target, [m.object_id for m in models], new)


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


def _download(server: Server, file: Published, to: Path) -> str:
    return server.download(file.address, to, size=file.size, sha256=file.sha256)


def _taken_in(coming: "Future[str]", model: _Model, path: Path, target: Target) -> int:
    """Unpack a model that came; how many models that is. What is wrong with one stops no other,
    but a token that is refused does."""
    place = PurePosixPath(model.object_id)
    taken: list[Unpacked] = []
    try:
        digest = coming.result()

        def take_in(unpacked: Unpacked, staged: Path) -> None:
            if taken:
                raise InvalidSource(f"{path.name}: holds more than one model; report it there")
            version = f"{REPOSITORY}@{model.file.version}/" if model.file.version else ""
            target.take_in(place, unpacked, staged, f"{version}{model.file.name}", digest)
            taken.append(unpacked)

        with target.unpacking() as folder:
            unpack(path, folder, lambda _: True, take_in)
    except AccessRefused:
        raise
    except (NotFetched, InvalidSource) as error:
        target.fail(model.object_id, error, path)
    path.unlink(missing_ok=True)
    return len(taken)


def _of_categories(
    models: Sequence[_Model],
    categories: Iterable[str],
    server: Server,
    target: Target,
    told: Told,
) -> list[_Model]:
    category_of = _categories(models, server, target, told)
    chosen: set[str] = set()
    for name in categories:
        wanted = common_categories().words(name)
        own = {i for i, category in category_of.items() if plain(category) in wanted}
        if not own:
            there = sorted({category for category in category_of.values() if category})
            raise unknown("PartNet-Mobility", name, there)
        chosen |= own
    return [m for m in models if m.object_id in chosen]


def _categories(
    models: Sequence[_Model], server: Server, target: Target, told: Told
) -> dict[str, str]:
    """Return the category of each model; what was looked up before is not asked for again."""
    path = target.work / CATEGORIES_NAME
    try:
        known = {str(k): str(v) for k, v in json.loads(read_regular(path, 2**24)).items()}
    except (UnfitFile, OSError, ValueError, AttributeError, RecursionError):
        known = {}
    keys = {m.object_id: f"{m.object_id} {m.file.sha256}" for m in models}
    todo = [m for m in models if keys[m.object_id] not in known]
    done = len(models) - len(todo)
    try:
        with _threads(_LOOKS_AT_ONCE, server) as pool:
            for model, category in zip(
                todo, pool.map(lambda m: _category(server, m.file), todo), strict=True
            ):
                known[keys[model.object_id]] = category
                done += 1
                told(done, len(models), f"which is what: {model.object_id}")
    finally:
        if todo:
            write_atomically(path, json.dumps(known, indent=0, sort_keys=True).encode())
    return {m.object_id: known[keys[m.object_id]] for m in models}


_NO_WORD = (
    *(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError),
    *(ValueError, KeyError, TypeError),
)
"""What Python's readers of archives and JSON raise; a RecursionError is a RuntimeError."""


def _category(server: Server, file: Published) -> str:
    """What meta.json in a published .zip calls its model; "" where it does not say."""
    try:
        with zipfile.ZipFile(RemoteFile(server, file.address, file.size or 0)) as archive:
            found = [i for i in archive.infolist() if PurePosixPath(i.filename).name == "meta.json"]
            first = min(found, key=lambda info: len(info.filename), default=None)
            usual = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
            if first is None or first.file_size > MAX_TEXT_BYTES:
                return ""
            if first.compress_type not in usual:
                return ""
            return str(json.loads(archive.read(first))["model_cat"])
    except _NO_WORD:
        return ""
