"""The URDF loader: what is read, what is refused, and agreement with yourdfpy on random trees."""

import io
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lxml import etree
from real_models import REAL_MODELS, needs_real_models
from scipy.spatial import cKDTree

from articugen.core.errors import InvalidSource
from articugen.core.geometry import apply
from articugen.core.records import ArticulatedObject, Floats
from articugen.sources import urdf_check
from articugen.sources.urdf import load_urdf

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def read(folder: Path, body: str, **options) -> ArticulatedObject:
    """Load a URDF whose <robot> holds `body`."""
    path = folder / "model.urdf"
    path.write_text(f'<robot name="r">{body}</robot>', encoding="utf-8")
    return load_urdf(path, object_id="1", category="thing", **options)


def visuals(*shapes: str) -> str:
    return "".join(f"<visual><geometry>{shape}</geometry></visual>" for shape in shapes)


BOX = visuals('<box size="1 1 1"/>')


def shown(*shapes: str) -> str:
    """Link a, with a visual of each shape."""
    return f'<link name="a">{visuals(*shapes)}</link>'


def links(*names: str) -> str:
    return "".join(f'<link name="{name}">{BOX}</link>' for name in names)


def joint(name: str, parent: str, child: str, rest: str = "", kind: str = "revolute") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{rest}</joint>"
    )


def two_links(rest: str, kind: str = "revolute") -> str:
    """Links a and b, and a joint j between them with `rest` inside."""
    return links("a") + '<link name="b"/>' + joint("j", "a", "b", rest, kind)


def link_frames(obj: ArticulatedObject) -> dict[str, Floats]:
    """Each link's frame at q = 0, in the root's."""
    T = {obj.links[0].name: np.eye(4)}
    for j in obj.joints:
        T[j.child] = T[j.parent] @ j.T_parent_joint
    return T


def test_links_joints_and_provenance(tmp_path):
    body = two_links('<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/><axis xyz="0 3 4"/>')
    obj = read(tmp_path, body, source="mine", semantics={"b": "lid"})
    assert (obj.object_id, obj.category, obj.source) == ("1", "thing", "mine")
    assert [link.name for link in obj.links] == ["a", "b"]
    assert [link.semantic for link in obj.links] == ["", "lid"]
    (j,) = obj.joints
    assert (j.name, str(j.kind), j.parent, j.child, j.mimic) == ("j", "revolute", "a", "b", None)
    np.testing.assert_allclose(j.axis, [0, 0.6, 0.8])
    np.testing.assert_allclose(apply(j.T_parent_joint, [1.0, 0, 0]), [1, 3, 3], atol=1e-12)
    np.testing.assert_array_equal(obj.T_world_root, np.eye(4))


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize(
    ("limit", "wanted"),
    [
        ("", (-np.inf, np.inf)),
        ("<limit effort='1' velocity='2'/>", (-np.inf, np.inf)),
        ("<limit lower='-1' upper='2'/>", (-1, 2)),
        ("<limit upper='2'/>", (0, 2)),
        ("<limit lower='-1'/>", (-1, 0)),
        ("<limit lower='-inf' upper='2'/>", (-np.inf, 2)),
        ("<limit lower='-1e16' upper='3.4e38'/>", (-np.inf, np.inf)),  # as simulators write none
    ],
)
def test_limits(tmp_path, kind, limit, wanted):
    (j,) = read(tmp_path, two_links(limit, kind)).joints
    assert (j.lower, j.upper) == wanted


def test_limits_of_fixed_and_continuous_joints(tmp_path):
    limit = "<limit lower='5' upper='1'/>"
    (j,) = read(tmp_path, two_links(limit, "continuous")).joints
    assert (j.lower, j.upper) == (-np.inf, np.inf)
    (j,) = read(tmp_path, two_links(limit + '<axis xyz="0 0 0"/>', "fixed")).joints
    assert (j.lower, j.upper) == (0, 0)


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_axes_become_unit_vectors(tmp_path, kind):
    (j,) = read(tmp_path, two_links('<axis xyz="0 0 0.1"/>', kind)).joints
    np.testing.assert_array_equal(j.axis, [0, 0, 1])
    (j,) = read(tmp_path, two_links('<axis xyz="1e200 -1e200 0"/>', kind)).joints
    np.testing.assert_allclose(j.axis, [0.5**0.5, -(0.5**0.5), 0])
    (j,) = read(tmp_path, two_links("", kind)).joints
    np.testing.assert_array_equal(j.axis, [1, 0, 0])


def test_root_first_and_joints_in_topological_file_order(tmp_path):
    body = links("c", "d", "b", "a", "e")
    body += joint("jd", "c", "d") + joint("je", "a", "e") + joint("jc", "b", "c")
    body += joint("jb", "a", "b")
    obj = read(tmp_path, body)
    assert [link.name for link in obj.links] == ["a", "c", "d", "b", "e"]
    assert [j.name for j in obj.joints] == ["je", "jb", "jc", "jd"]


def test_mimic(tmp_path):
    body = links("a", "b", "c", "d") + joint("j", "a", "b")
    body += joint("k", "a", "c", '<mimic joint="j" multiplier="-2" offset="0.5"/>')
    body += joint("m", "a", "d", '<mimic joint="k"/>')
    _, k, m = read(tmp_path, body).joints
    assert k.mimic is not None
    assert m.mimic is not None
    assert (k.mimic.joint, k.mimic.multiplier, k.mimic.offset) == ("j", -2.0, 0.5)
    assert (m.mimic.joint, m.mimic.multiplier, m.mimic.offset) == ("k", 1.0, 0.0)


def test_visuals_are_placed_and_joined(tmp_path):
    (tmp_path / "t.obj").write_text(TRIANGLE)
    body = """<link name="a">
      <visual><origin xyz="0 0 5" rpy="0 0 3.141592653589793"/>
        <geometry><mesh filename="t.obj" scale="2 3 1"/></geometry></visual>
      <visual><geometry><mesh filename="t.obj" scale="0.5"/></geometry></visual>
      <visual><origin xyz="9 0 0"/><geometry><sphere radius="2"/></geometry></visual>
      <visual><geometry><cylinder radius="1" length="8"/></geometry></visual>
      <visual><geometry><box size="1, 1,1"/></geometry></visual>
    </link>"""
    mesh = read(tmp_path, body).links[0].mesh
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_allclose(corners[0], [[0, 0, 5], [-2, 0, 5], [0, -3, 5]], atol=1e-12)
    np.testing.assert_allclose(corners[1], [[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    np.testing.assert_allclose(corners.max(axis=(0, 1)), [11, 2, 5])
    np.testing.assert_allclose(corners.min(axis=(0, 1)), [-2, -3, -4])


def test_what_is_not_used_cannot_hurt(tmp_path):
    body = f"""stray text <!-- <link/> -->
      <material/><transmission><joint name="x"/></transmission>
      <gazebo reference="a"><link/></gazebo>
      <link name="a"><inertial/>{BOX}<collision><geometry><capsule/></geometry></collision></link> `
      <link name="b"><collision/></link>tail
    """ + joint("j", "a", "b", "<dynamics/><safety_controller/><calibration/>")
    obj = read(tmp_path, body)
    assert [len(link.mesh.faces) for link in obj.links] == [12, 0]
    assert obj.notes == ("links with collision shapes but no visual, not seen: b",)


def test_missing_and_empty_meshes_are_left_out_where_that_is_known(tmp_path):
    (tmp_path / "new-2.obj").write_text("")
    shapes = ['<box size="1 1 1"/>']
    shapes += [f'<mesh filename="sub/../{name}.obj"/>' for name in ("new-1", "new-2")]
    obj = read(tmp_path, shown(*shapes), missing_ok="new-*.obj")
    assert obj.notes == ("meshes missing or empty, left out: sub/../new-1.obj, sub/../new-2.obj",)
    assert len(obj.links[0].mesh.faces) == 12
    with pytest.raises(InvalidSource, match=r"link 'a': mesh 'sub/../new-1.obj' does not exist"):
        read(tmp_path, shown(*shapes))
    with pytest.raises(InvalidSource, match=r"old\.obj"):
        read(tmp_path, shown(*shapes, '<mesh filename="old.obj"/>'), missing_ok="new-*.obj")


def test_hash_changes_with_any_file_and_with_nothing_else(tmp_path):
    body = shown('<mesh filename="m/t.obj"/>')
    digests = []
    for folder in ("one", "two"):
        (tmp_path / folder / "m").mkdir(parents=True)
        (tmp_path / folder / "m" / "t.obj").write_text(TRIANGLE)
        (tmp_path / folder / "unused.obj").write_text(folder)
        digests.append(read(tmp_path / folder, body).sha256)
    assert digests[0] == digests[1]
    (tmp_path / "two" / "m" / "t.obj").write_text(TRIANGLE + "\n")
    assert read(tmp_path / "two", body).sha256 != digests[0]
    assert read(tmp_path / "one", body + " ").sha256 != digests[0]


def test_meshes_beside_the_urdf_folder(tmp_path):
    (tmp_path / "urdf").mkdir()
    (tmp_path / "robots").mkdir()
    (tmp_path / "t.obj").write_text(TRIANGLE)
    body = shown('<mesh filename="../t.obj"/>')
    assert len(read(tmp_path / "urdf", body).links[0].mesh.faces) == 1
    assert len(read(tmp_path / "robots", body, root=tmp_path).links[0].mesh.faces) == 1
    with pytest.raises(InvalidSource, match="leads out of"):
        read(tmp_path / "robots", body)


REFUSED = {
    "no links": ("", "no <link>"),
    "no name": (f"<link>{BOX}</link>", "<link> at line 1: has no name"),
    "two links of one name": (links("a", "a"), "link 'a': a second link of that name"),
    "two joints of one name": (
        links("a", "b", "c") + joint("j", "a", "b") + joint("j", "a", "c"),
        "joint 'j': a second joint of that name",
    ),
    "planar": (two_links("", "planar"), "joint 'j': type 'planar' .* is not read"),
    "floating": (two_links("", "floating"), "joint 'j': type 'floating' .* is not read"),
    "spherical": (two_links("", "spherical"), "joint 'j': type 'spherical' .* is not read"),
    "unknown type": (two_links("", "hinge"), "unknown type 'hinge'; make it fixed, revolute"),
    "no type": (two_links("").replace('type="revolute"', ""), "unknown type ''"),
    "no parent": (two_links("").replace('<parent link="a"/>', ""), "'j': has no <parent>"),
    "no child": (two_links("").replace('<child link="b"/>', ""), "'j': has no <child>"),
    "two children": (two_links('<child link="b"/>'), "'j': has 2 <child>"),
    "empty child": (two_links("").replace('<child link="b"/>', "<child/>"), "names no link"),
    "unknown child": (two_links("").replace('child link="b"', 'child link="x"'), "link 'x'"),
    "unknown parent": (two_links("").replace('parent link="a"', 'parent link="x"'), "link 'x'"),
    "two parents": (
        links("a", "b", "c") + joint("j", "a", "c") + joint("k", "b", "c"),
        "joint 'k': link 'c' is already the child of joint 'j'",
    ),
    "two roots": (links("a", "b"), "links 'a', 'b' are all roots"),
    "a link on itself": (links("a") + joint("j", "a", "a"), "the joints j form a loop"),
    "loop beside a root": (
        links("a", "b", "c") + joint("j", "b", "c") + joint("k", "c", "b"),
        "the joints j, k form a loop",
    ),
    "zero axis": (two_links('<axis xyz="0 0 0"/>'), "'j': <axis> is zero"),
    "axis of two": (two_links('<axis xyz="0 1"/>'), "<axis> xyz='0 1' is not 3 numbers"),
    "axis of words": (two_links('<axis xyz="x y z"/>'), "<axis> xyz='x y z' is not 3 numbers"),
    "axis nan": (two_links('<axis xyz="0 nan 1"/>'), "<axis> xyz='0 nan 1' is not 3 numbers"),
    "two axes": (two_links('<axis xyz="0 0 1"/><axis xyz="0 1 0"/>'), "'j': has 2 <axis>"),
    "origin of four": (two_links('<origin xyz="1 2 3 4"/>'), "<origin> xyz='1 2 3 4' is not 3"),
    "rpy inf": (two_links('<origin rpy="0 0 inf"/>'), "<origin> rpy='0 0 inf' is not 3 numbers"),
    "limit nan": (two_links('<limit lower="nan"/>'), "<limit> lower='nan' is not 1 number"),
    "limits crossed": (two_links('<limit lower="2" upper="1"/>'), "lower limit 2 is above"),
    "mimic of nobody": (two_links('<mimic joint="x"/>'), "mimics the unknown joint 'x'"),
    "mimic of no name": (two_links("<mimic/>"), "mimics the unknown joint ''"),
    "mimic of itself": (two_links('<mimic joint="j"/>'), "its <mimic> leads back to 'j'"),
    "mimic nan": (two_links('<mimic joint="j" offset="nan"/>'), "<mimic> offset='nan'"),
    "mimic of fixed": (
        links("a", "b", "c")
        + joint("j", "a", "b", kind="fixed")
        + joint("k", "a", "c", '<mimic joint="j"/>'),
        "joint 'k': mimics 'j', which is fixed",
    ),
    "mimic cycle": (
        links("a", "b", "c")
        + joint("j", "a", "b", '<mimic joint="k"/>')
        + joint("k", "a", "c", '<mimic joint="j"/>'),
        "joint 'j': its <mimic> leads back to 'j'",
    ),
    "no geometry": ('<link name="a"><visual/></link>', "link 'a': has no <geometry>"),
    "empty geometry": (shown(""), "holds 0 shapes"),
    "two shapes": (shown('<sphere radius="1"/><sphere radius="1"/>'), "holds 2 shapes"),
    "unknown shape": (shown("<cone/>"), "<cone> is not a shape"),
    "no radius": (shown("<sphere/>"), "<sphere> has no radius"),
    "flat box": (shown('<box size="1 0 1"/>'), "size is not positive"),
    "mesh without file": (shown("<mesh/>"), "<mesh> has no filename"),
    "huge scale": (
        shown('<mesh filename="t.obj" scale="1e308"/>'),
        "<mesh> scale='1e308' is beyond 1,000,000",
    ),
    "no place": (two_links('<limit lower="inf" upper="inf"/>'), "leave no place"),
    "far away": (two_links('<origin xyz="0 0 1e7"/>'), "<origin> xyz='0 0 1e7' is beyond"),
    "many digits": (two_links(f'<origin xyz="0 0 {"0" * 2000}"/>'), "is not 3 numbers"),
    "long name": (links("a" * 256), "has a name of more than 255 bytes; shorten it"),
    "long mesh": (
        shown(f'<mesh filename="{"a" * 300}.obj"/>'),
        "link 'a': file .* has a name of more than 255 bytes; shorten it",
    ),
    "https": (
        shown('<mesh filename="https://x.org/a.obj"/>'),
        "link 'a': file 'https://x.org/a.obj' is on the network",
    ),
    "out of the folder": (
        shown('<mesh filename="../meshes/a.obj"/>'),
        "link 'a': file '../meshes/a.obj' leads out of .*; copy the file",
    ),
    "no package": (
        shown('<mesh filename="package://arm/a.obj"/>'),
        "link 'a': file 'package://arm/a.obj' is of a package that is not found: .*; put the pack",
    ),
    "zero scale": (shown('<mesh filename="t.obj" scale="1 0 1"/>'), "zero scale"),
    "missing mesh": (shown('<mesh filename="t.obj"/>'), "link 'a': mesh 't.obj' does not exist"),
    "nothing to see": ('<link name="a"/>', "no link has a <visual>"),
    "unexpanded xacro": (
        '<xacro:macro xmlns:xacro="http://www.ros.org/wiki/xacro"/>' + links("a"),
        "xacro source; expand it",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_file_element_and_reason(tmp_path, case):
    body, problem = REFUSED[case]
    with pytest.raises(InvalidSource, match=problem) as caught:
        read(tmp_path, body)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'model.urdf'}: ")
    assert "\n" not in message


def test_a_mimic_of_what_is_fixed_means_nothing(tmp_path):
    text = two_links('<mimic joint="nobody"/>', kind="fixed")
    assert read(tmp_path, text).joints[0].mimic is None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "not well-formed"),
        ('<robot name="r"><link name="a">', "not well-formed"),
        ("<robot><a:b/></robot>", "not well-formed"),
        ("<a>" * 300 + "</a>" * 300, "not well-formed"),
        ("<sdf/>", "root element is <sdf>"),
        ('<!DOCTYPE robot><robot name="r"/>', "DOCTYPE"),
        ('<!DOCTYPE r [<!ENTITY x SYSTEM "secret">]><robot>&x;</robot>', "DOCTYPE"),
    ],
)
def test_xml_from_strangers(tmp_path, text, problem):
    (tmp_path / "secret").write_text("<link name='a'/>")
    path = tmp_path / "m.urdf"
    path.write_text(text)
    with pytest.raises(InvalidSource, match=problem):
        load_urdf(path, object_id="1", category="c")


def test_words_that_nobody_asks_for_may_have_any_letters(tmp_path):
    obj = read(tmp_path, f'<link nä😀me="x" name="ä😀">{BOX}</link><näme/>')
    assert [link.name for link in obj.links] == ["ä😀"]


def test_what_says_nothing_of_where_a_joint_ends_is_not_read(tmp_path):
    wrong = '<limit effort="" velocity="fast" {}/>'
    (j,) = read(tmp_path, two_links(wrong.format('lower="0" upper="1"'))).joints
    assert (j.lower, j.upper) == (0, 1)
    (j,) = read(tmp_path, two_links(wrong.format('lower="x"') * 2, "continuous")).joints
    assert (j.lower, j.upper) == (-np.inf, np.inf)


@pytest.mark.parametrize("declared", ['xmlns="http://drake.mit.edu"', 'xmlns:x="y" xmlns="z"'])
def test_a_default_namespace_changes_nothing(tmp_path, declared):
    """TinyXML, with which ROS reads URDFs, knows no namespaces."""
    plain = read(tmp_path, two_links(""))
    path = tmp_path / "model.urdf"
    path.write_text(path.read_text().replace("<robot", f"<robot {declared}"))
    obj = load_urdf(path, object_id="1", category="thing")
    assert [link.name for link in obj.links] == [link.name for link in plain.links]
    np.testing.assert_array_equal(obj.links[0].mesh.vertices, plain.links[0].mesh.vertices)
    path.write_text(f'<u:robot xmlns:u="z">{links("a")}</u:robot>')
    with pytest.raises(InvalidSource, match="<u:robot> has a prefix; write the elements without"):
        load_urdf(path, object_id="1", category="thing")


def test_a_capsule_is_as_long_as_its_cylinder_and_two_radii(tmp_path):
    mesh = read(tmp_path, shown('<capsule radius="0.5" length="2"/>')).links[0].mesh
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [1, 1, 3])


def test_a_urdf_that_is_a_link_out_of_its_folder_is_refused(tmp_path):
    read(tmp_path, links("a"))
    (tmp_path / "other").mkdir()
    link = tmp_path / "other" / "m.urdf"
    link.symlink_to(tmp_path / "model.urdf")
    with pytest.raises(InvalidSource, match=r"m\.urdf: is a symbolic link out of the model's fol"):
        load_urdf(link, object_id="1", category="c")
    (tmp_path / "linked").symlink_to(tmp_path, target_is_directory=True)
    whole = load_urdf(tmp_path / "linked" / "model.urdf", object_id="1", category="c")
    assert whole.sha256 == read(tmp_path, links("a")).sha256


def test_many_shapes_are_counted_before_any_is_made(tmp_path, monkeypatch):
    """5,000 spheres took 99 s and 4.8 GB."""
    monkeypatch.setattr("articugen.meshes.read.sphere", lambda radius: pytest.fail("made"))
    spheres = ['<sphere radius="1"/>'] * 5001
    with pytest.raises(InvalidSource, match=r"more than 1,000,000 triangles .*simplify it"):
        read(tmp_path, shown(*spheres[:300]))
    with pytest.raises(InvalidSource, match="5,001 visuals, at most 5,000 are read"):
        read(tmp_path, shown(*spheres))


def test_a_mesh_that_many_visuals_show_counts_each_time(tmp_path, monkeypatch):
    (tmp_path / "t.obj").write_text("v 0 0 0\n" * 500 + TRIANGLE)
    monkeypatch.setattr("articugen.meshes.scenes.MAX_VERTICES", 1000)
    with pytest.raises(InvalidSource, match="or 1,000 vertices; simplify"):
        read(tmp_path, shown(*['<mesh filename="t.obj"/>'] * 2))


def test_limits_on_size(tmp_path, monkeypatch):
    monkeypatch.setattr(urdf_check, "MAX_LINKS", 2)
    with pytest.raises(InvalidSource, match="at most 2 are read"):
        read(tmp_path, links("a", "b", "c"))
    monkeypatch.setattr("articugen.meshes.scenes.MAX_FACES", 20)
    with pytest.raises(InvalidSource, match="more than 20 triangles"):
        read(tmp_path, links("a", "b") + joint("j", "a", "b"))
    monkeypatch.setattr("articugen.sources.urdf.MAX_TEXT_BYTES", 99)
    with pytest.raises(InvalidSource, match="more than the 99 that it may have; simplify it"):
        read(tmp_path, links("a"))
    with pytest.raises(InvalidSource, match="cannot be read"):
        load_urdf(tmp_path / "none.urdf", object_id="1", category="c")


numbers = st.floats(-3, 3).map(lambda x: round(x, 3))
vectors = st.tuples(numbers, numbers, numbers).map(lambda v: "{} {} {}".format(*v))


@given(data=st.data(), size=st.integers(2, 9))
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_random_trees_agree_with_yourdfpy(tmp_path, data, size):
    parents = [data.draw(st.integers(0, i)) for i in range(size - 1)]
    body = [links(*(f"l{i}" for i in range(size)))]
    for child, parent in enumerate(parents, 1):
        kind = data.draw(st.sampled_from(["fixed", "revolute", "continuous", "prismatic"]))
        origin = f'<origin xyz="{data.draw(vectors)}" rpy="{data.draw(vectors)}"/>'
        rest = origin + '<limit lower="-1" upper="1"/>'
        body.append(joint(f"j{child}", f"l{parent}", f"l{child}", rest, kind))
    body = "".join(data.draw(st.permutations(body)))
    obj = read(tmp_path, body)
    hung = {"l0"}
    for j in obj.joints:
        assert j.parent in hung
        hung.add(j.child)
    assert len(hung) == size == len(obj.links)
    theirs = yourdfpy.URDF.load(
        io.BytesIO(f'<robot name="r">{body}</robot>'.encode()), load_meshes=False
    )
    for link, T in link_frames(obj).items():
        np.testing.assert_allclose(T, theirs.get_transform(link, "l0"), atol=1e-9)


def real_urdfs() -> list[Path]:
    return sorted(path for path in REAL_MODELS.rglob("*.urdf") if "difficult" not in path.parts)


def area(corners: Floats) -> float:
    """Of all triangles (F, 3, 3)."""
    edges = corners[:, 1:] - corners[:, :1]
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2.0)


def farthest(points: Floats, others: Floats) -> float:
    """The largest distance of a point to the nearest of the others."""
    return float(cKDTree(others).query(points)[0].max())


@needs_real_models
@pytest.mark.parametrize("path", real_urdfs(), ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_real_models_agree_with_yourdfpy_scene(path):
    obj = load_urdf(path, object_id="1", category="c", missing_ok="new-*.obj")
    kinds = [joint.get("type") for joint in etree.fromstring(path.read_bytes()).iter("joint")]
    assert len(obj.moving_joints) == len(kinds) - kinds.count("fixed")  # some have none that moves
    assert sum(len(link.mesh.faces) for link in obj.links) > 100
    text = path.read_bytes().replace(b", ", b" ")  # yourdfpy takes no commas in an origin
    scene = yourdfpy.URDF.load(io.BytesIO(text), mesh_dir=str(path.parent)).scene
    expected = []
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        mesh = scene.geometry[name]
        expected.append(apply(T, mesh.vertices[mesh.faces].reshape(-1, 3)))
    T = link_frames(obj)
    mine = [apply(T[k.name], k.mesh.vertices[k.mesh.faces].reshape(-1, 3)) for k in obj.links]
    # Boxes may be cut along the other diagonals, and faces without an area are left out.
    ours, theirs = np.concatenate(mine), np.concatenate(expected)
    assert max(farthest(ours, theirs), farthest(theirs, ours)) < 1e-6
    assert area(ours.reshape(-1, 3, 3)) == pytest.approx(area(theirs.reshape(-1, 3, 3)), rel=1e-6)


@needs_real_models
@pytest.mark.parametrize(
    ("name", "kinds"),
    {
        "fixed_continuous_joints": "fixed continuous",
        "link_skip_ghost_link_chain": "fixed fixed fixed revolute",
        "mimic_joint": "fixed revolute revolute prismatic prismatic",
        "multiple_visuals_collisions_in_link": "fixed",
        "revolute_joints": "revolute revolute revolute revolute",
        "simple-primitives": "fixed fixed",
    }.items(),
)
def test_difficult_urdf_is_read(name, kinds):
    obj = load_urdf(REAL_MODELS / "difficult" / f"{name}.urdf", object_id="1", category="c")
    assert " ".join(str(j.kind) for j in obj.joints) == kinds
