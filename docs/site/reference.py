"""The pages of the reference: which names of the code are on which, written by mkdocstrings."""

HOMES = {
    "ArticugenError": "articugen.core.errors",
    "DataSet": "articugen.store.dataset",
    "Made": "articugen.instance.maker",
    "Maker": "articugen.instance.maker",
    "Model": "articugen.instance.maker",
    "Recipe": "articugen.core.recipe",
    "Row": "articugen.store.rows",
    "check": "articugen.inspection.check.door",
    "discover": "articugen.discovery.objects",
    "evaluate": "articugen.learning.commands",
    "export": "articugen.export.run",
    "fetch": "articugen.sources.fetch.door",
    "generate": "articugen.pipeline.door",
    "load": "articugen.instance.maker",
    "open": "articugen.store.dataset",
    "site": "articugen.inspection.report.site",
    "stream": "articugen.pipeline.stream",
    "train": "articugen.learning.commands",
    "verify": "articugen.verify.check",
}
"""Where each name of `articugen` is written; tests/test_site.py compares it with the package."""

_ELSEWHERE = {"verify": "check"}

_ABOUT = """Docstrings as they are in the code. [From Python](../python.md) says in short how these
go together; what is stored, with shapes, units and frames, is in [the files](../format.md)."""

_ON = {
    "data": ("Data sets and rows", ("open", "stream", "DataSet", "Row"), (
        "store.rows.RowJoint", "store.rows.RowPart", "store.rows.RowSurface",
        "store.rows.RowQueries", "store.rows.RowGrids", "store.rows.RowPartial",
        "store.rows.RowImages", "store.torch_dataset.TorchDataSet", "pipeline.stream.Stream",
        "store.torch_dataset.TorchStream",
    )),
    "models": ("Models at any joint state", ("load", "Model", "Maker", "Made"), (
        "instance.maker.MadeMesh", "core.records.Joint",
    )),
    "commands": ("What commands do", (
        "generate", "verify", "check", "site", "export", "discover", "train", "evaluate",
        "fetch",
    ), (
        "inspection.check.model.Checks", "inspection.check.model.Checked",
        "inspection.report.site.Site",
        "pipeline.options.Options", "export.run.Exported", "export.items.Options",
        "sources.fetch.target.Fetched",
    )),
    "recipes": ("Recipes", ("Recipe",), (
        "core.recipe.Articulation", "core.recipe.ViewSettings", "core.recipe.Fusion",
        "core.recipe.Sampling", "core.recipe.Images",
    )),
    "errors": ("Errors", ("ArticugenError",), (
        "core.errors.InvalidSource", "core.errors.InvalidRecipe", "core.errors.InvalidArgument",
        "core.errors.NotFetched", "core.errors.AccessRefused", "core.errors.RejectedInstance",
        "core.errors.NotOfCategory", "core.errors.MachineFault", "core.errors.CorruptShard",
        "core.errors.UnfitData", "core.errors.MissingExtra", "core.errors.MissingDriver",
        "core.errors.BrokenPlugin", "core.errors.InvalidCheckpoint",
        "core.errors.TrainingDiverged",
    )),
}  # fmt: skip
"""Of each page: its title, names of `ag`, and what these give and take, from articugen on."""


def pages() -> dict[str, str]:
    """Markdown by the page's place on the site."""
    return {f"reference/{name}.md": _page(*about) for name, about in _ON.items()}


def _page(title: str, offered: tuple[str, ...], others: tuple[str, ...]) -> str:
    entries = [
        _entry(f"{HOMES[name]}.{_ELSEWHERE.get(name, name)}", f"ag.{name}") for name in offered
    ]
    entries += [_entry(f"articugen.{name}", name.rpartition(".")[2]) for name in others]
    return "\n".join([f"# {title}\n", _ABOUT, "", *entries])


def _entry(identifier: str, heading: str) -> str:
    return f"::: {identifier}\n    options:\n      heading: {heading}\n      toc_label: {heading}\n"
