"""The gallery of the site: a small data set of each category, its contact sheet and its report, and
many objects of the plain and of the varied source.

`python docs/site/gallery.py build/gallery` makes it as `generate` and `inspect` do; data that
are there already are kept. `pages` then tells mkdocs what came out.
"""

# The program is imported where it is used: mkdocs imports this for `pages` alone.
# ruff: noqa: PLC0415
import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

CATEGORIES = ("drawer", "eyeglasses", "laptop", "oven", "washing_machine")
MANY, COLUMNS = 60, 10
SOURCES = ("procedural", "procedural_varied")

_OVERVIEW = """# Gallery

The five bundled categories, made by `articugen generate --recipe {recipe}` for this site, and
drawn from what their shards hold by `articugen inspect --image`. Each row is an object, each column
a joint state, the first the canonical pose; each colour is a part. The report of a category, by
`articugen inspect --html`, has an object to turn, with a slider for each joint.

"""

_ENTRY = """## {name}

[![{count} in random joint states]({category}.png){{ loading=lazy }}]({category}.md)

{about} [Open its report]({category}.md).

{many}

"""

_MANY = """`{source}`:

![Objects of {source}, each opened somewhere]({category}-{source}.png){{ loading=lazy }}
"""

_REPORT = """---
hide: [navigation, toc]
---
# {name}: the report

{about} This is the one file that `articugen inspect data/{category} --html` writes;
[open it alone]({category}-report.html) for all of the screen. [How it is made](../report.md).

<iframe class="report" src="{category}-report.html" title="Report of {category}"></iframe>
"""


def make(folder: Path, recipe: str, jobs: int | None = None, many: int = MANY) -> None:
    """Make what is missing of the gallery in `folder`, with so many workers, None for all cores.

    Args:
        many: so many objects of each source are drawn.
    """
    import articugen as ag
    from articugen.inspection.report.page import write_report
    from articugen.pictures.contact_sheet import contact_sheet

    for number, category in enumerate(CATEGORIES, 1):
        print(f"gallery: {category}, {number} of {len(CATEGORIES)} ...", flush=True)
        data = ag.generate(category, out=folder / "data", recipe=recipe, jobs=jobs, replace=True)
        contact_sheet(data.shards, folder / f"{category}.png")
        write_report(data.path, data.shards, folder / f"{category}-report.html")
        for source in SOURCES:
            crowd = ag.generate(
                category, source=source, recipe=recipe, objects=many, states=2, jobs=jobs,
                out=folder / "many" / source, replace=True,
            )  # fmt: skip
            _draw_many(crowd.shards, many, folder / f"{category}-{source}.png")


def _draw_many(shards: Sequence[Path], many: int, path: Path) -> None:
    """Draw so many objects as a PNG, each in the state in which its joints have moved most."""
    from articugen.pictures.contact_sheet import chosen_of, portraits
    from articugen.pictures.layout import Row, save, sheet

    widest = portraits(chosen_of(shards, many), states=2, which=slice(-1, None))
    drawn = [one.pictures[0] for one in widest]
    rows = [drawn[k : k + COLUMNS] for k in range(0, len(drawn), COLUMNS)]
    drawing = sheet([Row("", row, [()] * len(row)) for row in rows])
    save(drawing.resize((drawing.width // 2, drawing.height // 2)), path)


def pages(folder: Path) -> dict[str, str | Path]:
    """Text, or the file to copy, of each page and picture of the gallery, by its place on the site.

    Raises:
        FileNotFoundError: the gallery was not made.
    """
    made: dict[str, str | Path] = {}
    entries = []
    for category in CATEGORIES:
        manifest = json.loads((folder / "data" / category / "manifest.json").read_text("utf-8"))
        told = {"category": category, "name": category.replace("_", " ").capitalize()}
        told |= {"about": _about(manifest), "count": _objects(manifest)}
        crowds = [f"{category}-{source}.png" for source in SOURCES]
        told["many"] = "\n".join(
            _MANY.format(source=source, category=category) for source in SOURCES
        )
        entries.append(_ENTRY.format(**told))
        made[f"gallery/{category}.md"] = _REPORT.format(**told)
        for name in (f"{category}.png", f"{category}-report.html", *crowds):
            (folder / name).stat()
            made[f"gallery/{name}"] = folder / name
        recipe = json.loads(manifest["recipe"])["name"]
    made["gallery/index.md"] = _OVERVIEW.format(recipe=recipe) + "".join(entries)
    return made


def _about(manifest: dict[str, Any]) -> str:
    """How much a data set holds, in a sentence."""
    shards = manifest["shards"]
    instances = sum(shard["instances"] for shard in shards)
    size = sum(shard["bytes"] for shard in shards) / 1e6
    return f"{_objects(manifest)}, {instances:,} instances, {size:,.1f} MB of shards."


def _objects(manifest: dict[str, Any]) -> str:
    count = len(manifest["objects"])
    return f"{count} object{'s' * (count != 1)}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="where it goes")
    parser.add_argument("--recipe", default="quick", help="of the data sets")
    parser.add_argument("--jobs", type=int, help="worker processes; without it all cores")
    parser.add_argument("--many", type=int, default=MANY, help="objects drawn of each source")
    asked = parser.parse_args()
    make(asked.folder, asked.recipe, asked.jobs, asked.many)
