"""Exports for simulators and viewers, by their own readers, beside what the shards hold."""

import json
import re
from dataclasses import replace

import exports
import numpy as np
import pytest
import trimesh
import yourdfpy
from exports import MESHES, canonical_meshes, motion_in_metres, name_of, state_in_metres
from instances import HINGE, LOWER, UPPER, hinged_box
from ppd_data import shard
from test_html_report import named

import articugen as ag
from articugen.core.geometry import apply, invert_rigid, rotation_about, transform
from articugen.core.records import is_material
from articugen.export.parts import metric_joints

BOXES, rows, exported = exports.BOXES, exports.rows, exports.exported

SLOWS = ("damping", "friction")


def test_ply_in_trimesh(exported, rows):
    for row in rows:
        path = exported("ply") / row.split / f"{name_of(row)}.ply"
        cloud = trimesh.load(path)
        assert isinstance(cloud, trimesh.PointCloud)
        np.testing.assert_array_equal(cloud.vertices, row.surface.points)
        table = cloud.metadata["_ply_raw"]["vertex"]["data"]
        np.testing.assert_array_equal(table["part"], row.surface.part)
        normals = np.stack([table[axis] for axis in ("nx", "ny", "nz")], axis=1)
        np.testing.assert_array_equal(normals, row.surface.normals)
        assert len(np.unique(cloud.colors[:, :3], axis=0)) == 3


def test_part_meshes_from_grids_are_the_boxes(exported, rows):
    row = rows[0]
    for vertices, low, high in zip(canonical_meshes(rows, row), LOWER, UPPER, strict=True):
        voxel = row.scale / 64
        assert np.abs(vertices.min(axis=0) - low).max() < voxel
        assert np.abs(vertices.max(axis=0) - high).max() < voxel


def test_urdf_in_yourdfpy(exported, rows):
    for row in rows:
        path = exported("urdf", **MESHES) / row.split / row.object_id / f"{row.object_id}.urdf"
        robot = yourdfpy.URDF.load(str(path))
        assert robot.validate()
        joints = metric_joints(row)
        assert robot.actuated_joint_names == [joint.name for joint in joints]
        for joint in joints:
            limit = robot.joint_map[joint.name].limit
            np.testing.assert_allclose([limit.lower, limit.upper], [joint.lower, joint.upper])
        robot.update_cfg(state_in_metres(row))
        for part, vertices in enumerate(canonical_meshes(rows, row)):
            mesh = robot.scene.geometry[f"part_{part}.obj"]
            assert mesh.is_watertight
            assert mesh.volume > 0.0
            posed = apply(robot.get_transform(f"part_{part}"), mesh.vertices)
            truth = apply(motion_in_metres(row, part), vertices)
            np.testing.assert_allclose(
                trimesh.bounds.corners(np.stack([posed.min(0), posed.max(0)])),
                trimesh.bounds.corners(np.stack([truth.min(0), truth.max(0)])),
                atol=1e-8,
            )
            inertial = robot.link_map[f"part_{part}"].inertial
            assert inertial.mass == pytest.approx(500 * mesh.volume, rel=1e-6)


def test_mjcf_in_mujoco(exported, rows):
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    for row in rows:
        path = exported("mjcf", **MESHES) / row.split / row.object_id / f"{row.object_id}.xml"
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        data.qpos[:] = state_in_metres(row)
        mujoco.mj_forward(model, data)
        first = rows.of(row.object_id)[0]
        pivots = [np.zeros(3), *(joint.pivot for joint in metric_joints(first))]
        for part in range(3):
            body = model.body(f"part_{part}").id
            T = transform(data.xmat[body].reshape(3, 3), data.xpos[body])
            truth = motion_in_metres(row, part) @ transform(translation=pivots[part])
            np.testing.assert_allclose(T, truth, atol=1e-9)
        volume = np.prod(UPPER - LOWER, axis=1)
        np.testing.assert_allclose(model.body_mass[1:], 500 * volume, rtol=0.25)
        assert model.ngeom == 3
        assert data.ncon == 0


def test_a_lid_that_is_let_go_sinks_on_its_stop(exported, rows):
    """Undamped it hits it at 6 rad/s, and overshoots by 2.4 degrees."""
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    row = rows[0]
    path = exported("mjcf", **MESHES) / row.split / row.object_id / f"{row.object_id}.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = np.radians(50.0), 0.15
    low, high = np.radians(50.0), 0.0
    for _ in range(round(3.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        low, high = min(low, data.qpos[0]), max(high, abs(data.qvel[0]))
    assert -np.radians(0.6) < low < 0.0
    assert 1.0 < high < 3.0
    assert abs(data.qvel[0]) < 1e-5


def test_joints_are_slowed_by_what_moves_with_them(exported, rows):
    """In closed form of the boxes: a tenth of a second takes two thirds of the speed, and a push by
    a share of the weight moves nothing."""
    size, mass = UPPER - LOWER, 500 * np.prod(UPPER - LOWER, axis=1)
    arm = (UPPER + LOWER)[:, [0, 2]] / 2 - HINGE[[0, 2]]
    turned = mass * ((size[:, [0, 2]] ** 2).sum(axis=1) / 12 + (arm**2).sum(axis=1))
    truth = [10 * turned[1:].sum(), 10 * mass[2]]  # the knob slides on the lid
    row = rows[0]
    folder = exported("urdf", **MESHES) / row.split / row.object_id
    robot = yourdfpy.URDF.load(str(folder / f"{row.object_id}.urdf"))
    dynamics = [robot.joint_map[joint.name].dynamics for joint in metric_joints(row)]
    damping, friction = ([float(getattr(d, name)) for d in dynamics] for name in SLOWS)
    np.testing.assert_allclose(damping, truth, rtol=0.25)  # meshes of voxels
    lever = np.sqrt(turned[1:].sum() / mass[1:].sum())
    held = [0.2 * 9.81 * mass[1:].sum() * lever, 0.1 * 9.81 * mass[2]]
    np.testing.assert_allclose(friction, held, rtol=0.25)
    mjcf = (
        exported("mjcf", **MESHES) / row.split / row.object_id / f"{row.object_id}.xml"
    ).read_text()
    for name, values in (("damping", damping), ("frictionloss", friction)):
        assert [float(text) for text in re.findall(rf' {name}="([^"]+)"', mjcf)] == values


@pytest.mark.filterwarnings("ignore:.*Scene.dump:DeprecationWarning")  # yourdfpy's own call
def test_convex_parts_fill_the_boxes(boxes, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    ag.export(boxes, "mjcf", tmp_path / "m", split="test", collision=True, **MESHES)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "m" / "test" / "box-2" / "box-2.xml"))
    felt = [g for g in range(model.ngeom) if model.geom(g).contype[0]]
    assert {model.body(model.geom_bodyid[g]).name for g in felt} == {"part_0", "part_1", "part_2"}
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0  # parts that share a joint do not collide
    lines = json.loads((tmp_path / "m" / "test" / "box-2" / "collision.json").read_text())
    assert sum(line["pieces"] for line in lines) == len(felt)
    assert all(line["iou"] > 0.95 and line["cavities"] == [] for line in lines)
    ag.export(boxes, "urdf", tmp_path / "u", split="test", collision=True, **MESHES)
    path = str(tmp_path / "u" / "test" / "box-2" / "box-2.urdf")
    robot = yourdfpy.URDF.load(path, load_collision_meshes=True, build_collision_scene_graph=True)
    meshes = list(robot.collision_scene.geometry.values())
    assert len(meshes) == len(felt)
    for mesh in meshes:
        assert mesh.volume == pytest.approx(mesh.convex_hull.volume, rel=1e-3)
    solid = sum(mesh.volume for mesh in robot.scene.geometry.values())
    assert sum(mesh.volume for mesh in meshes) == pytest.approx(solid, rel=0.1)


def test_usd_in_openusd(exported, rows):
    pxr = pytest.importorskip("pxr", reason="make exporters installs it")
    from pxr import Gf, Usd, UsdGeom, UsdPhysics  # noqa: PLC0415

    assert pxr
    for row in (row for row in rows if row.state_index == 0):
        path = (
            exported("usd", **MESHES) / row.split / row.object_id / "usd" / f"{row.object_id}.usdc"
        )
        stage = Usd.Stage.Open(str(path))
        assert UsdGeom.GetStageUpAxis(stage) == "Z"
        assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
        root = stage.GetDefaultPrim()
        assert root.HasAPI(UsdPhysics.ArticulationRootAPI)
        joints = metric_joints(row)
        cache = UsdGeom.XformCache()
        for part, vertices in enumerate(canonical_meshes(rows, row)):
            body = stage.GetPrimAtPath(f"{root.GetPath()}/part_{part}")
            assert body.HasAPI(UsdPhysics.RigidBodyAPI)
            mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"{body.GetPath()}/visual"))
            T = np.array(cache.GetLocalToWorldTransform(mesh.GetPrim())).T
            np.testing.assert_allclose(apply(T, mesh.GetPointsAttr().Get()), vertices, atol=1e-6)
            solid = trimesh.Trimesh(
                mesh.GetPointsAttr().Get(),
                np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)),
            )
            assert solid.is_watertight
            mass = UsdPhysics.MassAPI(body)
            moments = np.array(mass.GetDiagonalInertiaAttr().Get())
            turn = np.array(Gf.Matrix3d(Gf.Quatd(mass.GetPrincipalAxesAttr().Get()))).T
            solid.density = 500
            np.testing.assert_allclose(
                turn @ np.diag(moments) @ turn.T, solid.moment_inertia, atol=1e-5
            )
        for joint in joints:
            prim = stage.GetPrimAtPath(f"{root.GetPath()}/{joint.name}")
            kind = {"revolute": UsdPhysics.RevoluteJoint, "prismatic": UsdPhysics.PrismaticJoint}
            made = kind[joint.kind](prim)
            unit = np.degrees(1) if joint.kind == "revolute" else 1.0
            limits = [made.GetLowerLimitAttr().Get(), made.GetUpperLimitAttr().Get()]
            np.testing.assert_allclose(limits, np.array([joint.lower, joint.upper]) * unit, 1e-6)
            drive = UsdPhysics.DriveAPI(prim, "angular" if unit > 1 else "linear")
            path = exported("urdf", **MESHES) / row.split / row.object_id / f"{row.object_id}.urdf"
            urdf = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=False)
            damping = float(urdf.joint_map[joint.name].dynamics.damping)
            np.testing.assert_allclose(drive.GetDampingAttr().Get() * unit, damping, rtol=1e-5)
            along = "angular" if unit > 1 else "linear"
            for kind in ("static", "dynamic"):
                effort = prim.GetAttribute(f"physxJointAxis:{along}:{kind}FrictionEffort").Get()
                friction = float(urdf.joint_map[joint.name].dynamics.friction)
                np.testing.assert_allclose(effort, friction, rtol=1e-5)
            for end, body in ((0, joint.parent), (1, joint.part)):
                relation = getattr(made, f"GetBody{end}Rel")().GetTargets()
                assert relation == [root.GetPath().AppendChild(f"part_{body}")]
                T = np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(relation[0]))).T
                place = apply(T, getattr(made, f"GetLocalPos{end}Attr")().Get())
                np.testing.assert_allclose(place, joint.pivot, atol=1e-6)
                turn = Gf.Rotation(getattr(made, f"GetLocalRot{end}Attr")().Get())
                np.testing.assert_allclose(turn.TransformDir((1, 0, 0)), joint.axis, atol=1e-6)


def test_objects_whose_names_begin_with_a_digit_keep_it_in_usd(tmp_path):
    pytest.importorskip("pxr", reason="make exporters installs it")
    from pxr import Usd  # noqa: PLC0415

    paths = []
    for name in ("12692", "22692"):
        path = shard(tmp_path / f"{name}.h5", hinged_box(object_id=name))
        ag.export(path, "usd", tmp_path / name, **MESHES)
        stage = Usd.Stage.Open(str(tmp_path / name / "train" / name / "usd" / f"{name}.usdc"))
        paths.append(str(stage.GetDefaultPrim().GetPath()))
        assert stage.GetDefaultPrim().GetDisplayName() == name
    assert paths == ["/_12692", "/_22692"]


def test_joints_have_their_names_in_usd_however_strange(tmp_path):
    pytest.importorskip("pxr", reason="make exporters installs it")
    from pxr import Usd, UsdPhysics  # noqa: PLC0415

    pairs = {
        ("hinge", "slide"): ("hinge", "slide"),
        ("door left", "door_left"): ("door_left", "door_left_2"),
        ("to_world", "part_1"): ("to_world_2", "part_1_2"),
        ("2nd", "滑"): ("_2nd", "___"),
    }
    for number, (names, paths) in enumerate(pairs.items()):
        box = [replace(i, joint_name=names) for i in hinged_box(object_id="box")]
        out = tmp_path / f"out{number}"
        ag.export(shard(tmp_path / f"{number}.h5", box), "usd", out, **MESHES)
        stage = Usd.Stage.Open(str(out / "train" / "box" / "usd" / "box.usdc"))
        for name, path in zip(names, paths, strict=True):
            prim = stage.GetPrimAtPath(f"/box/{path}")
            assert prim.GetDisplayName() == name
            assert UsdPhysics.Joint(prim).GetBody1Rel().GetTargets()


def test_links_named_like_mujocos_own_or_by_strangers(tmp_path):
    """Many URDFs call their first link `world`, which MuJoCo keeps for itself."""
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    worldly = [replace(i, part_name=("world", "lid", "lid")) for i in hinged_box(object_id="a")]
    strange = [named(i) for i in hinged_box(object_id="Schränkchen 箱")]
    for instances, bodies in (
        (worldly, ["world_2", "lid", "lid_2"]),
        (strange, list(strange[0].part_name or ())),
    ):
        path = shard(tmp_path / "train-00000.h5", instances)
        out = tmp_path / f"mit Leerzeichen {bodies[0]}"
        ag.export(path, "mjcf", out, **MESHES)
        (xml,) = out.glob("train/*/*.xml")
        model = mujoco.MjModel.from_xml_path(str(xml))
        names = [model.body(k).name for k in range(1, model.nbody)]
        assert [name.isprintable() for name in names] == [True] * 3
        assert names == ["".join(c if c.isprintable() else "_" for c in b) for b in bodies]
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        rest = data.xpos.copy()
        data.qpos[:] = model.jnt_range[:, 1]
        mujoco.mj_forward(model, data)
        assert np.abs(data.xpos - rest).max() > 0.1


def animated(gltf, name: str, key: int) -> dict[str, np.ndarray]:
    """The world transform of each node, by name, with a joint at one key of its animation."""

    def values(number: int) -> np.ndarray:
        accessor = gltf.accessors[number]
        view = gltf.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        data = gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        return np.frombuffer(data, np.float32).reshape(accessor.count, width)

    poses = [{"translation": n.translation or [0, 0, 0], "rotation": n.rotation or [0, 0, 0, 1]}
             for n in gltf.nodes]  # fmt: skip
    (animation,) = [a for a in gltf.animations if a.name == name]
    (channel,), (sampler,) = animation.channels, animation.samplers
    assert (np.diff(values(sampler.input)[:, 0]) > 0).all()
    poses[channel.target.node][channel.target.path] = values(sampler.output)[key]
    world: dict[str, np.ndarray] = {}

    def visit(number: int, above: np.ndarray) -> None:
        x, y, z, w = poses[number]["rotation"]
        turn = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
        world[number] = above @ transform(turn, poses[number]["translation"])
        for child in gltf.nodes[number].children or ():
            visit(child, world[number])

    visit(gltf.scenes[gltf.scene].nodes[0], np.eye(4))
    return world


def test_glb_in_trimesh_and_pygltflib(exported, rows):
    pygltflib = pytest.importorskip("pygltflib", reason="make exporters installs it")
    up = rotation_about((1, 0, 0), -np.pi / 2)  # glTF's y is our z
    for row in (row for row in rows if row.state_index == 0):
        path = exported("glb", **MESHES) / row.split / f"{row.object_id}.glb"
        scene = trimesh.load_scene(path)
        truth = canonical_meshes(rows, row)
        posed = scene.dump()
        assert all(mesh.is_watertight for mesh in posed)
        boxes = sorted(np.round(mesh.bounds, 5).tolist() for mesh in posed)
        wanted = [(v @ up.T) for v in truth]
        assert boxes == sorted(np.round(np.stack([v.min(0), v.max(0)]), 5).tolist() for v in wanted)
        gltf = pygltflib.GLTF2().load(str(path))
        for joint in metric_joints(row):
            for key, state in ((0, joint.lower), (-1, joint.upper)):
                world = animated(gltf, joint.name, key)
                if joint.kind == "revolute":
                    turn = rotation_about(joint.axis, state)
                    T = transform(turn, joint.pivot - turn @ joint.pivot)
                else:
                    T = transform(translation=state * joint.axis)
                rest = transform(up) @ transform(translation=joint.pivot)
                own = transform(up) @ T @ invert_rigid(transform(up)) @ rest
                np.testing.assert_allclose(world[joint.part + 1], own, atol=1e-6)
        assert {"revolute": 9, "prismatic": 2}[joint.kind] == 2  # a key every 15 degrees of 100


def test_meshes_come_from_the_models(laptops, tmp_path):
    data = ag.open(laptops)
    ag.export(laptops, "urdf", tmp_path / "urdf", resolution=192)
    for row in (row for row in data if row.state_index == 0):
        path = tmp_path / "urdf" / row.split / row.object_id / f"{row.object_id}.urdf"
        robot = yourdfpy.URDF.load(str(path))
        inside = {}
        for part in row.parts:
            mesh = robot.scene.geometry[f"part_{len(inside)}.obj"]
            assert mesh.is_watertight
            T = robot.get_transform(part.name)
            inside[len(inside)] = trimesh.Trimesh(apply(T, mesh.vertices), mesh.faces)
        points = row.to_metres(row.near.points[::8])
        label = np.zeros(len(points), np.uint8)
        for part in (*range(1, len(inside)), 0):
            label[inside[part].contains(points) & (label == 0)] = part + 1
        near = row.near.label[::8]
        truth = np.where(is_material(near), near, 0)
        assert (label == truth).mean() > 0.995
    with pytest.raises(ag.ArticugenError, match="holds an export of other data"):
        ag.export(laptops, "urdf", tmp_path / "urdf", resolution=64)
