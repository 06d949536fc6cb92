"""`articugen fetch` against publishers on this machine; nothing else is asked."""

import gzip
import hashlib
import json
import logging
import os
import resource
import signal
import subprocess
import sys
import tarfile
import time
from contextlib import contextmanager
from pathlib import Path

import command_line
import pytest

import articugen as ag
from articugen.core.errors import InvalidArgument, MachineFault
from articugen.core.files import lock_folder
from articugen.core.ledger import Ledger
from articugen.core.place import Folder as LocalFolder
from articugen.sources.fetch import web
from articugen.sources.fetch.web import Server
from articugen.sources.source import open_source
from tests.published import TOKEN, Publisher, model_files, serving, zipped

LAPTOPS = ("9748", "10040")
CATEGORY = {"9748": "Laptop", "10040": "Laptop", "7138": "Oven", "45213": "StorageFurniture"}


def published(**more) -> Publisher:
    """Four models, two in a folder of their own within their .zip, as SAPIEN's are, and terms."""
    files = {
        f"{name}.zip": zipped(model_files(kind), folder=f"{name}/" if name[0] in "94" else "")
        for name, kind in CATEGORY.items()
    }
    return Publisher({**files, "README.md": b"non-commercial research only\n"}, **more)


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """Next to no time between tries."""
    monkeypatch.setattr(web, "WAITS", (0.0, 0.01, 0.01, 0.01))


@pytest.fixture
def hub(monkeypatch):
    """The hub, whose files lie on a second server; HF_ENDPOINT and HF_TOKEN lead there."""
    cdn = published(token="")
    with serving(Publisher(cdn.files, cdn=cdn)) as there:
        monkeypatch.setenv("HF_ENDPOINT", there.base)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.delenv("SAPIEN_ACCESS_TOKEN", raising=False)
        yield there


@pytest.fixture
def site(monkeypatch):
    """SAPIEN's own site."""
    with serving(published(token="sapien-secret")) as there:
        monkeypatch.setenv("SAPIEN_ENDPOINT", there.base)
        yield there


def run(*arguments: object):
    return command_line.run("fetch", *arguments)


def unpacked(source: str, out: Path, *archives: Path):
    return run(source, *(word for path in archives for word in ("--from", path)), "-o", out)


def partnet(out: Path, ids: str = "9748", *more: object):
    return run("partnet-mobility", "--ids", ids, "-o", out, *more)


def files_in(folder: Path) -> dict[str, bytes]:
    """All visible files below a folder."""
    return {
        name: path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and "/." not in f"/{(name := path.relative_to(folder).as_posix())}"
    }


def whole(folder: Path, *ids: str) -> bool:
    return all(files_in(folder / name) == model_files(CATEGORY[name]) for name in ids)


def test_a_category_comes_whole_with_its_terms_and_can_be_used(hub, tmp_path):
    done = run("partnet-mobility", "-c", "laptop", "-o", tmp_path)
    assert done.exit_code == 0, done.output
    assert "research and education only" in done.output
    assert "2 models, 2 of them new, 2 sound" in done.output
    assert whole(tmp_path, *LAPTOPS)
    listed = json.loads((tmp_path / "fetched.json").read_text())
    assert set(listed["models"]) == set(LAPTOPS)
    assert "research" in listed["terms"]["partnet-mobility"]["licence"]
    digest = hashlib.sha256(hub.files["9748.zip"]).hexdigest()
    assert listed["models"]["9748"]["archive_sha256"] == digest
    assert "9748.zip" in listed["models"]["9748"]["archive"]
    assert (tmp_path / "terms" / "README.md").read_bytes() == hub.files["README.md"]
    assert {ref.object_id for ref in open_source(tmp_path).objects("Laptop")} == set(LAPTOPS)
    assert not list((tmp_path / ".fetch" / "downloads").iterdir())


def test_the_list_is_the_same_wherever_and_whenever(hub, tmp_path):
    bad = {"1.zip": zipped({**model_files(), "../a": b""}), "3.zip": zipped({"m.urdf": b"<robot"})}
    hub.files.update(bad)
    for name in "ab":
        (tmp_path / name / "10040").mkdir(parents=True)
        done = run("partnet-mobility", "--ids", "9748,10040,1,3", "-o", tmp_path / name)
        assert done.exit_code == 3
    text = (tmp_path / "a" / "fetched.json").read_text()
    assert text == (tmp_path / "b" / "fetched.json").read_text()
    assert str(tmp_path) not in text
    assert set(json.loads(text)["failed"]) == {"1", "10040"}


def test_called_again_it_asks_for_what_is_missing_alone(hub, tmp_path):
    run("partnet-mobility", "-c", "laptop", "-o", tmp_path)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.glob("*/textured_objs/a.obj")}
    hub.asked.clear()
    again = run("partnet-mobility", "-c", "Laptop", "-o", tmp_path)
    assert again.exit_code == 0
    assert "2 models, 0 of them new" in again.output
    assert not [path for path, _ in hub.asked if ".zip" in path]
    assert {p: p.stat().st_mtime_ns for p in before} == before
    (tmp_path / "9748" / "textured_objs" / "a.obj").unlink()
    assert "2 models, 1 of them new" in partnet(tmp_path, "9748,10040").output
    assert whole(tmp_path, *LAPTOPS)


def test_only_the_end_of_an_archive_is_read_to_know_its_category_and_once(hub, tmp_path):
    run("partnet-mobility", "-c", "laptop", "-o", tmp_path)
    size = len(hub.files["7138.zip"])
    assert hub.cdn.bytes_of("7138.zip")[0] == f"bytes={size - 2**16}-{size - 1}"
    assert all(hub.cdn.bytes_of("7138.zip"))
    hub.asked.clear()
    assert run("partnet-mobility", "-c", "storage furniture", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "45213")
    assert not [path for path, _ in hub.asked if ".zip" in path and "45213.zip" not in path]


@pytest.mark.parametrize("after", [[0], [1], [70_000], [70_000, 10, 0, 5000]])
def test_a_cut_connection_is_gone_on_from(hub, tmp_path, after):
    hub.cdn.cut["9748.zip"] = list(after)
    assert partnet(tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")
    have, expected = 0, [""]
    for cut in after:
        have += cut
        expected.append(f"bytes={have}-" if have else "")
    assert hub.cdn.bytes_of("9748.zip") == expected


def test_a_server_that_knows_no_ranges_gives_the_file_anew(hub, tmp_path):
    hub.cdn.cut["9748.zip"], hub.cdn.ranges = [70_000], False
    assert partnet(tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")


def test_what_came_before_the_line_went_dead_is_kept_and_its_digest_checked(hub, tmp_path):
    hub.cdn.cut["9748.zip"] = [50_000, 0, 0, 0, 0, 0]
    done = partnet(tmp_path)
    assert done.exit_code == 1
    assert "cannot be got (the connection was cut); what came is kept" in done.output
    part = tmp_path / ".fetch" / "downloads" / "9748.zip"
    part.write_bytes(b"?" + part.read_bytes()[1:])
    hub.cdn.cut.clear()
    hub.cdn.asked.clear()
    done = partnet(tmp_path, "9748,10040")
    assert done.exit_code == 3
    assert hub.cdn.bytes_of("9748.zip") == ["bytes=50000-"]
    assert "another digest than its publisher states" in done.output
    assert not part.exists()
    assert partnet(tmp_path).exit_code == 0
    assert whole(tmp_path, *LAPTOPS)


def test_a_busy_server_is_asked_again(hub, tmp_path):
    hub.busy = 3
    assert partnet(tmp_path).exit_code == 0


def give_token(monkeypatch, folder: Path, where: str, token: str) -> list[str]:
    """Put a token where fetch finds it; the options that it takes for that."""
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setenv("HF_TOKEN_PATH", str(folder / "token"))
    if where == "HF_TOKEN":
        monkeypatch.setenv("HF_TOKEN", token)
    if where == "HF_TOKEN_PATH":
        (folder / "token").write_text(f"{token}\n")
    return ["--token", token] if where == "option" else []


WHERE = pytest.mark.parametrize("where", ["option", "HF_TOKEN", "HF_TOKEN_PATH"])


@WHERE
@pytest.mark.parametrize("token", ["hf_wrong", ""])
def test_a_wrong_token_or_none_is_reported_with_the_cure(hub, tmp_path, monkeypatch, where, token):
    done = partnet(tmp_path / "out", "9748", *give_token(monkeypatch, tmp_path, where, token))
    assert done.exit_code == 1
    assert ("granted (403)" if token else "wrong (401)") in done.output
    assert "accept the terms of sapien-sim/PartNetMobility" in done.output
    assert not (tmp_path / "out" / "9748").exists()


@WHERE
def test_the_token_is_shown_to_nobody_else(hub, tmp_path, monkeypatch, where, caplog):
    hub.files["666.zip"] = b"no zip"
    options = give_token(monkeypatch, tmp_path, where, TOKEN)
    with caplog.at_level(logging.DEBUG):
        done = partnet(tmp_path / "out", "9748,666", *options)
    assert done.exit_code == 3, done.output
    assert not [h for _, h in hub.cdn.asked if "Authorization" in h]
    assert all(h["Authorization"] == f"Bearer {TOKEN}" for p, h in hub.asked if "/resolve/" in p)
    assert TOKEN not in done.output + caplog.text + repr(Server("x", token=TOKEN))
    assert not [p for p in (tmp_path / "out").rglob("*") if p.is_file() and TOKEN in read(p)]


def test_the_token_goes_along_to_another_place_on_the_same_server(hub, tmp_path):
    hub.moved |= {"README.md", "9748.zip"}
    done = partnet(tmp_path)
    assert done.exit_code == 0, done.output
    assert whole(tmp_path, "9748")
    assert not [h for _, h in hub.cdn.asked if "Authorization" in h]


def read(path: Path) -> str:
    return path.read_bytes().decode("latin-1")


def test_one_file_that_is_gone_stops_no_other(hub, tmp_path):
    hub.status["9748.zip"] = 404
    done = partnet(tmp_path, "9748,10040")
    assert done.exit_code == 3
    assert "not fetched 9748: http://127.0.0.1" in done.output
    assert "is not there (404)" in done.output
    assert whole(tmp_path, "10040")
    assert "9748" in json.loads((tmp_path / "fetched.json").read_text())["failed"]


def test_a_hostile_archive_and_an_unsound_model_are_told_apart(hub, tmp_path):
    hub.files["1.zip"] = hub.cdn.files["1.zip"] = zipped({**model_files(), "../2/a": b"x"})
    unsound = model_files() | {"textured_objs/a.obj": b"v 0 0 nan\nf 1 1 1\n"}
    hub.files["3.zip"] = hub.cdn.files["3.zip"] = zipped(unsound)
    done = partnet(tmp_path, "1,3,9748")
    assert done.exit_code == 3
    assert "not fetched 1: 1.zip: its entry '../2/a' leads out of the folder" in done.output
    assert "refused 3: 3/textured_objs/a.obj" in done.output
    assert "2 models, 2 of them new, 1 sound" in done.output
    assert not (tmp_path / "1").exists()
    assert not (tmp_path / "2").exists()


def test_a_folder_that_was_not_fetched_is_left_alone(hub, tmp_path):
    (tmp_path / "9748").mkdir()
    (tmp_path / "9748" / "mine.txt").write_text("mine")
    done = partnet(tmp_path, "9748,10040")
    assert "is there, and was not fetched; move it away" in done.output
    assert files_in(tmp_path / "9748") == {"mine.txt": b"mine"}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["partnet-mobility"], "nothing is chosen; name --category"),
        (["partnet-mobility", "--ids", "9749"], "has no model '9749'; did you mean '9748'?"),
        (["partnet-mobility", "-c", "laptob"], "has no category 'laptob'; did you mean 'laptop'?"),
        (["partnet-mobility", "--ids", "1", "--via", "ftp"], "no route 'ftp'; there are: hub, "),
        (["shape2motion"], "is not downloaded from here; get its archives from its authors"),
        (["shapenet"], "no data set 'shapenet'; did you mean 'shape2motion'?"),
        (["shape2motion", "--from", "no.zip"], "no.zip: cannot be read: No such file"),
        (["shape2motion", "--from", "no.zip", "--ids", "1"], "--from takes all models"),
    ],
)
def test_what_there_is_not_is_told_in_a_sentence(hub, tmp_path, arguments, sentence):
    done = run(*arguments, "-o", tmp_path)
    assert done.exit_code == 1
    assert sentence in done.output


SITE = ("--via", "sapien", "--token", "sapien-secret")


def test_the_site_gives_models_by_id(site, tmp_path):
    assert partnet(tmp_path, "9748,45213", *SITE).exit_code == 0
    assert whole(tmp_path, "9748", "45213")
    assert "sapien-secret" not in read(tmp_path / "fetched.json")
    site.asked.clear()
    assert "0 of them new" in partnet(tmp_path, "9748", *SITE).output
    assert not site.asked


def test_the_site_is_the_second_route_where_the_hub_refuses(hub, site, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    monkeypatch.setenv("SAPIEN_ACCESS_TOKEN", "sapien-secret")
    done = partnet(tmp_path)
    assert done.exit_code == 0, done.output
    assert "trying SAPIEN's own site" in done.output
    assert whole(tmp_path, "9748")
    assert partnet(tmp_path / "2", "9748", "--via", "hub").exit_code == 1


def test_a_cut_at_the_site_is_gone_on_from_within_a_call(site, tmp_path):
    site.cut["9748.zip"] = [70_000]
    assert partnet(tmp_path, "9748", *SITE).exit_code == 0
    assert site.bytes_of("9748.zip") == ["", "bytes=70000-"]
    assert whole(tmp_path, "9748")


@pytest.mark.parametrize(
    ("token", "sentence"), [("wrong", "not granted (403)"), (None, "wants a token")]
)
def test_the_sites_token_is_told_to_nobody(site, tmp_path, token, sentence, monkeypatch):
    monkeypatch.delenv("SAPIEN_ACCESS_TOKEN", raising=False)
    done = partnet(tmp_path, "9748", "--via", "sapien", *(["--token", token] if token else []))
    assert done.exit_code == 1
    assert sentence in done.output
    assert "token=" not in done.output


def test_as_a_function(hub, tmp_path):
    seen = []
    done = ag.fetch(
        "partnet-mobility", tmp_path, ids=LAPTOPS, on_progress=lambda *at: seen.append(at)
    )
    assert (done.models, done.new, done.refused, done.failed) == (2, 2, {}, {})
    assert whole(tmp_path, *LAPTOPS)
    assert seen[-1][:2] == (2, 2)
    with pytest.raises(InvalidArgument, match=r"ids='9748': must be a list: ids=\['9748'\]"):
        ag.fetch("partnet-mobility", tmp_path, ids="9748")


def test_two_do_not_fetch_into_one_folder(hub, tmp_path):
    partnet(tmp_path)
    lock = lock_folder(tmp_path / ".fetch")
    done = partnet(tmp_path)
    os.close(lock)
    assert done.exit_code == 1
    assert "another run is writing here" in done.output


def test_files_that_may_not_grow_so_large(hub, tmp_path, monkeypatch):
    """The limit of file sizes is a process's own, and has no need of root."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # it would be cut short
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, before[1]))
    try:
        with pytest.raises(MachineFault, match="not written: files may not grow so large"):
            ag.fetch("partnet-mobility", tmp_path, ids=["9748"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert ag.fetch("partnet-mobility", tmp_path, ids=["9748"]).models == 1


@contextmanager
def fetching_until(hub, folder: Path, *ids: str):
    """A process that fetches models, once a part of 7138, and all others, have come."""
    hub.cdn.stall["7138.zip"] = 30_000
    parts = [folder / ".fetch" / "downloads" / "7138.zip"]
    parts += [folder / name / "mobility.urdf" for name in ids if name != "7138"]
    command = [sys.executable, "-m", "articugen", "fetch", "partnet-mobility"]
    command += ["--ids", ",".join(ids), "-o", str(folder)]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as process:  # pyright: ignore
        while process.poll() is None and not all(path.exists() for path in parts):
            time.sleep(0.01)
        yield process
    hub.cdn.stall.clear()


def test_killed_in_the_midst_of_a_file_and_called_again_it_goes_on(hub, tmp_path):
    with fetching_until(hub, tmp_path, *CATEGORY) as process:
        process.kill()
    assert whole(tmp_path, "9748", "10040", "45213")
    assert not (tmp_path / "7138").exists()
    have = (tmp_path / ".fetch" / "downloads" / "7138.zip").stat().st_size
    hub.cdn.asked.clear()
    done = ag.fetch("partnet-mobility", tmp_path, ids=list(CATEGORY))
    assert (done.models, done.new, done.failed, done.refused) == (4, 1, {}, {})
    assert whole(tmp_path, *CATEGORY)
    assert hub.cdn.bytes_of("7138.zip") == [f"bytes={have}-" if have else ""]
    assert set(json.loads(read(tmp_path / "fetched.json"))["models"]) == set(CATEGORY)


def test_a_server_that_says_nothing_keeps_no_one_who_wants_to_leave(hub, tmp_path):
    """SIGTERM, or Ctrl-C, while a file does not come on."""
    with fetching_until(hub, tmp_path, "7138") as process:
        process.terminate()
        assert process.wait(timeout=5.0) == 143  # what it waits for would take 10 s
        assert "interrupted; the same command goes on" in process.communicate()[1]
    assert ag.fetch("partnet-mobility", tmp_path, ids=["7138"]).models == 1
    assert whole(tmp_path, "7138")


def test_killed_while_it_unpacks_leaves_no_half_model(hub, tmp_path):
    """What a killed process was unpacking has no name yet, and is gone after the next call."""
    half = tmp_path / ".fetch" / "unpacking" / "1234" / "0" / "9748"
    half.mkdir(parents=True)
    (half / "mobility.urdf").write_text("<rob")
    assert partnet(tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")
    assert not half.exists()


def test_archives_of_many_models_keep_their_folders(tmp_path):
    files = {f"laptop/{k}/{n}": d for k in ("0001", "0002") for n, d in shape2motion().items()}
    (tmp_path / "s2m.zip").write_bytes(zipped(files))
    done = unpacked("shape2motion", tmp_path / "out", tmp_path / "s2m.zip")
    assert done.exit_code == 0, done.output
    assert "research only" in done.output
    there = {ref.object_id for ref in open_source(tmp_path / "out").objects("laptop")}
    assert there == {"0001", "0002"}
    again = unpacked("shape2motion", tmp_path / "out", tmp_path / "s2m.zip")
    assert "2 models, 0 of them new" in again.output


def shape2motion() -> dict[str, bytes]:
    door = {"dof_name": "dof_rootd_Aa001_r", "motion_type": "rotation", "children": None}
    door |= {"center": [0, 0, 1], "direction": [0, 1, 0]}
    root = {"dof_name": "dof_rootd", "motion_type": "none", "children": [door]}
    root |= {"center": [0, 0, 0], "direction": [0, 0, 0]}
    shape = model_files()["textured_objs/a.obj"]
    return {
        "motion_attributes.json": json.dumps(root).encode(),
        "part_objs/none_motion.obj": shape,
        "part_objs/dof_rootd_Aa001_r.obj": shape,
    }


@pytest.fixture
def elsewhere(tmp_path):
    """A folder beside the one that is fetched into, to which links lead; it stays as it is."""
    folder = tmp_path / "elsewhere"
    (folder / "unpacking").mkdir(parents=True)
    for name in ("mine.txt", "unpacking/mine.txt", ".fetched.json.01234567.partial"):
        (folder / name).write_text(name)
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    yield folder
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize(
    ("link", "to"),
    [
        (".articugen", ""),
        (".fetch", ""),
        (".fetch/unpacking", "unpacking"),
        (".fetch/downloads", ""),
        (".fetch/downloads/9748.zip", "mine.txt"),
        ("terms", ""),
        ("9748", ""),
    ],
)
def test_no_link_is_followed_by_what_writes_or_deletes(hub, tmp_path, elsewhere, link, to):
    path = tmp_path / "out" / link
    path.parent.mkdir(parents=True)
    path.symlink_to(elsewhere / to)
    done = partnet(tmp_path / "out")
    assert done.exit_code == 1
    assert done.output.count("symbolic link") == 1 or "Too many levels of symbolic" in done.output
    assert path.is_symlink()


def test_no_link_is_followed_to_a_category(tmp_path, elsewhere):
    (tmp_path / "a.zip").write_bytes(zipped(shape2motion(), folder="laptop/0001/"))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "laptop").symlink_to(elsewhere)
    done = unpacked("shape2motion", tmp_path / "out", tmp_path / "a.zip")
    assert "laptop/0001: 'laptop' in it is a symbolic link" in done.output


def test_a_file_of_ones_own_stays_and_is_set_aside_where_a_new_version_comes(hub, tmp_path):
    partnet(tmp_path)
    (tmp_path / "9748" / "notes.txt").write_text("mine")
    assert "1 models, 0 of them new" in partnet(tmp_path).output
    before = files_in(tmp_path / "9748")
    hub.files["9748.zip"] = hub.cdn.files["9748.zip"] = zipped(model_files("Oven"))
    done = partnet(tmp_path)
    assert "9748: was of another version, or had changed; it is in" in done.output
    assert files_in(tmp_path / "9748") == model_files("Oven")
    (aside,) = (tmp_path / ".set-aside").glob("*/9748")
    assert files_in(aside) == before
    assert {ref.object_id for ref in open_source(tmp_path).objects("Oven")} == {"9748"}


def test_a_model_in_a_models_folder_is_refused_and_the_outer_one_stays_whole(tmp_path):
    files = {f"{at}/{n}": d for at in ("x", "x/y", "z") for n, d in shape2motion().items()}
    (tmp_path / "a.zip").write_bytes(zipped(files))
    (tmp_path / "b.zip").write_bytes(zipped(shape2motion(), folder="x/y/"))
    for name, counts in (("a", "2 models, 2 of"), ("a", "2 models, 0 of"), ("b", "error:")):
        done = unpacked("shape2motion", tmp_path / "out", tmp_path / f"{name}.zip")
        assert counts in done.output
        assert "x/y: lies in the folder of another model, x;" in done.output
        assert files_in(tmp_path / "out" / "x") == shape2motion()


@pytest.mark.parametrize("names", ["00", "01"])
def test_two_models_of_one_place_are_not_taken_for_each_other(tmp_path, names):
    """In one archive, or in two."""
    files: dict[str, dict[str, bytes]] = {name: {} for name in names}
    for name, folder, category in zip(names, "ab", ("", "Oven"), strict=True):
        files[name] |= {f"{folder}/7128/{n}": data for n, data in model_files(category).items()}
    for name, there in files.items():
        (tmp_path / f"{name}.zip").write_bytes(zipped(there))
    for _ in range(2):
        archives = (tmp_path / f"{name}.zip" for name in files)
        done = unpacked("partnet-mobility", tmp_path / "out", *archives)
        assert done.exit_code == 3
        assert "7128: is where another model goes, 0.zip/a/7128; rename" in done.output
        assert files_in(tmp_path / "out" / "7128") == model_files("")


@pytest.mark.parametrize(
    "name", ["fetched.json/m", "fetched.json", "Fetched.JSON", "terms/m", "terms", ".zip", "...zip"]
)
def test_a_model_is_called_as_nothing_that_fetch_keeps_is(tmp_path, name):
    bad, good = tmp_path / (name if name.endswith("zip") else "bad.zip"), tmp_path / "good.zip"
    bad.write_bytes(zipped(shape2motion(), folder="" if name.endswith("zip") else f"{name}/"))
    good.write_bytes(zipped(shape2motion(), folder="laptop/1/"))
    done = unpacked("shape2motion", tmp_path / "out", bad, good)
    assert done.exit_code == 3, done.output
    assert "no model can be called so here; rename its folder" in done.output
    assert set(json.loads(read(tmp_path / "out" / "fetched.json"))["models"]) == {"laptop/1"}


def test_whatever_an_archive_is_the_next_one_is_unpacked(tmp_path):
    nested = tarfile.TarInfo("pax")
    nested.type = tarfile.XHDTYPE
    (tmp_path / "nested.tar.gz").write_bytes(gzip.compress(nested.tobuf() * 4000))
    os.mkfifo(tmp_path / "fifo.zip")
    (tmp_path / "\udcff.zip").write_bytes(b"no zip")
    (tmp_path / "1\udcff.zip").write_bytes(zipped(model_files()))
    (tmp_path / "good.zip").write_bytes(zipped(model_files(), folder="9748/"))
    names = ("nested.tar.gz", "fifo.zip", "\udcff.zip", "1\udcff.zip", "nul\0.zip", "good.zip")
    done = ag.fetch(
        "partnet-mobility", tmp_path / "out", archives=[tmp_path / name for name in names]
    )
    assert (done.models, done.new, len(done.failed)) == (1, 1, 5)
    assert files_in(tmp_path / "out" / "9748") == model_files()
    assert all("; " in why and why.isprintable() for why in done.failed.values())
    assert json.loads((tmp_path / "out" / "fetched.json").read_text())["failed"] == done.failed


@pytest.mark.parametrize(
    "change",
    [{"source": "nobody's"}, {"sizes": {"../../x": 3}}, {"sizes": {"\0": 3}}, {"sizes": {}}, None],
)
def test_a_receipt_that_another_wrote_is_none(hub, tmp_path, change):
    ag.fetch("partnet-mobility", tmp_path, ids=["9748"])
    ledger = Ledger(LocalFolder(tmp_path))
    data = json.dumps(json.loads(ledger.known()["9748"]) | (change or {})).encode()
    ledger.record("9748", data if change else b"[" * 100_000)
    again = ag.fetch("partnet-mobility", tmp_path, ids=["9748"])
    assert (again.models, again.new) == (1, 1)
    (record,) = (tmp_path / ".articugen" / "done").iterdir()
    record.write_bytes(record.read_bytes()[:-9])
    assert ag.fetch("partnet-mobility", tmp_path, ids=["9748"]).new == 1
