"""The same answer every time, in any order of tests: chance is the same for each of them.

`make fuzz` draws anew, by `--hypothesis-profile=chance`; what it finds is printed, and becomes an
`@example` of its test.
"""

import os
import random
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from browser import browser
from hypothesis import settings

from articugen.core import plugins
from articugen.core.processes import default_jobs

settings.register_profile("same", derandomize=True, database=None, deadline=None)
# On a build server hypothesis is derandomised unless it is asked for chance.
settings.register_profile(
    "chance", derandomize=False, database=None, deadline=None, print_blob=True
)
settings.load_profile("same")

NEED_TORCH = (
    "bae", "blocks", "bsp", "cells", "cli_learn", "dataset", "fields", "loop", "method", "nsd",
    "one_part", "optimisers", "ppd_bench", "ppd_depth", "ppd_devices", "ppd_fused", "ppd_local",
    "ppd_losses", "ppd_model", "ppd_reconstruct", "ppd_release", "ppd_states", "ppd_variation",
    "ppd_warm_start", "race", "runs", "tensorboard", "viewer_run",
)  # fmt: skip
collect_ignore = [] if find_spec("torch") else [f"test_{name}.py" for name in NEED_TORCH]


def pytest_configure() -> None:
    """Keep what tests write in memory where there is room: a disk may take 4 ms for each file."""
    if os.access("/dev/shm", os.W_OK):
        memory = os.statvfs("/dev/shm")
        roomy = memory.f_bavail * memory.f_frsize > 8 << 30
        if roomy and not memory.f_flag & os.ST_NOEXEC:  # tests write programs, too
            os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", "/dev/shm")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than cores: some tests wait, for a process that ends or a time that passes."""
    return default_jobs() + 1


def pytest_report_header() -> list[str]:
    """Tell what is left out."""
    return [f"without torch, not run: {', '.join(collect_ignore)}"] if collect_ignore else []


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--but", metavar="REPORT",
        help="leave out what passed by this JUnit report of a run with fewer libraries",
    )  # fmt: skip


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what passed elsewhere, but for tests that do more with more libraries."""
    if not (report := config.getoption("--but")):
        return
    cases = ElementTree.parse(report).iter("testcase")
    passed = {(case.get("classname"), case.get("name")) for case in cases if not len(case)}

    def is_known(item: pytest.Item) -> bool:
        module = item.nodeid.partition("::")[0].removesuffix(".py").replace("/", ".")
        return (module, item.name) in passed and not item.get_closest_marker("extras")

    config.hook.pytest_deselected(items=[item for item in items if is_known(item)])
    items[:] = [item for item in items if not is_known(item)]


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Begin with the same random numbers, whichever tests came before in this process."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - libraries draw from it
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)
        sys.modules["torch"].set_num_threads(1)


@pytest.fixture(scope="module")
def boxes(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of hinged boxes; a module says in BOXES how many: see `write_boxes`."""
    from ppd_data import write_boxes  # noqa: PLC0415 - what few tests need

    folder = tmp_path_factory.mktemp("data") / "box"
    return write_boxes(folder, **getattr(request.module, "BOXES", {}))


@pytest.fixture(scope="session")
def laptops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two bundled laptops, whose models can be made again; nobody writes into it."""
    from exports import generated  # noqa: PLC0415 - what few tests need

    return generated("laptop", tmp_path_factory.mktemp("laptops"), objects=2, states=2)


@pytest.fixture
def forget_plugins() -> Callable[[], None]:
    """Has installed plugins looked up again."""

    def forget() -> None:
        for cached in (plugins._found, plugins._load, plugins.Table.load_all):
            cached.cache_clear()

    return forget


@pytest.fixture
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has figures of learners show one object in as few poses as there can be, and small: at its
    full size a picture takes half a second."""
    for name, few in (("OBJECTS", 1), ("STEPS", 2), ("EXAMPLE_STATES", 1)):
        monkeypatch.setattr(f"articugen.evaluation.figures.{name}", few)
    monkeypatch.setattr("articugen.pictures.portrait.tile_camera.__defaults__", (32,))


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def viser() -> Any:
    return pytest.importorskip("viser", reason="viser is not installed")


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Return a shard of the instances that `hinged_box` makes, and what is recorded of it."""
    from instances import hinged_box  # noqa: PLC0415 - takes a second
    from ppd_data import attributes_of  # noqa: PLC0415

    from articugen.store.writer import write_shard  # noqa: PLC0415

    path = tmp_path_factory.mktemp("shard") / "train-00000.h5"
    return path, write_shard(path, hinged_box(), attributes_of())


@pytest.fixture
def copy(written: tuple[Path, Any], tmp_path: Path) -> Path:
    """Return a copy of it, to be changed."""
    return Path(shutil.copy(written[0], tmp_path / "copy.h5"))


@pytest.fixture
def own_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that ARTICUGEN_SOURCES names."""
    folder = tmp_path / "own"
    folder.mkdir()
    monkeypatch.setenv("ARTICUGEN_SOURCES", str(folder))
    return folder
