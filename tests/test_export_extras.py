"""Formats that need more than the default samples, read as their loaders read them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_extras import ASKING, SLIDE

import articugen as ag
from articugen.errors import InvalidArgument


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


def test_vecset_as_doras_loader_reads_it(bolts, rows, tmp_path):
    ag.export(bolts, "vecset", tmp_path / "v")
    for split in rows.splits:
        paths = json.loads((tmp_path / "v" / f"{split}.json").read_text())
        assert len(paths) == len(rows.split(split))
        for path, row in zip(paths, rows.split(split), strict=True):
            data = np.load(tmp_path / "v" / path)
            coarse = data["fps_coarse_surface"][:, 0, :]
            sharp = data["fps_sharp_surface"][:, 0, :]
            np.testing.assert_allclose(coarse[:, :3], 2 * row.surface.points, atol=1e-7)
            np.testing.assert_allclose(sharp[:, :3], 2 * row.sharp.points, atol=1e-7)
            np.testing.assert_array_equal(sharp[:, 3:], row.sharp.normals)
            near, edges = data["rand_points"], data["sharp_near_surface"]
            assert (len(near), len(edges)) == (300 + 500, 200)
            assert near.dtype == np.float32
            np.testing.assert_allclose(edges[:, :3], 2 * row.near.points[300:], atol=1e-7)
            # its occupancy, and its truncated distance, both above 0 inside
            occupied = np.where(near[:, 3] < 0, 0, 1)
            label = np.concatenate([row.near.label[:300], row.uniform.label])
            clear = np.abs(near[:, 3]) > 1e-6
            np.testing.assert_array_equal(occupied[clear], label[clear] > 0)
            truncated = near[:, 3].clip(-0.015, 0.015) / 0.015
            far = np.concatenate([row.near.distance[:300], row.uniform.distance])
            np.testing.assert_allclose(truncated, (-2 * far).clip(-0.015, 0.015) / 0.015)


def readers_camera(frame):
    """(R, T) as ArtGS's reader makes them of a frame: x_camera = R^T x + T, y down, z forward."""
    c2w = np.array(frame["transform_matrix"])
    c2w[:3, 1:3] *= -1
    w2c = np.linalg.inv(c2w)
    return np.transpose(w2c[:3, :3]), w2c[:3, 3]


def test_artgs_as_its_reader_reads_it(bolts, rows, tmp_path):
    ag.export(bolts, "artgs", tmp_path / "a")
    for object_id, own in rows.by_object():
        folder = tmp_path / "a" / own[0].split / object_id
        shown = {"start": own[0], "end": max(own, key=lambda row: row.joints[0].state)}
        for (word, row), time in zip(shown.items(), (0.0, 1.0), strict=True):
            counts = {}
            for split in ("train", "test"):
                told = json.loads((folder / f"transforms_{split}_{word}.json").read_text())
                counts[split] = len(told["frames"])
                for frame in told["frames"]:
                    assert frame["time"] == time
                    check_frame(folder, frame, told, row)
            assert counts == {"train": 8, "test": 1}


def check_frame(folder, frame, told, row):
    """Depths that are seen lie on the surface, where its cameras put them."""
    path = folder / frame["file_path"]
    rgba = np.array(Image.open(path).convert("RGBA"))
    depth = np.array(Image.open(str(path).replace("rgba", "depth"))) / 1e3
    assert depth.shape == rgba.shape[:2] == (48, 48)
    np.testing.assert_array_equal(rgba[..., 3] > 127, depth > 0)
    R, T = readers_camera(frame)
    i, j = np.nonzero(depth)
    z = depth[i, j]
    half = np.tan(told["camera_angle_x"] / 2), np.tan(told["camera_angle_y"] / 2)
    x, y = ((k + 0.5) / 24 - 1.0 for k in (j, i))
    points = (np.stack([x * half[0] * z, y * half[1] * z, z], axis=1) - T) @ R.T
    metres = row.to_metres(points)
    bolt = [0.4 - row.joints[0].state, 0.0, 0.0]
    solids = ((np.zeros(3), [0.1, 0.2, 0.2]), (bolt, [0.1, 0.05, 0.05]))
    off = [np.abs(np.abs(metres - middle) - half).min(axis=1) for middle, half in solids]
    inside = [(np.abs(metres - middle) < np.add(half, 2e-3)).all(axis=1) for middle, half in solids]
    on_surface = np.any(
        [near & (far < 2e-3) for near, far in zip(inside, off, strict=True)], axis=0
    )
    assert on_surface.mean() > 0.99
    assert len(z) > 100


def test_particulate_has_its_half_of_sharp_points(bolts, rows, tmp_path):
    ag.export(bolts, "particulate", tmp_path / "p")
    for object_id, own in rows.by_object():
        data = np.load(tmp_path / "p" / own[0].split / f"{object_id}.npz")
        sharp = data["point_from_sharp"]
        assert (sharp.sum(), (~sharp).sum()) == (400, 1000)
        assert data["normals"].shape == data["points"].shape
        np.testing.assert_array_equal(data["point_to_bone"][sharp], own[0].sharp.part)


@pytest.mark.parametrize(
    ("to", "keys"), [("vecset", "sampling.sharp_points"), ("artgs", "images.views")]
)
def test_what_is_not_stored_is_left_out_and_said(plain, tmp_path, to, keys):
    with pytest.raises(InvalidArgument, match=rf"{to} can hold nothing .* {keys}"):
        ag.export(plain, to, tmp_path / "out")
