"""The wheel holds all that the package needs: it works from an empty folder, by itself."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from python_process import printed

CHECKOUT = Path(__file__).resolve().parent.parent
MAIN = "from articugen.cli import main; main()"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which the wheel is unpacked; its libraries are those of this environment."""
    work = tmp_path_factory.mktemp("wheel")
    source = work / "source"
    source.mkdir()
    for name in ("articugen", "recipes", "urdf_sources", "pyproject.toml", "setup.py", "README.md"):
        (source / name).symlink_to(CHECKOUT / name)
    build = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
    subprocess.run([*build, "--wheel-dir", str(work), str(source)], check=True, timeout=120)
    (wheel,) = work.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(work / "site")
    return work / "site"


def run(installed: Path, folder: Path, *arguments: str) -> str:
    """What the command prints, in an empty folder and with a home of its own."""
    own = {"PYTHONPATH": str(installed), "HOME": str(folder), "XDG_CACHE_HOME": str(folder / "c")}
    return printed("-c", MAIN, *arguments, folder=folder, seconds=400, **own)


def test_the_wheel_holds_recipes_and_sources_and_no_model(installed: Path) -> None:
    bundled = installed / "articugen" / "_bundled"
    for folder, pattern in (("recipes", "*.yaml"), ("urdf_sources", "*/source.yaml")):
        ours = {path.relative_to(CHECKOUT / folder) for path in (CHECKOUT / folder).glob(pattern)}
        assert ours == {p.relative_to(bundled / folder) for p in (bundled / folder).glob(pattern)}
    assert (installed / "articugen" / "py.typed").is_file()
    assert {path.suffix for path in bundled.rglob("*.*")} == {".yaml", ".md"}
    assert not list(installed.rglob("tests"))


def test_an_installed_package_finds_its_sources_and_plans(installed: Path, tmp_path: Path) -> None:
    """That it makes data too, CI shows: its kernels would have to be compiled anew here."""
    assert "eyeglasses" in run(installed, tmp_path, "sources")
    assert "86" in run(installed, tmp_path, "generate", "-c", "laptop", "-j", "0", "--dry-run")
    quick = ("-c", "oven", "-j", "0", "-r", "quick")
    assert "110" in run(installed, tmp_path, "generate", *quick, "--dry-run")
