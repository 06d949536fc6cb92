"""Who may import whom, kept by reading the source: docs/architecture.md draws the same picture."""

import ast
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from python_process import printed

import articugen
from articugen import fusion
from articugen.core.content import STAGES as DECLARED

PACKAGE = Path(articugen.__file__).parent

VOCABULARY = {
    "bundled", "calling", "colours", "content", "errors", "geometry", "jit", "memory", "plugins",
    "portable", "recipe", "recipe_files", "records",
    "seeding", "store.files", "store.schema",
}  # fmt: skip
"""What everybody speaks; the two of the store are what recipes are checked against and read by."""

STAGES = {"articulation", "swept", "rendering", "fusion", "sampling", "sources"}

WITH_TORCH = {"store.torch_dataset"} | {
    f"learning.{name}"
    for name in (
        "benchmark", "cells", "commands", "dataset", "loop", "optimisers", "processes", "race",
        "runs", "safetensors", "study", "tensors", "together",
        "ppd.batches", "ppd.depth", "ppd.descent", "ppd.discriminator", "ppd.drawing",
        "ppd.encoders", "ppd.found", "ppd.fused", "ppd.kinematics", "ppd.learner", "ppd.many",
        "ppd.warm_start", "ppd.losses", "ppd.model", "ppd.objective", "ppd.reconstruct",
        "ppd.release", "ppd.shape", "ppd.targets", "ppd.variation",
    )
}  # fmt: skip
"""The modules that cannot be imported without torch."""

MAY_IMPORT: dict[str, set[str]] = {
    # the vocabulary
    "errors": set(),
    "jit": set(),
    "memory": set(),
    "mesh_file": {"errors", "records"},
    "bundled": set(),
    "calling": set(),
    "colours": set(),
    "plugins": {"errors"},
    "ply": set(),
    "content": set(),
    "portable": set(),
    "seeding": set(),
    "geometry": {"portable"},
    "records": {"geometry", "portable", "store.schema"},
    "model_text": set(),
    "marching_cubes": {"records"},
    "recipe_files": {"bundled", "errors", "store.files"},
    "rendering.backends": {"errors", "plugins", "recipe_files", "records"},
    "recipe": {"bundled", "errors", "recipe_files", "rendering.backends", "store.schema"},
    # the stages, none of which knows another
    **dict.fromkeys(STAGES, VOCABULARY),
    # the process that reads USD dies with the worker that asked it to
    "sources": VOCABULARY | {"model_text", "ply", "workers"},
    "fusion": VOCABULARY | {"marching_cubes"},
    "fusion.bvh": VOCABULARY,
    "fusion.kernels": VOCABULARY | {"fusion.bvh"},
    "fusion.winding": VOCABULARY | {"fusion.bvh", "fusion.solidify"},
    "fusion.reachable": VOCABULARY | {"fusion.bvh", "fusion.kernels"},
    "fusion.solidify": VOCABULARY,
    "fusion.thin": VOCABULARY | {"fusion.bvh", "fusion.reachable", "fusion.solidify"},
    "sharp": VOCABULARY | {"sampling"},
    # what leads through them
    "instance": VOCABULARY | STAGES | {"sharp"},
    "workers": {"errors"},
    "sharing": set(),
    "cluster": {"errors", "workers", "store.manifest"},
    "rehearsal": VOCABULARY
    | STAGES
    | {"inspection", "report.skin"}
    | {"learning.ppd.greatest", "learning.ppd.patches", "learning.ppd.sine_kernels"},
    "compiling": {"bundled", "workers", "rehearsal"},
    "estimate": {"store.manifest", "recipe"},
    "pipeline": VOCABULARY
    | {"store", "sources", "articulation", "resolving", "instance", "workers", "estimate"}
    | {"cluster", "compiling", "sharing"},
    # beyond one machine
    "ranks": VOCABULARY | {"pipeline", "sources", "store"},
    "slurm": {"compiling", "errors", "pipeline", "ranks", "store.manifest", "store.rank_journal"},
    "bucket_runs": VOCABULARY | {"compiling", "pipeline", "ranks", "sources", "store", "workers"},
    # the store, which knows no stage
    "store": set(),
    "store.files": {"errors"},
    "store.schema": set(),
    "store.chunks": set(),
    "store.bucket": {"errors"},
    "store.remote": {"errors", "store.bucket"},
    "store.shards": {"errors", "records", "store.files", "store.schema", "store.chunks"}
    | {"store.bucket", "store.remote"},
    "store.rows": {"errors", "geometry", "records", "store.schema"},
    "store.dataset": VOCABULARY
    | {"store.bucket", "store.manifest", "store.remote", "store.rows", "store.shards"}
    | {"store.torch_dataset"},
    "store.torch_dataset": {"errors"},
    "store.manifest_pages": {"store.files"},
    "store.manifest": {"errors", "store.bucket", "store.files", "store.manifest_pages"}
    | {"store.schema", "store.shards"},
    "store.croissant": {"store.manifest"},
    "store.journal": {"errors", "store.files", "store.manifest", "store.manifest_pages"}
    | {"store.croissant", "store.shards"},
    "store.cleaning": {"store.journal"},
    "store.rank_journal": {"errors", "store.files", "store.journal", "store.manifest"}
    | {"store.manifest_pages"},
    "store.bucket_journal": {"errors", "store.bucket", "store.journal", "store.manifest"}
    | {"store.rank_journal"},
    # what reads it
    "verify": {"calling"},
    "verify.bounds": set(),
    "verify.exact": VOCABULARY | {"verify.bounds"},
    "verify.nearest": {"jit"},
    "verify.sampled": VOCABULARY | {"verify.bounds", "verify.nearest"},
    "verify.extras": VOCABULARY | {"verify.bounds", "verify.nearest"},
    "verify.invariants": VOCABULARY | {"verify.exact", "verify.extras", "verify.sampled"},
    "resolving": VOCABULARY | {"sources", "articulation"},
    "verify.dataset": VOCABULARY | {"store", "verify.invariants", "workers"},
    "verify.replay": VOCABULARY
    | {"store", "sources", "articulation", "fusion", "instance", "pipeline", "verify", "mesh_file"},
    "verify.rebuild": VOCABULARY
    | {"store", "sources", "instance", "pipeline", "resolving", "verify", "workers"},
    "verify.repair": VOCABULARY | {"store", "sources", "pipeline", "verify"},
    "verify.check": {"errors", "pipeline", "verify"},
    "inspection": VOCABULARY | {"store", "rendering"},
    "report": VOCABULARY | {"store", "inspection", "marching_cubes"},
    "report.facts": VOCABULARY | {"store"},
    "report.skin": VOCABULARY | {"inspection", "marching_cubes"},
    # alone in that room may know a stage: where links stand, and what they are made from
    "report.truth": VOCABULARY | {"store", "sources", "articulation", "resolving", "report.facts"},
    # joints found from several poses, for learners and for a command of its own
    "discovery": VOCABULARY,
    "learning": VOCABULARY
    | {"store", "inspection", "marching_cubes", "workers", "model_text", "plugins", "ply"}
    | {"discovery"},
    "learning.ppd.greatest": {"jit"},
    "learning.ppd.patches": {"jit"},
    "learning.ppd.sine_kernels": {"jit"},
    "learning.evaluation": VOCABULARY | {"store", "inspection", "marching_cubes"},
    # others' formats, a file a format; parts are made again as replay does
    "export": VOCABULARY
    | {"store", "inspection", "marching_cubes", "model_text", "verify.replay", "export"},
    # models of others, from where they are published
    "fetching": VOCABULARY | {"sources"},
    # the door, for notebooks
    "maker": VOCABULARY | STAGES | {"instance", "mesh_file", "store.rows"},
    "notebook": VOCABULARY | {"store", "inspection"},
    "api": VOCABULARY | {"bucket_runs", "pipeline", "slurm", "sources", "store"},
    "found_joints": VOCABULARY | {"discovery", "store", "learning.clouds"},
    # the browser: what is stored, or made again by what notebooks make it with
    "viewer": VOCABULARY
    | {"inspection", "learning", "maker", "marching_cubes", "report.markup", "sources", "store"}
    | {"export.simpler", "verify.replay"},
    "cli": {
        "api",
        "export",
        "fetching",
        "found_joints",
        "discovery",
        "compiling",
        "errors",
        "records",
        "recipe",
        "recipe_files",
        "store",
        "sources",
        "pipeline",
        "bucket_runs",
        "ranks",
        "slurm",
        "verify",
        "inspection",
        "report",
        "learning",
        "viewer",
    },
    "__main__": {"cli"},
}
"""For each module or room, which others of ours it may import; a module's own line counts before
that of its room, and a room may import what lies in it."""

FOREIGN: dict[str, set[str]] = {
    "h5py": {"store.shards", "export.hdf5"},
    "llvmlite": {"compiling"},
    "tensorboard": {"learning.tensorboard"},
    "platformdirs": {"bundled"},
    "yourdfpy": {"sources.urdf"},
    "lxml": {"sources.urdf", "sources.xml_strict"},
    "trimesh": {"sources.mesh_formats", "mesh_file", "learning.clouds", "export.inertia"},
    "coacd": {"export.assembly"},
    "manifold3d": {"export.simpler"},
    "pyarrow": {"export.parquet"},
    "PIL": {"export.artgs", "inspection.layout", "inspection.shading"},
    "matplotlib": {"learning.evaluation.figures.plots"},
    "typer": {
        "cli.data",
        "cli.discover",
        "cli.export",
        "cli.fetch",
        "cli.learn",
        "cli.saying",
        "cli.shares",
        "cli.view",
    },
    "rich": {
        "cli.data",
        "cli.console",
        "cli.discover",
        "cli.export",
        "cli.fetch",
        "cli.learn",
        "cli.saying",
        "cli.view",
        "inspection.summary",
        "inspection.tables",
    },
    "distributed": {"cluster"},
    "obstore": {"store.bucket"},
    "fsspec": {"store.remote"},
    "submitit": {"slurm"},
    "open3d": {"rendering.embree"},
    "pyrender": {"rendering.opengl"},
    "OpenGL": {"rendering.opengl"},
    "sapien": {"rendering.sapien"},
    "websockets": {"viewer.guard"},
    "viser": {"viewer.panel", "viewer.serve", "viewer.session", "viewer.stage"},
    "torch": WITH_TORCH | {"learning.method", "learning.ppd.method", "learning.tensorboard"},
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


def rule_of(module: str) -> str:
    """The line of MAY_IMPORT that holds for a module: its own, or that of the room it lies in."""
    while module not in MAY_IMPORT and "." in module:
        module = module.rpartition(".")[0]
    return module


@pytest.mark.parametrize("module", [m for m in modules() if m != "__init__"])
def test_a_module_imports_only_what_it_may(module: str) -> None:
    rule = rule_of(module)
    for name in imports(module):
        top, _, rest = name.partition(".")
        if top == "articugen":
            allowed = MAY_IMPORT[rule] | {rule, "__version__"}
            assert any(f"{rest}.".startswith(f"{a}.") for a in allowed), f"{module} imports {name}"
        elif top not in sys.stdlib_module_names | EVERYWHERE:
            assert module in FOREIGN.get(top, set()), f"{module} imports {name}"


def test_nobody_reaches_into_fusion_past_its_door() -> None:
    door = set(fusion.__all__) | {"isosurface"}
    for module in modules():
        if module.split(".")[0] not in ("fusion", "rehearsal"):  # which calls every kernel once
            for name in imports(module):
                inner = name.removeprefix("articugen.fusion.")
                assert inner == name or inner.split(".")[0] in door, f"{module} imports {name}"


def test_what_all_learners_share_knows_no_method() -> None:
    """A method is found by its name, see learning.method; evaluation lies below all the rest."""
    for module in (m for m in modules() if m.startswith("learning.")):
        ours = {name.removeprefix("articugen.") for name in imports(module)}
        if not module.startswith("learning.ppd"):
            assert not [n for n in ours if n.startswith("learning.ppd")], module
        if module.startswith("learning.evaluation"):
            above = {n for n in ours if n.startswith(("learning.", "torch"))}
            assert not {n for n in above if not n.startswith("learning.evaluation")}, module


def test_every_module_has_its_place_in_the_picture() -> None:
    for module in set(modules()) - {"__init__"}:
        assert rule_of(module) in MAY_IMPORT, f"give {module} a line in MAY_IMPORT"


def test_the_picture_has_no_cycle() -> None:
    left = {name: {rule_of(w) for w in wanted} - {name} for name, wanted in MAY_IMPORT.items()}
    for name, wanted in left.items():  # a room as a whole comes after each of its modules
        wanted.update(m for m in MAY_IMPORT if m.startswith(f"{name}."))
        if name.startswith("verify."):
            wanted.discard("verify")
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


def test_the_door_is_lazy_and_gives_what_it_names() -> None:
    loaded = printed("-c", "import sys, articugen as ag; print(*sys.modules)").split()
    ours = {name for name in loaded if name.startswith("articugen")}
    assert ours == {"articugen"}
    assert not {"numpy", "numba", "h5py", "pydantic"} & set(loaded)
    learns = {"train", "evaluate"} if importlib.util.find_spec("torch") else set[str]()
    assert set(articugen.__all__) == set(articugen._HOME) - {"train", "evaluate"} | learns
    assert set(articugen.__all__) <= set(dir(articugen))
    for name in articugen.__all__:
        assert callable(getattr(articugen, name)), name
    with pytest.raises(AttributeError, match="no attribute 'opne'"):
        _ = articugen.opne


def test_without_torch_the_package_can_be_looked_at() -> None:
    code = """
import sys
sys.modules["torch"] = None
import inspect, pydoc
import articugen as ag
from articugen import *
print(hasattr(ag, "train"), "train" in dir(ag), len(inspect.getmembers(ag)) > 14)
print(generate is ag.generate, "generate" in pydoc.render_doc(ag))
try:
    ag.evaluate
except AttributeError as error:
    print(error)
"""
    looks, works, sentence = printed("-c", code).splitlines()
    assert (looks, works) == ("False False True", "True True")
    assert sentence.startswith("articugen.evaluate: torch is not installed; run: ")
    assert sentence.endswith(" install 'articugen[ppd]'")


@pytest.mark.parametrize("first", ["", "import articugen.verify.dataset\n"])
def test_a_package_that_is_called_like_a_function_can_be_called(first: str) -> None:
    code = (
        f"{first}import articugen as ag; import articugen.verify.check as module\n"
        "print(ag.verify('.').ok)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "False\n", done.stderr


def test_the_core_needs_no_optional_library() -> None:
    """All but the files that wrap them import where open3d, torch and the like are absent."""
    optional = (
        "open3d", "pyrender", "OpenGL", "sapien", "tensorboard", "torch", "scipy", "matplotlib",
        "coacd", "pxr", "pyarrow", "viser", "distributed", "obstore", "fsspec",
        "submitit",
    )  # fmt: skip
    drawing = {f"learning.evaluation.figures.{name}" for name in ("draw", "plots")}
    without = WITH_TORCH | drawing | {"__init__", "__main__"}
    names = [m for m in modules() if m not in without]
    code = (
        f"import sys, importlib\nfor name in {optional}: sys.modules[name] = None\n"
        f"for name in {names}: importlib.import_module('articugen.' + name)"
    )
    printed("-c", code)


@pytest.mark.parametrize("recipe", ["ppd_quick", "ppd_paper"])
def test_a_checkpoint_is_read_without_torch_s_compiler(recipe: str) -> None:
    """Which is imported where something is computed on `meta`, and takes longer than the rest."""
    pytest.importorskip("torch", reason="learners need torch")
    code = (
        "import sys, torch\nfrom articugen.learning.method import find_method, load_recipe\n"
        f"recipe, meta = load_recipe({recipe!r}), torch.device('meta')\n"
        "find_method('ppd').start(recipe, seed=0, device=meta)\n"
        "print(*{'torch._dynamo', 'sympy'} & {*sys.modules})"
    )
    assert printed("-c", code).split() == []


def test_every_stage_declares_a_version_of_what_it_makes() -> None:
    assert DECLARED.keys() == STAGES | {"instance", "sharp", "vocabulary"}
