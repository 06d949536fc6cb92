"""Exports for learners, read back as their loaders read them, beside what the shards hold.

Their arithmetic is written out here, from its public source.
"""

import pickle
from pathlib import Path

import exports
import h5py
import numpy as np
import pytest
import trimesh
from exports import name_of
from instances import changed, hinged_box
from test_html_report import shard

import articugen as ag
from articugen.geometry import apply, rotation_about, transform
from articugen.records import is_material

boxes, rows, exported, laptops = exports.boxes, exports.rows, exports.exported, exports.laptops


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


def test_of_objects_that_ditto_cannot_hold_no_folder_is_left(boxes, tmp_path):
    (tmp_path / "mine").mkdir()
    for out in (tmp_path / "new", tmp_path / "mine"):
        with pytest.raises(
            ag.ArticugenError, match=r"box-\d: 2 joints move; Ditto's scenes have one"
        ):
            ag.export(boxes, "ditto", out)
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


def test_an_object_in_one_state_makes_no_scene_of_ditto(tmp_path):
    recipe = {"extends": "quick", "views": {"count": 30, "resolution": 128},
              "sampling": {"grids": [16]}}  # fmt: skip
    ag.generate("laptop", out=tmp_path, recipe=recipe, objects=1, states=0, jobs=0)
    with pytest.raises(ag.ArticugenError, match="one state; Ditto's scenes are of two"):
        ag.export(tmp_path / "laptop", "ditto", tmp_path / "out")


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


def test_an_object_with_a_part_that_no_point_shows_is_left_out_of_npcs(tmp_path):
    """As real cabinets whose body is a single bar have them."""
    hidden = [
        changed(i, surface_part=np.maximum(i.surface_part, 1)) for i in hinged_box(object_id="bar")
    ]
    (tmp_path / "data").mkdir()
    shard(tmp_path / "data" / "train-00000.h5", hidden)
    shard(tmp_path / "data" / "train-00001.h5", hinged_box(object_id="box"))
    done = ag.export(tmp_path / "data", "npcs", tmp_path / "out")
    (said,) = done.left_out
    assert said.startswith("bar: part 0 has no surface points")
    listed = (tmp_path / "out" / "splits" / "box" / "all" / "train.txt").read_text().split()
    assert listed == sorted(f"hdf5/box/box/{k:04d}/{c}.h5" for k in range(4) for c in range(2))
    assert all((tmp_path / "out" / name).is_file() for name in listed)
    factors = pickle.loads((tmp_path / "out" / "pickle" / "box.pkl").read_bytes())
    assert list(factors) == ["box"]


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
        amount = row.joints[1].state_unit / span
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
