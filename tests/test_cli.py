"""The command line as a user meets it: real commands, real data sets, tiny ones."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run
from instances import hinged_box
from ppd_data import shard
from python_process import ended

import articugen as ag
from articugen import __version__
from articugen.cli import generate, saying
from articugen.core.errors import NotOfCategory
from articugen.instance import articulation
from articugen.store.shards import open_shard

TINY = """
name: tiny
objects: 2
articulation: {states: 2}
views: {count: 12, resolution: 64}
sampling:
  {grids: [8, 16], surface_points: 512, uniform_points: 64, near_points: 64, partial_views: 1,
   partial_points: 32, partial_resolution: 32}
"""

BOX = """<robot name="box"><link name="base"><visual><geometry><box size="1 1 0.1"/></geometry>
</visual></link><link name="lid"><visual><origin xyz="0.5 0 0.1"/><geometry><box size="1 1 0.1"/>
</geometry></visual></link><joint name="hinge" type="revolute"><origin xyz="-0.5 0 0"/>
<axis xyz="0 -1 0"/><limit lower="0" upper="1.5" effort="1" velocity="1"/><parent link="base"/>
<child link="lid"/></joint></robot>"""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two good objects and a broken one."""
    folder = tmp_path_factory.mktemp("boxes")
    for name in ("one", "two"):
        (folder / f"{name}.urdf").write_text(BOX)
    (folder / "worse.urdf").write_text(BOX.replace('child link="lid"', 'child link="lost"'))
    return folder


@pytest.fixture(scope="module")
def made(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a data set: two procedural laptops."""
    root = tmp_path_factory.mktemp("made")
    done = run("generate", "-c", "laptop", "-r", recipe, "-o", root, "-j", 0)
    assert done.exit_code == 0, done.output
    return root / "laptop"


def test_version_and_help() -> None:
    assert run("--version").output.strip() == f"articugen {__version__}"
    for command in ([], ["sources"], ["generate"], ["inspect"], ["verify"]):
        done = run(*command, "--help")
        assert done.exit_code == 0
        assert "Usage" in done.output
        if command and command != ["sources"]:
            assert f"articugen {command[0]} " in done.output.split("Example")[1]


def test_sources_lists_what_will_be_made(tmp_path: Path) -> None:
    (line,) = [
        words
        for block in run("sources").output.split("\n\n")
        if block.startswith("procedural\n")
        for words in map(str.split, block.splitlines())
        if words[0] == "drawer"
    ]
    plan = run("generate", "-c", "drawer", "-o", tmp_path, "--dry-run").output
    assert f"{int(line[1]) + int(line[3])} objects" in plan


def test_settings_become_part_of_the_recipe_that_is_stored(recipe: Path, tmp_path: Path) -> None:
    given = ("generate", "-c", "eyeglasses", "-r", recipe, "-o", tmp_path, "-j", 0, "-n", 1)
    done = run(*given, "--set", "sampling.grids=[4]", "--set", "articulation.states=1")
    assert done.exit_code == 0, done.output
    manifest = json.loads((tmp_path / "eyeglasses" / "manifest.json").read_text())
    stored = json.loads(manifest["recipe"])
    assert (stored["sampling"]["grids"], stored["articulation"]["states"]) == ([4], 1)
    (shard,) = (tmp_path / "eyeglasses").glob("*.h5")
    with open_shard(shard) as opened:
        assert [name for name in opened.fields if name.startswith("occupancy")] == ["occupancy_4"]
        told = json.loads(str(opened.attributes["recipe"]))
    assert told["sampling"] == stored["sampling"]
    done = run(*given, "--set", "sampling.grid=[4]")
    assert done.exit_code == 1
    assert "unknown key 'sampling.grid'; did you mean 'grids'?" in done.output.replace("\n", " ")


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
@pytest.mark.parametrize("target", ["dataset", "train"])
def test_make_hands_settings_on(target: str) -> None:
    asked = ["make", "-n", target, "CATEGORY=x", "SET=views.count=5 sampling.grids=[8,16]"]
    root = Path(__file__).parents[1]
    said = subprocess.run(asked, cwd=root, capture_output=True, text=True, check=True).stdout
    assert " --set 'views.count=5' --set 'sampling.grids=[8,16]'" in said


def test_generate_says_what_was_made_and_what_comes_next(made: Path, recipe: Path) -> None:
    manifest = json.loads((made / "manifest.json").read_text())
    again = run("generate", "-c", "laptop", "-r", recipe, "-o", made.parent)
    assert again.exit_code == 0
    assert "nothing to do" in again.stdout
    assert manifest["content_sha256"] in again.stdout.replace("\n", "")
    looking = saying.command("inspect", made, "--image", made / "sheet.png")
    assert f"next: {looking}\n" in again.stdout
    assert {shard["instances"] for shard in manifest["shards"]} == {3}


def test_generate_warns_of_an_empty_split(made: Path, recipe: Path, boxes: Path, tmp_path: Path):
    both = run("generate", "-c", "laptop", "-r", recipe, "-o", made.parent)
    assert "no object is for" not in both.stdout
    one = boxes / "one.urdf"
    alone = run("generate", "-c", "box", "-s", one, "-r", recipe, "-o", tmp_path, "-j", 0)
    assert "no test" in alone.stdout
    assert "no object is for testing: add models" in " ".join(alone.stdout.split())


def test_what_comes_next_can_be_pasted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ours = tmp_path / "my env" / "articugen"
    ours.parent.mkdir()
    ours.write_text("#!/bin/sh\n")
    ours.chmod(0o755)
    monkeypatch.setattr(sys, "argv", [str(ours)])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert shlex.split(saying.command("inspect", "my data")) == [str(ours), "inspect", "my data"]
    monkeypatch.setenv("PATH", str(ours.parent))
    assert saying.command("inspect", "my data") == "articugen inspect 'my data'"
    monkeypatch.setattr(sys, "argv", ["/elsewhere/bin/articugen"])
    assert saying.command("sources") == "/elsewhere/bin/articugen sources"
    monkeypatch.setattr(sys, "argv", ["articugen/__main__.py"])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert saying.command("sources") == f"{shlex.quote(sys.executable)} -m articugen sources"


def test_what_make_calls_speaks_of_make(recipe, tmp_path, monkeypatch):
    monkeypatch.setenv("ARTICUGEN_CALLED_BY", "make")
    monkeypatch.chdir(tmp_path)
    given = ("generate", "-c", "laptop", "-r", recipe, "-j", 0, "-n", 1)
    assert "next: make inspect CATEGORY=laptop\n" in run(*given).output
    done = run(*given, "-o", "my data")
    assert "next: make inspect CATEGORY=laptop 'OUT=my data'\n" in done.output
    done = run(*given, "--seed", 1)
    assert done.exit_code == 1
    assert done.output.endswith(", or add REPLACE=1\n")


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
@pytest.mark.parametrize(
    "words", [("--help",), ("sources",), ("generate", "--help"), ("export", "--to"), ("discover",)]
)
def test_who_stops_reading_ends_a_command_without_a_word(tmp_path: Path, words: tuple[str]) -> None:
    """As `head` does; the status is that of SIGPIPE, as other tools have it."""
    reader, writer = os.pipe()
    os.close(reader)
    one_pose = shard(tmp_path / "one.h5", hinged_box([(0.0, 0.0)]))  # says so at once
    more = [str(one_pose)] if words == ("discover",) else []
    code = "from articugen.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *words, *more], stdout=writer, stderr=subprocess.PIPE,
        check=False,
    )  # fmt: skip
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


def test_a_dry_run_tells_the_plan_and_makes_nothing(recipe: Path, tmp_path: Path) -> None:
    done = run("generate", "-c", "oven", "-r", recipe, "-o", tmp_path / "new", "--dry-run")
    assert done.exit_code == 0
    assert "2 objects" in done.output
    assert "instances       6" in done.output
    assert not list(tmp_path.rglob("*.h5"))


def test_several_categories_go_into_their_own_folders_and_one_that_fails_stops_none(
    recipe: Path, boxes: Path, tmp_path: Path
) -> None:
    for name in ("one", "two"):
        folder = tmp_path / "models" / "Lamp" / name
        folder.mkdir(parents=True)
        (folder / "lamp.urdf").write_text(BOX)
        broken = tmp_path / "models" / "Chair" / name
        broken.mkdir(parents=True)
        (broken / "chair.urdf").write_text((boxes / "worse.urdf").read_text())
    flags = ("-r", recipe, "-o", tmp_path / "data", "-j", 0, "-s", tmp_path / "models")
    done = run("generate", "-c", "all", *flags)
    assert done.exit_code == 1
    assert "1 of 2 categories are done; not: chair" in done.output
    manifest = json.loads((tmp_path / "data" / "lamp" / "manifest.json").read_text())
    assert [entry["key"]["object_id"] for entry in manifest["objects"]] == ["two", "one"]
    one = run("generate", "-c", "Lamp,lamp", "--exclude", "two", *flags, "--dry-run")
    assert "1 object" in one.output
    assert "categories are done" not in one.output


def test_chosen_joints_are_in_the_manifest_and_chosen_objects_keep_their_shards(
    recipe: Path, made: Path, tmp_path: Path
) -> None:
    flags = ("-c", "laptop", "-r", recipe, "-o", tmp_path, "-j", 0)
    both = json.loads((made / "manifest.json").read_text())["objects"]
    split = {entry["key"]["object_id"]: entry["key"]["split"] for entry in both}
    last = max(split)
    done = run("generate", *flags, "--ids", last, "--movable", "hin*,x", "--movable", "y")
    assert done.exit_code == 0, done.output
    manifest = json.loads((tmp_path / "laptop" / "manifest.json").read_text())
    articulation = json.loads(manifest["recipe"])["articulation"]
    assert articulation["movable"] == ["hin*", "x", "y"]
    assert articulation["clip_to_limits"] is False
    keys = [entry["key"] for entry in manifest["objects"]]
    assert [(key["object_id"], key["split"]) for key in keys] == [(last, split[last])]
    lost = run("generate", *flags, "--ids", "laptop_1", "--dry-run")
    assert (lost.exit_code, "did you mean 'laptop_" in lost.output) == (1, True)


def test_data_made_in_another_way_is_replaced_only_on_request(recipe: Path, tmp_path: Path) -> None:
    common = ("generate", "-c", "laptop", "-r", recipe, "-n", 1, "-j", 0, "-o", tmp_path)
    assert run(*common, "--states", 0).exit_code == 0
    before = (tmp_path / "laptop" / "manifest.json").read_bytes()
    refused = run(*common, "--states", 1)
    assert refused.exit_code == 1
    assert "--replace" in refused.stderr
    assert (tmp_path / "laptop" / "manifest.json").read_bytes() == before
    assert run(*common, "--states", 1, "--replace").exit_code == 0
    assert (tmp_path / "laptop" / "manifest.json").read_bytes() != before


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("generate", "-c", "lapto"), "did you mean 'laptop'?"),
        (("generate", "-c", "laptop", "-s", "procedral"), "did you mean 'procedural'?"),
        (("generate", "-c", "laptop", "-r", "quik"), "did you mean 'quick'?"),
        (("inspect", "nowhere"), "there is no such shard or folder"),
        (("verify", "nowhere"), "holds no data set"),
    ],
)
def test_an_error_is_one_sentence_on_stderr(arguments, sentence: str, tmp_path: Path) -> None:
    done = run(*arguments, *(("-o", tmp_path) if arguments[0] == "generate" else ()))
    assert done.exit_code == 1
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert sentence in done.stderr
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "arguments", [("generate",), ("generate", "-c", "laptop", "-n", "0"), ("frobnicate",)]
)
def test_wrong_usage_exits_with_2(arguments) -> None:
    assert run(*arguments).exit_code == 2


@pytest.mark.parametrize(
    "arguments",
    [("inspect",), ("verify",), ("train", "-c", "laptop", "-d"), ("export", "--to", "glb")],
)
def test_an_address_is_no_path(arguments) -> None:
    done = run(*arguments, "s3://shelf/laptop")
    assert done.exit_code == 2
    assert "an address; copy it to a folder" in " ".join(done.stderr.split())


def test_a_rejected_object_shows_in_the_exit_status(boxes, recipe, tmp_path):
    patient = tmp_path / "patient.yaml"
    patient.write_text(f"extends: {recipe}\nobjects: 3\nmax_rejected_fraction: 0.5\n")
    common = ("generate", "-c", "box", "-s", boxes, "-j", 0)
    done = run(*common, "-r", patient, "-o", tmp_path)
    assert done.exit_code == 3, done.output
    assert "worse" in done.stdout
    assert "lost" in done.stdout
    manifest = json.loads((tmp_path / "box" / "manifest.json").read_text())
    assert len(manifest["objects"]) == 2
    assert run("verify", tmp_path / "box", "-j", 1).exit_code == 0

    strict = run(*common, "-r", recipe, "-n", 3, "-o", tmp_path / "strict")
    assert strict.exit_code == 1
    assert "1 of 3 objects were rejected" in strict.stderr
    assert strict.output.count("lost") == 1  # the reason is told once
    assert (tmp_path / "strict" / "box" / "manifest.json").exists()
    lax = run(*common, "-r", recipe, "-n", 3, "-o", tmp_path / "strict", "--max-rejected", 0.5)
    assert lax.exit_code == 3
    assert "nothing to do" in lax.stdout


def test_verify_accepts_what_was_made_and_finds_a_flipped_bit(made: Path, tmp_path: Path) -> None:
    done = run("verify", made.parent, "-j", 1)
    assert done.exit_code == 0, done.output
    assert "2 shards, 6 instances" in done.output
    copy = Path(shutil.copytree(made, tmp_path / "laptop"))
    victim = next(copy.glob("*.h5"))
    flipped = bytearray(victim.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    victim.write_bytes(flipped)
    found = run("verify", copy, "-j", 1)
    assert found.exit_code == 1
    assert victim.name in found.output


def test_inspect_prints_the_schema_and_draws(made: Path, tmp_path: Path) -> None:
    image = tmp_path / "sheet.png"
    done = run("inspect", made, "--image", image, "--objects", 1, "--states", 1)
    assert done.exit_code == 0, done.output
    for word in ("surface_points", "revolute", "occupancy_16", "2 objects (1 train, 1 test)"):
        assert word in done.stdout
    assert image.read_bytes()[:4] == b"\x89PNG"
    refused = run("inspect", made, "--states", 1)
    assert (refused.exit_code, "are of a picture" in refused.stderr) == (2, True)


def test_no_more_instances_come_out_the_same_than_there_are(made: Path) -> None:
    assert "; 6 came out the same, made again" in run("verify", made, "--replay", 99).stdout


INTERRUPTED = """
import os, signal
from articugen.pipeline.executors import work as pipeline
from articugen.cli import main
make, begun = pipeline.make_object, []
def make_object(*given, **more):
    begun.append(given)
    if len(begun) == 2:
        os.kill(os.getpid(), signal.SIGINT)  # Ctrl-C at the second object
    return make(*given, **more)
pipeline.make_object = make_object
main()
"""


TWICE = """
import os, signal
from articugen.pipeline.records import Records
close = Records.close
def closed(self):
    for _ in range(3):  # again and again while all is put in order
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
    close(self)
Records.close = closed
"""


@pytest.mark.parametrize(("first", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_second_ctrl_c_or_sigterm_changes_nothing(recipe, tmp_path, first, status):
    command = ["generate", "-c", "laptop", "-r", str(recipe), "-o", str(tmp_path), "-j", "0"]
    code = INTERRUPTED.replace("len(begun) == 2", "len(begun) == 1").replace("SIGINT", first)
    done = ended("-c", TWICE + code, *command)
    assert done.returncode == status, done.stderr
    assert done.stderr == "finished work is kept; run the same command to resume\n"


STUBBORN = """
import os, signal
try:
    os.kill(os.getpid(), signal.{signal})
    for _ in range(100):  # the handler runs between two instructions
        pass
except BaseException:
    pass
"""
IMPORTING = """
from importlib import import_module

app = import_module("articugen.cli.app")

def work(**_):
    import stubborn
    print("went on")

app.app = work
app.main()
"""


@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_stop_is_not_swallowed_by_a_module_that_is_imported(tmp_path, name, status):
    (tmp_path / "stubborn.py").write_text(STUBBORN.format(signal=name))
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = ended("-c", IMPORTING, PYTHONPATH=path)
    assert (done.returncode, done.stdout, done.stderr) == (status, "", "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("arguments", [["sources"], ["--help"], ["inspect", "SET"]])
def test_a_full_standard_output_is_one_sentence(arguments: list[str], made: Path) -> None:
    command = [str(made) if word == "SET" else word for word in arguments]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "articugen", *command],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr == "error: output: No space left on device\n"


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "-x", "a\nb"])
def test_a_category_is_a_name(name: str, boxes: Path, tmp_path: Path) -> None:
    for command in (("generate", "-s", boxes, "-o"), ("train", "-d", tmp_path, "--runs")):
        refused = run(*command, tmp_path / "out", "-c", name)
        assert refused.exit_code == 1
        told = "no category is asked for" if command[0] == "generate" and not name else "category's"
        assert told in refused.stderr
    assert not list(tmp_path.iterdir())


def test_what_is_skipped_or_has_failed_shows_once(boxes, recipe, tmp_path, monkeypatch):
    resolve = articulation.resolve

    def resolved(obj, *given, **settings):
        if obj.object_id == "one":
            raise NotOfCategory("a hob, it has no door")
        if obj.object_id == "two":
            raise ZeroDivisionError("by nought")
        return resolve(obj, *given, **settings)

    monkeypatch.setattr(articulation, "resolve", resolved)
    common = ("-c", "box", "-s", boxes, "-j", 0, "-r", recipe, "-n", 3, "--max-rejected", 1)
    done = run("generate", *common, "-o", tmp_path)
    assert done.exit_code == 1
    assert "1 of 2 objects failed through no fault of theirs" in done.stderr
    for reason in ("a hob, it has no door", "by nought"):
        assert done.output.count(reason) == 1
        assert reason in " ".join(done.stdout.split())
    assert "1 object, such as one: a hob" in " ".join(done.stdout.split())
    checked = run("verify", tmp_path, "-j", 1)
    assert checked.exit_code == 1
    assert "two: incomplete: is not in the data, and will be tried again" in checked.output


def test_a_demo_is_a_set_a_picture_and_a_page(tmp_path: Path, recipe: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(generate, "DEMO", 1)
    monkeypatch.setattr(generate, "DEMO_RECIPE", recipe)
    shown = run("demo", "box")
    assert shown.exit_code == 0, shown.output
    assert len(ag.open("demo/box")) == 3
    assert (tmp_path / "demo" / "box.png").read_bytes().startswith(b"\x89PNG")
    assert "</html>" in (tmp_path / "demo" / "box.html").read_text("utf-8")
    written, _, following = shown.output.partition("next:\n")
    assert written.count("demo/box") == 3
    first, *others = (
        shlex.split(line.partition("articugen ")[2]) for line in following.splitlines()
    )
    assert run(*first).exit_code == 0
    assert [line[0] for line in others] == ["export", "generate"]
