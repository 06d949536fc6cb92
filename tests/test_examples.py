"""examples/, the README and pages of docs/, run as anybody runs them: in a new folder."""

import importlib.util
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yourdfpy
from python_process import printed
from typer.main import get_command

import articugen as ag
from articugen.cli import app
from articugen.core.recipe import load_recipe

CHECKOUT = Path(__file__).resolve().parents[1]
LITTLE = """\
extends: quick
objects: 6
articulation: {states: 6}
views: {count: 16, resolution: 64}
sampling: {surface_points: 2048, uniform_points: 64, near_points: 64, partial_views: 0, grids: [8]}
"""


def run(name: str, folder: Path, *arguments: object) -> str:
    script = str(CHECKOUT / "examples" / f"{name}.py")
    own = {"PYTHONPATH": str(CHECKOUT)}
    return printed(script, *map(str, arguments), folder=folder, seconds=900, **own)


@pytest.mark.skipif(not importlib.util.find_spec("torch"), reason="torch is not installed")
def test_a_model_of_ones_own_learns_parts(tmp_path: Path) -> None:
    (tmp_path / "little.yaml").write_text(LITTLE)
    told = run("train_your_model", tmp_path, "--recipe", "little.yaml", "--iterations", 45)
    scores = {
        name: (float(accuracy), float(iou))
        for name, accuracy, iou in re.findall(r"(\w+): accuracy ([\d.]+), part IoU ([\d.]+)", told)
    }
    assert scores.keys() == {"baseline", "PointNet"}
    assert scores["PointNet"][0] > scores["baseline"][0] + 0.03
    assert scores["PointNet"][1] > scores["baseline"][1] + 0.05
    assert scores["PointNet"][1] > 0.85


def test_a_urdf_is_articulated_and_exported_to_four_formats(tmp_path: Path) -> None:
    told = run("articulate_and_export", tmp_path, "--states", 2, "--resolution", 64)
    made = tmp_path / "made"
    half = trimesh.load_mesh(made / "half_open.ply")
    assert half.is_watertight
    assert "half open: {'door': 0.9}" in told
    (path,) = made.glob("urdf/train/*/cabinet.urdf")
    robot = yourdfpy.URDF.load(str(path))
    limit = robot.joint_map["door"].limit
    assert (limit.lower, limit.upper) == (0.0, 1.8)
    door = trimesh.load_scene(next(made.glob("glb/train/*.glb"))).geometry["part_1"]
    np.testing.assert_allclose(sorted(door.extents), [0.02, 0.38, 0.56], atol=0.01)
    clouds = sorted(made.glob("ply/train/*.ply"))
    assert len(clouds) == 3
    assert len(trimesh.load(clouds[0]).vertices) == 8192
    with tarfile.open(next(made.glob("webdataset/*.tar"))) as tar:
        arrays = [
            np.load(io.BytesIO(tar.extractfile(member).read()))
            for member in tar
            if member.name.endswith(".npz")
        ]
    assert len(arrays) == 3
    assert arrays[0]["joint_state"] == 0.0
    assert all(0.0 < each["joint_state"][0] < 1.8 for each in arrays[1:])


def test_a_urdf_of_ones_own_with_another_name_goes_as_well(tmp_path: Path) -> None:
    (tmp_path / "mein schrank.urdf").write_text(
        '<robot name="s"><link name="wall"><visual><geometry><box size="0.1 0.4 0.4"/></geometry>'
        '</visual></link><link name="bolt"><visual><geometry><box size="0.2 0.1 0.1"/></geometry>'
        '</visual></link><joint name="slide" type="prismatic"><parent link="wall"/>'
        '<child link="bolt"/><origin xyz="0.2 0 0"/><axis xyz="1 0 0"/>'
        '<limit lower="0" upper="0.2" effort="1" velocity="1"/></joint></robot>'
    )
    asked = ("mein schrank.urdf", "--out", "elsewhere", "--states", 1, "--resolution", 48)
    told = run("articulate_and_export", tmp_path, *asked)
    assert "half open: {'slide': 0.1}" in told
    assert all(f"{name}: " in told for name in ("glb", "urdf", "ply", "webdataset"))
    assert not (tmp_path / "made").exists()


@pytest.mark.skipif(not importlib.util.find_spec("torch"), reason="torch is not installed")
def test_the_notebook_learns_from_a_urdf_of_ones_own(tmp_path: Path, monkeypatch) -> None:
    """Its cells one after another, which needs no jupyter; and it is kept without outputs."""
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((CHECKOUT / "examples" / "own_urdf.ipynb").read_text("utf-8"))
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            exec(compile("".join(cell["source"]), "notebook", "exec"), names)
    assert len(names["data"]) == 81
    assert names["error"] < 0.2 * names["spread"]


PAGES = ("README.md", "docs/commands.md", "docs/recipes.md", "docs/python.md")
"""Read in this order, as one story: what one makes the next may use."""

NOT_RUN = {
    "make dataset CATEGORY=laptop SOURCE=models": "models that `fetch` brought",
    "make dataset CATEGORY=dishwasher,oven": "PartNet-Mobility's models",
    "make dataset CATEGORY=cabinet SOURCE=partnet_mobility": "PartNet-Mobility's models",
    "make dataset CATEGORY=laptop REPLACE=1": "takes minutes",
    "make comparison": "takes minutes",
    "make train": "takes minutes",
    "make evaluate": "wants the run of that training",
    "articugen train": "takes minutes",
}
"""How lines begin that are only parsed, and why; `ag.train` below takes three iterations."""
NEEDS = {".torch(": "torch", "ag.train": "torch", "ag.evaluate": "torch"}
BRIEFLY = {
    "extends": "ppd_plain",
    "data": {"surface_points": 256, "uniform_points": 128, "near_points": 128,
             "validation_objects": 1},
    "schedule": {"batch": 3, "stages": [{"resolution": 16, "iterations": 3}], "validate_every": 3},
    "seeds": {"count": 1, "halve_at": []},
}  # fmt: skip


def blocks() -> list[tuple[str, str]]:
    """The language and the text of each block of code, in order."""
    text = "\n".join((CHECKOUT / page).read_text(encoding="utf-8") for page in PAGES)
    return re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL)


def lacks(line: str) -> str:
    """The library that a line needs and that is not installed, "" where there is none."""
    wanted = [library for words, library in NEEDS.items() if words in line]
    return next((name for name in wanted if not importlib.util.find_spec(name)), "")


def parsed(line: str, folder: Path) -> None:
    """Have the command line take a command, or what make would call, without running it."""
    if line.startswith("make "):
        line = line.replace("make", "make -n --no-print-directory", 1)
        line = subprocess.check_output(line, shell=True, cwd=folder, text=True).splitlines()[-1]
    words = shlex.split(line, comments=True)
    words = words[[Path(word).name for word in words].index("articugen") + 1 :]
    group = get_command(app)
    name, command, rest = group.resolve_command(group.make_context("articugen", ["sources"]), words)
    assert command.make_context(name, rest)


class _TrainsBriefly:
    """`articugen`, but what pages train in minutes takes three iterations."""

    def __getattr__(self, name: str) -> object:
        return getattr(ag, name)

    def train(self, data: ag.DataSet, recipe: str) -> object:
        assert recipe == "ppd_quick"
        return ag.train(data, recipe=BRIEFLY)

    def evaluate(self, run: object, data: ag.DataSet) -> object:
        return ag.evaluate(run, data, resolution=8, states=1)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with what the checkout holds but data, and this environment as `.venv`."""
    if not (Path(sys.prefix) / "bin" / "articugen").exists():
        pytest.skip("articugen is not installed in this environment")
    folder = tmp_path_factory.mktemp("checkout")
    for path in CHECKOUT.iterdir():
        if path.name in {"Makefile", "README.md", "pyproject.toml", "constraints.txt"} | {
            "articugen", "docs", "examples", "recipes"}:  # fmt: skip
            (folder / path.name).symlink_to(path)
    (folder / ".venv").mkdir()
    for path in Path(sys.prefix).iterdir():
        if not path.name.startswith(".installed"):
            (folder / ".venv" / path.name).symlink_to(path)
    (folder / ".venv" / ".installed").touch()  # the stamp of what is made before
    before = Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


@pytest.mark.slow
def test_every_line_of_the_readme_and_of_pages_runs_as_written_in_order(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bin_folder = checkout / ".venv" / "bin"
    monkeypatch.setenv("PATH", f"{bin_folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))
    few = {"OBJECTS": "3", "STATES": "7", "JOBS": "1", "SET": "views.count=40"}
    for name, value in few.items():  # what no line says, make takes from here
        monkeypatch.setenv(name, value)
    names: dict[str, object] = {}
    run_lines = 0
    for language, text in blocks():
        if language == "python":
            lines = [line for line in text.splitlines() if not lacks(line)]
            names["ag"] = ag
            code = "\n".join(lines)
            if "ag.train(" in code:
                names["ag"] = _TrainsBriefly()
            exec(compile(code, "page", "exec"), names)
        elif language == "yaml":
            (checkout / "path.yaml").write_text(text)
            assert load_recipe(checkout / "path.yaml", "laptop").articulation.states == 20
        else:
            for line in filter(None, text.splitlines()):
                if any(map(line.startswith, NOT_RUN)) or lacks(line):
                    parsed(line, checkout)
                    continue
                done = subprocess.run(
                    line, shell=True, capture_output=True, text=True, check=False, timeout=600
                )
                assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
                run_lines += 1
    assert run_lines == 8
    assert names["row"].surface.points.shape == (8192, 3)
    assert names["batch"]["surface_points"].shape == (16, 8192, 3)
    assert names["labels"].shape == (8192,)
    assert names["flow"].shape == (8192, 3)
    assert len(ag.open("data/cabinet")) == 11
    assert len(ag.open("data/cupboard")) == 21
    assert ag.open("data/oven").recipe.sampling.grids == (16, 32)
    for path in ("door.ply", "data/laptop/sheet.png", "data/laptop/report.html", "onet/laptop"):
        assert (checkout / path).exists()
