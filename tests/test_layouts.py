"""Data sets that appeared lately, in the folders in which they are published: tiny ones."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from articugen.core.errors import InvalidSource
from articugen.core.records import JointKind
from articugen.sources.readers import load
from articugen.sources.source import open_source

URDF = """<robot name="m">
  <link name="body"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>
  <link name="door"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="body"/><child link="door"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 0 2"/><limit lower="0" upper="1.5"/></joint>
</robot>"""


def write_urdf(path: Path, mesh: str, file: Path) -> None:
    """A URDF of two boxes, and the mesh file that it names."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(URDF.format(mesh=mesh))
    trimesh.creation.box((1.0, 0.2, 0.4)).export(file)


def sketch(folder: Path) -> None:
    write_urdf(folder / "mobility.urdf", "meshes/box.obj", folder / "meshes" / "box.obj")
    (folder / "annotation.json").write_text('{"upstreamId": "x", "joints": []}')


def artiverse(folder: Path, mesh: str = "meshes/box.glb") -> None:
    own = folder / "urdf_w_collider"
    write_urdf(own / f"{folder.name}.urdf", mesh, own / "meshes" / "box.glb")
    (folder / f"{folder.name}.articulations.json").write_text("{}")
    trimesh.creation.box((9.0, 9.0, 9.0)).export(folder / f"{folder.name}.segmented.glb")


def articraft(folder: Path) -> None:
    file = folder / "assets" / "meshes" / "box.obj"
    write_urdf(folder / "model.urdf", "assets/meshes/box.obj", file)


def check(obj) -> None:
    (joint,) = obj.joints
    assert (joint.kind, joint.lower, joint.upper) == (JointKind.REVOLUTE, 0.0, 1.5)
    np.testing.assert_allclose(joint.axis, (0, 0, 1))
    np.testing.assert_allclose(joint.T_parent_joint[:3, 3], (0.5, 0, 0))
    for link in obj.links:
        np.testing.assert_allclose(np.ptp(link.mesh.vertices, axis=0), (1.0, 0.2, 0.4))


def found(source: Path, category: str) -> dict[str, str]:
    return {ref.object_id: ref.reader for ref in open_source(source).objects(category)}


@pytest.mark.parametrize("inside", ["", "data", "data/PartNeXt"])
def test_sketchmobility_from_any_folder_of_it(tmp_path, inside):
    for name in ("laptop/a1", "laptop/a2", "oven/b1"):
        sketch(tmp_path / "data" / "PartNeXt" / name)
    source = tmp_path / inside
    assert found(source, "laptop") == {"a1": "annotated_urdf", "a2": "annotated_urdf"}
    assert open_source(source).categories(["all"]) == ("laptop", "oven")
    check(load(open_source(source).objects("oven")[0]))


def test_ids_that_sources_share_are_told_apart(tmp_path):
    sketch(tmp_path / "data" / "PartNeXt" / "oven" / "1")
    sketch(tmp_path / "data" / "Agentic" / "oven" / "1")
    assert set(found(tmp_path, "oven")) == {"data.PartNeXt.oven.1", "data.Agentic.oven.1"}


def test_models_in_a_folder_that_is_no_category_are_of_any(tmp_path):
    sketch(tmp_path / "mine" / "a1")
    assert set(found(tmp_path / "mine", "laptop")) == {"a1"}


@pytest.mark.parametrize("inside", ["", "data"])
@pytest.mark.parametrize("mesh", ["meshes/box.glb", "package://meshes/box.glb"])
def test_artiverse_from_any_folder_of_it(tmp_path, inside, mesh):
    artiverse(tmp_path / "data" / "armoire" / "hssd" / "c1", mesh)
    artiverse(tmp_path / "data" / "dishwasher" / "hssd" / "c2", mesh)
    source = tmp_path / inside
    assert found(source, "armoire") == {"c1": "artiverse"}
    assert open_source(source).categories(["all"]) == ("armoire", "dishwasher")
    check(load(open_source(source).objects("armoire")[0]))


def test_of_several_urdfs_the_shortest_name_is_read_and_the_others_are_noted(tmp_path):
    model = tmp_path / "armoire" / "hssd" / "c1"
    artiverse(model)
    (model / "urdf_w_collider" / "c1_other.urdf").write_text("<robot/>")
    obj = load(open_source(tmp_path).objects("armoire")[0])
    check(obj)
    assert obj.notes == ("read from c1.urdf; left aside: c1_other.urdf",)


def test_a_model_without_its_urdf_is_refused_not_passed_over(tmp_path):
    model = tmp_path / "armoire" / "hssd" / "c1"
    artiverse(model)
    (model / "urdf_w_collider" / "c1.urdf").unlink()
    with pytest.raises(InvalidSource, match="urdf_w_collider: holds no URDF; get"):
        load(open_source(tmp_path).objects("armoire")[0])


def test_a_compiled_articraft_model_is_a_urdf_and_its_program_is_never_run(tmp_path):
    for name in ("rec_globe_01", "rec_globe_02"):
        articraft(tmp_path / name)
        (tmp_path / name / "model.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    assert set(found(tmp_path, "globe")) == {"rec_globe_01", "rec_globe_02"}
    check(load(open_source(tmp_path).objects("globe")[0]))
    assert not (tmp_path / "ran").exists()


def test_plain_urdfs_beside_others_deep_down_are_not_lost(tmp_path):
    sketch(tmp_path / "data" / "PartNeXt" / "laptop" / "a1")
    (tmp_path / "data" / "PartNeXt" / "own.urdf").write_text(URDF.replace("{mesh}", "x.obj"))
    assert set(found(tmp_path, "laptop")) == {"a1"}
    assert set(found(tmp_path, "data")) == {"a1", "own"}


@pytest.mark.parametrize(
    ("model", "package"),
    [
        ("robots/arm/robots", "example-robot-data"),  # the source itself, cloned, no package.xml
        ("robots/arm/urdf", "robots"),
        ("arm", "meshes_of_arm"),  # beside the model
    ],
)
def test_a_package_is_found_by_the_name_of_a_folder_in_the_source(tmp_path, model, package):
    source = tmp_path / "example-robot-data"
    place = next((f for f in (source, source / "robots") if f.name == package), source / package)
    write_urdf(source / model / "m.urdf", f"package://{package}/arm/box.obj", place / "arm/box.obj")
    check(load(open_source(source).objects("robot")[0]))
    (model,) = open_source(source / "arm" if package[0] == "m" else source / "robots/arm").objects(
        "a"
    )
    with pytest.raises(InvalidSource, match="name its folder as the source"):
        load(model)


def test_a_folder_called_like_the_package_that_leads_out_is_none(tmp_path):
    write_urdf(
        tmp_path / "in" / "arm" / "m.urdf", "package://p/box.obj", tmp_path / "p" / "box.obj"
    )
    (tmp_path / "in" / "p").symlink_to(tmp_path / "p")
    with pytest.raises(InvalidSource, match="is of a package that is not found"):
        load(open_source(tmp_path / "in").objects("robot")[0])


def test_bullets_xml_of_version_0_is_read_with_a_note(tmp_path):
    write_urdf(tmp_path / "m.urdf", "box.obj", tmp_path / "box.obj")
    text = (tmp_path / "m.urdf").read_text()
    (tmp_path / "m.urdf").write_text(f'<?xml version="0.0" ?>\n{text}')
    (model,) = open_source(tmp_path).objects("robot")
    check(load(model))
    assert load(model).notes == ("its XML version 0.0 is read as 1.0",)


def test_folders_with_a_mobility_usd_are_objects(tmp_path):
    for name in ("10040", "10101"):
        (tmp_path / "Laptop" / name).mkdir(parents=True)
        (tmp_path / "Laptop" / name / "mobility.usd").touch()
    for source in (tmp_path, tmp_path / "Laptop"):
        assert found(source, "laptop") == {"10040": "usd", "10101": "usd"}
    (tmp_path / "Laptop" / "10040" / "meta.json").write_text('{"model_cat": "Oven"}')
    assert set(found(tmp_path / "Laptop", "oven")) == {"10040"}


def test_models_without_a_category_are_apart_from_those_with_one(tmp_path):
    sketch(tmp_path / "data" / "laptop" / "a1")
    sketch(tmp_path / "data" / "oven" / "b1")
    write_urdf(tmp_path / "own.urdf", "box.obj", tmp_path / "box.obj")
    source = open_source(tmp_path)
    assert source.categories(["all"]) == ("laptop", "oven", "object")
    assert [set(found(tmp_path, c)) for c in ("laptop", "object")] == [{"a1"}, {"own"}]
    with pytest.raises(InvalidSource, match="there are: laptop, oven, object"):
        source.objects("lamp")
