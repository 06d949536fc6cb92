"""MJCF: beside MuJoCo's own compiler, read back from our export, and refused in one sentence."""

import re
import struct
from pathlib import Path

import exports
import numpy as np
import pytest
from exports import MESHES, canonical_meshes, motion_in_metres, state_in_metres
from few import FEW
from hypothesis import given
from hypothesis import strategies as st

from articugen.core.errors import InvalidSource
from articugen.core.records import JointKind
from articugen.instance import articulation
from articugen.sources import xml_check
from articugen.sources.mjcf.reader import detect
from articugen.sources.readers import digest
from articugen.sources.source import load_path, open_source
from tests.mjcf_oracle import compare, in_mujoco, posed

BOXES, rows, exported = exports.BOXES, exports.rows, exports.exported

WEDGE = ((0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3), (1, 0, 3))
SIDES = ((0, 2, 1), (0, 1, 4), (0, 4, 3), (0, 3, 2), (1, 2, 4), (2, 3, 4))
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in WEDGE) + "".join(
    f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in SIDES
)
MSH = (
    struct.pack("<4i", len(WEDGE), 0, 0, len(SIDES))
    + np.array(WEDGE, "<f4").tobytes()
    + np.array(SIDES, "<i4").tobytes()
)
VERTICES = " ".join(f"{x} {y} {z}" for x, y, z in WEDGE)
HINGED = (
    '<body name="door"><joint name="hinge" range="0 90"/><geom size="1 1 1" type="box"/></body>'
)


@pytest.fixture
def tmp_path(tmp_path):
    """A folder in one of the test's own: a URDF above would make copies of its models."""
    (tmp_path / "own").mkdir()
    return tmp_path / "own"


def written(folder: Path, inside: str, name: str = "model.xml") -> Path:
    meshes = folder / "meshes"
    meshes.mkdir(exist_ok=True)
    (meshes / "wedge.obj").write_text(OBJ)
    (meshes / "wedge.msh").write_bytes(MSH)
    (folder / name).write_text(f"<mujoco>{inside}</mujoco>")
    return folder / name


def model(folder: Path, bodies: str, before: str = "") -> Path:
    return written(folder, f"{before}<worldbody>{bodies}</worldbody>")


class Writer:
    """Random models, of all ways to say where something is."""

    def __init__(self, random) -> None:
        self.random = random
        self.count = 0
        self.degrees = random.random() < 0.5

    def numbers(self, count: int, low: float = -1.0, high: float = 1.0) -> str:
        return " ".join(f"{self.random.uniform(low, high):.4f}" for _ in range(count))

    def angles(self, count: int) -> str:
        return self.numbers(count, -180, 180) if self.degrees else self.numbers(count, -3, 3)

    def turn(self) -> str:
        return self.random.choice([
            "", f'quat="{self.numbers(4, 0.1, 1)}"', f'euler="{self.angles(3)}"',
            f'axisangle="{self.numbers(3, 0.1, 1)} {self.angles(1)}"',
            f'xyaxes="{self.numbers(4, 0.1, 1)} {self.numbers(2, -1, -0.1)}"',
            f'zaxis="{self.numbers(3, 0.1, 1)}"', 'zaxis="0 0 -1"',
        ])  # fmt: skip

    def place(self) -> str:
        return f'pos="{self.numbers(3)}" {self.turn()}'

    def of_class(self, word: str = "class") -> str:
        return self.random.choice(["", f'{word}="one"', f'{word}="two"'])

    def geom(self) -> str:
        kind = self.random.choice(
            ["mesh", "box", "sphere", "capsule", "cylinder", "ellipsoid", "ends", "default"]
        )
        own = self.of_class()
        if kind == "default":
            return f'<geom class="{self.random.choice(["one", "two"])}" {self.place()}/>'
        if kind == "mesh":
            name = self.random.choice(["wedge", "binary", "written", "hull"])
            return f'<geom type="mesh" mesh="{name}" {own} {self.place()}/>'
        size = f'size="{self.numbers(3, 0.1, 0.5)}"'
        if kind == "ends":
            kind = self.random.choice(["box", "capsule", "cylinder", "ellipsoid"])
            size = f'size="{self.numbers(1, 0.1, 0.5)}"'
            start, end = self.numbers(3, 0.1, 1), self.numbers(3, -1, -0.1)
            return f'<geom type="{kind}" {own} {size} fromto="{start} {end}"/>'
        return f'<geom type="{kind}" {own} {size} {self.place()}/>'

    def joint(self) -> str:
        kind = self.random.choice(["hinge", "slide"])
        self.count += 1
        low = self.random.uniform(-1, 0)
        reach = self.random.choice(
            ["", f'range="{low} {low + 1}" limited="true"', 'range="1 2" limited="false"']
        )
        ref = self.random.choice(["", f'ref="{self.numbers(1)}"'])
        return (
            f'<joint name="j{self.count}" type="{kind}" {self.of_class()} '
            f'pos="{self.numbers(3)}" axis="{self.numbers(3, 0.1, 1)}" {reach} {ref}/>'
        )

    def body(self, depth: int) -> str:
        self.count += 1
        name = f'name="b{self.count}"' if self.random.random() < 0.7 else ""
        inside = "".join(self.joint() for _ in range(self.random.randrange(3)))
        inside += "".join(self.geom() for _ in range(self.random.randrange(1, 3)))
        if depth:
            inside += "".join(self.body(depth - 1) for _ in range(self.random.randrange(3)))
        if self.random.random() < 0.2:
            inside = f"<frame {self.place()} {self.of_class('childclass')}>{inside}</frame>"
        return f"<body {name} {self.of_class('childclass')} {self.place()}>{inside}</body>"

    def model(self) -> str:
        sequence = self.random.choice(["xyz", "zyx", "XYZ", "zxz", "ZxY"])
        angle = "" if self.degrees else 'angle="radian"'
        scale = self.random.choice(["", 'scale="0.5 2 -1"'])
        moved = self.random.choice(
            ["", f'refpos="{self.numbers(3)}" refquat="{self.numbers(4, 0.1, 1)}"']
        )
        faces = " ".join(f"{a} {b} {c}" for a, b, c in SIDES)
        return f"""
            <compiler {angle} eulerseq="{sequence}" meshdir="meshes"/>
            <default>
                <geom size="0.3 0.2 0.1" contype="0" conaffinity="0"/><mesh {scale}/>
                <default class="one"><geom type="box" {self.turn()}/>
                    <default class="two"><geom type="ellipsoid" size="0.2" {self.turn()}/>
                    <joint range="0.1 0.4"/></default></default>
            </default>
            <asset>
                <mesh file="wedge.obj" {moved}/>
                <mesh name="binary" file="wedge.msh" scale="1 1 2" {moved}/>
                <mesh name="written" vertex="{VERTICES}" face="{faces}"/>
                <mesh name="hull" vertex="{VERTICES}" {moved}/>
            </asset>
            <worldbody>{self.geom()}{self.body(2)}{self.body(1)}</worldbody>"""


@given(st.randoms(use_true_random=False))
@FEW
def test_any_model_stands_where_mujoco_has_it(tmp_path_factory, random):
    mujoco = pytest.importorskip("mujoco", reason="the oracle; make exporters")
    folder = tmp_path_factory.mktemp("model") / "own"
    folder.mkdir()
    path = written(folder, Writer(random).model())
    obj = load_path(path)
    rng = np.random.default_rng(0)
    assert compare(mujoco, obj, path, rng, states=2, both=True) < 1e-5
    compiled = mujoco.MjModel.from_xml_path(str(path))
    moving = [joint for joint in obj.joints if joint.kind != JointKind.FIXED]
    assert len(moving) == compiled.njnt
    for k, joint in enumerate(moving):
        assert compiled.joint(k).name == joint.name
        assert np.isfinite(joint.lower) == bool(compiled.jnt_limited[k])
        if compiled.jnt_limited[k]:
            np.testing.assert_allclose([joint.lower, joint.upper], compiled.jnt_range[k])


def test_the_default_class_above_all_counts_for_all_whatever_its_name(tmp_path):
    """Until version 3 MuJoCo took any."""
    classes = '<default class="top"><joint type="slide"/><default class="low"/></default>'
    obj = load_path(model(tmp_path, HINGED.replace("<geom", '<joint class="low"/><geom'), classes))
    assert [str(joint.kind) for joint in obj.moving_joints] == ["prismatic", "prismatic"]


def test_a_range_without_length_undoes_that_of_a_class_as_in_mujoco(tmp_path):
    path = model(tmp_path, HINGED.replace("0 90", "0 0"), '<default><joint range="0 9"/></default>')
    (joint,) = load_path(path).moving_joints
    assert (joint.kind, joint.lower, joint.upper) == (JointKind.CONTINUOUS, -np.inf, np.inf)


def test_a_model_is_put_together_of_files_in_its_folder(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "asset.xml").write_text(
        '<mujocoinclude><compiler assetdir="meshes" strippath="true"/><asset>'
        '<mesh file="old/place/wedge.obj"/></asset></mujocoinclude>'
    )
    (tmp_path / "parts" / "door.xml").write_text(
        '<mujoco><include file="parts/asset.xml"/><worldbody><body name="door"><joint/>'
        '<geom type="mesh" mesh="wedge"/></body></worldbody></mujoco>'
    )
    path = written(tmp_path, '<worldbody/><include file="parts/door.xml"/>')
    obj = load_path(path)
    assert [(link.name, len(link.mesh.faces)) for link in obj.links] == [("world", 0), ("door", 6)]
    assert obj.joints[0].kind == JointKind.CONTINUOUS
    (ref,) = open_source(tmp_path).objects("door")
    assert digest(ref) == obj.sha256
    (tmp_path / "parts" / "asset.xml").write_text(
        (tmp_path / "parts" / "asset.xml").read_text().replace("<asset>", "<asset> ")
    )
    assert load_path(path).sha256 != obj.sha256


@pytest.mark.parametrize(
    ("geoms", "shown"),
    [
        ('<geom group="2" SEEN/><geom group="3"/>', 1),
        ('<geom group="1" SEEN/><geom group="0"/>', 1),
        ('<geom group="0" SEEN/><geom group="0"/>', 2),
        ('<geom group="3"/><geom group="4"/>', 2),
        ('<geom group="1" rgba="0 1 0 0" SEEN/><geom/>', 1),
        ('<geom class="glass" SEEN/><geom/>', 1),
        ('<geom class="glass" rgba="0 1 0 1"/><geom/>', 2),
        ('<geom/><geom/><geom type="plane" size="1 1 1"/>', 2),
    ],
)
def test_what_is_seen_goes_before_what_collides(tmp_path, geoms, shown):
    geoms = geoms.replace("SEEN", 'contype="0" conaffinity="0"')
    path = model(
        tmp_path,
        f'<body name="b">{geoms}</body>',
        '<default><geom type="box" size="1 1 1"/><default class="glass"><material rgba="0 1 0 0"/>'
        '<geom material="m"/></default></default><asset><material name="m" class="glass"/></asset>',
    )
    obj = load_path(path)
    assert len(obj.links[1].mesh.faces) == 12 * shown
    assert obj.notes == (("not read, left out: a plane",) if "plane" in geoms else ())


def test_what_is_left_out_is_noted(tmp_path):
    body = HINGED.replace("<joint", '<freejoint/></body><body><geom size="1"/><joint')
    body = body.replace("<freejoint/>", '<freejoint/><geom size="1"/>')
    obj = load_path(model(tmp_path, body, "<equality><weld/></equality><tendon/>"))
    assert obj.notes == (
        "door: moves freely, taken as fixed where it stands",
        "not read, left out: a <weld> of <equality>, tendon",
    )


def test_joints_follow_by_linear_equalities_as_in_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    bodies = "".join(
        f'<body name="b{k}"><joint name="j{k}" {more}/><geom size="1"/></body>'
        for k, more in enumerate(
            ('range="0 90" ref="20"', 'type="slide" ref="0.3"', 'axis="1 0 0"', 'axis="1 0 0"')
        )
    )
    coupled = """<equality>
        <joint joint1="j1" joint2="j0" polycoef="0.1 -0.5"/><joint joint1="j2" joint2="j1"/>
        <joint joint1="j0" joint2="j2"/><joint joint1="j3" joint2="j0" polycoef="0 1 2"/>
        <joint joint1="j3" joint2="j0" active="false"/><joint joint1="j3"/></equality>"""
    path = model(tmp_path, bodies, coupled)
    obj = load_path(path)
    left = "a <joint> of <equality>, an equality of 'j0', an equality of 'j3'"
    assert obj.notes == (f"not read, left out: {left}",)
    state = articulation.driven_state(obj, {"j0": 0.7, "j3": 0.0}).q
    by_name = dict(zip([joint.name for joint in obj.moving_joints], state, strict=True))
    q = [by_name[f"j{k}"] for k in range(4)]
    compiled = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(compiled)
    data.qpos[:] = q
    mujoco.mj_forward(compiled, data)
    np.testing.assert_allclose(data.efc_pos[:2], 0.0, atol=1e-12)  # of the two that are read
    np.testing.assert_allclose(q[1], 0.4 - 0.5 * (0.7 - np.radians(20.0)))
    with pytest.raises(InvalidSource, match="unknown joint 'j9'; correct it"):
        load_path(model(tmp_path, bodies, '<equality><joint joint1="j9" joint2="j0"/></equality>'))


def test_an_equality_is_as_active_as_its_class(tmp_path):
    off = '<default><default class="off"><equality active="false"/></default></default>'
    bodies = HINGED + HINGED.replace("door", "lid").replace("hinge", "other")
    coupled = '<equality><joint class="off" joint1="hinge" joint2="other"/></equality>'
    assert [j.mimic for j in load_path(model(tmp_path, bodies, off + coupled)).joints] == [None] * 2
    coupled = coupled.replace("joint1", 'active="true" joint1')
    assert load_path(model(tmp_path, bodies, off + coupled)).joints[0].mimic is not None


def test_our_export_is_read_back_as_it_was(exported, rows):
    for row in rows:
        path = exported("mjcf", **MESHES) / row.split / row.object_id / f"{row.object_id}.xml"
        obj = load_path(path)
        state = list(state_in_metres(row))
        there = [v for v in posed(obj, state).values() if len(v)]
        assert len(there) == len(canonical_meshes(rows, row))
        for part, (vertices, own) in enumerate(
            zip(there, canonical_meshes(rows, row), strict=True)
        ):
            T = motion_in_metres(row, part)
            np.testing.assert_allclose(vertices, own @ T[:3, :3].T + T[:3, 3], atol=1e-6)


def test_folders_of_models_are_sources(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        model(tmp_path / name, HINGED)
        (tmp_path / name / "parts.xml").write_text("<mujocoinclude/>")
    (tmp_path / "package.xml").write_text("<package/>")
    refs = open_source(tmp_path).objects("cabinet")
    assert sorted(ref.object_id for ref in refs) == ["a", "b"]
    assert open_source(tmp_path).find("cabinet", "a").reader == "mjcf"
    (tmp_path / "a" / "a.urdf").write_text("<robot/>")
    assert detect(tmp_path / "a" / "model.xml") is None
    assert detect(tmp_path / "a") is None


LONG = HINGED.replace("hinge", "x" * 255).replace("door", "x" * 255)
CLASS = '<default class="a"/>'
BOX = '<geom type="box" size="1 1 1"/>'
WEDGES = '<asset><mesh name="w" file="meshes/wedge.obj"/></asset>'


@pytest.mark.parametrize(
    ("bodies", "before", "words"),
    [
        (f'<body name="a">{BOX}</body><body name="a"/>', "", "a second body of that name"),
        (f'<body name="world">{BOX}</body>', "", "a second body of that name"),
        (f'{HINGED}{HINGED.replace("door", "lid")}', "", "a second joint of that name"),
        (BOX, WEDGES + WEDGES, "a second mesh of that name"),
        ('<geom type="mesh" mesh="w"/>', "", "unknown mesh 'w'"),
        ('<geom type="mesh" mesh="w"/>', WEDGES.replace("meshes/", "../"), "leads out of"),
        ('<geom type="mesh" mesh="w"/>', WEDGES.replace("wedge", "gone"), "does not exist"),
        ('<geom type="mesh" mesh="w"/>', WEDGES.replace("name", 'scale="1 0 1" name'), "zero sc"),
        ('<geom type="mesh" mesh="w"/>', '<asset><mesh name="w" vertex="0 0"/></asset>', "threes"),
        ('<geom type="mesh" mesh="w"/>', '<asset><mesh name="w"/></asset>', "no triangle"),
        ('<geom type="mesh" mesh="w"/>',
         f'<asset><mesh name="w" vertex="0 0 0 1 1 1" face="0 1 {9**99}"/></asset>', "threes"),
        (BOX, '<compiler meshdir="/etc"/><include file="/etc/passwd.xml"/>', "does not exist"),
        (BOX, '<include file="../other.xml"/>', "leads out of"),
        (BOX, '<include file="model.xml"/>', "a second time"),
        (BOX, '<include file="https://x.org/a.xml"/>', "on the network"),
        (BOX, '<compiler coordinate="global"/>', "that no MuJoCo has"),
        (BOX, '<compiler angle="turns"/>', "that no MuJoCo has"),
        (BOX, '<compiler eulerseq="xy"/>', "three of xyz"),
        (f'<geom class="no"/>{BOX}', "", "unknown class 'no'"),
        (BOX, f'<default>{CLASS * 2}</default>', "a second default class 'a'"),
        (BOX, f'<default><geom pos="{"0 " * 999}"/></default>', "an endless attribute"),
        (HINGED.replace('range="0 90"', 'type="ball"'), "", "its type is 'ball'"),
        (HINGED.replace("0 90", "90 0"), "", "has no length"),
        (HINGED.replace("0 90", "0 x"), "", "is not 2 numbers"),
        (HINGED.replace("range", 'axis="0 0 0" range'), "", "is zero; correct it"),
        (BOX.replace("1 1 1", "1 1"), "", "a box has 3 sizes above 0"),
        (BOX.replace("1 1 1", "1 1 -1"), "", "a box has 3 sizes above 0"),
        (BOX.replace("box", "cone"), "", "is a 'cone'"),
        (BOX.replace("size", 'euler="0 0 1" zaxis="1 0 0" size'), "", "keep one"),
        (BOX.replace("size", 'quat="0 0 0 0" size'), "", "is zero; correct it"),
        (BOX.replace("size", 'pos="1e9 0 0" size'), "", "is beyond 1,000,000"),
        (f'<replicate count="9">{BOX}</replicate>', "", "save the model with MuJoCo first"),
        (BOX, '<asset><mesh name="m" builtin="cone"/></asset>', "'m': a <mesh> that MuJoCo builds"),
        (f"<site>{BOX}</site>", "", "is in a <site>"),
        ('<geom type="plane" size="1 1 1"/>', "", "shows no geom"),
        (LONG.replace("<geom", "<joint/><geom"), "", "is too long"),
        (HINGED * 2001, "", "2,001 <body>, at most 2,000"),
        (BOX * 5001, "", "5,001 <geom>, at most 5,000"),
        ('<geom size="1"/>' * 300, "", "more than 1,000,000 triangles"),
        (BOX + "<body>", "", "not well-formed XML"),
    ],
)  # fmt: skip
def test_what_is_amiss_is_one_sentence(tmp_path, bodies, before, words):
    (tmp_path.parent / "other.xml").write_text("<mujocoinclude/>")
    path = model(tmp_path, bodies, before)
    with pytest.raises(InvalidSource) as refusal:
        load_path(path)
    text = str(refusal.value)
    assert re.search(re.escape(words), text)
    assert "model.xml" in text
    assert "\n" not in text


def test_deep_chains_of_includes_and_bodies_end(tmp_path):
    for k in range(12):
        inner = f'<include file="{k + 1}.xml"/>' if k < 11 else BOX
        (tmp_path / f"{k}.xml").write_text(
            f"<mujocoinclude>{'<body>' * 150}{inner}{'</body>' * 150}</mujocoinclude>"
        )
    obj = load_path(model(tmp_path, '<include file="0.xml"/>'))
    assert len(obj.links) == 1801
    assert xml_check.MAX_LINKS == 2000


def test_the_oracle_tells_a_difference(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="the oracle; make exporters")
    path = model(tmp_path, HINGED)
    ours = posed(load_path(path), [0.5])["door"]
    assert np.abs(in_mujoco(mujoco, path)([0.5])["door"] - ours).max() < 1e-9
    assert np.abs(in_mujoco(mujoco, path)([0.6])["door"] - ours).max() > 1e-2
