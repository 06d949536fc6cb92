"""Every export, read back as its consumer reads it, beside what the shards hold.

Where the consumer's reader is on PyPI it is that one; elsewhere its loader's arithmetic is written
out here, from its public source.
"""

import json
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
import yourdfpy
from instances import HINGE, HINGE_AXIS, LOWER, SLIDE_AXIS, SMALL, UPPER
from ppd_data import write_boxes

import articugen as ag
from articugen.export.formats import Options
from articugen.export.joints import metric_joints
from articugen.export.parts import PartMeshes
from articugen.geometry import apply, invert_rigid, rotation_about, transform
from articugen.records import is_material

RICH = SMALL.model_copy(
    update={
        "sampling": SMALL.sampling.model_copy(
            update={
                "grids": (16, 32, 64),
                "surface_points": 8192,
                "uniform_points": 8192,
                "near_points": 8192,
            }
        )
    }
)

MESHES = {"from_grids": True}


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "box"
    return write_boxes(folder, train=2, test=1, states=2, recipe=RICH)


@pytest.fixture(scope="module")
def rows(boxes: Path) -> ag.DataSet:
    return ag.open(boxes)


@pytest.fixture(scope="module")
def exported(boxes: Path, tmp_path_factory: pytest.TempPathFactory):
    """The folder of the boxes in a format."""
    root, made = tmp_path_factory.mktemp("exported"), {}

    def export(to: str, **options) -> Path:
        key = (to, *sorted(options))
        if key not in made:
            made[key] = root / "-".join(key)
            done = ag.export(boxes, to, made[key], **options)
            assert done.left_out == ()
        return made[key]

    return export


@pytest.fixture(scope="module")
def laptops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two procedural laptops, whose models can be made again."""
    recipe = {"extends": "quick", "views": {"count": 30, "resolution": 128},
              "sampling": {"grids": [16]}}  # fmt: skip
    out = tmp_path_factory.mktemp("laptops")
    ag.generate("laptop", out=out, recipe=recipe, objects=2, states=2, jobs=0)
    return out / "laptop"


def name_of(row: ag.Row) -> str:
    return f"{row.object_id}_{row.state_index:04d}"


def motion_in_metres(row: ag.Row, part: int) -> np.ndarray:
    """(4, 4) of a part from the canonical pose, in the model's own frame."""
    T = np.array(row.parts[part].motion)
    T[:3, 3] = row.scale * T[:3, 3] + row.center - T[:3, :3] @ row.center
    return T


def state_in_metres(row: ag.Row) -> list[float]:
    unit = {"prismatic": row.scale, "revolute": 1.0}
    return [joint.state * unit[joint.kind] for joint in row.joints]


def canonical_meshes(data: ag.DataSet, row: ag.Row) -> list[np.ndarray]:
    """The vertices of each part in metres, canonical pose."""
    meshes = PartMeshes(data, Options(from_grids=True)).of(data.of(row.object_id))
    return [row.to_metres(mesh.vertices) for mesh in meshes]


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


def test_what_is_exported_as_urdf_is_read_as_a_source_again(exported, rows):
    row = rows[0]
    model = ag.load(
        exported("urdf", **MESHES) / row.split / row.object_id / f"{row.object_id}.urdf"
    )
    hinge, slide = model.joints
    np.testing.assert_allclose(hinge.T_parent_joint[:3, 3], HINGE, atol=1e-9)
    np.testing.assert_allclose([hinge.axis, slide.axis], [HINGE_AXIS, SLIDE_AXIS], atol=1e-9)


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


@pytest.mark.filterwarnings("ignore:.*Scene.dump:DeprecationWarning")  # yourdfpy's own call
def test_convex_parts_fill_the_boxes(boxes, tmp_path):
    pytest.importorskip("coacd", reason="make exporters installs it")
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    ag.export(boxes, "mjcf", tmp_path / "m", split="test", collision=True, **MESHES)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "m" / "test" / "box-2" / "box-2.xml"))
    felt = [g for g in range(model.ngeom) if model.geom(g).contype[0]]
    assert {model.body(model.geom_bodyid[g]).name for g in felt} == {"part_0", "part_1", "part_2"}
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0  # parts that share a joint do not collide
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
        path = exported("usd", **MESHES) / row.split / f"{row.object_id}.usdc"
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
            prim = stage.GetPrimAtPath(f"{root.GetPath()}/joint_{joint.part}")
            kind = {"revolute": UsdPhysics.RevoluteJoint, "prismatic": UsdPhysics.PrismaticJoint}
            made = kind[joint.kind](prim)
            unit = np.degrees(1) if joint.kind == "revolute" else 1.0
            limits = [made.GetLowerLimitAttr().Get(), made.GetUpperLimitAttr().Get()]
            np.testing.assert_allclose(limits, np.array([joint.lower, joint.upper]) * unit, 1e-6)
            for end, body in ((0, joint.parent), (1, joint.part)):
                relation = getattr(made, f"GetBody{end}Rel")().GetTargets()
                assert relation == [root.GetPath().AppendChild(f"part_{body}")]
                T = np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(relation[0]))).T
                place = apply(T, getattr(made, f"GetLocalPos{end}Attr")().Get())
                np.testing.assert_allclose(place, joint.pivot, atol=1e-6)
                turn = Gf.Rotation(getattr(made, f"GetLocalRot{end}Attr")().Get())
                np.testing.assert_allclose(turn.TransformDir((1, 0, 0)), joint.axis, atol=1e-6)


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
    ag.export(laptops, "urdf", tmp_path / "urdf", resolution=256)
    for row in (row for row in data if row.state_index == 0):
        path = tmp_path / "urdf" / row.split / row.object_id / f"{row.object_id}.urdf"
        robot = yourdfpy.URDF.load(str(path))
        inside = {}
        for part in row.parts:
            mesh = robot.scene.geometry[f"part_{len(inside)}.obj"]
            assert mesh.is_watertight
            T = robot.get_transform(part.name)
            inside[len(inside)] = trimesh.Trimesh(apply(T, mesh.vertices), mesh.faces)
        points = row.to_metres(row.near.points)
        label = np.zeros(len(points), np.uint8)
        for part in (*range(1, len(inside)), 0):
            label[inside[part].contains(points) & (label == 0)] = part + 1
        truth = np.where(is_material(row.near.label), row.near.label, 0)
        assert (label == truth).mean() > 0.995
    with pytest.raises(ag.ArticugenError, match="holds an export of other data"):
        ag.export(laptops, "urdf", tmp_path / "urdf", resolution=64)


def test_parquet_in_datasets(exported, rows, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    datasets = pytest.importorskip("datasets", reason="make exporters installs it")
    folder = str(exported("parquet"))
    for split in ("train", "test"):
        loaded = datasets.load_dataset(folder, split=split, cache_dir=str(tmp_path / "cache"))
        mine = rows.split(split)
        assert len(loaded) == len(mine)
        for sample, row in zip(loaded, mine, strict=True):
            assert (sample["split"], sample["category"]) == (split, "box")
            for name in row.fields:
                stored = np.asarray(row.stored(name))
                value = np.array(sample[name], dtype=stored.dtype)
                np.testing.assert_array_equal(value, stored, err_msg=name)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # files left open
def test_webdataset_in_webdataset(exported, rows):
    wds = pytest.importorskip("webdataset", reason="make exporters installs it")
    for split in ("train", "test"):
        tars = sorted(map(str, exported("webdataset").glob(f"{split}-*.tar")))
        samples = wds.WebDataset(tars, shardshuffle=False).decode()
        for sample, row in zip(samples, rows.split(split), strict=True):
            assert sample["__key__"] == name_of(row)
            assert sample["json"]["state_index"] == row.state_index
            assert sample["json"]["joint_kind"] == [joint.kind for joint in row.joints]
            np.testing.assert_array_equal(sample["npz"]["near_points"], row.near.points)
            np.testing.assert_array_equal(sample["npz"]["near_label"], row.near.label)
            np.testing.assert_array_equal(sample["npz"]["joint_state"], row.stored("joint_state"))


def test_onet_as_its_fields_read_it(exported, rows):
    folder = exported("onet") / "box"
    for split in ("train", "test"):
        models = (folder / f"{split}.lst").read_text().split("\n")
        assert [name for name in models if name] == [name_of(row) for row in rows.split(split)]
    for row in rows:
        points = np.load(folder / name_of(row) / "points.npz")
        occupied = np.unpackbits(points["occupancies"])[: points["points"].shape[0]]
        np.testing.assert_array_equal(points["points"], row.uniform.points)
        np.testing.assert_array_equal(occupied, row.uniform.label > 0)
        cloud = np.load(folder / name_of(row) / "pointcloud.npz")
        np.testing.assert_array_equal(cloud["points"], row.surface.points)
        np.testing.assert_array_equal(cloud["normals"], row.surface.normals)
        assert (cloud["loc"].shape, cloud["scale"].shape) == ((3,), ())


def test_imnet_as_its_trainer_reads_it(exported, rows):
    for split in ("train", "test"):
        mine = rows.split(split)
        names = (exported("imnet") / f"box_{split}.txt").read_text().split()
        assert names == [name_of(row) for row in mine]
        with h5py.File(exported("imnet") / f"box_{split}.hdf5") as data:
            assert data["voxels"].shape == (len(mine), 64, 64, 64, 1)
            for resolution, count in ((16, 4096), (32, 4096), (64, 16384)):
                points = (data[f"points_{resolution}"][:].astype(np.float32) + 0.5) / 256 - 0.5
                values = data[f"values_{resolution}"][:].astype(np.float32)
                assert points.shape == (len(mine), count, 3)
                assert values.shape == (len(mine), count, 1)
                for i, row in enumerate(mine):
                    check_values(row, points[i], values[i, :, 0], resolution)
            voxels = data["voxels"][:]
            for i, row in enumerate(mine):
                np.testing.assert_array_equal(voxels[i, ..., 0], row.grids[64] > 0)
                cells = np.floor((data["points_16"][i] + 0.5) / 16).astype(int)
                assert len(np.unique(cells, axis=0)) == 4096  # one in each cell
                full = (row.grids[64] > 0).reshape(16, 4, 16, 4, 16, 4).any(axis=(1, 3, 5))
                inside = full[tuple(cells.T)]  # an inside one where there is any
                np.testing.assert_array_equal(data["values_16"][i, :, 0], inside)


def check_values(row: ag.Row, points: np.ndarray, values: np.ndarray, resolution: int) -> None:
    """Each point is one of the shard's, or a voxel of its, and has its label."""
    if resolution == 16:
        voxel = np.round((points + 0.5) * 64 - 0.5).astype(int)
        np.testing.assert_allclose((voxel + 0.5) / 64 - 0.5, points, atol=1e-6)
        np.testing.assert_array_equal(row.grids[64][tuple(voxel.T)] > 0, values)
        return
    known = np.concatenate([row.near.points, row.uniform.points])[: len(points)]
    label = np.concatenate([row.near.label, row.uniform.label])[: len(points)]
    np.testing.assert_allclose(points, known, atol=1e-6)
    np.testing.assert_array_equal(values, label > 0)


def chainless(tmp_path: Path) -> Path:
    """The laptops' like of PPD: joints from the base alone, with the grids of its release."""
    recipe = {"extends": "quick", "views": {"count": 30, "resolution": 128},
              "sampling": {"grids": [16, 32], "surface_points": 4096}}  # fmt: skip
    ag.generate("laptop", out=tmp_path, recipe=recipe, objects=2, states=1, jobs=0)
    return tmp_path / "laptop"


def test_ppd_as_its_release_reads_it(tmp_path, boxes):
    folder = chainless(tmp_path)
    rows = ag.open(folder)
    ag.export(folder, "ppd", tmp_path / "ppd", resolution=64)
    samples = tmp_path / "ppd" / "data" / "sample"
    lists = {
        path.stem: path.read_text().split()
        for path in (tmp_path / "ppd" / "data" / "list").glob("*.lst")
    }
    assert lists.keys() == {"train", "val", "test", "all"}
    assert set(lists["val"]) <= set(lists["train"])
    assert (
        set(lists["all"])
        == {f"laptop/{row.object_id}/{row.state_index:04d}" for row in rows}
        == {*lists["train"], *lists["test"]}
    )
    tail = "sample_wise_normalize"
    rest = {row.object_id: row for row in rows if row.state_index == 0}
    for row in rows:
        place = samples / "laptop" / row.object_id / f"{row.state_index:04d}"
        for resolution in (16, 32):
            data = np.load(place / f"points_values_whole_shape_{tail}_{resolution}.npz")
            points, values = (data["points"] + 0.5) / 256 - 0.5, data["values"]
            assert values.shape == (resolution**3, 1)
            assert values.dtype.kind == "u"
            voxel = np.round((points + 0.5) * resolution - 0.5).astype(int)
            truth = row.grids[resolution][tuple(voxel.T)]
            np.testing.assert_allclose((voxel + 0.5) / resolution - 0.5, points, atol=1e-6)
            np.testing.assert_array_equal(values[:, 0], np.where(truth == 255, 1, truth))
        motion = np.load(place / f"motion_param_{tail}.npz")
        assert (motion["rotation_primitives_num"], motion["translation_primitives_num"]) == (1, 0)
        turn = rotation_about(motion["rotation_direction_0"], float(motion["rotation_amount_0"][0]))
        anchor = motion["rotation_anchor_point_0"]
        own = transform(turn, anchor - turn @ anchor)  # T(a) R(amount, dir) T(-a)
        np.testing.assert_allclose(own, row.parts[1].motion, atol=1e-9)
        surface = np.load(place / f"surface_points_whole_shape_{tail}.npz")
        np.testing.assert_array_equal(surface["points"], row.surface.points)
        for part in range(2):
            mesh = trimesh.load(place / f"surface_mesh_{tail}_{part}.obj")
            assert isinstance(mesh, trimesh.Trimesh)
            canonical = samples / "laptop" / row.object_id / "0000"
            first = trimesh.load(canonical / f"surface_mesh_{tail}_{part}.obj")
            posed = apply(row.parts[part].motion, first.vertices)
            np.testing.assert_allclose(mesh.vertices, posed, atol=1e-8)
    assert len(rest) == 2
    with pytest.raises(ag.ArticugenError, match="a joint hangs on another"):
        ag.export(boxes, "ppd", tmp_path / "chains", from_grids=True)


def test_ditto_as_its_loader_reads_it(laptops, tmp_path):
    ag.export(laptops, "ditto", tmp_path / "out")
    rows = {(row.object_id, row.state_index): row for row in ag.open(laptops)}
    scenes = sorted(tmp_path.glob("out/*/scenes/*.npz"))
    assert len(scenes) == 4
    for path in scenes:
        data = np.load(path)
        name, a, b = path.stem.rsplit("_", 2)
        start, end = rows[name, int(a)], rows[name, int(b)]
        occ = list(data["start_occ_list"])
        moving = occ.pop(int(data["joint_index"]))
        label = np.concatenate([start.uniform.label, start.near.label])
        np.testing.assert_array_equal(moving, label == 2)
        np.testing.assert_array_equal(occ[0], label == 1)
        assert data["start_p_occ"].shape == (len(label), 3)
        assert data["start_occ_density"].shape == (len(label), 1)
        axis = data["screw_axis"]
        point = np.cross(axis, data["screw_moment"])  # as the loader has it
        turn = rotation_about(axis, float(data["state_end"] - data["state_start"]))
        own = transform(turn, point - turn @ point)
        mine = data["pc_seg_start"]
        np.testing.assert_allclose(
            apply(own, data["pc_start"][mine]), data["pc_start_end"][mine], atol=1e-5
        )
        np.testing.assert_array_equal(data["pc_start_end"][~mine], data["pc_start"][~mine])
        assert int(data["joint_type"]) == 0
        np.testing.assert_array_equal(data["pc_end"], end.partial.points.reshape(-1, 3))
    with pytest.raises(ag.ArticugenError, match="Shape2Motion"):
        ag.export(laptops, "ditto", tmp_path / "Shape2Motion")


def test_npcs_as_its_loader_reads_it(exported, rows):
    folder = exported("npcs")
    factors = pickle.loads((folder / "pickle" / "box.pkl").read_bytes())
    corners = pickle.loads((folder / "pickle" / "box_corners.pkl").read_bytes())
    listed = [
        line
        for split in ("train", "test")
        for line in (folder / "splits" / "box" / "all" / f"{split}.txt").read_text().split()
    ]
    assert len(listed) == len(set(listed)) == 2 * len(rows)
    for row in rows:
        for camera in range(2):
            name = f"hdf5/box/{row.object_id}/{row.state_index:04d}/{camera}.h5"
            assert name in listed
            item = name.split(".", maxsplit=1)[0].split("/")[-3]
            T = row.partial.T_camera_world[camera]
            with h5py.File(folder / name) as data:
                for part in range(3):
                    points = data["gt_points"][str(part)][()]
                    coords = data["gt_coords"][str(part)][()]
                    assert len(points) == (row.partial.part[camera] == part).sum()
                    posed = apply(T @ row.parts[part].motion, coords)
                    np.testing.assert_allclose(points, posed, atol=1e-5)
                    factor, (low, high) = factors[item][part + 1], corners[item][part + 1]
                    nocs = (coords - low) * factor + 0.5 - 0.5 * (high - low) * factor
                    assert (np.abs(nocs - 0.5) < 0.51).all()
                    assert np.linalg.norm((high - low) * factor) == pytest.approx(1.0)


def test_particulate_as_it_articulates(exported, rows):
    for row in rows:
        data = np.load(exported("particulate") / row.split / f"{row.object_id}.npz")
        assert not data["point_from_sharp"].any()
        axes, ranges, tree = data["link_axes_plucker"], data["link_range"], data["bone_structure"]
        assert axes.shape == (3, 12)
        assert tree.tolist() == [[0, 1], [1, 2]]
        first = rows.of(row.object_id)[0]
        span = np.ptp(first.surface.points, axis=0).max()
        np.testing.assert_allclose(np.ptp(data["points"], axis=0).max(), 1.0, atol=1e-6)
        points, part = data["points"].astype(np.float64), data["point_to_bone"]
        # the slide first, which the hinge then carries, as its tree of parts does
        amount = row.joints[1].state / span
        assert ranges[2, 2] <= amount <= ranges[2, 3] + 1e-6
        points[part == 2] += amount * axes[2, 6:9]
        line, moment = axes[1, :3], axes[1, 3:6]
        pivot = np.cross(moment, line)
        turn = rotation_about(line, row.joints[0].state)
        moved = part > 0
        points[moved] = apply(transform(turn, pivot - turn @ pivot), points[moved])
        box = np.stack([first.surface.points.min(0), first.surface.points.max(0)])
        back = points * span + box.mean(axis=0)
        truth = np.array(first.surface.points, np.float64)
        for k in range(3):
            mine = first.surface.part == k
            truth[mine] = apply(row.parts[k].motion, truth[mine])
        np.testing.assert_allclose(back, truth, atol=1e-5)


def test_opalign_as_its_loader_reads_it(exported, rows):
    files = list(exported("opalign").glob("box/train/*/*/input_2/*.npz"))
    assert len(files) == 2 * len(rows.split("train"))
    for row in rows.split("train"):
        for camera in range(2):
            folder = exported("opalign") / "box" / "train" / row.object_id
            path = folder / f"{row.state_index:04d}" / "input_2" / f"{camera:02d}.npz"
            data = np.load(path, allow_pickle=True)["arr_0"].item()
            turn, place = data["part"][:, :9].reshape(-1, 3, 3), data["part"][:, 9:12]
            size, pivot, axis = data["part"][:, 12:], data["joint"][:, :3], data["joint"][:, 3:6]
            seen = np.logical_and(data["pc"].sum(-1) != 0, data["detection"])
            points, part = data["pc"][seen], data["segmentation"][seen] - 1
            np.testing.assert_array_equal(part, row.partial.part[camera])
            T = row.partial.T_camera_world[camera]
            np.testing.assert_allclose(points, apply(T, row.partial.points[camera]), atol=1e-5)
            for k in range(3):  # each part's points lie in its box
                own = (points[part == k] - place[k]) @ turn[k]
                assert (np.abs(own) <= size[k] / 2 + 0.02).all()
            for j, joint in enumerate(row.joints):
                np.testing.assert_allclose(pivot[j], apply(T, joint.pivot), atol=1e-9)
                np.testing.assert_allclose(axis[j], T[:3, :3] @ joint.axis, atol=1e-9)


def test_material_counts_no_enclosed_space(tmp_path):
    """An oven's shut inside is visible occupancy, and no part's material."""
    recipe = {"extends": "quick", "views": {"count": 30, "resolution": 128},
              "sampling": {"grids": [16]}}  # fmt: skip
    ag.generate("oven", out=tmp_path, recipe=recipe, objects=1, states=0, jobs=0)
    rows = ag.open(tmp_path / "oven")
    shares = {}
    for occupancy in ("visible", "material"):
        ag.export(rows, "onet", tmp_path / occupancy, occupancy=occupancy)
        (path,) = (tmp_path / occupancy).glob("oven/*/points.npz")
        occupied = np.unpackbits(np.load(path)["occupancies"])[: len(rows[0].uniform)]
        shares[occupancy] = occupied.mean()
    assert shares["visible"] == (rows[0].uniform.label > 0).mean()
    assert shares["material"] == is_material(rows[0].uniform.label).mean()
    assert shares["material"] < 0.8 * shares["visible"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of rdflib, in mlcroissant
@pytest.mark.parametrize("to", ["ply", "parquet", "onet", "webdataset"])
def test_croissant_in_mlcroissant(exported, rows, to):
    mlc = pytest.importorskip("mlcroissant", reason="make exporters installs it")
    folder = exported(to)
    told = json.loads((folder / "croissant.json").read_text())
    assert told["conformsTo"].endswith("/1.1")
    dataset = mlc.Dataset(jsonld=folder / "croissant.json")
    assert not dataset.metadata.issues.errors
    assert dataset.metadata.name == f"box-{to}"
    assert dataset.metadata.license == ["MIT"]
    if to == "parquet":
        ids = [record["instances/object_id"] for record in dataset.records("instances")]
        assert sorted(map(bytes.decode, ids)) == sorted(row.object_id for row in rows)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_data_set_has_its_own_croissant(laptops):
    mlc = pytest.importorskip("mlcroissant", reason="make exporters installs it")
    dataset = mlc.Dataset(jsonld=laptops / "croissant.json")
    assert not dataset.metadata.issues.errors
    assert dataset.metadata.license == ["MIT"]
    shards = {shard.name: shard.sha256 for shard in ag.open(laptops).manifest.shards}
    assert {file.name: file.sha256 for file in dataset.metadata.distribution} == shards
    assert ag.open(laptops).manifest.content_sha256 in dataset.metadata.description
    assert ag.verify(laptops).ok
