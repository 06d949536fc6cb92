"""USD models: what OpenUSD itself makes of them is the truth."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from usd_models import artvip, at, body, joint, text

from articugen.core.errors import InvalidSource
from articugen.core.geometry import apply, rotation_about, transform
from articugen.core.records import Joint, JointKind
from articugen.sources import readers
from articugen.sources.source import load_path, open_source
from articugen.sources.usd import apart, model

pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

zip_files = (Sdf if hasattr(Sdf, "ZipFileWriter") else Usd).ZipFileWriter

HINGE = (
    'uniform token physics:axis = "Z"\nfloat physics:lowerLimit = 0\nfloat physics:upperLimit = 90'
)
DOOR = body("door", place=at(1, 0, 0))


def written(folder: Path, *prims: str, name: str = "m.usda", **how) -> Path:
    path = folder / name
    path.write_text(text(*prims, **how))
    return path


def read(path: Path) -> model.Model:
    """In this process, which is quicker."""
    return model.read_model(path, path.parent)


def boxes(made: model.Model) -> dict[str, np.ndarray]:
    return {
        link.name: np.stack([link.mesh.vertices.min(0), link.mesh.vertices.max(0)])
        for link in made.links
        if len(link.mesh.vertices)
    }


def moving(made: model.Model) -> list[Joint]:
    return [j for j in made.joints if j.kind != JointKind.FIXED]


def world_of(made: model.Model, state: dict[str, float]) -> dict[str, np.ndarray]:
    """`T_world_link` by plain matrices."""
    world = {made.links[0].name: np.eye(4)}
    for j in made.joints:
        q = state.get(j.name, 0.0)
        slides = j.kind == JointKind.PRISMATIC
        own = transform(None, j.axis * q) if slides else transform(rotation_about(j.axis, q))
        world[j.child] = world[j.parent] @ j.T_parent_joint @ own
    return world


def test_an_artvip_model_in_metres_and_z_up(tmp_path):
    made = read(artvip(tmp_path / "cab"))
    own = boxes(made)
    np.testing.assert_allclose(own["E_body_1"], [[-0.5, -0.5, 0], [0.5, 0.5, 1]], atol=1e-9)
    # relative to the hinge, (0, -0.5, 0)
    np.testing.assert_allclose(
        own["E_door_4"], [[-0.25, -0.03, 0.25], [0.25, -0.01, 0.75]], atol=1e-7
    )
    fixed, hinge = made.joints
    assert (fixed.parent, fixed.child, fixed.kind) == ("world", "E_body_1", JointKind.FIXED)
    assert (hinge.name, hinge.kind) == ("RevoluteJoint", JointKind.REVOLUTE)
    assert (hinge.lower, hinge.upper) == (0.0, pytest.approx(np.pi / 2))
    np.testing.assert_allclose(hinge.axis, (1, 0, 0))
    np.testing.assert_allclose(hinge.T_parent_joint, transform(None, (0, -0.5, 0)), atol=1e-9)
    assert made.notes == ()


def test_artvip_is_found_by_category_and_its_layers_are_no_models(tmp_path):
    for name in ("dishwasher/dishwasher_1", "dishwasher/dishwasher_2", "refrigerator/fridge/f_01"):
        artvip(tmp_path / "Articulated_objects" / "major_appliances" / name)
    odd = artvip(tmp_path / "Articulated_objects" / "small_appliances" / "airfryer" / "Collected_1")
    odd.rename(odd.with_name("AirFryer1.usda"))
    assert open_source(tmp_path).categories(["all"]) == ("airfryer", "dishwasher", "refrigerator")
    refs = open_source(tmp_path).objects("dishwasher")
    assert {(r.object_id, r.reader) for r in refs} == {
        ("dishwasher_1", "usd"),
        ("dishwasher_2", "usd"),
    }
    (one,) = open_source(tmp_path).objects("airfryer")
    assert one.object_id == "Collected_1"
    obj = readers.load(one)
    assert [link.name for link in obj.links] == ["world", "E_body_1", "E_door_4"]
    assert obj.part_of_link.tolist() == [0, 0, 1]


def test_the_digest_is_of_all_layers_and_of_no_other_file(tmp_path):
    path = artvip(tmp_path / "a" / "cab")
    (ref,) = open_source(tmp_path / "a").objects("thing")
    before = readers.load(ref).sha256
    assert readers.digest(ref) == before
    artvip(tmp_path / "b" / "cab")
    assert load_path(tmp_path / "b" / "cab").sha256 == before
    (path.parent / "resource" / "wood.png").write_bytes(b"a texture")
    assert readers.digest(ref) == before
    for layer in ("material.usda", "v_0/link.usda"):
        with (path.parent / "resource" / layer).open("a") as file:
            file.write("# more\n")
        assert readers.digest(ref) not in (before, ""), layer
        before = readers.digest(ref)
    assert readers.load(ref).sha256 == before


def test_joints_are_known_without_meshes(tmp_path):
    artvip(tmp_path / "cab")
    assert len(open_source(tmp_path).objects("thing", joints=["revolute"])) == 1
    with pytest.raises(InvalidSource, match="has prismatic joints alone"):
        open_source(tmp_path).objects("thing", joints=["prismatic"])


OPS = {
    "translate": ("double3", "(1, -2, 0.5)"),
    "translate:pivot": ("float3", "(0.1, 0.2, 0.3)"),
    "rotateX": ("float", "31"),
    "rotateXYZ": ("float3", "(10, 20, 30)"),
    "rotateZYX": ("float3", "(-40, 50, 60)"),
    "rotateYXZ": ("double3", "(15, -25, 35)"),
    "orient": ("quatf", "(0.5, 0.1, 0.7, 0.5)"),
    "scale": ("float3", "(2, 2, 2)"),
    "transform": ("matrix4d", "((0, 1, 0, 0), (-1, 0, 0, 0), (0, 0, 1, 0), (3, 4, 5, 1))"),
}


@pytest.mark.parametrize("seed", range(6))
def test_prims_stand_where_openusd_has_them(tmp_path, seed):
    rng = np.random.default_rng(seed)

    def placed(inside: str) -> str:
        names = rng.permutation(list(OPS))[:4].tolist()
        order = [f'"xformOp:{n}"' for n in names] + [f'"!invert!xformOp:{n}"' for n in names[1:2]]
        lines = [f"{OPS[n][0]} xformOp:{n} = {OPS[n][1]}" for n in names]
        order = ['"!resetXformStack!"'] * (rng.random() < 0.2) + order
        return "\n".join([*lines, f"uniform token[] xformOpOrder = [{', '.join(order)}]", inside])

    leaf = placed('def Cube "cube"\n{\n' + placed("double size = 0.5") + "\n}")
    path = written(tmp_path, f'def Xform "a"\n{{\n{leaf}\n}}\n')
    stage = Usd.Stage.Open(str(path))
    cube = stage.GetPrimAtPath("/root/a/cube")
    T = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(cube)).T
    corners = np.array(np.meshgrid(*[[-0.25, 0.25]] * 3)).reshape(3, -1).T
    ours = read(path).links[0].mesh.vertices
    np.testing.assert_allclose(
        np.sort(ours.round(9), axis=0), np.sort(apply(T, corners).round(9), axis=0), atol=1e-6
    )


@pytest.mark.parametrize("seed", range(6))
def test_joints_stand_where_openusd_has_them(tmp_path, seed):
    """Bodies that are turned, scaled, mirrored and in each other; frames by OpenUSD's parser."""
    rng = np.random.default_rng(seed)
    stage = Usd.Stage.CreateNew(str(tmp_path / "m.usdc"))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/root").GetPrim())
    for name in ("base", "base/door"):
        xform = UsdGeom.Xform.Define(stage, f"/root/{name}")
        UsdPhysics.RigidBodyAPI.Apply(xform.GetPrim())
        xform.AddTranslateOp().Set(Gf.Vec3d(*rng.normal(size=3)))
        xform.AddRotateXYZOp().Set(Gf.Vec3f(*rng.uniform(-90, 90, 3)))
        sign = -1 if name == "base" and seed % 2 else 1
        scale = rng.uniform(0.5, 2, 3) if name == "base/door" else np.full(3, 1.5) * sign
        xform.AddScaleOp().Set(Gf.Vec3f(*scale))
        UsdGeom.Cube.Define(stage, f"/root/{name}/cube")
    cache = UsdGeom.XformCache()
    here, there = (
        cache.GetLocalToWorldTransform(stage.GetPrimAtPath(f"/root/{n}"))
        for n in ("base", "base/door")
    )
    made = UsdPhysics.RevoluteJoint.Define(stage, "/root/joint")
    made.CreateBody0Rel().SetTargets(["/root/base"])
    made.CreateBody1Rel().SetTargets(["/root/base/door/cube"])  # a shape of the body
    made.CreateAxisAttr("Y")
    made.CreateLowerLimitAttr(-10)
    pivot, turn = Gf.Vec3d(*rng.normal(size=3)), Gf.Rotation(Gf.Vec3d(*rng.normal(size=3)), 40.0)
    drawn_at = Gf.Rotation(Gf.Vec3d(0, 1, 0), 25.0)
    for end, T, own in ((0, here, turn), (1, there, drawn_at * turn)):
        getattr(made, f"CreateLocalPos{end}Attr")(Gf.Vec3f(T.GetInverse().Transform(pivot)))
        world = Gf.Transform(T).GetRotation()
        getattr(made, f"CreateLocalRot{end}Attr")(Gf.Quatf((own * world.GetInverse()).GetQuat()))
    stage.GetRootLayer().Save()

    (hinge,) = moving(read(tmp_path / "m.usdc"))
    with pytest.warns(DeprecationWarning, match="LoadUsdPhysicsFromRange"):
        found = UsdPhysics.LoadUsdPhysicsFromRange(stage, ["/"])
    (told,) = found[UsdPhysics.ObjectType.RevoluteJoint][1]
    base = Gf.Transform(here)
    at_place = base.GetRotation().TransformDir(Gf.Vec3d(told.localPose0Position))
    at_place += base.GetTranslation()
    axis = base.GetRotation().TransformDir(
        Gf.Rotation(told.localPose0Orientation).TransformDir(Gf.Vec3d(0, 1, 0))
    )
    z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(hinge.T_parent_joint[:3, 3], z_up @ at_place * 0.1, atol=1e-6)
    np.testing.assert_allclose(hinge.axis, z_up @ axis, atol=1e-6)
    np.testing.assert_allclose(
        hinge.T_parent_joint[:3, :3], rotation_about(hinge.axis, -np.radians(25)), atol=1e-6
    )


def test_a_model_drawn_open_is_closed_at_zero(tmp_path):
    """The door's frame is 30 degrees on from the base's: as drawn it stands at 30 degrees."""
    half = np.radians(15)
    turned_back = f"quatf physics:localRot1 = ({np.cos(half)}, 0, 0, {np.sin(half)})"
    path = written(tmp_path, body("base"), DOOR, joint("Revolute", more=f"{HINGE}\n{turned_back}\n"
                   "point3f physics:localPos0 = (1, 0, 0)"))  # fmt: skip
    made = read(path)
    (hinge,) = moving(made)
    drawn = world_of(made, {"joint": np.radians(30)})["door"]
    np.testing.assert_allclose(drawn, transform(None, (1, 0, 0)), atol=1e-7)
    assert (hinge.lower, hinge.upper) == (0.0, pytest.approx(np.pi / 2))
    assert made.notes == ("joint: drawn at 0.5236 rad, not at 0",)


def test_a_drawer_drawn_open_is_closed_at_zero(tmp_path):
    slide = "float physics:lowerLimit = -20\nfloat physics:upperLimit = 40"
    path = written(tmp_path, body("base"), DOOR, joint("Prismatic", more=slide), metres=0.01)
    made = read(path)
    (drawer,) = moving(made)
    assert (drawer.kind, drawer.lower, drawer.upper) == (JointKind.PRISMATIC, -0.2, 0.4)
    assert made.notes == ("joint: drawn at 0.01 m, not at 0",)
    drawn = world_of(made, {"joint": 0.01})["door"]
    np.testing.assert_allclose(drawn[:3, 3] + boxes(made)["door"].mean(0), (0.01, 0, 0), atol=1e-9)


@pytest.mark.parametrize("kind", ["Revolute", "Prismatic"])
def test_a_joint_named_from_the_other_side_moves_alike(tmp_path, kind):
    """body0 hangs on body1: the same motion of one relative to the other, at the same state."""
    to_world = joint("Fixed", "", "base", name="to_world")
    more = HINGE + "\npoint3f physics:localPos{} = (1, 0, 0)"
    one, other = (
        read(written(tmp_path, body("base"), DOOR, to_world, named, name=f"{k}.usda"))
        for k, named in enumerate((
            joint(kind, "base", "door", more=more.format(0)),
            joint(kind, "door", "base", more=more.format(1)),
        ))
    )  # fmt: skip
    q = 0.3
    a, b = world_of(one, {"joint": q})["door"], world_of(other, {"joint": -q})["door"]
    np.testing.assert_allclose(a, b, atol=1e-9)
    assert moving(other)[0].parent == "base"


def test_limits_that_are_not_there_and_named_the_wrong_way_round(tmp_path):
    far = "float physics:lowerLimit = -3.4e38\nfloat physics:upperLimit = inf"
    swapped = "float physics:lowerLimit = 20\nfloat physics:upperLimit = -20"
    made = read(
        written(
            tmp_path, body("base"), DOOR, body("knob"), body("lid"),
            joint("Revolute", more="point3f physics:localPos0 = (1, 0, 0)"),
            joint("Revolute", body1="knob", name="knob_joint", more=far),
            joint("Revolute", body1="lid", name="lid_joint", more=swapped),
        )
    )  # fmt: skip
    door, knob, lid = moving(made)
    assert door.kind == knob.kind == JointKind.CONTINUOUS
    assert (door.lower, door.upper) == (-np.inf, np.inf)
    np.testing.assert_allclose((lid.lower, lid.upper), np.radians((-20, 20)))
    assert made.notes == ("lid_joint: its limits were named the wrong way round",)


def test_what_hangs_on_nothing_is_held_and_what_is_switched_off_does_nothing(tmp_path):
    static = 'def Cube "floor"\n{\ndouble size = 2\n}\n'
    off = joint("Revolute", name="off", more="bool physics:jointEnabled = false")
    made = read(written(tmp_path, body("base"), body("cup"), DOOR, static, off, joint("Fixed")))
    assert {(j.parent, j.child) for j in made.joints} == {
        ("world", "base"), ("base", "door"), ("world", "cup"),
    }  # fmt: skip
    assert not moving(made)
    assert set(boxes(made)) == {"world", "base", "door", "cup"}


def test_two_fixed_joints_between_rigid_parts_are_no_loop(tmp_path):
    twice = (joint("Fixed", name="one"), joint("Fixed", name="two"))
    assert len(read(written(tmp_path, body("base"), DOOR, *twice)).joints) == 2


def test_names_that_are_shared_are_told_by_their_paths(tmp_path):
    lids = "".join(body(n, inside=body("lid")) for n in ("left", "right", "world"))
    names = [link.name for link in read(written(tmp_path, lids)).links]
    assert names == ["world", "left", "left.lid", "right", "right.lid", "world~", "world.lid"]


def volume(made: model.Model, link: int = 0) -> float:
    mesh = made.links[link].mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert solid.is_watertight
    return solid.volume


@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize(
    ("shape", "attributes", "expected"),
    [
        ("Cube", "double size = 3", 27.0),
        ("Sphere", "double radius = 2", 32 / 3 * np.pi),
        ("Cylinder", "double radius = 2\ndouble height = 3", 12 * np.pi),
        ("Capsule", "double radius = 1\ndouble height = 3", 13 / 3 * np.pi),
        ("Cone", "double radius = 2\ndouble height = 3", 4 * np.pi),
    ],
)
def test_shapes_have_their_volume_and_extent(tmp_path, axis, shape, attributes, expected):
    token = f'uniform token axis = "{axis}"\n' if shape not in ("Cube", "Sphere") else ""
    path = written(tmp_path, f'def {shape} "s"\n{{\n{attributes}\n{token}}}\n')
    made = read(path)
    assert volume(made) == pytest.approx(expected, rel=0.01)
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/root/s")
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), 0.0)
    np.testing.assert_allclose(boxes(made)["world"], np.array(extent), atol=0.01)
    if shape == "Cone":
        tip = made.links[0].mesh.vertices[-1]
        np.testing.assert_allclose(tip, 1.5 * np.eye(3)["XYZ".index(axis)], atol=1e-12)


TETRAHEDRON = """def Mesh "m"
{{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    int[] faceVertexCounts = [3, 3, 3, 3{extra}]
    int[] faceVertexIndices = [{faces}]
    {more}
}}
"""
OUTWARDS = "0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3"
INWARDS = "0, 1, 2, 0, 3, 1, 0, 2, 3, 1, 3, 2"
MIRROR = 'float3 xformOp:scale = (-2, 1, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'


@pytest.mark.parametrize(
    ("faces", "extra", "more", "expected"),
    [
        (OUTWARDS, "", "", 1 / 6),
        (INWARDS, "", 'uniform token orientation = "leftHanded"', 1 / 6),
        (OUTWARDS, "", MIRROR, 1 / 3),
        (f"{OUTWARDS}, 0, 1, 2", ", 3", "int[] holeIndices = [4]", 1 / 6),
    ],
)
def test_meshes_are_outside_out(tmp_path, faces, extra, more, expected):
    mesh = TETRAHEDRON.format(faces=faces, extra=extra, more=more)
    assert volume(read(written(tmp_path, mesh))) == pytest.approx(expected)


def test_only_what_is_seen_is_read(tmp_path):
    def cube(name: str, more: str, size: int = 1) -> str:
        return f'def Cube "{name}"\n{{\ndouble size = {size}\n{more}\n}}\n'

    collider = (
        'def Scope "collisions"\n{\nuniform token purpose = "guide"\n' + cube("c", "") + "}\n"
    )
    shown = (
        'def Cube "both" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\ndouble size = 3\n}\n'
    )
    hidden = cube("hidden", 'token visibility = "invisible"')
    proxy = cube("proxy", 'uniform token purpose = "proxy"')
    curve = 'def BasisCurves "curve"\n{\n}\n'
    made = read(written(tmp_path, collider, shown, hidden, proxy, curve))
    assert volume(made) == pytest.approx(27.0)
    assert made.notes == ("of kinds that are not read, left out: BasisCurves",)


def test_what_is_not_in_the_default_prim_is_no_part_of_the_model(tmp_path):
    path = written(tmp_path, body("base"))
    path.write_text(path.read_text() + 'def Cube "ground"\n{\ndouble size = 100\n}\n')
    assert np.ptp(boxes(read(path))["base"], axis=0).tolist() == [1, 1, 1]


def test_a_file_without_a_unit_is_in_centimetres_and_says_so(tmp_path):
    path = written(tmp_path, body("base"))
    path.write_text(path.read_text().replace("metersPerUnit = 1.0", ""))
    made = read(path)
    assert np.ptp(boxes(made)["base"], axis=0).tolist() == [0.01] * 3
    assert "taken as centimetres" in made.notes[0]


def test_all_forms_of_a_model_are_the_same_model(tmp_path):
    path = artvip(tmp_path / "cab")
    stage = Usd.Stage.Open(str(path))
    stage.Export(str(tmp_path / "cab.usdc"))
    layers = [path, *sorted((path.parent / "resource").rglob("*.usda"))]
    with zip_files.CreateNew(str(tmp_path / "cab.usdz")) as package:
        for layer in layers:
            package.AddFile(str(layer), str(layer.relative_to(path.parent)))
    truth = read(path)
    for name in ("cab.usdc", "cab.usdz"):
        made = read(tmp_path / name)
        assert made.sha256 != truth.sha256
        for link, other in zip(made.links, truth.links, strict=True):
            assert link.name == other.name
            np.testing.assert_allclose(link.mesh.vertices, other.mesh.vertices, atol=1e-9)
        for j, k in zip(made.joints, truth.joints, strict=True):
            np.testing.assert_allclose(j.T_parent_joint, k.T_parent_joint, atol=1e-9)


def test_reading_apart_is_reading(tmp_path, monkeypatch):
    path = artvip(tmp_path / "cab")
    monkeypatch.setenv("PXR_PLUGINPATH_NAME", str(tmp_path / "elsewhere"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "numpy.py").write_text("raise SystemExit('a stranger\\'s module')")
    one, other = read(path), apart.apart(partial(model.read_model, root=path.parent), path)
    assert other.sha256 == one.sha256
    assert repr(other.joints) == repr(one.joints)
    for link, expected in zip(other.links, one.links, strict=True):
        np.testing.assert_array_equal(link.mesh.vertices, expected.mesh.vertices)
        np.testing.assert_array_equal(link.mesh.faces, expected.mesh.faces)
