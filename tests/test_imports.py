"""The house, read from the imports of the code; docs/architecture.md draws the same picture."""

import ast
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from python_process import ended, printed

import articugen
from articugen.core.content import STAGES
from articugen.learning.method import METHODS

PACKAGE = Path(articugen.__file__).parent

FLOORS = (
    {"core"},
    {"meshes", "store", "rendering"},
    {"fusion", "procedural", "pictures", "discovery"},
    {"sources", "evaluation"},
    {"instance", "learning"},
    {"pipeline", "export", "inspection"},
    {"verify"},
    {"cli"},
)
"""From the cellar up: a room imports from floors below its own, never from its own or above."""

FLOOR = {room: level for level, rooms in enumerate(FLOORS, start=1) for room in rooms}

MOST_ARROWS = 70
MOST_LINES = 56_974
"""Of the whole package; it is lowered as the package shrinks."""
LARGEST_ROOM = 0.2
"""Its share of the lines."""
LONGEST_FILE = 450
CORE = {
    "arrays", "backends", "calling", "colours", "compiling", "content", "errors",
    "files", "geometry", "jit", "ledger", "memory", "near", "place", "plugins",
    "portable", "processes", "recipe", "records", "schema", "seeding", "tables", "texture",
    "yaml_files",
}  # fmt: skip
"""All that may lie in core/, or it becomes a drawer for everything."""

FOREIGN: dict[str, set[str]] = {
    "PIL": {
        "evaluation.recorded.frames",
        "inspection.report.site",
        "meshes.pixels",
        "pictures.layout",
        "pictures.shading",
    },
    "collada": {"meshes.materials"},
    "distributed": {"pipeline.executors.dask"},
    "fsspec": {"store.remote"},
    "h5py": {"export.hdf5", "store.columns", "store.writer"},
    "llvmlite": {"core.compiling"},
    "lxml": {"meshes.xml_strict", "sources.urdf"},
    "manifold3d": {"meshes.convex", "meshes.simpler"},
    "obstore": {"store.bucket"},
    "platformdirs": {"core.content"},
    "pyarrow": {"export.parquet"},
    "rich": {
        "cli.console",
        "cli.discover",
        "cli.learn",
        "cli.saying",
        "core.tables",
        "inspection.summary",
    },
    "safetensors": {"learning.commands", "learning.sealed"},
    "scipy": {"evaluation.metrics", "learning.commands"},
    "submitit": {"pipeline.executors.slurm"},
    "tensorboard": {"learning.run_folder"},
    "trimesh": {"export.assembly", "meshes.mesh_file", "meshes.points", "meshes.scenes"},
    "typer": {
        "cli.app",
        "cli.data",
        "cli.export",
        "cli.generate",
        "cli.learn",
        "cli.options",
        "cli.saying",
    },
    "viser": {
        "inspection.viewer.panel",
        "inspection.viewer.serve",
        "inspection.viewer.session",
        "inspection.viewer.stage",
    },
    "websockets": {"inspection.viewer.guard"},
    "yourdfpy": {"sources.urdf"},
}
"""The modules that wrap a library; nobody else imports it."""

COMPILED = {"kernel", "helper", "inlined"}
"""The decorators of core/jit.py."""

EVERYWHERE = {"numpy", "numba", "pydantic", "torch", "yaml"}


def _files() -> dict[str, Path]:
    """Every module of the package, by its full name."""
    return {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(
            ".__init__"
        ): path
        for path in sorted(PACKAGE.rglob("*.py"))
    }


MODULES = _files()
LINES = {name: len(path.read_bytes().splitlines()) for name, path in MODULES.items()}


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


@cache
def _statements(module: str, *, at_start: bool = False) -> list[ast.Import | ast.ImportFrom]:
    """Its imports, wherever they stand; or those alone that run when it is imported itself."""
    body = _tree(module).body
    tried = [inner for node in body if isinstance(node, ast.Try) for inner in node.body]
    nodes = [*body, *tried] if at_start else ast.walk(_tree(module))
    return [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]


def _imports(module: str, *, at_start: bool = False) -> set[str]:
    """Full names of what a module imports; of ours, the modules."""
    names = set()
    for node in _statements(module, at_start=at_start):
        if isinstance(node, ast.Import):
            full = [alias.name for alias in node.names]
        else:
            assert node.level == 0, f"{module} imports relatively"
            full = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in full:
            inner = name
            while inner.startswith("articugen.") and inner not in MODULES:
                inner = inner.rpartition(".")[0]
            names.add(inner)
    return names


IMPORTS = {module: _imports(module) for module in MODULES}
OURS = {m: {n for n in names if n in MODULES} - {m} for m, names in IMPORTS.items()}


def _room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_every_module_lies_in_a_room_that_has_a_floor() -> None:
    flat = {m for m in MODULES if m.count(".") < 2 and MODULES[m].name != "__init__.py"}
    assert flat == {"articugen.__main__"}
    assert {_room(m) for m in MODULES if m not in flat} - {""} == FLOOR.keys()


def test_a_room_imports_from_lower_floors_alone() -> None:
    arrows = set()
    for module, names in OURS.items():
        if module in ("articugen", "articugen.__main__"):
            continue
        for name in names:
            here, there = _room(module), _room(name)
            if here != there:
                assert FLOOR[there] < FLOOR[here], f"{module} imports {name}"
                arrows.add((here, there))
    assert len(arrows) <= MOST_ARROWS


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Inside rooms neither, nor for types alone, nor late."""
    graph = {m: {n for n in names if n != "articugen"} for m, names in OURS.items()}
    assert tuple(TopologicalSorter(graph).static_order())


def test_the_face_imports_no_room() -> None:
    assert not OURS["articugen"]


def test_core_holds_what_is_named_here() -> None:
    assert {m.removeprefix("articugen.core.") for m in MODULES if _room(m) == "core"} - {
        "articugen.core"
    } == CORE


def test_rooms_and_files_keep_their_measure() -> None:
    total = sum(LINES.values())
    assert total <= MOST_LINES, f"{total} lines: take out as many as you add (CONTRIBUTING.md)"
    for room in FLOOR:
        lines = sum(n for module, n in LINES.items() if _room(module) == room)
        assert lines <= LARGEST_ROOM * total, f"{room} has {lines} of {total} lines"
    for module, lines in LINES.items():
        assert lines <= LONGEST_FILE, module


@pytest.mark.parametrize("library", sorted(FOREIGN))
def test_a_library_has_one_home(library: str) -> None:
    users = {m for m, names in IMPORTS.items() if any(n.split(".")[0] == library for n in names)}
    assert {m.removeprefix("articugen.") for m in users} == FOREIGN[library]


def test_every_library_is_known() -> None:
    tops = {name.split(".")[0] for names in IMPORTS.values() for name in names}
    assert tops - sys.stdlib_module_names - EVERYWHERE - FOREIGN.keys() == {"articugen"}


def test_nobody_reaches_into_fusion_past_its_door() -> None:
    door = {alias.asname for node in _statements("articugen.fusion") for alias in node.names}
    door |= {"isosurface"}
    for module in (m for m in MODULES if _room(m) != "fusion"):
        for node in _statements(module):
            if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith(
                "articugen.fusion."
            ):
                inner = {node.module.split(".")[2]} if node.module.count(".") > 1 else {
                    alias.name for alias in node.names
                }  # fmt: skip
                assert inner <= door, f"{module} imports {inner}"


def test_what_all_learners_share_knows_no_method() -> None:
    """A method is found by its name, see learning.method."""
    methods = {".".join(where.partition(":")[0].split(".")[:3]) for where in METHODS.values()}
    for module in (m for m in MODULES if _room(m) == "learning"):
        for method in methods:
            if not module.startswith(method):
                assert not [n for n in OURS[module] if n.startswith(method)], module


def test_no_constant_of_another_file_is_compiled_into_a_kernel() -> None:
    """Numba would keep the old value: only the files of a kernel and of its helpers are watched."""
    for module in MODULES:
        named = {alias.asname or alias.name for node in _statements(module, at_start=True)
                 if isinstance(node, ast.ImportFrom) for alias in node.names}  # fmt: skip
        constants = {name for name in named if name.strip("_").isupper()}
        for function in _tree(module).body:
            if isinstance(function, ast.FunctionDef) and COMPILED & {
                name.id for mark in function.decorator_list for name in ast.walk(mark)
                if isinstance(name, ast.Name)
            }:  # fmt: skip
                used = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
                assert not used & constants, f"{module}.{function.name}"


def test_evaluation_is_numpy_alone() -> None:
    for module in (m for m in MODULES if _room(m) == "evaluation"):
        assert "torch" not in {name.split(".")[0] for name in IMPORTS[module]}, module


def test_help_waits_for_no_heavy_library() -> None:
    code = "import sys, articugen.cli; print(*sorted(m for m in sys.modules if '.' not in m))"
    loaded = printed("-c", code).split()
    assert "typer" in loaded
    assert not {"numpy", "numba", "h5py", "trimesh", "yourdfpy", "pydantic"} & set(loaded)


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("pipeline.door", {"numba", "trimesh"}),
        ("instance.maker", {"trimesh"}),
        ("learning.ppd.warm.found", {"torch"}),  # which workers import that look for joints
    ],
)
def test_runs_are_planned_without_numba_and_instances_made_without_trimesh(
    module: str, heavy: set[str]
) -> None:
    if module.startswith("learning"):
        pytest.importorskip("safetensors")
    loaded = printed("-c", f"import sys, articugen.{module}; print(*sys.modules)").split()
    assert f"articugen.{module}" in loaded
    assert not heavy & set(loaded)


def test_the_door_is_lazy_and_gives_what_it_names() -> None:
    code = "import sys, articugen as ag; print(*sys.modules)"
    loaded = printed("-c", code).split()
    assert {name for name in loaded if name.startswith("articugen")} == {"articugen"}
    assert not {"numpy", "numba", "h5py", "pydantic"} & set(loaded)
    stub = ast.parse(PACKAGE.joinpath("__init__.pyi").read_text(encoding="utf-8"))
    typed = {
        n.asname or n.name for s in stub.body if isinstance(s, ast.ImportFrom) for n in s.names
    }
    assert articugen._HOME.keys() == typed
    assert set(articugen.__all__) >= typed - {"train", "evaluate"}  # which want torch
    for name in set(articugen.__all__) - {"train", "evaluate"}:
        assert callable(getattr(articugen, name)), name
    with pytest.raises(AttributeError, match="no attribute 'opne'"):
        _ = articugen.opne  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("first", ["", "import articugen.verify.dataset\n"])
def test_a_package_that_is_called_like_a_function_can_be_called(first: str) -> None:
    code = (
        f"{first}import articugen as ag; import articugen.verify.check as module\n"
        "print(ag.verify('.').ok)"
    )
    done = ended("-c", code)
    assert done.stdout == "False\n", done.stderr


def test_the_core_needs_no_optional_library() -> None:
    """All but the files that wrap them import where open3d, torch and the like are absent."""
    optional = (
        "open3d", "pyrender", "OpenGL", "safetensors", "sapien", "tensorboard", "torch",
        "scipy", "pxr", "pyarrow", "viser", "distributed", "obstore", "fsspec", "submitit",
    )  # fmt: skip
    starts = {m: _imports(m, at_start=True) for m in MODULES}
    without = {"articugen.__main__"}
    while more := {
        m for m, names in starts.items() if any(n.split(".")[0] in optional for n in names)
        or names & without
    } - without:  # fmt: skip
        without |= more
    assert {_room(m) for m in without - {"articugen.__main__"}} == {"learning", "store"}
    code = (
        f"import sys, importlib\nfor name in {optional}: sys.modules[name] = None\n"
        f"for name in {sorted(MODULES.keys() - without)}: importlib.import_module(name)"
    )
    printed("-c", code)


def test_a_checkpoint_is_read_without_torch_s_compiler() -> None:
    """Which is imported where something is computed on `meta`, and takes longer than the rest."""
    pytest.importorskip("torch", reason="learners need torch")
    code = (
        "import sys, torch\nfrom articugen.learning.method import find_method, load_recipe\n"
        "for name in ('bae', 'bsp', 'ppd_quick', 'ppd_paper'):\n"
        "    recipe, meta = load_recipe(name), torch.device('meta')\n"
        "    find_method(recipe.method).start(recipe, seed=0, device=meta)\n"
        "    print(name, *{'torch._dynamo', 'sympy'} & {*sys.modules})"
    )
    assert printed("-c", code).split() == ["bae", "bsp", "ppd_quick", "ppd_paper"]


def test_every_stage_declares_a_version_of_what_it_makes() -> None:
    stages = {"articulation", "swept", "rendering", "fusion", "sampling", "sharp", "sources"}
    assert STAGES.keys() == stages | {"instance", "vocabulary"}
