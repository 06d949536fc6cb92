"""The Shape2Motion reader: a synthetic raw model (no real one was at hand) and real URDF ones."""

import json
import math

import numpy as np
import pytest
from real_models import REAL_MODELS, needs_real_models

from articugen.core.errors import InvalidSource, RejectedInstance
from articugen.core.geometry import apply
from articugen.core.recipe import Articulation
from articugen.core.records import JointState
from articugen.instance.articulation import canonical_state, forward_kinematics, resolve
from articugen.sources.refs import CategorySettings, ObjectRef
from articugen.sources.shape2motion import load

BOX = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]


def write_obj(path, low, high):
    """A box from corner `low` to corner `high`: eight vertices, two triangles are enough here."""
    corners = np.array(low) + np.array(BOX) * (np.array(high) - np.array(low))
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 2 4", "f 5 6 8"]
    path.write_text("\n".join(lines) + "\n")


def dof(name, kind, center=(0, 0, 0), direction=(1, 0, 0), children=()):
    return {
        "dof_name": name,
        "motion_type": kind,
        "center": list(center),
        "direction": list(direction),
        "children": list(children),
    }


def cabinet():
    """A door about z at (0.4, 0.5, 0) with a knob about x on it, and a drawer along 2x."""
    knob = dof("dof_rootd_Aa001_r_Ba001_r", "rotation", (0.4, -0.4, 0.1))
    return dof(
        "dof_rootd",
        "none",
        center=(7, 7, 7),  # the root's centre means nothing
        children=[
            dof("dof_rootd_Aa001_r", "rotation", (0.4, 0.5, 0), (0, 0, 1), [knob]),
            dof("dof_rootd_Aa002_t", "translation", (0.1, 0.2, -0.3), (2, 0, 0)),
        ],
    )


@pytest.fixture
def model(tmp_path):
    """Writes a raw model of the attributes given and returns its folder."""

    def write(attributes):
        parts = tmp_path / "part_objs"
        parts.mkdir()
        write_obj(parts / "none_motion.obj", (-0.4, -0.5, -0.4), (0.3, 0.5, 0.4))
        write_obj(parts / "dof_rootd_Aa001_r.obj", (0.35, -0.5, 0), (0.4, 0.5, 0.4))
        write_obj(parts / "dof_rootd_Aa001_r_Ba001_r.obj", (0.4, -0.45, 0.05), (0.45, -0.35, 0.15))
        write_obj(parts / "dof_rootd_Aa002_t.obj", (-0.3, -0.5, -0.4), (0.4, 0.5, 0))
        (tmp_path / "motion_attributes.json").write_text(json.dumps(attributes))
        return tmp_path

    return write


def read(folder, yaw=0.0):
    ref = ObjectRef("shape2motion", "cabinet", folder.name, "train", folder)
    return load(ref, CategorySettings(yaw_degrees=yaw))


def world_vertices(obj, q):
    """The vertices of every link by its name, at the joint values `q`."""
    posed = forward_kinematics(obj, JointState(np.array(q, float)))
    return {
        link.name: apply(T, link.mesh.vertices)
        for link, T in zip(obj.links, posed.T_world_link, strict=True)
    }


def test_raw_layout_gives_the_tree_of_joints_without_limits(model):
    obj = read(model(cabinet()))
    assert [link.name for link in obj.links] == [
        "dof_rootd",
        "dof_rootd_Aa001_r",
        "dof_rootd_Aa001_r_Ba001_r",
        "dof_rootd_Aa002_t",
    ]
    door, knob, drawer = obj.joints
    assert [str(j.kind) for j in obj.joints] == ["revolute", "revolute", "prismatic"]
    assert (knob.parent, door.parent, drawer.parent) == (door.child, "dof_rootd", "dof_rootd")
    assert all((j.lower, j.upper) == (-math.inf, math.inf) for j in obj.joints)
    np.testing.assert_array_equal(drawer.axis, [1, 0, 0])
    np.testing.assert_array_equal(obj.part_of_link, [0, 1, 2, 3])


def test_at_rest_every_vertex_is_where_its_file_has_it(model):
    folder = model(cabinet())
    vertices = world_vertices(read(folder), [0, 0, 0])
    for name, file in [("dof_rootd", "none_motion")] + [(n, n) for n in list(vertices)[1:]]:
        lines = (folder / "part_objs" / f"{file}.obj").read_text().splitlines()
        in_file = [[float(x) for x in line.split()[1:]] for line in lines if line[0] == "v"]
        np.testing.assert_allclose(vertices[name], in_file, atol=1e-15)


def test_the_door_turns_about_its_centre_and_takes_its_knob_along(model):
    obj = read(model(cabinet()))
    moved = world_vertices(obj, [math.pi / 2, 0, 0.25])
    still = world_vertices(obj, [0, 0, 0])
    for name in ("dof_rootd_Aa001_r", "dof_rootd_Aa001_r_Ba001_r"):
        x, y, z = still[name].T
        # A quarter turn about the vertical line through (0.4, 0.5): (dx, dy) -> (-dy, dx).
        expected = np.stack([0.4 - (y - 0.5), 0.5 + (x - 0.4), z], axis=1)
        np.testing.assert_allclose(moved[name], expected, atol=1e-12)
    drawer = "dof_rootd_Aa002_t"
    np.testing.assert_allclose(moved[drawer] - still[drawer], [[0.25, 0, 0]] * 8, atol=1e-12)
    np.testing.assert_array_equal(moved["dof_rootd"], still["dof_rootd"])


def test_yaw_turns_the_whole_model(model):
    folder = model(cabinet())
    turned, still = (
        world_vertices(read(folder, 90), [0, 0, 0]),
        world_vertices(read(folder), [0] * 3),
    )
    x, y, z = still["dof_rootd"].T
    np.testing.assert_allclose(turned["dof_rootd"], np.stack([-y, x, z], axis=1), atol=1e-12)


def test_missing_limits_come_from_the_recipe(model):
    obj = read(model(cabinet()))
    with pytest.raises(RejectedInstance, match="prismatic_metres"):
        resolve(obj, Articulation())
    resolved = resolve(obj, Articulation(prismatic_metres=(0.0, 0.3)))
    ranges = [(j.lower, j.upper) for j in resolved.moving_joints]
    assert ranges == [(0.0, pytest.approx(math.radians(135)))] * 2 + [(0.0, 0.3)]


def test_a_part_that_does_not_move_is_fixed_to_its_parent(model):
    attributes = cabinet()
    attributes["children"][1]["motion_type"] = "none"
    attributes["children"][1]["direction"] = [0, 0, 0]
    kinds = [str(j.kind) for j in read(model(attributes)).joints]
    assert kinds == ["revolute", "revolute", "fixed"]


def test_meshes_that_no_joint_names_are_noted(model):
    attributes = cabinet()
    del attributes["children"][1]
    notes = read(model(attributes)).notes
    assert any("dof_rootd_Aa002_t.obj" in note for note in notes)


def test_the_hash_is_of_every_byte_read(model):
    folder = model(cabinet())
    first = read(folder).sha256
    assert read(folder).sha256 == first
    part = folder / "part_objs" / "dof_rootd_Aa002_t.obj"
    part.write_text(part.read_text() + "# more\n")
    assert read(folder).sha256 != first


def spoil(change):
    attributes = cabinet()
    change(attributes)
    return json.dumps(attributes)


@pytest.mark.parametrize(
    ("attributes", "says"),
    [
        (spoil(lambda a: a["children"][0].update(motion_type="spiral")), "spiral joint.*leave"),
        (
            spoil(lambda a: a["children"][0].update(motion_type="dance")),
            r"children\.0\.motion_type",
        ),
        (spoil(lambda a: a["children"][1].update(direction=[0, 0, 0])), "zero direction"),
        (spoil(lambda a: a["children"][1].update(direction=[1e308, 0, 1e308])), "or equal to 1e?"),
        (spoil(lambda a: a["children"][1].update(center=[0, 0, 1e9])), "less than or equal to"),
        (spoil(lambda a: a["children"][1].update(dof_name="a\0b")), "no control characters"),
        (spoil(lambda a: a["children"][1].update(dof_name="a" * 256)), "a name has 1 to 255"),
        (
            spoil(lambda a: a["children"][1].update(dof_name="a" * 253)),
            "part 'a.*has a name of more than 255 bytes; shorten it",
        ),
        (spoil(lambda a: a["children"][1].update(dof_name="dof_rootd_Aa001_r")), "two parts"),
        (
            spoil(lambda a: a["children"][1].update(dof_name="gone")),
            r"part_objs/gone\.obj is missing",
        ),
        (spoil(lambda a: a["children"][1].update(dof_name="../../x")), "leads out"),
        (spoil(lambda a: a.pop("dof_name")), "dof_name"),
        ('{"dof_name": "dof_rootd", ', "JSON"),
        (spoil(lambda a: a.update(center=[0, 0, math.nan])), "center"),
    ],
)
def test_bad_models_are_refused_with_a_sentence(model, attributes, says):
    folder = model(cabinet())
    (folder / "motion_attributes.json").write_text(attributes)
    with pytest.raises(InvalidSource, match=says):
        read(folder)


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(InvalidSource, match=r"neither motion_attributes\.json nor a \.urdf"):
        read(tmp_path)


A_NCSH = """<robot name="syn">
  <link name="base_link"><visual><origin xyz="0 0 0"/><geometry>
    <mesh filename="/home/author/oven/1/none_motion.obj"/></geometry></visual></link>
  <link name="1"><visual><origin xyz="-0.4 0 0.4"/><geometry>
    <mesh filename="/home/author/oven/1/dof_rootd_Aa001_r.obj"/></geometry></visual></link>
  <link name="2"><visual><origin xyz="0 0 0"/><geometry>
    <mesh filename="/home/author/oven/1/dof_rootd_Aa002_t.obj"/></geometry></visual></link>
  <joint name="0_j_1" type="revolute"><origin xyz="0.4 0 -0.4"/><axis xyz="0 1 0"/>
    <limit lower="-3.1415" upper="3.1415" effort="1" velocity="1"/>
    <parent link="base_link"/><child link="1"/></joint>
  <joint name="0_j_2" type="prismatic"><origin xyz="0 0 0"/>
    <parent link="base_link"/><child link="2"/></joint>
</robot>
"""


def test_the_urdf_of_a_ncsh_is_read_without_its_stand_in_limits(tmp_path):
    (tmp_path / "syn.urdf").write_text(A_NCSH)
    for name in ("none_motion", "dof_rootd_Aa001_r", "dof_rootd_Aa002_t"):
        write_obj(tmp_path / f"{name}.obj", (0.35, -0.5, -0.4), (0.4, 0.5, 0.4))
    obj = read(tmp_path)
    assert [(str(j.kind), j.lower, j.upper) for j in obj.joints] == [
        ("revolute", -math.inf, math.inf),
        ("prismatic", -math.inf, math.inf),
    ]
    assert any("3.1415" in note and "0_j_1" in note for note in obj.notes)
    np.testing.assert_allclose(
        world_vertices(obj, [0, 0])["1"], world_vertices(obj, [0, 0])["base_link"], atol=1e-12
    )


@needs_real_models
@pytest.mark.parametrize(
    ("number", "kind", "count"), [("0004", "revolute", 1), ("0007", "prismatic", 5)]
)
def test_real_cabinets_open_to_the_front(number, kind, count):
    obj = read(REAL_MODELS / "shape2motion" / "cabinet" / number)
    resolved = resolve(obj, Articulation())
    assert [str(j.kind) for j in resolved.moving_joints] == [kind] * count
    assert any(f"read from cabinet_{number}.urdf; left aside" in note for note in obj.notes)
    canonical = forward_kinematics(resolved, canonical_state(resolved))
    for k, joint in enumerate(resolved.moving_joints):
        half = np.zeros(count)
        half[k] = 0.5 * joint.upper
        link = resolved.link_index[joint.child]
        vertices = resolved.links[link].mesh.vertices
        T_open = forward_kinematics(resolved, JointState(half)).T_world_link[link]
        forward = apply(T_open, vertices) - apply(canonical.T_world_link[link], vertices)
        assert forward[:, 0].mean() > 0.1
        if kind == "prismatic":
            np.testing.assert_allclose(canonical.axes[k], [1, 0, 0], atol=1e-12)
