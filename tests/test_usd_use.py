"""USD models as a user has them: our own exports, fetched archives, a data set made of them."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_line import run
from published import zipped
from usd_models import artvip

import articugen as ag
from articugen.core.geometry import apply
from articugen.core.records import ArticulatedObject, JointKind, JointState
from articugen.export.parts import metric_joints, part_names
from articugen.instance import articulation
from articugen.sources import readers
from articugen.sources.source import load_path, open_source

pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")

TINY = {"extends": "quick", "views": {"count": 30, "resolution": 128}, "sampling": {"grids": [16]}}


def state_of(obj: ArticulatedObject, row: ag.Row) -> JointState:
    """In radians and metres, in the order of the model's joints."""
    unit = [row.scale if joint.kind == "prismatic" else 1.0 for joint in row.joints]
    q = {joint.name: joint.state * u for joint, u in zip(row.joints, unit, strict=True)}
    return JointState(np.array([q[joint.name] for joint in obj.moving_joints]))


@pytest.mark.slow
@pytest.mark.parametrize("category", ["laptop", "drawer", "eyeglasses"])
def test_what_is_exported_as_usd_is_read_as_a_source_again(tmp_path, category):
    """Parts, joints and limits are those of the data set, and in every state the solids are those
    that the same export as URDF has."""
    ag.generate(category, out=tmp_path, recipe=TINY, objects=1, states=2, jobs=0)
    data = ag.open(tmp_path / category)
    for to in ("usd", "urdf"):
        ag.export(tmp_path / category, to, tmp_path / to, resolution=64)
    (usd,), (urdf,) = (sorted(tmp_path.rglob(f"*.{ending}")) for ending in ("usdc", "urdf"))
    ours, theirs = (load_path(path, category) for path in (usd, urdf))
    own = [joint for joint in ours.joints if joint.kind != JointKind.FIXED]
    assert tuple(link.name for link in ours.links[1:]) == part_names(data[0])
    for joint, truth in zip(own, metric_joints(data[0]), strict=True):
        assert (joint.name, str(joint.kind)) == (truth.name, truth.kind)
        np.testing.assert_allclose(joint.axis, truth.axis, atol=1e-6)
        limits = (truth.lower, truth.upper)
        np.testing.assert_allclose((joint.lower, joint.upper), limits, atol=1e-6)
    for row in data:
        for name in part_names(row):
            one, other = (solid(obj, name, state_of(obj, row)) for obj in (ours, theirs))
            assert one.is_watertight
            np.testing.assert_allclose(one.bounds, other.bounds, atol=1e-5 * row.scale)
            np.testing.assert_allclose((one.volume, one.area), (other.volume, other.area), 1e-3)


def solid(obj: ArticulatedObject, name: str, state: JointState) -> trimesh.Trimesh:
    """A link's, where the joints have it."""
    (at,) = (n for n, link in enumerate(obj.links) if link.name == name)
    T = articulation.forward_kinematics(obj, state).T_world_link[at]
    mesh = obj.links[at].mesh
    return trimesh.Trimesh(apply(T, mesh.vertices), mesh.faces)


def test_generate_inspect_and_choose(tmp_path):
    models = tmp_path / "models" / "major_appliances" / "dishwasher"
    for name in ("cab_1", "cab_2"):
        artvip(models / name)
    (models / "cab_2" / "resource" / "material.usda").unlink()
    tiny = tmp_path / "tiny.yaml"
    tiny.write_text(json.dumps(TINY))
    common = ("--source", tmp_path / "models", "--recipe", tiny, "--states", 2, "--jobs", 0,
              "--max-rejected", 1)  # fmt: skip
    done = run("generate", "-c", "dishwasher", *common, "--joints", "revolute", "--out", tmp_path)
    assert done.exit_code == 3, done.output
    assert "material.usda' is missing" in " ".join(done.output.split())
    data = ag.open(tmp_path / "dishwasher")
    assert {row.object_id for row in data} == {"cab_1"}
    (lid,) = data[0].joints
    assert (lid.name, lid.kind) == ("RevoluteJoint", "revolute")
    shown = run("inspect", tmp_path / "dishwasher")
    assert shown.exit_code == 0, shown.output
    assert ag.verify(tmp_path / "dishwasher", replay=1, jobs=0).ok
    again = run("generate", "-c", "dishwasher", *common, "--joints", "revolute", "--out", tmp_path)
    assert again.exit_code == 3
    assert ag.open(tmp_path / "dishwasher")[0].object_id == "cab_1"


def archive(folder: Path, *names: str) -> Path:
    """A .zip of ArtVIP's folders, with what lies beside the models."""
    for name in names:
        artvip(folder / "ArtVIP" / "Articulated_objects" / name)
    files = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in (folder / "ArtVIP").rglob("*")
        if path.is_file()
    }
    made = folder / "artvip.zip"
    made.write_bytes(zipped({**files, "ArtVIP/README.md": b"# ArtVIP", ".DS_Store": b"x"}))
    return made


def test_fetch_artvip_unpacks_checks_and_lists(tmp_path):
    good, bad = "major_appliances/dishwasher/d_1", "large_furniture/wardrobe/w_1"
    artvip(tmp_path / "ArtVIP" / "Articulated_objects" / bad).write_text("not USD")
    path = archive(tmp_path, good)
    done = run("fetch", "artvip", "--from", path, "--out", tmp_path / "models")
    assert done.exit_code == 3, done.output
    assert "Apache-2.0" in done.output
    assert "2 models, 2 of them new, 1 sound" in done.output
    listed = json.loads((tmp_path / "models" / "fetched.json").read_text())["models"]
    root = "ArtVIP/Articulated_objects"
    assert set(listed) == {f"{root}/{good}", f"{root}/{bad}"}
    assert listed[f"{root}/{good}"]["files"] == 3
    assert "is no USD layer; export it again" in listed[f"{root}/{bad}"]["refused"]
    assert str(tmp_path) not in json.dumps(listed)
    assert open_source(tmp_path / "models").categories(["all"]) == (
        "dishwasher",
        "storage_furniture",
    )
    (ref,) = open_source(tmp_path / "models").objects("dishwasher")
    assert readers.load(ref).sha256 == listed[f"{root}/{good}"]["sha256"]
    again = run("fetch", "artvip", "--from", path, "--out", tmp_path / "models")
    assert "2 models, 0 of them new" in again.output
