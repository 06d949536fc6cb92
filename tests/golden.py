"""Golden digests: what our code makes of a tiny set, and of the shapes of bundled models.

`python -m tests.golden` says what differs from tests/data/golden.json; `--write` renews that file,
but only where a number of `articugen/core/content.py` was raised for what changed.
"""

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from articugen import procedural
from articugen.core import content
from articugen.core.recipe import load_recipe
from articugen.core.yaml_files import with_settings
from articugen.export.formats import FORMATS, format_named
from articugen.export.run import export
from articugen.pipeline import door
from articugen.pipeline.job import Job
from articugen.sources.source import open_source
from articugen.store.provenance import library_versions

GOLDEN = Path(__file__).with_name("data") / "golden.json"

CATEGORIES = tuple(content.MODELS)

WRITTEN = ("messy", "varied", "rough")
"""The sources procedural_<how> whose objects are other ones, or written otherwise."""

RENEW = "python -m tests.golden --write"

SETS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(CATEGORIES, ()),
    "laptop, messy": (),
    **{f"{category}, varied": () for category in open_source("procedural_varied").file.categories},
    "laptop, rough": (),
    "oven, rough": (),
    "boxes": (),
    "boxes, rigid": ("fusion.rule=rigid",),
    "boxes, reachable": ("fusion.rule=reachable", "sampling.coverage=true"),
    "boxes, extras": (
        "articulation.collision=reject",
        "sampling.signed_distance=0.1",
        "sampling.sharp_points=64",
        "sampling.near_sigma=[0.01, 0.05]",
        "images={views: 2, resolution: 32}",
    ),
    "boxes, mean": ("fusion.rule=mean", "views.projection=pinhole", "sampling.depth_noise=0.002"),
}
"""Tiny data sets of one object each, and what their recipes say otherwise."""

EXPORTED = (
    "articulation.states=2", "images={views: 3, resolution: 32}", "sampling.grids=[16, 32, 64]",
    "sampling.sharp_points=64", "sampling.near_sharp=0.5", "sampling.signed_distance=0.1",
    "sampling.uniform_points=8192", "sampling.near_points=8192", "sampling.surface_points=8192",
    "sampling.partial_points=1024",
)  # fmt: skip
"""What the recipe of the laptop that is exported says otherwise."""

_TOLD = ("croissant.json", "export.json")
"""Files of an export that tell of this version and machine."""

SHAPES = 2
"""Bundled models of a category whose files are looked at."""

RECIPE = """\
extends: category
articulation: {states: 1}
views: {count: 12, resolution: 64}
sampling:
  {grids: [8], surface_points: 64, uniform_points: 64, near_points: 64, partial_points: 16}
"""

CABINET = """\
<robot name="cabinet">
  <link name="body">
    <visual><geometry><box size="0.4 0.5 0.02"/></geometry></visual>
    <visual><origin xyz="0 0 0.3"/><geometry><box size="0.4 0.5 0.02"/></geometry></visual>
    <visual><origin xyz="-0.19 0 0.15"/><geometry><box size="0.02 0.5 0.28"/></geometry></visual>
  </link>
  <link name="door">
    <visual><origin xyz="0 0.25 0"/><geometry><box size="0.02 0.5 0.28"/></geometry></visual>
    <visual><origin xyz="0.03 0.45 0"/>
      <geometry><cylinder radius="0.01" length="0.1"/></geometry></visual>
  </link>
  <link name="tray">
    <visual><geometry><box size="0.3 0.4 0.03"/></geometry></visual>
  </link>
  <joint name="hinge" type="revolute"><parent link="body"/><child link="door"/>
    <origin xyz="0.21 -0.25 0.15"/><axis xyz="0 0 -1"/>
    <limit lower="0" upper="1.9" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="body"/><child link="tray"/>
    <origin xyz="0 0 0.1" rpy="0 0 0.1"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
</robot>
"""


def data(name: str, folder: Path) -> str:
    """The content hash of one of the SETS; `folder`, to work in, does not exist yet."""
    folder.mkdir(parents=True)
    (folder / "tiny.yaml").write_text(RECIPE)
    (folder / "cabinet.urdf").write_text(CABINET)
    category, _, how = name.partition(", ")
    source = f"procedural_{how}" if how in WRITTEN else "procedural"
    if category == "boxes":
        source = str(folder / "cabinet.urdf")
    recipe = with_settings(load_recipe(folder / "tiny.yaml", category), SETS[name])
    job = Job(source, category, recipe.with_options(objects=1), seed=0, out=folder / "out", jobs=0)
    return door.make(job).content_sha256


def shapes(category: str, folder: Path) -> str:
    """One digest of the files of some bundled models of a category."""
    digest = hashlib.sha256()
    for number in range(SHAPES):
        object_id = f"{category}_{number:04d}"
        urdf = procedural.write_object(category, object_id, folder / object_id)
        for path in sorted(urdf.parent.iterdir()):
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            digest.update(f"{path.name} {content}\n".encode())
    return digest.hexdigest()


def exports(folder: Path) -> dict[str, str]:
    """One digest of the files of each format that can be written here; a tiny laptop's."""
    folder.mkdir(parents=True)
    (folder / "tiny.yaml").write_text(RECIPE)
    recipe = with_settings(load_recipe(folder / "tiny.yaml", "laptop"), EXPORTED)
    job = Job(
        "procedural", "laptop", recipe.with_options(objects=1), seed=0, out=folder / "out", jobs=0
    )
    door.make(job)
    there = [n for n in FORMATS if all(find_spec(library) for library, _ in format_named(n).needs)]
    return {name: _exported(folder / "out", name, folder / name) for name in there}


def _exported(data: Path, name: str, out: Path) -> str:
    meshes = "from_grids" in format_named(name).takes
    export(data, name, out, from_grids=True if meshes else None)
    digest = hashlib.sha256()
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        if path.name not in _TOLD:
            held = hashlib.sha256(path.read_bytes()).hexdigest()
            digest.update(f"{path.relative_to(out).as_posix()} {held}\n".encode())
    return digest.hexdigest()


def made(folder: Path) -> dict[str, Any]:
    """What golden.json must hold: the declared versions, and what this code makes."""
    return {
        "stages": dict(content.STAGES),
        "models": content.MODELS | content.FORMS,
        "data": {name: data(name, folder / "data" / name) for name in SETS},
        "shapes": {name: shapes(name, folder / "shapes" / name) for name in CATEGORIES},
        "exports": exports(folder / "exports"),
        "libraries": {name: library_versions()[name] for name in ("numba", "numpy")},
    }


def read() -> dict[str, Any]:
    """What golden.json holds."""
    return json.loads(GOLDEN.read_text())


def undeclared(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """One sentence for each thing that changed though no number that stands for it was raised."""

    def raised(table: str, *names: str) -> bool:
        return any(new[table].get(name, 0) > old[table].get(name, 0) for name in names)

    def changed(table: str) -> list[str]:
        return [n for n, digest in new[table].items() if old[table].get(n, digest) != digest]

    sentences = [
        f"the shapes of {name} changed: raise MODELS[{name!r}] in articugen/core/content.py"
        for name in changed("shapes")
        if not raised("models", name)
    ]
    return sentences + [
        f"the data of {name} changed: raise the number of the stage that makes them otherwise, in "
        "STAGES of articugen/core/content.py"
        for name in changed("data")
        if not raised("stages", *new["stages"]) and not raised("models", *name.split(", "))
    ]


def advice(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """What to do where `new` is not as `old`; "" where it is."""
    other = [n for n, digest in new["exports"].items() if old["exports"].get(n) != digest]
    if not other and new == old | {name: new[name] for name in ("libraries", "exports")}:
        return ""
    sentences = undeclared(old, new)
    if other:
        sentences.append(f"exports are other files: {', '.join(other)}")
    if sentences:
        sentences.append("where that is not meant, mend the code instead; where it is, then")
    if new["libraries"] != old["libraries"]:
        sentences.append(f"it may be due to libraries: {old['libraries']}, here {new['libraries']}")
    sentences.append(f"run {RENEW}, and tell in CHANGELOG.md what moved, and how far")
    return "\n".join(sentences)


def main() -> str | None:
    """Compare, or renew; what is wrong, if anything."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("--write", action="store_true", help="renew tests/data/golden.json")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        new = made(Path(folder))
    old = read()
    if asked.write and not undeclared(old, new):
        GOLDEN.write_text(json.dumps(new, indent=1) + "\n")
        return None
    return advice(old, new) or None


if __name__ == "__main__":
    sys.exit(main())
