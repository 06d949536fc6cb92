"""articugen: articulated URDF models in, training data for part decomposition out.

    import articugen as ag

    data = ag.open("data/laptop")       # len, data[7], slices, data.split("test"), data.batch(16)
    maker = ag.Maker(ag.load("my/cabinet.urdf"), recipe="quick")
    inst = maker.at(door=1.2)           # inst.labels(points), inst.mesh(), inst.flow_to(other)

Whatever a command does is a function here: `fetch`, `generate`, `verify`, `export`,
`train`, `evaluate`. Each is imported when it is first used. docs/python.md has them all.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from articugen.core.errors import ArticugenError
    from articugen.core.recipe import Recipe
    from articugen.discovery.objects import discover
    from articugen.export.run import export
    from articugen.inspection.notebook import DataSet, Row, open
    from articugen.instance.maker import Made, Maker, Model, load
    from articugen.learning.commands import evaluate, train
    from articugen.pipeline.door import generate
    from articugen.sources.fetch.door import fetch
    from articugen.verify.check import check as verify

_HOME = {
    "ArticugenError": "errors",
    "DataSet": "notebook",
    "Made": "maker",
    "Maker": "maker",
    "Model": "maker",
    "Recipe": "recipe",
    "Row": "notebook",
    "discover": "found_joints",
    "evaluate": "learning.commands",
    "export": "",
    "fetch": "fetching.door",
    "generate": "api",
    "load": "maker",
    "open": "notebook",
    "train": "learning.commands",
    "verify": "",
}
"""The module of each name; "" where it is a module itself, which can be called. What comes from
`notebook` is the store's, with pictures."""

__all__ = [
    "ArticugenError",
    "DataSet",
    "Made",
    "Maker",
    "Model",
    "Recipe",
    "Row",
    "discover",
    "evaluate",
    "export",
    "fetch",
    "generate",
    "load",
    "open",
    "train",
    "verify",
]
if find_spec("torch") is None:  # then `import *` and the like do without
    __all__.remove("evaluate")
    __all__.remove("train")


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from articugen.core.errors import MissingExtra  # noqa: PLC0415 - as everything else

    try:
        home = import_module(f"{__name__}.{_HOME[name]}" if _HOME[name] else f"{__name__}.{name}")
    except MissingExtra as missing:  # or hasattr and inspect would raise it
        raise AttributeError(f"{__name__}.{name}: {missing}") from missing
    value = getattr(home, name) if _HOME[name] else home
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__"})
