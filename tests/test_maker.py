"""Models at joint states of one's own: the same as a data set has, and the same frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import articugen as ag
from articugen.core.errors import ArticugenError, InvalidArgument, InvalidRecipe, InvalidSource
from articugen.core.geometry import rotation_about, transform
from articugen.core.records import FREE, JointKind, Mesh
from articugen.store.shards import open_shard

CABINET = """<robot name="cabinet">
  <link name="body">
    <visual><origin xyz="0 0 0.39"/><geometry><box size="0.4 0.5 0.02"/></geometry></visual>
    <visual><origin xyz="0 0 0.01"/><geometry><box size="0.4 0.5 0.02"/></geometry></visual>
    <visual><origin xyz="-0.19 0 0.2"/><geometry><box size="0.02 0.5 0.36"/></geometry></visual>
    <visual><origin xyz="0 0.24 0.2"/><geometry><box size="0.36 0.02 0.36"/></geometry></visual>
    <visual><origin xyz="0 -0.24 0.2"/><geometry><box size="0.36 0.02 0.36"/></geometry></visual>
  </link>
  <link name="leaf">
    <visual><origin xyz="0.01 -0.25 0"/><geometry><box size="0.02 0.5 0.4"/></geometry></visual>
  </link>
  <link name="latch">
    <visual><origin xyz="0.01 0 0"/><geometry><box size="0.02 0.02 0.02"/></geometry></visual>
  </link>
  <link name="tray">
    <visual><geometry><box size="0.3 0.4 0.02"/></geometry></visual>
  </link>
  <joint name="door" type="revolute"><parent link="body"/><child link="leaf"/>
    <origin xyz="0.201 0.25 0.2"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1.57" effort="1" velocity="1"/></joint>
  <joint name="lock" type="revolute"><parent link="leaf"/><child link="latch"/>
    <origin xyz="0.02 -0.45 0"/><axis xyz="1 0 0"/><mimic joint="door" multiplier="0.5"/>
    <limit lower="0" upper="3" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="body"/><child link="tray"/>
    <origin xyz="0 0 0.2"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
</robot>"""
"""A door, a latch on it that follows it, and a tray."""

TINY = {
    "extends": "category",
    "articulation": {"states": 2},
    "views": {"count": 40, "resolution": 128},
    "sampling": {"grids": [8], "surface_points": 512, "uniform_points": 512, "near_points": 64,
                 "partial_views": 1, "partial_points": 32, "partial_resolution": 32},
}  # fmt: skip


RIGID = TINY | {"fusion": {"rule": "rigid"}, "views": {"count": 12, "resolution": 64}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("urdfs")
    (folder / "cabinet.urdf").write_text(CABINET)
    return folder


@pytest.fixture(scope="module")
def cabinet(folder: Path) -> ag.Model:
    return ag.load(folder / "cabinet.urdf", category="cabinet")


@pytest.fixture(scope="module")
def maker(cabinet: ag.Model) -> ag.Maker:
    return ag.Maker(cabinet, TINY, seed=3)


@pytest.fixture(scope="module")
def inst(maker: ag.Maker) -> ag.Made:
    return maker.at(door=1.2, slide=0.05)


def test_what_a_data_set_holds_is_what_a_maker_makes(folder, maker, tmp_path):
    data = ag.generate("cabinet", folder, tmp_path, TINY, seed=3, jobs=0)
    assert (len(data), len(maker)) == (3, 3)
    with open_shard(data.shards[0]) as shard:
        for index, made in enumerate(maker):
            stored = shard.instance(index).arrays()
            for name, value in made.instance.arrays().items():
                np.testing.assert_array_equal(value, stored[name], err_msg=name)
            assert set(stored) == set(made.fields)
            assert repr(made.joints) == repr(data[index].joints)
    assert list(maker[-1].surface.part) == list(data[2].surface.part)
    assert [made.state_index for made in maker[1:]] == [1, 2]
    assert set(maker[0].state.values()) == {0.0}
    for wrong in (3, -4, 1.5):
        with pytest.raises(IndexError, match=f"no state {wrong}, there are 3"):
            maker[wrong]


def test_a_joint_state_by_name(maker, inst):
    assert [joint.name for joint in maker.joints] == ["door", "lock", "slide"]
    assert inst.state == {"door": 1.2, "lock": 0.6, "slide": 0.05}
    states = {joint.name: joint.state for joint in inst.joints}
    assert states == inst.state
    units = {joint.name: joint.state_unit for joint in inst.joints}
    assert units == pytest.approx({"door": 1.2, "lock": 0.6, "slide": 0.05 / inst.scale})
    slide = inst.joints[2]
    assert (slide.lower, slide.upper) == pytest.approx((0.0, 0.2))
    assert (slide.lower_unit, slide.upper_unit) == pytest.approx((0.0, 0.2 / inst.scale))
    about_z = rotation_about((0, 0, 1), 1.2)
    np.testing.assert_allclose(inst.parts[1].motion[:3, :3], about_z, atol=1e-12)
    assert maker.at({"slide": 0.05}, door=1.2).state == inst.state
    again = maker.at(door=1.2, slide=0.05)
    np.testing.assert_array_equal(again.uniform.points, inst.uniform.points)
    other = maker.at(door=1.1)
    assert not np.array_equal(other.uniform.points, inst.uniform.points)
    assert (other.scale, other.center.tolist()) == (inst.scale, inst.center.tolist())
    assert "Joint('door', revolute, 1.2 of 0 to 1.57 rad)" in repr(inst)
    assert "Joint('slide', prismatic, 0.05 of 0 to 0.2 m)" in repr(inst)


def as_stored(inst: ag.Made) -> ag.Row:
    """What a shard would give back of an instance."""
    arrays = inst.instance.arrays()
    return ag.Row(lambda names: [arrays[name] for name in names], arrays)


def sized(model: ag.Model, size: float) -> ag.Model:
    """The model, `size` times as large."""
    links = [
        replace(link, mesh=Mesh(size * link.mesh.vertices, link.mesh.faces))
        for link in model.obj.links
    ]
    joints = [
        replace(
            joint,
            T_parent_joint=transform(
                joint.T_parent_joint[:3, :3], size * joint.T_parent_joint[:3, 3]
            ),
            upper=joint.upper * (size if joint.kind == JointKind.PRISMATIC else 1.0),
        )
        for joint in model.obj.joints
    ]
    return replace(model, obj=replace(model.obj, links=tuple(links), joints=tuple(joints)))


@settings(max_examples=12, deadline=None)
@given(st.floats(-2.0, 2.0), st.integers(0, 2), st.floats(0.0, 1.0))
def test_the_states_of_a_row_are_what_at_takes(cabinet, digits, index, share):
    """For models of 1 cm to 100 m; what a shard holds of the same pose is in the unit frame."""
    maker = ag.Maker(sized(cabinet, 10.0**digits), RIGID, seed=3)
    between = maker.at({joint.name: share * joint.upper for joint in maker.joints})
    for inst, row in ((maker[index], as_stored(maker[index])), (between, between)):
        again = maker.at({joint.name: joint.state for joint in row.joints})
        arrays = again.instance.arrays()
        for name, value in inst.instance.arrays().items():
            np.testing.assert_array_equal(arrays[name], value, err_msg=name)
    row = as_stored(between)
    again = maker.at({joint.name: joint.state for joint in row.joints})
    for part, same in zip(again.parts, between.parts, strict=True):
        np.testing.assert_allclose(part.motion, same.motion, atol=1e-12)
    assert again.state == pytest.approx(between.state, rel=1e-12)


@pytest.mark.parametrize(
    ("state", "sentence"),
    [
        ({"dor": 1.0}, "no moving joint 'dor'; did you mean 'door'"),
        ({"door": 1.6}, r"joint 'door' at 1.6 rad is outside its range, 0 to 1.57"),
        ({"slide": -0.01}, r"joint 'slide' at -0.01 m is outside its range, 0 to 0.2"),
        ({"slide": 0.2000012}, "at 0.2000012 m is outside its range, 0 to 0.2;"),
        ({0: 0.1}, "no moving joint '0'; there are: door"),
        ({"door": np.nan}, "outside its range"),
        ({"door": "0.5"}, "joint 'door' at '0.5' is no number; give one, rad from the canonical"),
        ({"slide": None}, "joint 'slide' at None is no number; give one, m from the canonical"),
        ({"slide": [0.1]}, "is no number"),
        (0.5, r"0.5 names no joint; give values by name, as in at\(door=0.1\)"),
        ({"lock": 0.1}, "joint 'lock' follows 'door', which puts it at 0; give that alone"),
        ({"door": 1.0, "lock": np.nan}, "outside its range"),
    ],
)
def test_what_no_joint_does_is_refused(maker, state, sentence):
    with pytest.raises(InvalidArgument, match=sentence):
        maker.at(state)


def test_states_beyond_the_recipes_have_views_that_hold_them(folder, maker):
    """The recipe's views fit the recipe's states: what projects beside them would be seen free."""
    wide = ag.Maker(maker.obj, TINY | {"padding": 0.4}, seed=3)
    widest = wide.at(door=1.57, slide=0.2)
    assert widest.scale == wide[0].scale
    inside = widest.surface.points - 0.004 * widest.surface.normals
    free = widest._posed[1].whole.is_free(inside)
    assert free.mean() < 0.003  # with the recipe's views it is 0.014, and the mesh lacks an edge
    narrow = ag.Maker(maker.obj, TINY | {"padding": 0.0, "articulation": {"states": 0}})
    with pytest.raises(InvalidArgument, match=r"door=1.57.*sticks out.*1 states.*raise padding"):
        narrow.at(door=1.57)


def test_random_states_lie_in_the_ranges(maker):
    states = [made.state for made in maker.random(20, rng=0)]
    assert states == [made.state for made in maker.random(20, rng=0)]
    for joint in maker.joints:
        values = [state[joint.name] for state in states]
        assert joint.lower <= min(values) < max(values) <= joint.upper
        assert len(set(values)) == 20
    assert [s["lock"] for s in states] == pytest.approx([0.5 * s["door"] for s in states])


def test_labels_are_those_of_the_boxes(maker, inst):
    np.testing.assert_array_equal(inst.labels(inst.uniform.points), inst.uniform.label)
    tray = np.array([[0.05, 0.0, 0.2], [0.19, 0.1, 0.2], [0.05, 0.0, 0.23], [0.26, 0.0, 0.2]])
    labels = inst.labels((tray - inst.center) / inst.scale)
    assert labels.dtype == np.uint8
    assert labels.tolist() == [4, 4, FREE, FREE]
    for wrong in (np.zeros(3), np.full((1, 3), 0.6), np.full((1, 3), np.nan)):
        with pytest.raises(InvalidArgument, match=r"labels of points"):
            inst.labels(wrong)


def test_flow_moves_each_part_rigidly(maker, inst):
    flow = inst.flow_to(maker.at(door=0.3))
    points, part = inst.surface.points, inst.surface.part
    assert not flow[part == 0].any()
    back = [[-0.05 / inst.scale, 0.0, 0.0]] * (part == 3).sum()
    np.testing.assert_allclose(flow[part == 3], back, atol=1e-6)
    hinge = inst.joints[0].pivot
    turned = (points[part == 1] - hinge) @ rotation_about((0, 0, 1), -0.9).T
    np.testing.assert_allclose(points[part == 1] + flow[part == 1], turned + hinge, atol=1e-6)


def test_the_mesh_is_watertight_and_can_be_written(inst, tmp_path):
    mesh = inst.mesh(resolution=48)
    for ending in (".ply", ".obj", ".stl"):
        mesh.export(tmp_path / f"door{ending}")
        assert trimesh.load_mesh(tmp_path / f"door{ending}").is_watertight
    assert repr(mesh).startswith("Mesh(")
    with pytest.raises(ArticugenError, match=r"choose one of \.ply"):
        mesh.export("door.blend")


def test_any_model_that_a_source_reads(folder, tmp_path, monkeypatch):
    model = ag.load(folder)
    assert (model.object_id, model.category) == ("cabinet", "object")
    assert [joint.name for joint in model.joints] == ["door", "lock", "slide"]
    assert "Joint('slide', prismatic, 0 to 0.2 m)" in repr(model)
    assert "follows 'door'" in repr(ag.Maker(model, TINY))
    (tmp_path / "12").mkdir()
    (tmp_path / "12" / "mobility.urdf").write_text(CABINET)
    (tmp_path / "12" / "meta.json").write_text('{"model_cat": "StorageFurniture"}')
    furniture = ag.load(tmp_path / "12")
    assert furniture.movable  # what PartNet-Mobility's source.yaml says of storage furniture
    drawer = ag.load("procedural", "drawer_0003")
    assert (drawer.category, drawer.clips_to_limits) == ("drawer", False)
    for wrong, error, sentence in (
        (lambda: ag.load("procedural"), InvalidSource, r"name one, as in load\('procedural', 'b"),
        (lambda: ag.load(tmp_path / "none.urdf"), InvalidSource, "there is no such file"),
        (lambda: ag.Maker(model, "quikc"), InvalidRecipe, "did you mean 'quick'"),
        (lambda: ag.Maker("a.urdf"), InvalidArgument, "'a.urdf' is no model; load one"),  # type: ignore[arg-type]
        (lambda: ag.Maker(model, {"views": {"cont": 3}}), InvalidRecipe, "did you mean 'count'"),
    ):
        with pytest.raises(error, match=sentence):
            wrong()


def test_the_joint_that_makes_an_object_small_in_its_frame_has_a_note(folder, maker, tmp_path):
    assert maker.prepared.obj.notes == ()
    far = tmp_path / "far.urdf"
    far.write_text(CABINET.replace('upper="0.2"', 'upper="6"'))
    stretched = ag.Maker(ag.load(far, category="cabinet"), RIGID, seed=3)
    (note,) = stretched.prepared.obj.notes
    size = 0.5 / stretched.prepared.unit.scale
    assert size < 0.25
    assert note.startswith(f"{size:.2g} of the unit frame long in its canonical pose, since joint")
    assert "joint 'slide' (prismatic, 0 to 6)" in note
    stored = ag.generate("cabinet", far, tmp_path / "out", RIGID, seed=3, jobs=0)
    assert [entry.notes for entry in stored.manifest.objects] == [(note,)]


@pytest.mark.parametrize(("gap", "closes"), [(0.004, True), (0.03, False)])
def test_a_slit_that_sheets_close_has_a_note(tmp_path, gap, closes):
    """Above a plate runs a strip so narrow that views look into the slit between them."""
    corners = [(x, y, 0.0) for x, y in ((-0.5, -0.4), (0.5, -0.4), (0.5, 0.4), (-0.5, 0.4))]
    corners += [(x, y / 80, gap) for x, y, _ in corners]
    lines = ["v {} {} {}".format(*corner) for corner in corners] + ["f 1 2 3 4", "f 5 6 7 8"]
    (tmp_path / "plates.obj").write_text("\n".join(lines))
    text = CABINET.replace('<box size="0.3 0.4 0.02"/>', '<mesh filename="plates.obj"/>')
    (tmp_path / "plates.urdf").write_text(text)
    recipe = RIGID | {"views": {"count": 60, "resolution": 256}}
    maker = ag.Maker(ag.load(tmp_path / "plates.urdf"), recipe)
    notes = [note for note in maker.prepared.obj.notes if note.startswith("slits narrower than")]
    assert [note.rpartition(": ")[2] for note in notes] == (["tray"] if closes else [])
    middle = np.array([[0.0, 0.0, 0.2 + gap / 2]])  # where joint `slide` has the tray
    inst = maker[0]
    assert (inst.labels((middle - inst.center) / inst.scale) == 4).all() == closes


def test_what_is_printed_is_short_and_of_one_unit(maker, inst):
    assert repr(maker.joints[:2]) == (
        "(Joint('door', revolute, 0 to 1.57 rad), "
        "Joint('lock', revolute, 0 to 0.785 rad, follows 'door'))"
    )
    assert repr(inst.joints[0]) == "Joint('door', revolute, 1.2 of 0 to 1.57 rad)"
    assert repr(inst).startswith("Made(cabinet at a state of its own)\n")
    assert repr(maker[1]).startswith("Made(cabinet [1])\n")


@pytest.mark.parametrize("resolution", [5000, 7, -1, "64", 64.0, None])
def test_a_mesh_has_a_number_of_voxels_that_memory_holds(inst, resolution):
    with pytest.raises(InvalidArgument, match="give a number from 8 to 1,024"):
        inst.mesh(resolution)
