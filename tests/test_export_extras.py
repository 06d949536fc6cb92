"""Formats that need more than the default samples, read as their loaders read them."""

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from instances import changed, hinged_box
from PIL import Image
from ppd_data import shard
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from test_extras import ASKING, SLIDE

import articugen as ag
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import transform


@pytest.fixture(scope="module")
def bolts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bolt and a wall, with everything that a recipe may ask for; nine cameras."""
    root = tmp_path_factory.mktemp("bolts")
    for name in "ab":
        (root / f"{name}.urdf").write_text(SLIDE.format(upper=0.15))
    recipe = ASKING | {
        "images": {"views": 9, "resolution": 48},
        "sampling": ASKING["sampling"] | {"near_sharp": 0.4},
    }
    ag.generate("bolt", root, root / "out", recipe, states=3, jobs=0)
    return root / "out" / "bolt"


@pytest.fixture(scope="module")
def rows(bolts: Path) -> ag.DataSet:
    return ag.open(bolts)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without any of it."""
    root = tmp_path_factory.mktemp("plain")
    (root / "a.urdf").write_text(SLIDE.format(upper=0.15))
    recipe = {"extends": "quick", "views": ASKING["views"], "sampling": {"grids": [16]}}
    ag.generate("bolt", root / "a.urdf", root / "out", recipe, states=1, jobs=0)
    return root / "out" / "bolt"


def drawn_by_dora(path):
    """A sample as Dora's loader draws it with its own configuration: each point at most once."""
    rng = np.random.default_rng(0)
    data = np.load(path)
    near, far = data["rand_points"][:400_000], data["rand_points"][400_000:]
    counts = ((data["sharp_near_surface"], 21_384), (near, 10_000), (far, 10_000))
    queries = [points[rng.choice(len(points), count, replace=False)] for points, count in counts]
    return data["fps_coarse_surface"][:, 0, :], data["fps_sharp_surface"][:, 0, :], queries


def test_vecset_as_doras_loader_reads_it(bolts, rows, tmp_path):
    ag.export(bolts, "vecset", tmp_path / "v")
    lists = {split: json.loads((tmp_path / "v" / f"{split}.json").read_text())
             for split in ("train", "val", "test")}  # fmt: skip
    assert lists["val"] == lists["train"][:1]
    for split in rows.splits:
        assert len(lists[split]) == len(rows.split(split))
        for path, row in zip(lists[split], rows.split(split), strict=True):
            coarse, sharp, (edges, near, far) = drawn_by_dora(tmp_path / "v" / path)
            np.testing.assert_allclose(coarse[:, :3], 2 * row.surface.points, atol=1e-7)
            np.testing.assert_allclose(sharp[:, :3], 2 * row.sharp.points, atol=1e-7)
            np.testing.assert_array_equal(sharp[:, 3:], row.sharp.normals)
            stored = {
                "edges": (edges, row.near, slice(300, 500)),
                "near": (near, row.near, slice(300)),
                "far": (far, row.uniform, slice(500)),
            }
            for name, (points, queries, which) in stored.items():
                assert points.dtype == np.float32
                distance, index = cKDTree(2 * queries.points[which]).query(points[:, :3])
                assert distance.max() < 1e-6, name
                # its occupancy, and its truncated distance, both above 0 inside
                occupied = np.where(points[:, 3] < 0, 0, 1)
                clear = np.abs(points[:, 3]) > 1e-6
                label = queries.label[which][index]
                np.testing.assert_array_equal(occupied[clear], label[clear] > 0)
                truncated = points[:, 3].clip(-0.015, 0.015) / 0.015
                truth = (-2 * queries.distance[which][index]).clip(-0.015, 0.015) / 0.015
                np.testing.assert_allclose(truncated, truth)


def test_vecset_wants_points_near_edges(tmp_path):
    (tmp_path / "a.urdf").write_text(SLIDE.format(upper=0.15))
    ag.generate("bolt", tmp_path / "a.urdf", tmp_path / "out", ASKING, states=1, jobs=0)
    with pytest.raises(InvalidArgument, match=r"sampling\.near_sharp between 0 and 1"):
        ag.export(tmp_path / "out" / "bolt", "vecset", tmp_path / "v")


@pytest.fixture(scope="module")
def scenes(bolts, tmp_path_factory):
    out = tmp_path_factory.mktemp("scenes") / "a"
    ag.export(bolts, "artgs", out)
    return out


def ends_of(own):
    """The instances that a scene shows, by the names of its ends."""
    return {"start": own[0], "end": max(own, key=lambda row: row.joints[0].state)}


def readers_camera(frame):
    """(R, T) as ArtGS's reader makes them of a frame: x_camera = R^T x + T, y down, z forward."""
    c2w = np.array(frame["transform_matrix"])
    c2w[:3, 1:3] *= -1
    w2c = np.linalg.inv(c2w)
    return np.transpose(w2c[:3, :3]), w2c[:3, 3]


def readers_image(folder, file_path):
    """Where ArtGS's reader looks for a frame's image: in `rgba` beside it where there is one."""
    path = folder / file_path
    if (path.parent.parent / "rgba").exists():
        path = path.parent.parent / "rgba" / path.name
    assert path.suffix == ".png"
    assert int(path.stem) >= 0
    return path


def test_artgs_as_its_scene_reads_it(scenes, rows):
    for object_id, own in rows.by_object():
        folder = scenes / own[0].split / object_id
        assert (folder / "transforms_train.json").exists()  # or its Scene finds no data
        for (word, row), time in zip(ends_of(own).items(), (0.0, 1.0), strict=True):
            counts = {}
            for split in ("train", "test"):
                told = json.loads((folder / f"transforms_{split}_{word}.json").read_text())
                counts[split] = len(told["frames"])
                for number, frame in enumerate(told["frames"]):
                    assert frame["time"] == time
                    # data_tools/process_artgs.py takes files by number, poses by their place
                    image = readers_image(folder, frame["file_path"])
                    assert image == folder / word / split / "rgba" / f"{number:04d}.png"
                    check_frame(folder, frame, told, row)
            assert counts == {"train": 8, "test": 1}
        both = json.loads((folder / "transforms_train.json").read_text())["frames"]
        assert [frame["time"] for frame in both] == 8 * [0.0] + 8 * [1.0]
        assert all((folder / frame["file_path"]).is_file() for frame in both)


def test_artgs_as_paris_reads_it(scenes, rows):
    counts = {"train": 8, "val": 1, "test": 1}
    for object_id, own in rows.by_object():
        folder = scenes / own[0].split / object_id
        for split, (word, row) in product(counts, ends_of(own).items()):
            cameras = json.loads((folder / word / f"camera_{split}.json").read_text())
            K = np.array(cameras.pop("K"))
            assert (K[0, 2], K[1, 2]) == (24, 24)  # which it takes to be the middle
            assert len(cameras) == counts[split]
            for name, pose in cameras.items():
                c2w = np.array(pose)[:3, :4]
                rgba = np.array(Image.open(folder / word / split / f"{name}.png"))
                assert rgba.shape == (48, 48, 4)
                j, i = np.mgrid[:48, :48] + 0.5
                rays = [(i - 24) / K[0, 0], -(j - 24) / K[0, 0], -np.ones_like(i)]
                rays = np.stack(rays, axis=-1) @ c2w[:, :3].T
                (k,) = [k for k, T in enumerate(row.images.T_camera_world)
                        if np.allclose(np.linalg.inv(T)[:3, 3], c2w[:, 3])]  # fmt: skip
                depth = row.images.depth[k]
                np.testing.assert_array_equal(rgba[..., 3] > 0, depth > 0)
                check_on_surface(c2w[:, 3] + rays[depth > 0] * depth[depth > 0][:, None], row)


def readers_motion(joint):
    """(4, 4) from start to end as PARIS and ArtGS make it of what gt/trans.json says of a joint."""
    axis, amount = np.array(joint["axis"]["d"]), joint[joint["type"]]
    amount = amount["r"] - amount["l"]
    if joint["type"] == "translate":
        return transform(translation=amount * axis)
    turn = Rotation.from_rotvec(axis * np.deg2rad(amount)).as_matrix()
    return transform(turn, (np.eye(3) - turn) @ np.array(joint["axis"]["o"]))


def test_the_truth_of_a_scene_of_artgs_moves_its_parts(scenes, rows, tmp_path):
    """A joint that is alone stands alone, as PARIS wants it; several are a list, as ArtGS does."""
    for object_id, own in rows.by_object():
        path = scenes / own[0].split / object_id / "gt" / "trans.json"
        T = readers_motion(json.loads(path.read_text())["trans_info"])
        np.testing.assert_allclose(T, ends_of(own)["end"].parts[1].motion, atol=1e-9)
    blank = {"depth": np.zeros((2, 4, 4), np.float32), "rgba": np.zeros((2, 4, 4, 4), np.uint8),
             "part": np.zeros((2, 4, 4), np.uint8), "intrinsics": np.ones((2, 4)),
             "T_camera_world": np.stack([np.eye(4)] * 2)}  # fmt: skip
    blank = {f"image_{name}": value for name, value in blank.items()}
    box = shard(tmp_path / "box.h5", [changed(i, **blank) for i in hinged_box()])
    ag.export(box, "artgs", tmp_path / "out")
    (path,) = (tmp_path / "out").rglob("trans.json")
    hinge, slide = map(readers_motion, json.loads(path.read_text())["trans_info"])
    end = ag.open(box)[2]  # the one opened furthest
    np.testing.assert_allclose(hinge, end.parts[1].motion, atol=1e-9)
    np.testing.assert_allclose(hinge @ slide, end.parts[2].motion, atol=1e-9)


def check_frame(folder, frame, told, row):
    """Depths that are seen lie on the surface, where its cameras put them."""
    path = readers_image(folder, frame["file_path"])
    rgba = np.array(Image.open(path))
    stored = np.array(Image.open(str(path).replace("rgba", "depth")))
    assert (stored.dtype, stored.shape, rgba.shape) == (np.uint16, (48, 48), (48, 48, 4))
    depth = stored / 1e3
    np.testing.assert_array_equal(rgba[..., 3] > 127, depth > 0)
    R, T = readers_camera(frame)
    i, j = np.nonzero(depth)
    z = depth[i, j]
    half = np.tan(told["camera_angle_x"] / 2), np.tan(told["camera_angle_y"] / 2)
    x, y = ((k + 0.5) / 24 - 1.0 for k in (j, i))
    check_on_surface((np.stack([x * half[0] * z, y * half[1] * z, z], axis=1) - T) @ R.T, row)


def check_on_surface(points, row):
    metres = row.to_metres(points)
    bolt = [0.4 - row.joints[0].state, 0.0, 0.0]
    solids = ((np.zeros(3), [0.1, 0.2, 0.2]), (bolt, [0.1, 0.05, 0.05]))
    off = [np.abs(np.abs(metres - middle) - half).min(axis=1) for middle, half in solids]
    inside = [(np.abs(metres - middle) < np.add(half, 2e-3)).all(axis=1) for middle, half in solids]
    on_surface = np.any(
        [near & (far < 2e-3) for near, far in zip(inside, off, strict=True)], axis=0
    )
    assert on_surface.mean() > 0.99
    assert len(points) > 100


def test_particulate_has_its_half_of_sharp_points(bolts, rows, tmp_path):
    ag.export(bolts, "particulate", tmp_path / "p")
    for object_id, own in rows.by_object():
        data = np.load(tmp_path / "p" / own[0].split / f"{object_id}.npz")
        sharp = data["point_from_sharp"]
        assert data["normals"].shape == data["points"].shape
        np.testing.assert_allclose(np.ptp(data["points"], axis=0).max(), 1.0, atol=1e-6)
        for group, chosen in (("surface", ~sharp), ("sharp", sharp)):
            parts = data["point_to_bone"][chosen]
            assert set(parts) == set(range(len(own[0].parts)))
            for part in set(parts):  # as many as one state has of it
                counts = {int((getattr(row, group).part == part).sum()) for row in own}
                assert (parts == part).sum() in counts


@pytest.mark.parametrize(
    ("to", "keys"), [("vecset", "sampling.sharp_points"), ("artgs", "images.views")]
)
def test_what_is_not_stored_is_left_out_and_said(plain, tmp_path, to, keys):
    with pytest.raises(InvalidArgument, match=rf"{to} can hold nothing .* {keys}"):
        ag.export(plain, to, tmp_path / "out")
