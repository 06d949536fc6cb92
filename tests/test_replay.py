"""A small data set made again from its source."""

import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
import trimesh
from command_line import run

from articugen.core import content
from articugen.core.errors import ArticugenError, InvalidSource
from articugen.core.recipe import Recipe
from articugen.core.records import dequantize, quantize
from articugen.instance import articulation
from articugen.instance.again import prepared_again, write_meshes
from articugen.instance.make import make_instance
from articugen.instance.preparing import prepare
from articugen.pipeline import door
from articugen.pipeline.job import Job
from articugen.sources import readers
from articugen.sources.source import open_source
from articugen.store.manifest import Manifest
from articugen.verify import replay as replaying
from articugen.verify.replay import replay

RECIPE = Recipe.model_validate(
    {
        "name": "tiny",
        "articulation": {"states": 2},
        "views": {"count": 60, "resolution": 192},
        "sampling": {"grids": [8], "surface_points": 512, "uniform_points": 64, "near_points": 64,
                     "partial_views": 1, "partial_points": 32, "partial_resolution": 32},
        "objects": 2,
    }
)  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("oven")
    door.make(Job("procedural", "oven", RECIPE, seed=3, out=folder, jobs=0))
    return folder


def test_instances_come_out_the_same(made):
    assert list(replay(made, 3)) == [None, None, None]
    assert list(replay(made, 99)) == 6 * [None]  # of which there are no more


def test_data_that_was_changed_is_found(made):
    shard = next(made.glob("train-*.h5"))
    before = shard.read_bytes()
    with h5py.File(shard, "r+") as file:
        points = file["surface_points"]
        points[:] = np.roll(points[:], 5000, axis=2)  # modulo 65536: off the surface
    found = [finding for finding in replay(made, 6) if finding]
    shard.write_bytes(before)
    assert {finding.check for finding in found} == {"replay", "zero level"}
    assert all(finding.shard == shard.name for finding in found)
    again = {(f.object_id, f.state_index) for f in found if f.check == "replay"}
    assert len(again) == sum(f.check == "replay" for f in found) == 3  # each of them once
    assert "surface_points" in str(found[0])


def test_other_code_or_another_source_cannot_make_it_again(made, monkeypatch):
    manifest = Manifest.read(made)
    name = manifest.objects[0].key.object_id
    with pytest.raises(InvalidSource, match="no object 'sofa'"):
        prepared_again(manifest, "sofa")
    changed = manifest.objects[0].model_copy(update={"input_sha256": "0" * 64})
    other = manifest.model_copy(update={"objects": (changed,)})
    with pytest.raises(InvalidSource, match="have changed since"):
        prepared_again(other, name)
    monkeypatch.setitem(content.STAGES, "fusion", 9)
    with pytest.raises(ArticugenError, match=r"it was fusion 1, is fusion 9; only such a version"):
        prepared_again(manifest, name)


def test_meshes_of_an_instance_are_closed(made, tmp_path):
    name, volume = Manifest.read(made).objects[0].key.object_id, {}
    for of in ("material", "visible", "part"):
        where = ("--state", 1, "--resolution", 96, "-o", tmp_path / f"{of}.ply")
        done = run("mesh", made, name, *where, "--of", of)
        written = sorted(tmp_path.glob(f"{of}*.ply"))
        meshes = [trimesh.load_mesh(path) for path in written]
        assert re.findall(r": ([\d,]+) faces", done.output) == [f"{len(m.faces):,}" for m in meshes]
        assert all(mesh.is_watertight and np.abs(mesh.bounds).max() < 0.5 for mesh in meshes)
        volume[of] = sum(mesh.volume for mesh in meshes)
    assert (tmp_path / "part_0.ply") in written
    assert volume["material"] == pytest.approx(volume["part"], rel=0.02)
    assert volume["visible"] >= 0.99 * volume["material"]
    with pytest.raises(ArticugenError, match="is of material, visible or part, not 'all'"):
        write_meshes(made, name, 1, 48, tmp_path / "oven.ply", "all")
    with pytest.raises(ArticugenError, match="has the states 0 to 2"):
        write_meshes(made, name, 3, 48, tmp_path / "oven.ply", "material")
    with pytest.raises(ArticugenError, match=r"choose one of \.ply"):
        write_meshes(made, name, 1, 48, tmp_path / "oven.doc", "material")


COARSE = Recipe.model_validate(
    RECIPE.model_dump()
    | {"views": {"count": 30, "resolution": 48}, "fusion": {"rule": "reachable"}, "objects": 1}
)


@pytest.fixture(scope="module")
def coarse():
    """Eyeglasses with pixels wider than the frame: 5 % of the surface is off its level."""
    (ref,) = open_source("procedural_messy").objects("eyeglasses", ids=["eyeglasses_0000"])
    obj = articulation.resolve(readers.load(ref), COARSE.articulation)
    prepared = prepare(obj, COARSE, seed=6)
    return prepared, make_instance(prepared, 1)


def test_coarse_views_are_no_fault(coarse):
    assert list(replaying.beside_level(*coarse)) == []


@pytest.mark.parametrize("beside", [1 / 256, -1 / 256])
def test_a_surface_a_voxel_beside_the_level_is_found(coarse, beside):
    prepared, row = coarse
    moved = dequantize(row.surface_points) + beside * row.surface_normals / 127
    other = replace(row, surface_points=quantize(moved))
    assert "lie off the field's zero level" in next(replaying.beside_level(prepared, other))
