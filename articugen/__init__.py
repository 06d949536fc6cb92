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
from typing import Any

_HOME = {
    "ArticugenError": "core.errors",
    "DataSet": "inspection.notebook",
    "Made": "instance.maker",
    "Maker": "instance.maker",
    "Model": "instance.maker",
    "Recipe": "core.recipe",
    "Row": "inspection.notebook",
    "check": "inspection.check.door",
    "discover": "discovery.objects",
    "evaluate": "learning.commands",
    "export": "",
    "fetch": "sources.fetch.door",
    "generate": "pipeline.door",
    "load": "instance.maker",
    "open": "inspection.notebook",
    "site": "inspection.report.site",
    "stream": "pipeline.stream",
    "train": "learning.commands",
    "verify": "",
}
"""The module of each name; "" where it is a module itself, which can be called. What comes from
`notebook` is the store's, with pictures."""

__all__ = list(_HOME)  # pyright: ignore[reportUnsupportedDunderAll] - the stub has the types
if find_spec("torch") is None:  # then `import *` and the like do without
    __all__.remove("evaluate")
    __all__.remove("train")


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module(f"{__name__}.core.content").VERSION
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    missing_extra = import_module(f"{__name__}.core.errors").MissingExtra
    try:
        home = import_module(f"{__name__}.{_HOME[name]}" if _HOME[name] else f"{__name__}.{name}")
    except missing_extra as missing:  # or hasattr and inspect would raise it
        raise AttributeError(f"{__name__}.{name}: {missing}") from missing
    value = getattr(home, name) if _HOME[name] else home
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__"})
