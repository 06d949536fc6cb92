"""The names of the package, with their types: `__init__.py` hands them on late."""

from articugen.core.errors import ArticugenError
from articugen.core.recipe import Recipe
from articugen.discovery.objects import discover
from articugen.export.run import export
from articugen.inspection.check.door import check
from articugen.inspection.notebook import DataSet, Row, open
from articugen.inspection.report.site import site
from articugen.instance.maker import Made, Maker, Model, load
from articugen.learning.commands import evaluate, train
from articugen.pipeline.door import generate
from articugen.pipeline.stream import stream
from articugen.sources.fetch.door import fetch
from articugen.verify.check import check as verify

__version__: str
__all__ = [
    "ArticugenError",
    "DataSet",
    "Made",
    "Maker",
    "Model",
    "Recipe",
    "Row",
    "check",
    "discover",
    "evaluate",
    "export",
    "fetch",
    "generate",
    "load",
    "open",
    "site",
    "stream",
    "train",
    "verify",
]
