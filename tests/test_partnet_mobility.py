"""The PartNet-Mobility reader: a synthetic folder for its rules, real models for its choices."""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from real_models import REAL_MODELS, needs_real_models

from articugen.core.errors import InvalidSource, NotOfCategory
from articugen.core.geometry import apply, bounds
from articugen.core.recipe import Articulation, load_recipe
from articugen.core.records import JointKind, JointState
from articugen.instance.articulation import (
    _part_boxes,
    canonical_state,
    forward_kinematics,
    resolve,
)
from articugen.sources.partnet_mobility import load
from articugen.sources.refs import CategorySettings, ObjectRef
from articugen.sources.source_file import read_source_file

SOURCE = read_source_file(
    Path(__file__).parent.parent / "urdf_sources" / "partnet_mobility" / "source.yaml"
)

URDF = """<robot name="partnet">
  <link name="base"/>
  <link name="link_0">{drawer}</link>
  <joint name="joint_0" type="prismatic"><origin xyz="0 0 0"/><axis xyz="0 0 1"/>
    <child link="link_0"/><parent link="link_2"/><limit lower="-0.25" upper="0.5"/></joint>
  <link name="link_1">{door}</link>
  <joint name="joint_1" type="revolute"><origin xyz="0.5 0 0.5"/><axis xyz="0 -1 0"/>
    <child link="link_1"/><parent link="link_2"/><limit lower="-1.5" upper="0"/></joint>
  <link name="link_2">{body}</link>
  <joint name="joint_2" type="fixed"><origin rpy="1.570796326794897 0 -1.570796326794897"/>
    <child link="link_2"/><parent link="base"/></joint>
</robot>
"""
BOX = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""
SEMANTICS = "link_0 slider drawer\nlink_1 hinge rotation_door\nlink_2 heavy furniture_body\n"


@pytest.fixture
def folder(tmp_path):
    """A cabinet of one drawer and one door."""
    meshes = tmp_path / "textured_objs"
    meshes.mkdir()
    (meshes / "original-1.obj").write_text(BOX)
    visual = '<visual><geometry><mesh filename="textured_objs/{}.obj"/></geometry></visual>'
    shape = visual.format("original-1")
    urdf = URDF.format(drawer=shape + visual.format("new-7"), door=shape, body=shape)
    (tmp_path / "mobility.urdf").write_text(urdf)
    (tmp_path / "semantics.txt").write_text(SEMANTICS)
    (tmp_path / "meta.json").write_text(json.dumps({"model_cat": "StorageFurniture"}))
    (tmp_path / "mobility_v2.json").write_text("[]")
    return tmp_path


def read(folder, category="drawer", settings=None):
    ref = ObjectRef("partnet_mobility", category, folder.name, "train", folder)
    return load(ref, settings or SOURCE.categories[category])


def test_links_get_their_names_from_semantics_txt(folder):
    """A mesh that was never published is noted, and another category."""
    obj = read(folder)
    (note,) = (note for note in obj.notes if re.search(r"new-7|meta\.json", note))
    assert "new-7.obj" in note
    assert len(obj.links[obj.link_index["link_0"]].mesh.faces) == 4
    (folder / "meta.json").write_text(json.dumps({"model_cat": "Microwave"}))
    assert any("'Microwave'" in note for note in read(folder).notes)
    (folder / "meta.json").write_text("[" * 10**5)
    assert not any("meta.json" in note for note in read(folder).notes)
    named = {link.name: link.semantic for link in obj.links}
    assert named == {
        "base": "",
        "link_0": "drawer",
        "link_1": "rotation_door",
        "link_2": "furniture_body",
    }


def test_any_other_missing_mesh_is_refused(folder):
    (folder / "textured_objs" / "original-1.obj").unlink()
    with pytest.raises(InvalidSource, match=r"original-1\.obj"):
        read(folder)


def test_side_files_may_be_absent_and_count_in_the_hash(folder):
    full = read(folder).sha256
    (folder / "semantics.txt").write_text(SEMANTICS.replace("drawer", "tray"))
    assert read(folder).sha256 != full
    (folder / "semantics.txt").write_text(SEMANTICS)
    (folder / "mobility_v2.json").write_text("[ ]")
    assert read(folder).sha256 != full
    for name in ("meta.json", "mobility_v2.json", "semantics.txt"):
        (folder / name).unlink()
    bare = read(folder)
    assert {link.semantic for link in bare.links} == {""}


def test_the_hash_does_not_depend_on_the_place(folder, tmp_path_factory):
    copy = tmp_path_factory.mktemp("elsewhere") / folder.name
    shutil.copytree(folder, copy)
    assert read(copy).sha256 == read(folder).sha256


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("meta.json", b"\xff", r"meta\.json: is not UTF-8"),
        ("semantics.txt", b"\xff\xfe", r"semantics\.txt: is not UTF-8"),
    ],
)
def test_bad_side_files_are_refused_with_a_sentence(folder, name, text, says):
    (folder / name).write_bytes(text)
    with pytest.raises(InvalidSource, match=says):
        read(folder)


def test_yaw_turns_the_model_about_z(folder):
    obj = read(folder, settings=CategorySettings(yaw_degrees=180))
    np.testing.assert_allclose(obj.T_world_root, np.diag([-1, -1, 1, 1]), atol=1e-15)


def resolved(obj, category, settings=None):
    """The model as the recipe, by default the category's, and its source want it."""
    choices = SOURCE.categories[category]
    settings = settings or load_recipe(None, category).articulation
    return resolve(obj, settings, canonical=choices.canonical, movable=choices.movable)


LAPTOPS = ["9748", "10040", "10101", "10125", "10248", "10697", "11030", "11405"]
GLASSES = ["101287", "101326"]
OVENS = ["7138", "101940"]
DRAWERS = ["20555", "22692", "23472", "29557", "45213", "45940"]


class Opened:
    """A real model as the paper's protocol has it, to look at its parts at any joint values."""

    def __init__(self, category, object_id):
        self.source = read(REAL_MODELS / "partnet_mobility" / category / object_id, category)
        self.obj = resolved(self.source, category)
        self.joints = self.obj.moving_joints
        self.axes = forward_kinematics(self.obj, canonical_state(self.obj)).axes

    def part(self, part, *q):
        """The world vertices (V, 3) of a part, at the joint values `q` (by default all 0)."""
        state = JointState(np.array(q)) if q else canonical_state(self.obj)
        posed = forward_kinematics(self.obj, state)
        return np.concatenate(
            [
                apply(T, link.mesh.vertices)
                for link, T, own in zip(
                    self.obj.links, posed.T_world_link, self.obj.part_of_link, strict=True
                )
                if own == part
            ]
        )


@needs_real_models
@pytest.mark.parametrize("object_id", LAPTOPS)
def test_real_laptops_are_shut_and_open_upwards_about_y(object_id):
    laptop = Opened("laptop", object_id)
    np.testing.assert_allclose(laptop.axes, [[0, 1, 0]], atol=1e-6)
    body, shut = laptop.part(0), laptop.part(1)
    far = shut[:, 0] < shut[:, 0].min() + 0.1
    # Shut: a flat lid that covers the base and lies on it.
    assert np.ptp(shut[:, 2]) < 0.15
    assert abs(shut[far, 2].mean() - body[:, 2].max()) < 0.08
    np.testing.assert_allclose(bounds(shut)[:, 0], bounds(body)[:, 0], atol=0.16)
    # Opening: the far edge describes a circle that starts upwards and ends behind the hinge.
    heights = []
    for degrees in (30, 60, 90, 135):
        lid = laptop.part(1, math.radians(degrees))
        heights.append(np.mean(lid[far, 2] - shut[far, 2]) / np.ptp(shut[:, 0]))
        assert lid[far, 2].min() > body[:, 2].max()
    np.testing.assert_allclose(
        heights, np.sin(np.radians([30, 60, 90, 135])), atol=0.2, err_msg="height of the far edge"
    )
    assert laptop.part(1, math.radians(135))[far, 0].mean() > shut[:, 0].max()


@needs_real_models
@pytest.mark.parametrize("object_id", GLASSES)
def test_real_eyeglasses_fold_their_temples_inwards_about_z(object_id):
    glasses = Opened("eyeglasses", object_id)
    # Part 1 is the wearer's left temple, at -y: the wearer looks to -x, as in our procedural ones.
    np.testing.assert_allclose(glasses.axes, [[0, 0, 1], [0, 0, -1]], atol=1e-6)
    assert glasses.part(1)[:, 1].mean() < glasses.part(2)[:, 1].mean()
    assert glasses.part(0)[:, 0].mean() < glasses.part(1)[:, 0].mean()
    assert all(math.radians(60) < j.upper <= math.pi / 2 for j in glasses.joints)
    for part in (1, 2):
        worn = glasses.part(part)
        folded = glasses.part(part, *(math.pi / 2 * (np.arange(1, 3) == part)))
        assert np.ptp(worn[:, 0]) > 3 * np.ptp(worn[:, 1]), "worn: temples point along x"
        assert np.ptp(folded[:, 1]) > 3 * np.ptp(folded[:, 0]), "folded: along y"
        tip = worn[:, 0].argmax()
        assert folded[tip, 1] * worn[tip, 1] < 0.0, "folded: the tip has crossed the middle"


@needs_real_models
@pytest.mark.parametrize("object_id", OVENS)
def test_real_ovens_open_their_door_forwards_and_down_about_y(object_id):
    oven = Opened("oven", object_id)
    assert len(oven.joints) == 1
    np.testing.assert_allclose(oven.axes, [[0, 1, 0]], atol=1e-6)
    shut, level = oven.part(1), oven.part(1, math.pi / 2)
    body = oven.part(0)
    assert shut[:, 0].min() > body[:, 0].max() - 0.2, "shut: in front of the body"
    assert np.ptp(shut[:, 2]) > 3 * np.ptp(shut[:, 0])
    assert level[:, 0].mean() > shut[:, 0].max(), "open: in front of where it was"
    assert level[:, 2].max() < shut[:, 2].mean(), "open: level, at the height of its hinge"
    knobs = [j for j in oven.source.joints if j.kind == JointKind.CONTINUOUS]
    assert len(knobs) == (4 if object_id == "101940" else 0)
    assert all(any(k.name in note for note in oven.obj.notes) for k in knobs)


@needs_real_models
def test_the_real_washing_machine_opens_its_door_to_the_side_about_z():
    machine = Opened("washing_machine", "103480")
    np.testing.assert_allclose(machine.axes, [[0, 0, -1]], atol=1e-6)
    body, shut = machine.part(0), machine.part(1)
    quarter = machine.part(1, math.pi / 2)
    assert shut[:, 0].max() <= body[:, 0].max() + 0.02, "shut: flush with the front"
    assert quarter[:, 0].mean() > body[:, 0].max(), "open: in front of it"


@needs_real_models
@pytest.mark.parametrize("object_id", DRAWERS)
def test_real_drawers_start_shut_and_slide_forwards_by_their_limits(object_id):
    cabinet = Opened("drawer", object_id)
    body = cabinet.part(0)
    sliders = [j for j in cabinet.source.joints if j.kind == JointKind.PRISMATIC]
    assert len(cabinet.joints) == len(sliders) >= 1
    np.testing.assert_allclose(cabinet.axes, [[1, 0, 0]] * len(sliders), atol=1e-6)
    for k, (joint, slider) in enumerate(zip(cabinet.joints, sliders, strict=True)):
        assert (joint.lower, joint.upper) == (0.0, pytest.approx(slider.upper - slider.lower))
        shut = cabinet.part(k + 1)
        assert shut[:, 0].max() < body[:, 0].max() + 0.05, "shut: not in front of the body"
        q = np.zeros(len(sliders))
        q[k] = joint.upper
        np.testing.assert_allclose(
            cabinet.part(k + 1, *q) - shut, np.tile([joint.upper, 0, 0], (len(shut), 1)), atol=1e-9
        )


def real_folders(*roots: str) -> list[tuple[str, Path]]:
    """(category's own name, folder) of every real model."""
    folders = [path.parent for root in roots for path in (REAL_MODELS / root).glob("*/*/meta.json")]
    named = [(SOURCE.own_name(folder.parent.name), folder) for folder in sorted(folders)]
    return [(name, folder) for name, folder in named if name]


@needs_real_models
def test_by_default_no_real_model_leaves_the_limits_of_its_urdf():
    made = 0
    for category, folder in real_folders("partnet_mobility", "partnet_mobility_more"):
        source = read(folder, category)
        if folder.name == "103127":  # a coffee machine of buttons alone
            with pytest.raises(NotOfCategory):
                resolved(source, category)
            continue
        obj = resolved(source, category)
        assert not [note for note in obj.notes if "beyond the limits" in note]
        reach = {j.name: j.upper - j.lower for j in source.joints}
        for joint in obj.moving_joints:
            assert 0.0 <= joint.lower < joint.upper <= reach[joint.name] + 1e-9
        made += 1
    assert made >= 23


@needs_real_models
@pytest.mark.parametrize("category", ["dishwasher", "microwave", "oven", "table", "drawer"])
def test_fronts_of_real_models_look_along_x(category):
    for name, folder in real_folders("partnet_mobility", "partnet_mobility_more"):
        if name != category:
            continue
        obj = resolved(read(folder, category), category, Articulation())
        boxes = _part_boxes(obj)
        state = JointState(np.array([j.upper for j in obj.moving_joints]))
        posed = forward_kinematics(obj, state)
        for link, T, k in zip(obj.links, posed.T_world_link, obj.part_of_link, strict=True):
            if k and len(link.mesh.vertices):
                nearest = apply(T, link.mesh.vertices)[:, 0].max()
                assert nearest > boxes[k, 1, 0] + 0.1, "opens towards +x"
