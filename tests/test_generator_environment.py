"""`make dataset` installs what the generator imports, and nothing else: that is enough."""

import re
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from python_process import printed

CHECKOUT = Path(__file__).resolve().parent.parent

ONLY_THOSE = """
import sys
from importlib.machinery import PathFinder
from importlib.metadata import packages_distributions
needed = set({needed!r})
names = packages_distributions()
class Found(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        of = names.get(name)
        if of and not needed & {{each.lower().replace("_", "-") for each in of}}:
            return None
        return super().find_spec(name, path, target)
sys.meta_path = [Found if each is PathFinder else each for each in sys.meta_path]
"""

COMMANDS = """
from typer.testing import CliRunner
from articugen.cli import app
def run(*arguments):
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    assert result.exit_code == 0, (arguments, result.output, result.exception)
small = ("--objects", 1, "--states", 1, "--set", "views.count=8", "--set", "views.resolution=64")
small += ("--set", "sampling.surface_points=1024")
run("generate", "-c", "laptop", "--jobs", 0, "--out", ".", *small)
run("inspect", "laptop", "--image", "sheet.png")
run("inspect", "laptop", "--html", "report.html")
run("verify", "laptop", "--jobs", 1)
run("discover", "laptop")
for name in ("urdf", "glb", "mjcf"):
    run("export", "laptop", "--to", name, "--out", name, "--resolution", 32)
for name in ("onet", "ply"):
    run("export", "laptop", "--to", name, "--out", name)
run("mesh", "laptop", "laptop_0000", "--output", "field.glb", "--resolution", 32)
"""

MESHES = """
from pathlib import Path
from articugen.meshes.read import read_mesh
for path in map(Path, ("box.dae", "box.glb")):
    assert len(read_mesh(path).faces) == 12
"""


def needed() -> set[str]:
    text = (CHECKOUT / "Makefile").read_text().replace("\\\n", " ")
    (names,) = re.findall(r"^generators := (.*)$", text, re.MULTILINE)
    return set(names.split())


def test_what_is_needed_needs_nothing_else() -> None:
    names, missing = needed(), set()
    for name in ("articugen", *sorted(names)):
        try:
            wanted = [Requirement(each) for each in requires(name) or ()]
        except PackageNotFoundError:
            pytest.skip(f"{name} is not installed here")
        for each in wanted:
            if each.marker is None or each.marker.evaluate({"extra": ""}):
                missing |= {canonicalize_name(each.name)} - names
    assert not missing


def test_all_that_is_needed_is_pinned() -> None:
    pinned = re.findall(r"^([\w.-]+)==", (CHECKOUT / "constraints.txt").read_text(), re.MULTILINE)
    assert needed() <= {canonicalize_name(name) for name in pinned}


def test_commands_import_nothing_else(tmp_path: Path) -> None:
    code = ONLY_THOSE.format(needed={"articugen", *needed()}) + COMMANDS
    printed("-c", code, folder=tmp_path, seconds=300)


def test_meshes_are_read_with_nothing_else(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    for name in ("box.dae", "box.glb"):
        (tmp_path / name).write_bytes(trimesh.creation.box().export(file_type=name[-3:]))
    code = ONLY_THOSE.format(needed={"articugen", *needed()}) + MESHES
    assert printed("-c", code, folder=tmp_path, seconds=60).strip() == ""
