"""docs/exports/<format>.md, a page a format: files, fields and snippet, beside a real export.

A page says of files `<split>/<object>_<state>.ply`, what is in <> standing for any name, and of
fields name, dtype and shape in a table that begins with `| field |`.
"""

import importlib.util
import re
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest
from python_process import printed

import articugen as ag
from articugen.export.formats import FORMATS, format_named

DOCS = Path(__file__).resolve().parents[1] / "docs"
ASKING = {
    "extends": "quick",
    "views": {"count": 30, "resolution": 128},
    "sampling": {
        "sharp_points": 1024, "near_sharp": 0.25, "near_sigma": [0.001, 0.005],
        "signed_distance": 0.05,
    },
    "images": {"views": 9, "resolution": 64, "fields": ["depth", "rgba"]},
}  # fmt: skip
BESIDE = {"export.json", "croissant.json"}
"""Every export has these; docs/exports.md says so, once for all."""

READERS = {
    "parquet": "datasets", "webdataset": "webdataset", "mjcf": "mujoco", "usd": "pxr",
    "glb": "pygltflib",
}  # fmt: skip


def page(name: str) -> str:
    return (DOCS / "exports" / f"{name}.md").read_text(encoding="utf-8")


def code(name: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page(name), re.DOTALL | re.MULTILINE)


def pattern(said: str, any_name: str = "[^/]+") -> re.Pattern[str]:
    """What a name with <...> in it stands for."""
    return re.compile(re.sub(r"<[^>]+>", lambda _: any_name, re.escape(said)))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data/laptop: two laptops, with everything that some format asks for."""
    folder = tmp_path_factory.mktemp("pages")
    ag.generate("laptop", out=folder / "data", recipe=ASKING, objects=2, states=2, jobs=0)
    return folder


def options_for(to: str, **more: bool | None) -> dict:
    """Options that the format takes, of `more` and a coarse grid; skipped without its library."""
    for library, extra in format_named(to).needs:
        pytest.importorskip(library, reason=f"needs articugen[{extra}]")
    return {k: v for k, v in {"resolution": 32, **more}.items() if k in format_named(to).takes}


@pytest.fixture(scope="module")
def exported(root: Path):
    """The folder of the laptops in a format: <root>/<format>/laptop, as the pages have it."""

    @cache
    def export(to: str) -> Path:
        options = options_for(to, collision=None if to == "usd" else True)
        assert ag.export(root / "data" / "laptop", to, root / to / "laptop", **options).files
        return root / to / "laptop"

    return export


def test_every_format_has_its_page_and_the_overview_and_the_site_link_it() -> None:
    assert {path.stem for path in (DOCS / "exports").glob("*.md")} == set(FORMATS)
    overview = (DOCS / "exports.md").read_text(encoding="utf-8")
    site = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    readme = (DOCS.parent / "README.md").read_text(encoding="utf-8")
    for name in FORMATS:
        assert format_named(name).what
        assert page(name).startswith(f"# {name}: ")
        assert f"--to {name} --out {name}/laptop" in page(name)
        assert f"[`{name}`](exports/{name}.md)" in overview
        assert f"- exports/{name}.md" in site
        assert f"`{name}`" in readme


@pytest.mark.parametrize("split", ["../../x", "absolute", ""])
@pytest.mark.parametrize("name", FORMATS)
def test_no_split_leads_out_of_the_folder(name: str, split: str, root: Path, tmp_path) -> None:
    """Neither manifest nor shard may name such splits; should one ever come through, the folder
    that is written to holds all the same."""
    split = f"{tmp_path}/absolute" if split == "absolute" else split
    data = ag.open(root / "data" / "laptop")
    data = data.of(data.objects[0])[:2]
    data._shelf.entries = tuple(replace(entry, split=split) for entry in data._shelf.entries)
    out = tmp_path / "a" / "b" / "out"
    with suppress(ag.ArticugenError):
        ag.export(data, name, out, **options_for(name, from_grids=True))
    assert {p for p in tmp_path.rglob("*") if p.is_file() and not p.is_relative_to(out)} == set()
    assert not list(root.glob("x*"))


@pytest.mark.parametrize("name", FORMATS)
def test_options_are_those_that_the_format_takes(name: str) -> None:
    said = page(name).partition("\n## Options\n")[2]
    listed = set(re.findall(r"^\| `--([a-z-]+)", said, re.MULTILINE))
    assert {option.replace("-", "_") for option in listed} == set(format_named(name).takes)


@pytest.mark.parametrize("name", FORMATS)
def test_stated_files_are_all_that_an_export_writes(name: str, exported) -> None:
    folder = exported(name)
    there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} - BESIDE
    stated = [line.split("  ")[0] for line in code(name, "text")[0].splitlines()]
    assert stated
    for said in stated:
        assert any(pattern(said).fullmatch(file) for file in there), f"{said} is not written"
    for file in there:
        assert any(pattern(said).fullmatch(file) for said in stated), f"{file} is not stated"


def fields_stated(name: str) -> dict[str, tuple[str, str]]:
    """(dtype, shape) of each field of a page's tables, by its name."""
    found = {}
    for table in re.findall(r"^\| field \|.*?(?:\n\n|\Z)", page(name), re.DOTALL | re.MULTILINE):
        for row in table.strip().splitlines()[2:]:
            names, dtype, shape, _ = (cell.strip() for cell in row.strip().strip("|").split("|"))
            if dtype:
                found |= dict.fromkeys(re.findall(r"`([^`]+)`", names), (dtype, shape))
    return found


def fields_of(path: Path) -> dict[str, np.ndarray]:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=True) as data:
            arrays = {name: data[name] for name in data.files}
        return arrays["arr_0"].item() if set(arrays) == {"arr_0"} else arrays
    arrays = {}
    with h5py.File(path) as data:
        data.visititems(
            lambda name, item: (
                arrays.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None
            )
        )
    return arrays


@pytest.mark.parametrize("name", FORMATS)
def test_stated_fields_are_those_of_the_files(name: str, exported) -> None:
    stated, seen = fields_stated(name), set()
    paths = [p for p in exported(name).rglob("*") if p.suffix in (".npz", ".h5", ".hdf5")]
    for path in paths:
        for field, array in fields_of(path).items():
            (said,) = [s for s in stated if pattern(s, "[0-9]+").fullmatch(field)]
            dtype, shape = stated[said]
            assert str(array.dtype) == dtype, (path.name, field)
            axes = [axis.strip() for axis in shape.strip("()").split(",") if axis.strip()]
            assert len(axes) == array.ndim, (path.name, field, shape)
            for axis, size in zip(axes, array.shape, strict=True):
                assert not axis.isdecimal() or int(axis) == size, (path.name, field, shape)
            seen.add(said)
    assert seen == set(stated)


@pytest.mark.parametrize("name", FORMATS)
def test_the_snippet_of_a_page_reads_an_export(name: str, exported, root: Path) -> None:
    reader = READERS.get(name, "numpy")
    if importlib.util.find_spec(reader) is None:
        pytest.skip(f"{reader} is not installed: make exporters")
    exported(name)
    (snippet,) = code(name, "python")
    home = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(root / "home")}
    assert printed("-c", snippet, folder=root, seconds=120, **home).strip()
