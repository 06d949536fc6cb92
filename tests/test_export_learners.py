"""Exports for learners, read back as their loaders read them, beside what the shards hold.

Their arithmetic is written out here, from its public source.
"""

import pickle
from pathlib import Path
from xml.etree import ElementTree as ET

import exports
import h5py
import numpy as np
import pytest
import trimesh
from exports import generated, name_of
from instances import changed, hinged_box
from ppd_data import shard
from scipy.spatial import KDTree

import articugen as ag
from articugen.core.geometry import (
    apply,
    bounds,
    box_corners,
    invert_rigid,
    rotation_about,
    transform,
)
from articugen.core.records import is_material
from articugen.export.items import Options
from articugen.export.parts import part_boxes, part_solids
from articugen.meshes.points import shape_of_file

BOXES, rows, exported = exports.BOXES, exports.rows, exports.exported


@pytest.fixture(scope="module")
def drawers(tmp_path_factory: pytest.TempPathFactory) -> ag.DataSet:
    """A bundled cabinet, shut and in two states between: shut, its drawers hide their boxes."""
    return ag.open(generated("drawer", tmp_path_factory.mktemp("drawers"), states=2, views=50))


@pytest.fixture(scope="module")
def solids(drawers: ag.DataSet) -> np.ndarray:
    """(P, 2, 3) boxes of the solids of its parts, canonical pose."""
    made = part_solids(drawers, Options(resolution=64))
    return np.stack([bounds(solid.mesh.vertices) for solid in made])


def test_boxes_of_parts_are_those_of_their_solids(drawers, solids):
    shut = drawers[0].surface
    front = np.ptp(shut.points[shut.part == 1], axis=0)
    depth = np.argmax(solids[1, 1] - solids[1, 0] - front)
    assert front[depth] < 0.3 * np.ptp(solids[1], axis=0)[depth]  # all that the shut pose shows
    for some in (drawers, drawers[:1], drawers[1:]):  # one state is enough, whichever it is
        np.testing.assert_allclose(part_boxes(some), solids, atol=0.01)
    boxes = part_boxes(drawers)
    for row in drawers:
        for group in (row.surface, row.partial):
            for k, part in enumerate(row.parts):
                points = apply(invert_rigid(part.motion), group.points[group.part == k])
                assert (points >= boxes[k, 0] - 1e-6).all()
                assert (points <= boxes[k, 1] + 1e-6).all()


def test_no_point_of_a_drawer_lies_outside_of_its_box(drawers, solids, tmp_path):
    """In whatever state it is seen, in the formats that give boxes."""
    ag.export(drawers, "npcs", tmp_path / "npcs")
    data = ancsh(tmp_path / "npcs", "drawer", drawers[0].split)
    assert len(data) == 4 * len(drawers)
    for view in data:
        for coords in view["nocs"]:
            assert (coords >= -1e-6).all()
            assert (coords <= 1.0 + 1e-6).all()
    ag.export(drawers, "opalign", tmp_path / "opalign")
    paths = list(tmp_path.glob("opalign/drawer/*/*/*/input_2/*.npz"))
    assert len(paths) == 4 * len(drawers)
    for path in paths:
        view = np.load(path, allow_pickle=True)["arr_0"].item()
        turn, place, size = np.split(view["part"], [9, 12], axis=1)
        np.testing.assert_allclose(size, solids[:, 1] - solids[:, 0], atol=0.01)
        for k in range(len(solids)):
            points = view["pc"][view["segmentation"] == k + 1] - place[k]
            assert (np.abs(points @ turn[k].reshape(3, 3)) <= size[k] / 2 + 1e-5).all()


def test_drawers_of_particulate_have_boxes_behind_their_fronts(drawers, solids, tmp_path):
    ag.export(drawers, "particulate", tmp_path)
    (path,) = tmp_path.glob("*/*.npz")
    data = np.load(path)
    shut = drawers[0].surface
    span, _, rest = rest_pose(dict(data), drawers)
    assert span == pytest.approx(np.ptp(np.concatenate(rest), axis=0).max(), rel=1e-6)
    for k in range(1, len(solids)):
        front, shown = np.ptp(shut.points[shut.part == k], axis=0), np.ptp(rest[k], axis=0)
        size = np.ptp(solids[k], axis=0)
        assert (shown <= size + 0.01).all()
        assert shown.max() > 2.5 * front[size.argmax()]
        if max(row.joints[k - 1].state_unit for row in drawers) > 0.1:
            np.testing.assert_allclose(shown, size, atol=0.01)


def shapes3d(folder: Path, split: str) -> list[dict]:
    """All models of all categories, as Occupancy Networks, ConvONet and NSD go through them."""
    found = []
    for category in (path for path in folder.iterdir() if path.is_dir()):
        models = (category / f"{split}.lst").read_text().split("\n")  # as they do: not stripped
        for model in models:
            cloud, points = (
                dict(np.load(category / model / f"{name}.npz")) for name in ("pointcloud", "points")
            )
            found.append({"model": model, "cloud": cloud, "points": points})
    return found


def test_onet_as_its_fields_read_it(exported, rows):
    folder = exported("onet") / "box"
    for split in ("train", "test"):
        models = [data["model"] for data in shapes3d(folder.parent, split)]
        assert models == [name_of(row) for row in rows.split(split)]
    held_out = [data["model"] for data in shapes3d(folder.parent, "val")]
    assert held_out == [name_of(row) for row in rows.of(rows.split("train").objects[0])]
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


def test_ppd_as_its_release_reads_it(tmp_path, boxes):
    release = {"grids": [16, 32], "surface_points": 4096}
    folder = generated("laptop", tmp_path, objects=2, states=1, **release)
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
    steps = [
        abs(row.joints[0].state - rows[name, index - 1].joints[0].state) / row.joints[0].upper
        for (name, index), row in rows.items() if index
    ]  # fmt: skip
    assert len(steps) == 4
    assert len(scenes) == sum(step >= 0.3 for step in steps) == 2
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


def test_of_objects_that_ditto_cannot_hold_no_folder_is_left(boxes, tmp_path):
    (tmp_path / "mine").mkdir()
    for out in (tmp_path / "new", tmp_path / "mine"):
        with pytest.raises(
            ag.ArticugenError, match=r"box-\d: in no two .* with articulation.one_at"
        ):
            ag.export(boxes, "ditto", out)
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


CHAIN = """<robot name="chain">
  <link name="foot"><visual><geometry><box size="0.4 0.4 0.1"/></geometry></visual></link>
  <link name="arm"><visual><origin xyz="0.3 0 0"/><geometry><box size="0.6 0.1 0.1"/></geometry>
    </visual></link>
  <link name="tip"><visual><geometry><box size="0.1 0.3 0.1"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="foot"/><child link="arm"/>
    <origin xyz="0 0 0.11"/><axis xyz="0 0 1"/><limit lower="0" upper="1.5"/></joint>
  <joint name="slide" type="prismatic"><parent link="arm"/><child link="tip"/>
    <origin xyz="0.5 0 0.11"/><axis xyz="1 0 0"/><limit lower="0" upper="0.3"/></joint>
</robot>"""


def test_of_joints_that_move_one_at_a_time_ditto_has_scenes(tmp_path):
    """Each joint in turn, with all that hangs on it; the screw takes the clouds there and back."""
    (tmp_path / "chain.urdf").write_text(CHAIN)
    recipe = {"articulation": {"states": 4, "one_at_a_time": True}, "fusion": {"rule": "rigid"},
              "views": {"count": 12, "resolution": 64}, "sampling": {"grids": [8]}}  # fmt: skip
    data = ag.generate("chain", tmp_path / "chain.urdf", tmp_path / "data", recipe, jobs=0)
    ag.export(data, "ditto", tmp_path / "out")
    scenes = [np.load(path) for path in sorted(tmp_path.glob("out/*/scenes/*.npz"))]
    assert [int(scene["joint_type"]) for scene in scenes] == [0, 1, 0, 1]
    for scene, start, end in zip(scenes, data[:-1], data[1:], strict=True):
        axis, how_far = scene["screw_axis"], float(scene["state_end"] - scene["state_start"])
        point = np.cross(axis, scene["screw_moment"])
        turn = rotation_about(axis, how_far)
        own = transform(turn, point - turn @ point)
        if scene["joint_type"] == 1:
            own = transform(translation=how_far * axis)
        parts = [2] if scene["joint_type"] else [1, 2]
        for word, other, row, T in (("start", "end", start, own),
                                    ("end", "start", end, invert_rigid(own))):  # fmt: skip
            moving = scene[f"pc_seg_{word}"]
            np.testing.assert_array_equal(moving, np.isin(row.partial.part.ravel(), parts))
            there, cloud = scene[f"pc_{word}_{other}"], scene[f"pc_{word}"]
            np.testing.assert_allclose(there[moving], apply(T, cloud[moving]), atol=1e-6)
            np.testing.assert_array_equal(there[~moving], cloud[~moving])
            label = np.concatenate([row.uniform.label, row.near.label])
            stays, moves = scene[f"{word}_occ_list"]
            np.testing.assert_array_equal(moves, np.isin(label, np.add(parts, 1)))
            np.testing.assert_array_equal(stays | moves, is_material(label))
            assert not (stays & moves).any()


def test_an_object_in_one_state_makes_no_scene_of_ditto(tmp_path):
    with pytest.raises(ag.ArticugenError, match="one state; Ditto's scenes are of two"):
        ag.export(generated("laptop", tmp_path), "ditto", tmp_path / "out")


def ancsh(folder: Path, category: str, split: str) -> list[dict]:
    """All views of a split, as A-NCSH's Dataset goes through lists, names, models and pickles; one
    looks from the folder itself, where its lists begin."""
    objects = {}
    for item in (path.name for path in (folder / "render" / category).iterdir()):
        path = folder / "urdf" / category / item
        count = len(list(path.iterdir())) - 1  # whatever lies beside syn.urdf is a part's
        place, axis, parent = [None] * count, [None] * count, [None] * count
        root = ET.parse(path / "syn.urdf").getroot()
        for link in root.iter("link"):
            name = link.attrib["name"]
            k = 0 if name == "base_link" else int(name)
            for origin in (o for visual in link.iter("visual") for o in visual.iter("origin")):
                assert [float(x) for x in origin.attrib["rpy"].split()] == [0.0] * 3
                place[k] = [-float(x) for x in origin.attrib["xyz"].split()]
        for joint in root.iter("joint"):
            above, k = (int(joint.attrib["name"].split("_")[end]) for end in (0, -1))
            parent[k] = above
            axis[k] = [float(x) for x in next(joint.iter("axis")).attrib["xyz"].split()]
        objects[item] = {"place": place, "axis": axis, "parent": parent}
    factors, corners = (
        pickle.loads((folder / "pickle" / f"{category}{end}.pkl").read_bytes())
        for end in ("", "_corners")
    )
    views = []
    for line in (folder / "splits" / category / "all" / f"{split}.txt").read_text().splitlines():
        item = line.split(".", maxsplit=1)[0].split("/")[-3]
        with h5py.File(folder / line) as data:
            assert data["rgb"][()].shape[2] == 3
            parts = range(len(objects[item]["place"]))
            points = [data["gt_points"][str(k)][()] for k in parts]
            coords = [data["gt_coords"][str(k)][()] for k in parts]
        view = {"name": line, "points": points, "coords": coords, "nocs": [], **objects[item]}
        view |= {"factors": factors[item], "corners": corners[item]}
        for k in parts:  # 0 is the whole object
            factor, (low, high) = factors[item][k + 1], corners[item][k + 1]
            view["nocs"].append((coords[k] - low) * factor + 0.5 - 0.5 * (high - low) * factor)
        views.append(view)
    return views


def test_npcs_as_its_loader_reads_it(exported, rows):
    folder = exported("npcs")
    views = {v["name"]: v for split in ("train", "test") for v in ancsh(folder, "box", split)}
    assert len(views) == 2 * len(rows)
    for row in rows:
        T_canonical = [invert_rigid(part.motion) for part in row.parts]
        for camera in range(2):
            view = views[f"hdf5/box/{row.object_id}/{row.state_index:04d}/{camera}.h5"]
            listed = folder / "render" / "box" / row.object_id / f"{row.state_index:04d}"
            assert (listed / "all.txt").read_text().split() == ["0", "1"]
            T = row.partial.T_camera_world[camera]
            for part in range(3):
                points, coords = view["points"][part], view["coords"][part]
                assert len(points) == (row.partial.part[camera] == part).sum()
                posed = apply(T @ row.parts[part].motion, coords)
                np.testing.assert_allclose(points, posed, atol=1e-5)
                assert (np.abs(view["nocs"][part] - 0.5) < 0.5 + 1e-6).all()
                low, high = view["corners"][part + 1]
                assert np.linalg.norm((high - low) * view["factors"][part + 1]) == pytest.approx(1)
            for joint in row.joints:  # in the canonical pose, as coordinates are
                assert view["parent"][joint.part] == joint.parent
                pivot = apply(T_canonical[joint.parent], joint.pivot)
                axis = T_canonical[joint.parent][:3, :3] @ joint.axis
                np.testing.assert_allclose(view["axis"][joint.part], axis, atol=1e-9)
                off = np.cross(view["place"][joint.part] - pivot, axis)
                np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_boxes_of_npcs_move_as_the_object_does(exported, rows):
    """The URDF is one that anybody may load."""
    yourdfpy = pytest.importorskip("yourdfpy")
    row = rows[-1]
    path = exported("npcs") / "urdf" / "box" / row.object_id / "syn.urdf"
    robot = yourdfpy.URDF.load(str(path))
    assert [joint.name for joint in robot.robot.joints] == ["0_1", "1_2"]
    robot.update_cfg({f"{j.parent}_{j.part}": j.state_unit for j in row.joints})
    boxes = part_boxes(rows.of(row.object_id))
    for k, link in enumerate(robot.robot.links):
        (mesh,) = link.visuals
        box = trimesh.load(path.parent / mesh.geometry.mesh.filename)
        assert isinstance(box, trimesh.Trimesh)
        assert box.is_watertight
        assert box.volume == pytest.approx(np.prod(boxes[k, 1] - boxes[k, 0]), rel=1e-5)
        T = robot.get_transform(link.name, "base_link") @ mesh.origin
        corners = apply(row.parts[k].motion, box_corners(boxes[k]))
        np.testing.assert_allclose(apply(T, box_corners(boxes[k])), corners, atol=1e-6)


def test_an_object_with_a_part_that_nothing_tells_of_is_left_out(tmp_path):
    def without_base(label: np.ndarray) -> np.ndarray:
        return np.where(label == 1, np.uint8(0), label)

    hidden = [
        changed(
            i,
            surface_part=np.maximum(i.surface_part, 1),
            partial_part=np.maximum(i.partial_part, 1),
            uniform_label=without_base(i.uniform_label),
            near_label=without_base(i.near_label),
        )
        for i in hinged_box(object_id="bar")
    ]
    (tmp_path / "data").mkdir()
    shard(tmp_path / "data" / "train-00000.h5", hidden)
    shard(tmp_path / "data" / "train-00001.h5", hinged_box(object_id="box"))
    for to in ("npcs", "opalign"):
        done = ag.export(tmp_path / "data", to, tmp_path / to)
        (sentence,) = done.left_out
        assert sentence.startswith("bar: no stored point is on or in part 0")
    views = ancsh(tmp_path / "npcs", "box", "train")
    assert [v["name"] for v in views] == [
        f"hdf5/box/box/{k:04d}/{c}.h5" for k in range(4) for c in range(2)
    ]
    assert [path.name for path in (tmp_path / "opalign" / "box" / "train").iterdir()] == ["box"]


def rest_pose(data: dict, states: ag.DataSet) -> tuple[float, np.ndarray, list[np.ndarray]]:
    """How an object was scaled and shifted, and the points of each part in the rest pose: those of
    one of its states. All parts agree on the former."""
    chosen, frames = [], []
    for k in range(len(states[0].parts)):
        points = data["points"][data["point_to_bone"] == k].astype(np.float64)
        for state in states:
            on_it = state.surface.part == k
            T = invert_rigid(state.parts[k].motion)
            truth = apply(T, state.surface.points[on_it])
            if len(truth) != len(points):
                continue
            span = np.ptp(truth, axis=0).max() / np.ptp(points, axis=0).max()
            shift = truth.min(axis=0) - span * points.min(axis=0)
            off, which = KDTree(truth).query(span * points + shift)
            if off.max() < 1e-5:
                normals = state.surface.normals[on_it][which] @ T[:3, :3].T
                of_part = data["normals"][data["point_to_bone"] == k]
                np.testing.assert_allclose(of_part, normals, atol=1e-6)
                chosen.append(truth[which])
                frames.append([span, *shift])
                break
    assert len(chosen) == len(states[0].parts)
    np.testing.assert_allclose(np.ptp(frames, axis=0), 0.0, atol=1e-5)
    return frames[0][0], np.array(frames[0][1:]), chosen


def test_particulate_as_it_articulates(exported, rows):
    for row in rows:
        data = np.load(exported("particulate") / row.split / f"{row.object_id}.npz")
        assert not data["point_from_sharp"].any()
        axes, ranges, tree = data["link_axes_plucker"], data["link_range"], data["bone_structure"]
        assert axes.shape == (3, 12)
        assert tree.tolist() == [[0, 1], [1, 2]]
        span, shift, truth = rest_pose(dict(data), rows.of(row.object_id))
        np.testing.assert_allclose(np.ptp(data["points"], axis=0).max(), 1.0, atol=1e-6)
        points, part = data["points"].astype(np.float64), data["point_to_bone"]
        # the slide first, which the hinge then carries, as its tree of parts does
        amount = row.joints[1].state_unit / span
        assert ranges[2, 2] <= amount <= ranges[2, 3] + 1e-6
        points[part == 2] += amount * axes[2, 6:9]
        line, moment = axes[1, :3], axes[1, 3:6]
        pivot = np.cross(moment, line)
        turn = rotation_about(line, row.joints[0].state)
        moved = part > 0
        points[moved] = apply(transform(turn, pivot - turn @ pivot), points[moved])
        for k in range(3):
            posed = apply(row.parts[k].motion, truth[k])
            np.testing.assert_allclose(span * points[part == k] + shift, posed, atol=1e-4)


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
            middle = part_boxes(rows.of(row.object_id))[0].mean(axis=0)
            here = row.partial.points[camera] - middle  # read back in a frame that all views share
            np.testing.assert_allclose(shape_of_file(path)[0], here, atol=1e-5)
            for k in range(3):  # each part's points lie in its box
                own = (points[part == k] - place[k]) @ turn[k]
                assert (np.abs(own) <= size[k] / 2 + 1e-5).all()
            for j, joint in enumerate(row.joints):
                np.testing.assert_allclose(pivot[j], apply(T, joint.pivot), atol=1e-9)
                np.testing.assert_allclose(axis[j], T[:3, :3] @ joint.axis, atol=1e-9)


def test_material_counts_no_enclosed_space(tmp_path):
    """An oven's shut inside is visible occupancy, and no part's material."""
    rows = ag.open(generated("oven", tmp_path))
    shares = {}
    for occupancy in ("visible", "material"):
        ag.export(rows, "onet", tmp_path / occupancy, occupancy=occupancy)
        (path,) = (tmp_path / occupancy).glob("oven/*/points.npz")
        occupied = np.unpackbits(np.load(path)["occupancies"])[: len(rows[0].uniform)]
        shares[occupancy] = occupied.mean()
    assert shares["visible"] == (rows[0].uniform.label > 0).mean()
    assert shares["material"] == is_material(rows[0].uniform.label).mean()
    assert shares["material"] < 0.8 * shares["visible"]
