"""`articugen fetch` against publishers on this machine; nothing else is asked."""

import hashlib
import io
import json
import logging
import os
import resource
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

import articugen as ag
from articugen.cli import app
from articugen.errors import AccessRefused, InvalidArgument, MachineFault, NotFetched
from articugen.fetching import partnet_mobility, web
from articugen.fetching.hub import Published
from articugen.fetching.partnet_mobility import fetch_partnet_mobility
from articugen.fetching.target import RECEIPT_NAME
from articugen.fetching.web import RemoteFile, Server
from articugen.sources.registry import object_refs
from tests.published import TOKEN, Publisher, model_files, serving, zipped
from tests.trouble import small_disk

LAPTOPS = ("9748", "10040")
CATEGORY = {"9748": "Laptop", "10040": "Laptop", "7138": "Oven", "45213": "StorageFurniture"}


def published(**more) -> Publisher:
    """Four models, two in a folder of their own within their .zip, as SAPIEN's are, and terms."""
    files = {
        f"{name}.zip": zipped(model_files(kind), folder=f"{name}/" if name[0] in "94" else "")
        for name, kind in CATEGORY.items()
    }
    return Publisher({**files, "README.md": b"non-commercial research only\n"}, **more)


@pytest.fixture
def hub(monkeypatch):
    """The hub, whose files lie on a second server; HF_ENDPOINT and HF_TOKEN lead there."""
    cdn = published(token="")
    with serving(Publisher(cdn.files, cdn=cdn)) as there:
        monkeypatch.setenv("HF_ENDPOINT", there.base)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.delenv("SAPIEN_ACCESS_TOKEN", raising=False)
        monkeypatch.setattr(web, "WAITS", (0.0, 0.01, 0.01, 0.01))
        yield there


@pytest.fixture
def site(monkeypatch):
    """SAPIEN's own site."""
    with serving(published(token="sapien-secret")) as there:
        monkeypatch.setenv("SAPIEN_ENDPOINT", there.base)
        monkeypatch.setattr(web, "WAITS", (0.0, 0.01, 0.01, 0.01))
        yield there


def run(*arguments: object):
    return CliRunner().invoke(app, ["fetch", *map(str, arguments)])


def files_in(folder: Path) -> dict[str, bytes]:
    """All visible files below a folder."""
    return {
        name: path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and "/." not in f"/{(name := path.relative_to(folder).as_posix())}"
    }


def whole(folder: Path, *ids: str) -> bool:
    return all(files_in(folder / name) == model_files(CATEGORY[name]) for name in ids)


# ------------------------------------------------------------------ the hub


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
    assert {ref.object_id for ref in object_refs(tmp_path, "Laptop")} == set(LAPTOPS)
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


def test_called_again_it_asks_for_no_file_and_changes_nothing(hub, tmp_path):
    run("partnet-mobility", "-c", "laptop", "-o", tmp_path)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.glob("*/textured_objs/a.obj")}
    hub.asked.clear()
    again = run("partnet-mobility", "-c", "Laptop", "-o", tmp_path)
    assert again.exit_code == 0
    assert "2 models, 0 of them new" in again.output
    assert not [path for path, _ in hub.asked if ".zip" in path]
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_another_category_looks_no_model_up_twice(hub, tmp_path):
    run("partnet-mobility", "-c", "laptop", "-o", tmp_path)
    hub.asked.clear()
    assert run("partnet-mobility", "-c", "storage furniture", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "45213")
    assert [path for path, _ in hub.asked if ".zip" in path] == [
        path for path, _ in hub.asked if "45213.zip" in path
    ]


def test_only_the_end_of_an_archive_is_read_to_know_its_category(hub, tmp_path):
    run("partnet-mobility", "-c", "laptop", "-o", tmp_path)
    asked = hub.cdn.bytes_of("7138.zip")
    assert asked
    assert all(asked)
    size = len(hub.files["7138.zip"])
    assert asked[0] == f"bytes={size - 2**16}-{size - 1}"


def test_ids_alone_need_no_category(hub, tmp_path):
    assert run("partnet-mobility", "--ids", "9748, 7138", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "9748", "7138")
    assert not (tmp_path / "10040").exists()


@pytest.mark.parametrize("after", [[0], [1], [70_000], [70_000, 10, 0, 5000]])
def test_a_cut_connection_is_gone_on_from(hub, tmp_path, after):
    hub.cdn.cut["9748.zip"] = list(after)
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")
    have, expected = 0, [""]
    for cut in after:
        have += cut
        expected.append(f"bytes={have}-" if have else "")
    assert hub.cdn.bytes_of("9748.zip") == expected


def test_a_server_that_knows_no_ranges_gives_the_file_anew(hub, tmp_path):
    hub.cdn.cut["9748.zip"], hub.cdn.ranges = [70_000], False
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")


def test_what_came_before_the_line_went_dead_is_kept_for_the_next_call(hub, tmp_path):
    hub.cdn.cut["9748.zip"] = [50_000, 0, 0, 0, 0, 0]
    done = run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
    assert done.exit_code == 1
    assert "cannot be got (the connection was cut); what came is kept" in done.output
    hub.cdn.cut.clear()
    hub.cdn.asked.clear()
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert hub.cdn.bytes_of("9748.zip") == ["bytes=50000-"]
    assert whole(tmp_path, "9748")


def test_a_partial_file_of_another_version_is_found_out(hub, tmp_path):
    part = tmp_path / ".fetch" / "downloads" / ".9748.zip.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"?" * 1000)
    done = run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
    assert done.exit_code == 1
    assert "another digest than its publisher tells" in done.output
    assert not part.exists()
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0


def test_a_busy_server_is_asked_again(hub, tmp_path):
    hub.busy = 3
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")


@pytest.mark.parametrize("where", ["option", "HF_TOKEN", "HF_TOKEN_PATH"])
@pytest.mark.parametrize("token", ["hf_wrong", ""])
def test_a_wrong_token_or_none_is_told_with_the_cure(hub, tmp_path, monkeypatch, where, token):
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setenv("HF_TOKEN_PATH", str(tmp_path / "token"))
    if where == "HF_TOKEN":
        monkeypatch.setenv("HF_TOKEN", token)
    elif where == "HF_TOKEN_PATH":
        (tmp_path / "token").write_text(f"{token}\n")
    given = ["--token", token] if where == "option" else []
    done = run("partnet-mobility", "--ids", "9748", "-o", tmp_path / "out", *given)
    assert done.exit_code == 1
    status = "granted (403)" if token else "wrong (401)"
    assert status in done.output
    assert "accept the terms of sapien-sim/PartNetMobility" in done.output
    assert not (tmp_path / "out" / "9748").exists()


@pytest.mark.parametrize("where", ["option", "HF_TOKEN", "HF_TOKEN_PATH"])
def test_the_token_is_found_and_told_to_nobody_else(hub, tmp_path, monkeypatch, where, caplog):
    monkeypatch.delenv("HF_TOKEN")
    given = ["--token", TOKEN] if where == "option" else []
    if where == "HF_TOKEN":
        monkeypatch.setenv(where, TOKEN)
    elif where == "HF_TOKEN_PATH":
        monkeypatch.setenv(where, str(tmp_path / "token"))
        (tmp_path / "token").write_text(f"{TOKEN}\n")
    hub.files["666.zip"] = b"no zip"
    with caplog.at_level(logging.DEBUG):
        done = run("partnet-mobility", "--ids", "9748,666", "-o", tmp_path / "out", *given)
    assert done.exit_code == 3, done.output
    assert not [h for _, h in hub.cdn.asked if "Authorization" in h]
    assert all(h["Authorization"] == f"Bearer {TOKEN}" for p, h in hub.asked if "/resolve/" in p)
    assert TOKEN not in done.output + caplog.text + repr(Server("x", token=TOKEN))
    assert not [p for p in (tmp_path / "out").rglob("*") if p.is_file() and TOKEN in read(p)]


def test_the_token_goes_along_to_another_place_on_the_same_server(hub, tmp_path):
    hub.moved |= {"README.md", "9748.zip"}
    done = run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
    assert done.exit_code == 0, done.output
    assert whole(tmp_path, "9748")
    assert not [h for _, h in hub.cdn.asked if "Authorization" in h]


def read(path: Path) -> str:
    return path.read_bytes().decode("latin-1")


def test_one_file_that_is_gone_stops_no_other(hub, tmp_path):
    hub.status["9748.zip"] = 404
    done = run("partnet-mobility", "--ids", "9748,10040", "-o", tmp_path)
    assert done.exit_code == 3
    assert "not fetched 9748: http://127.0.0.1" in done.output
    assert "is not there (404)" in done.output
    assert whole(tmp_path, "10040")
    assert "9748" in json.loads((tmp_path / "fetched.json").read_text())["failed"]


def test_a_file_that_is_not_what_its_publisher_tells_is_not_taken(hub, tmp_path):
    hub.lie.add("9748.zip")
    done = run("partnet-mobility", "--ids", "9748,10040", "-o", tmp_path)
    assert done.exit_code == 3
    assert "another digest" in done.output
    assert not (tmp_path / "9748").exists()


def test_a_hostile_archive_and_an_unsound_model_are_told_apart(hub, tmp_path):
    hub.files["1.zip"] = hub.cdn.files["1.zip"] = zipped({**model_files(), "../2/a": b"x"})
    unsound = model_files() | {"textured_objs/a.obj": b"v 0 0 nan\nf 1 1 1\n"}
    hub.files["3.zip"] = hub.cdn.files["3.zip"] = zipped(unsound)
    done = run("partnet-mobility", "--ids", "1,3,9748", "-o", tmp_path)
    assert done.exit_code == 3
    assert "not fetched 1: 1.zip: its entry '../2/a' leads out of the folder" in done.output
    assert "refused 3: 3/textured_objs/a.obj" in done.output
    assert "2 models, 2 of them new, 1 sound" in done.output
    assert not (tmp_path / "1").exists()
    assert not (tmp_path / "2").exists()


def test_a_model_with_a_file_missing_is_fetched_again(hub, tmp_path):
    run("partnet-mobility", "--ids", "9748,10040", "-o", tmp_path)
    (tmp_path / "9748" / "textured_objs" / "a.obj").unlink()
    done = run("partnet-mobility", "--ids", "9748,10040", "-o", tmp_path)
    assert "2 models, 1 of them new" in done.output
    assert whole(tmp_path, *LAPTOPS)


def test_a_new_version_replaces_the_old(hub, tmp_path):
    run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
    hub.files["9748.zip"] = hub.cdn.files["9748.zip"] = zipped(model_files("Oven"))
    assert "1 of them new" in run("partnet-mobility", "--ids", "9748", "-o", tmp_path).output
    assert files_in(tmp_path / "9748") == model_files("Oven")


def test_a_folder_that_was_not_fetched_is_left_alone(hub, tmp_path):
    (tmp_path / "9748").mkdir()
    (tmp_path / "9748" / "mine.txt").write_text("mine")
    done = run("partnet-mobility", "--ids", "9748,10040", "-o", tmp_path)
    assert "is there, and was not fetched; move it away" in done.output
    assert files_in(tmp_path / "9748") == {"mine.txt": b"mine"}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "nothing is chosen; name --category"),
        (["--ids", "9749"], "has no model '9749'; did you mean '9748'?"),
        (["-c", "laptob"], "has no category 'laptob'; did you mean 'laptop'?"),
        (["--ids", "1", "--via", "ftp"], "no route 'ftp'; there are: hub, sapien"),
    ],
)
def test_what_there_is_not_is_told_in_a_sentence(hub, tmp_path, arguments, sentence):
    done = run("partnet-mobility", "-o", tmp_path, *arguments)
    assert done.exit_code == 1
    assert sentence in done.output


def test_nobody_there(tmp_path, monkeypatch, hub):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    done = run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
    assert done.exit_code == 1
    assert "http://127.0.0.1:9/api" in done.output
    assert "cannot be got" in done.output


# ------------------------------------------------------------------ SAPIEN's site


def test_the_site_gives_models_by_id(site, tmp_path):
    arguments = ["--via", "sapien", "--token", "sapien-secret", "-o", tmp_path]
    assert run("partnet-mobility", "--ids", "9748,45213", *arguments).exit_code == 0
    assert whole(tmp_path, "9748", "45213")
    assert "sapien-secret" not in read(tmp_path / "fetched.json")
    site.asked.clear()
    assert "0 of them new" in run("partnet-mobility", "--ids", "9748", *arguments).output
    assert not site.asked


def test_the_site_is_the_second_route_where_the_hub_refuses(hub, site, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    monkeypatch.setenv("SAPIEN_ACCESS_TOKEN", "sapien-secret")
    done = run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
    assert done.exit_code == 0, done.output
    assert "trying SAPIEN's own site" in done.output
    assert whole(tmp_path, "9748")
    assert run("partnet-mobility", "--ids", "9748", "--via", "hub", "-o", tmp_path / "2").exit_code


def test_a_cut_at_the_site_is_gone_on_from_within_a_call(site, tmp_path):
    site.cut["9748.zip"] = [70_000]
    arguments = ["--via", "sapien", "--token", "sapien-secret", "-o", tmp_path]
    assert run("partnet-mobility", "--ids", "9748", *arguments).exit_code == 0
    assert site.bytes_of("9748.zip") == ["", "bytes=70000-"]
    assert whole(tmp_path, "9748")


@pytest.mark.parametrize(
    ("token", "sentence"), [("wrong", "not granted (403)"), (None, "wants a token")]
)
def test_the_sites_token_is_told_to_nobody(site, tmp_path, token, sentence, monkeypatch):
    monkeypatch.delenv("SAPIEN_ACCESS_TOKEN", raising=False)
    given = ["--token", token] if token else []
    done = run("partnet-mobility", "--ids", "9748", "--via", "sapien", "-o", tmp_path, *given)
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


# ------------------------------------------------------------------ trouble


def test_two_do_not_fetch_into_one_folder(hub, tmp_path):
    run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
    holder = (
        "import fcntl, sys, time\nfile = open(sys.argv[1], 'r+b')\n"
        "fcntl.flock(file, fcntl.LOCK_EX)\nprint('held', flush=True)\ntime.sleep(60)\n"
    )
    command = [sys.executable, "-c", holder, str(tmp_path / ".fetch" / "lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        done = run("partnet-mobility", "--ids", "9748", "-o", tmp_path)
        process.kill()
    assert done.exit_code == 1
    assert "another process fetches into it" in done.output


def test_a_full_disk_ends_the_call_and_a_larger_one_goes_on(hub, tmp_path):
    with small_disk(tmp_path / "disk", "250k") as disk:
        with pytest.raises(MachineFault, match=r"free"):
            fetch_partnet_mobility(disk, ids=LAPTOPS)
        assert not [p for p in disk.glob("*/mobility.urdf") if not whole(disk, p.parent.name)]
        subprocess.run(["mount", "-o", "remount,size=4m", str(disk)], check=True)
        assert fetch_partnet_mobility(disk, ids=LAPTOPS).models == 2
        assert whole(disk, *LAPTOPS)


def test_files_that_may_not_grow_so_large(hub, tmp_path, monkeypatch):
    """The limit of file sizes is a process's own, and has no need of root."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # it would be cut short
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, before[1]))
    try:
        with pytest.raises(MachineFault, match="not written: files may not grow so large"):
            fetch_partnet_mobility(tmp_path, ids=["9748"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert fetch_partnet_mobility(tmp_path, ids=["9748"]).models == 1


def test_killed_in_the_midst_of_a_file_and_called_again_it_goes_on(hub, tmp_path):
    command = [sys.executable, "-m", "articugen", "fetch", "partnet-mobility"]
    command += ["--ids", ",".join(CATEGORY), "-o", str(tmp_path)]
    hub.cdn.stall["7138.zip"] = 30_000
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        part = tmp_path / ".fetch" / "downloads" / ".7138.zip.part"
        others = [tmp_path / name / "mobility.urdf" for name in ("9748", "10040", "45213")]
        while process.poll() is None and not all(path.exists() for path in (part, *others)):
            time.sleep(0.01)
        process.kill()
    hub.cdn.stall.clear()
    assert whole(tmp_path, "9748", "10040", "45213")
    assert not (tmp_path / "7138").exists()
    have = part.stat().st_size
    hub.cdn.asked.clear()
    done = fetch_partnet_mobility(tmp_path, ids=list(CATEGORY))
    assert (done.models, done.new, done.failed, done.refused) == (4, 1, {}, {})
    assert whole(tmp_path, *CATEGORY)
    assert hub.cdn.bytes_of("7138.zip") == [f"bytes={have}-" if have else ""]
    assert set(json.loads((tmp_path / "fetched.json").read_text())["models"]) == set(CATEGORY)


def test_a_server_that_says_nothing_keeps_no_one_who_wants_to_leave(hub, tmp_path):
    """SIGTERM, or Ctrl-C, while a file does not come on."""
    command = [sys.executable, "-m", "articugen", "fetch", "partnet-mobility"]
    hub.cdn.stall["7138.zip"] = 30_000
    part = tmp_path / ".fetch" / "downloads" / ".7138.zip.part"
    with subprocess.Popen(
        [*command, "--ids", "7138", "-o", str(tmp_path)], stderr=subprocess.PIPE, text=True
    ) as process:
        while process.poll() is None and not part.exists():
            time.sleep(0.01)
        process.terminate()
        assert process.wait(timeout=5.0) == 143  # what it waits for would take 10 s
        assert "interrupted; the same command goes on" in process.stderr.read()
    hub.cdn.stall.clear()
    assert fetch_partnet_mobility(tmp_path, ids=["7138"]).models == 1
    assert whole(tmp_path, "7138")


def test_killed_while_it_unpacks_leaves_no_half_model(hub, tmp_path):
    """What a killed process was unpacking has no name yet, and is gone after the next call."""
    half = tmp_path / ".fetch" / "unpacking" / "1234" / "0" / "9748"
    half.mkdir(parents=True)
    (half / "mobility.urdf").write_text("<rob")
    assert run("partnet-mobility", "--ids", "9748", "-o", tmp_path).exit_code == 0
    assert whole(tmp_path, "9748")
    assert not list((tmp_path / ".fetch" / "unpacking").iterdir())


# ------------------------------------------------------------------ archives at hand


def test_archives_of_many_models_keep_their_folders(tmp_path):
    files = {f"laptop/{k}/{n}": d for k in ("0001", "0002") for n, d in shape2motion().items()}
    (tmp_path / "s2m.zip").write_bytes(zipped(files))
    arguments = ["shape2motion", "--from", tmp_path / "s2m.zip", "-o", tmp_path / "out"]
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    assert "research only" in done.output
    assert {r.object_id for r in object_refs(tmp_path / "out", "laptop")} == {"0001", "0002"}
    assert "2 models, 0 of them new" in run(*arguments).output


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


def test_one_bad_archive_stops_no_other_and_the_whole_partnet_is_flat(tmp_path):
    for name, folder in (("good", "dataset/9748/"), ("bad", "../")):
        (tmp_path / f"{name}.zip").write_bytes(zipped(model_files(), folder=folder))
    named = [x for name in ("bad", "good", "gone") for x in ("--from", tmp_path / f"{name}.zip")]
    done = run("partnet-mobility", *named, "-o", tmp_path / "out")
    assert done.exit_code == 3
    assert "not fetched bad.zip" in done.output
    assert "not fetched gone.zip" in done.output
    assert files_in(tmp_path / "out" / "9748") == model_files()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["shape2motion"], "is not downloaded from here; get its archives from its authors"),
        (["shapenet"], "no data set 'shapenet' to fetch"),
        (["shape2motion", "--from", "no.zip"], "no.zip: cannot be read: No such file"),
        (["shape2motion", "--from", "no.zip", "--ids", "1"], "--from takes all models"),
    ],
)
def test_the_command_refuses_in_a_sentence(tmp_path, arguments, sentence):
    done = run(*arguments, "-o", tmp_path)
    assert done.exit_code == 1
    assert sentence in done.output


# ------------------------------------------------------------------ the web


def test_a_remote_file_reads_like_the_file(hub):
    data = os.urandom(200_000)
    hub.cdn.files["r.bin"] = hub.files["r.bin"] = data
    file = RemoteFile(Server(hub.base, token=TOKEN), "/r.bin", len(data))
    for start, count in ((199_990, 10), (0, 5), (5, 100_000), (150_000, 99_999), (200_000, 1)):
        file.seek(start)
        got = b""
        while len(got) < count and (part := file.read(count - len(got))):
            got += part
        assert got == data[start : start + count]
    assert file.seek(-3, 2) == 199_997
    assert file.read(10) == data[-3:]


def test_a_list_that_leads_to_another_server_is_not_followed(hub):
    own = Server(hub.base, token=TOKEN)
    hub.base = hub.base.replace("127.0.0.1", "127.0.0.2")
    with pytest.raises(NotFetched, match="leads on to another server"):
        own.json("/api/datasets/x/tree/main?recursive=true")


def test_user_and_password_in_an_address_are_not_shown(hub):
    server = Server("http://me:secret@127.0.0.1:9")
    with pytest.raises(NotFetched) as told:
        server.json("/list?token=secret")
    assert "secret" not in str(told.value)


def test_a_refusal_is_not_asked_again(hub):
    hub.token = "other"
    before = len(hub.asked)
    with pytest.raises(AccessRefused):
        Server(hub.base, token=TOKEN).part("/9748.zip", 0, 9)
    assert len(hub.asked) == before + 1


@pytest.mark.parametrize("harm", ["deep", "damaged", "encrypted"])
def test_what_a_published_archive_calls_its_model_may_be_anything(monkeypatch, harm):
    text = b"[" * 100_000 if harm == "deep" else b"{}"
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("1/meta.json", text)
    image = bytearray(data.getvalue())
    if harm == "damaged":
        image[30 + len("1/meta.json")] = 0xFF
    if harm == "encrypted":
        image[6] |= 1
        image[image.index(b"PK\1\2") + 8] |= 1
    monkeypatch.setattr(partnet_mobility, "RemoteFile", lambda *_: io.BytesIO(image))
    file = Published("1.zip", "/1.zip", len(image), None)
    assert partnet_mobility._category(Server("http://127.0.0.1:1"), file) == ""


def test_a_receipt_that_is_deep_is_none(hub, tmp_path):
    assert fetch_partnet_mobility(tmp_path, ids=["9748"]).new == 1
    (receipt,) = tmp_path.rglob(RECEIPT_NAME)
    receipt.write_bytes(b"[" * 100_000)
    again = fetch_partnet_mobility(tmp_path, ids=["9748"])
    assert (again.models, again.new) == (1, 1)
