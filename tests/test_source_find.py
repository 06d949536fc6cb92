"""An object of a source is found by its id, as in a listing, and without one."""

import os
import shutil
from dataclasses import replace

import pytest
from source_models import add, add_partnet

from articugen.core.errors import InvalidSource
from articugen.sources.source import open_source


def laid_plain(folder, count):
    for k in range(count):
        add(folder / f"a{k}" / "deep" / "m.urdf")
        add(folder / f"b{k}.urdf")


def laid_shape2motion(folder, count):
    for k in range(count):
        (folder / "laptop" / f"{k:04d}" / "part_objs").mkdir(parents=True)
        (folder / "laptop" / f"{k:04d}" / "motion_attributes.json").write_text("{}")


def laid_partnet(folder, count):
    for k in range(count):
        add_partnet(folder / str(k), ("Laptop", "StorageFurniture")[k % 2])


def laid_artiverse(folder, count):
    for k in range(count):
        model = folder / "laptop" / f"hssd{k % 3}" / f"c{k}"
        (model / "urdf_w_collider").mkdir(parents=True, exist_ok=True)


def laid_in_two_folders(folder, count):
    for k in range(count):
        add(folder / "Laptop" / f"a{k}" / "m.urdf")
        add(folder / "oven" / f"a{k}" / "m.urdf")


def laid_with_names_twice(folder, count):
    for name in (
        "x.urdf",
        "x/m.urdf",
        "y/m.urdf",
        "Laptop/x/m.urdf",
        "Laptop/q/m.urdf",
        "y/n.urdf",
    ):
        add(folder / name)
    add_partnet(folder / "z.1", "Laptop")
    add_partnet(folder / "z" / "1", "Laptop")
    add_partnet(folder / "laptops" / "1", "Laptop")
    add_partnet(folder / "1", "Laptop")


LAYOUTS = {
    laid_plain: ("laptop", True),
    laid_shape2motion: ("laptop", True),
    laid_partnet: ("cabinet", True),
    laid_artiverse: ("laptop", False),
    laid_in_two_folders: ("laptop", True),
    laid_with_names_twice: ("laptop", False),
}


@pytest.mark.parametrize("lay", LAYOUTS)
def test_an_object_is_found_by_its_id_as_in_a_listing(lay, tmp_path):
    lay(tmp_path, 7)
    category, _ = LAYOUTS[lay]
    refs = open_source(tmp_path).objects(category)
    assert len(refs) > 2
    for ref in refs:
        assert open_source(tmp_path).find(category, ref.object_id) == replace(ref, split="")
    for name in ("none", "", ".", "..", "a/b", f"../{tmp_path.name}", "x\0", "a*", "LAPTOP"):
        with pytest.raises(InvalidSource, match="no object"):
            open_source(tmp_path).find(category, name)


@pytest.mark.parametrize(
    ("source", "lay", "category"),
    [
        ("partnet_mobility", laid_partnet, "cabinet"),
        ("partnet_mobility", laid_partnet, "laptop"),
        ("shape2motion", laid_shape2motion, "laptop"),
        ("shape2motion", laid_in_two_folders, "laptop"),
        ("procedural", None, "laptop"),
    ],
)
def test_an_object_of_a_named_source_is_found_as_in_a_listing(source, lay, category, own_sources):
    if lay:
        lay(own_sources / source, 6)
    refs = open_source(source).objects(category)
    assert len(refs) > 2
    for ref in refs:
        assert open_source(source).find(category, ref.object_id) == replace(ref, split="")
    with pytest.raises(InvalidSource, match="no object '77' of"):
        open_source(source).find(category, "77")


@pytest.mark.parametrize("lay", LAYOUTS)
def test_what_finding_an_object_costs_does_not_grow_with_its_source(lay, tmp_path, monkeypatch):
    category, by_name = LAYOUTS[lay]
    calls = []
    for name in ("listdir", "scandir", "stat"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, real=real, **k: calls.append(a) or real(*a, **k))

    def cost(count: int) -> tuple[int, int]:
        lay(tmp_path / str(count), count)
        refs = open_source(tmp_path / str(count)).objects(category)
        calls.clear()
        open_source(tmp_path / str(count)).find(category, refs[0].object_id)
        first = len(calls)
        open_source(tmp_path / str(count)).find(category, refs[-1].object_id)
        return first, len(calls) - first

    few, many = cost(6), cost(150)
    assert many[1] == few[1]
    assert not by_name or many[0] == few[0]


def test_a_model_that_came_later_is_found_too(tmp_path):
    laid_artiverse(tmp_path, 3)
    assert open_source(tmp_path).find("laptop", "c2").location.name == "c2"
    laid_artiverse(tmp_path, 4)
    assert open_source(tmp_path).find("laptop", "c3").location.name == "c3"
    shutil.rmtree(tmp_path / "laptop" / "hssd0")
    with pytest.raises(InvalidSource, match="no object 'c3'"):
        open_source(tmp_path).find("laptop", "c3")
