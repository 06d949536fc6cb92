"""Who may import whom, kept by reading the source: docs/architecture.md draws the same picture."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import articugen
from articugen.pipeline import GENERATING_CODE

PACKAGE = Path(articugen.__file__).parent

BASE = {
    "bundled",
    "errors",
    "files",
    "portable",
    "geometry",
    "records",
    "seeding",
    "recipe",
    "recipe_files",
}
STAGES = {
    "articulation": set(),
    "rendering": set(),
    "fusion": {"fusion_kernels", "hierarchy", "reachable", "slender", "winding"},
    "fusion_kernels": {"hierarchy"},
    "hierarchy": set(),
    "reachable": {"hierarchy", "fusion_kernels"},
    "sheets": set(),
    "slender": {"hierarchy", "reachable", "sheets"},
    "swept": set(),
    "winding": {"hierarchy"},
    "sampling": set(),
    "sources": {"files"},
}
STORE = {"schema", "chunks", "shards", "manifest", "journal"}

PPD_WITH_TORCH = {
    "dataset", "depth", "descent", "discriminator", "evaluate", "kinematics", "learner", "losses",
    "model", "objective", "predict", "processes", "race", "reconstruct", "release", "runs",
    "shape", "tensors", "train", "figures.draw", "figures.shapes",
}  # fmt: skip
"""The modules of ppd that cannot be imported without torch."""

MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "bundled": set(),
    "portable": set(),
    "geometry": {"portable"},
    "seeding": set(),
    "records": {"geometry", "portable"},
    "recipe_files": {"bundled", "errors", "files"},
    "recipe": {"bundled", "errors", "recipe_files", "schema"},
    **{stage: BASE | own for stage, own in STAGES.items()},
    "instance": BASE | set(STAGES),
    "files": {"errors"},
    "schema": set(),
    "chunks": set(),
    "shards": {"errors", "records", "files", "schema", "chunks"},
    "manifest": {"errors", "files", "schema", "shards"},
    "journal": {"errors", "files", "manifest"},
    "cleaning": {"journal"},
    "checks": BASE,
    "workers": {"errors"},
    "verify": BASE | STORE | {"checks", "workers"},
    "estimate": {"manifest", "recipe"},
    "pipeline": BASE | STORE | {"sources", "articulation", "instance", "workers", "estimate"},
    "meshing": BASE | {"fusion"},
    "replay": BASE
    | STORE
    | {"sources", "articulation", "fusion", "instance", "meshing", "pipeline", "checks", "verify"},
    "inspection": BASE | STORE | {"rendering"},
    "ppd": BASE | STORE | {"inspection", "workers"},
    "console": {"inspection", "manifest", "pipeline", "sources"},
    "cli": {
        "errors",
        "cleaning",
        "console",
        "inspection",
        "journal",
        "pipeline",
        "ppd",
        "recipe",
        "replay",
        "sources",
        "verify",
    },
    "__main__": {"cli"},
}
"""For each module or subpackage, the others of ours that it may import."""

FOREIGN: dict[str, set[str]] = {
    "h5py": {"shards"},
    "platformdirs": {"bundled"},
    "yourdfpy": {"sources.urdf"},
    "lxml": {"sources.urdf", "sources.xml_strict"},
    "trimesh": {"sources.mesh_formats", "replay", "ppd.clouds"},
    "PIL": {"inspection.layout", "inspection.shading"},
    "matplotlib": {"ppd.figures.plots"},
    "typer": {"cli", "ppd.cli"},
    "rich": {"cli", "console", "ppd.cli", "inspection.summary", "inspection.tables"},
    "open3d": {"rendering.embree"},
    "pyrender": {"rendering.opengl"},
    "OpenGL": {"rendering.opengl"},
    "sapien": {"rendering.sapien"},
    "tensorboard": {"ppd.boards"},
    "torch": {f"ppd.{name}" for name in PPD_WITH_TORCH | {"cli"}},
}
"""The modules that wrap a library; nobody else imports it."""

EVERYWHERE = {"numpy", "numba", "pydantic", "yaml"}


def modules() -> list[str]:
    names = (path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py"))
    return sorted(".".join(n.parts).removesuffix(".__init__") for n in names)


def imports(module: str) -> Iterator[str]:
    """Absolute names of all that a module imports, wherever in it."""
    path = PACKAGE.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("module", [m for m in modules() if m != "__init__"])
def test_a_module_imports_only_what_it_may(module: str) -> None:
    own = module.partition(".")[0]
    for name in imports(module):
        top, _, rest = name.partition(".")
        if top == "articugen":
            ours = rest.split(".")[0]
            assert ours in MAY_IMPORT[own] | {own, "__version__"}, f"{module} imports {name}"
        elif top not in sys.stdlib_module_names | EVERYWHERE:
            assert module in FOREIGN.get(top, set()), f"{module} imports {name}"


def test_every_module_has_its_place_in_the_picture() -> None:
    tops = {module.split(".")[0] for module in modules()} - {"__init__"}
    assert tops <= set(MAY_IMPORT), "give the new module a line in MAY_IMPORT"


def test_the_picture_has_no_cycle() -> None:
    left = {name: wanted - {name} for name, wanted in MAY_IMPORT.items()}
    while left:
        free = {name for name, wanted in left.items() if not wanted & left.keys()}
        assert free, f"a cycle among {sorted(left)}"
        left = {name: wanted for name, wanted in left.items() if name not in free}


def test_help_waits_for_no_heavy_library() -> None:
    code = "import sys, articugen.cli; print(*sorted(m for m in sys.modules if '.' not in m))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "typer" in loaded
    assert not {"numpy", "numba", "h5py", "trimesh", "yourdfpy", "pydantic"} & set(loaded)


def test_the_core_needs_no_optional_library() -> None:
    """All but the files that wrap them import where open3d, torch and the like are absent."""
    optional = (
        "open3d", "pyrender", "OpenGL", "sapien", "tensorboard", "torch", "scipy", "matplotlib"
    )  # fmt: skip
    with_extras = PPD_WITH_TORCH | {"figures.plots"}
    without = {"__init__", "__main__"} | {f"ppd.{name}" for name in with_extras}
    names = [m for m in modules() if m not in without]
    code = (
        f"import sys, importlib\nfor name in {optional}: sys.modules[name] = None\n"
        f"for name in {names}: importlib.import_module('articugen.' + name)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_all_code_that_decides_numbers_counts_in_the_generators_version() -> None:
    """What an instance is made by, as far as it is ours and no mere reader of files or errors."""
    needed = set(STAGES) | (BASE - {"bundled", "errors", "files"}) | {"instance", "schema"}
    assert {Path(name).stem for name in GENERATING_CODE} == needed
