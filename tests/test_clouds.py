"""Clouds from files: every format gives the same points, and each fault is said in a sentence."""

import io
import os
import zipfile

import numpy as np
import pytest
import trimesh

from articugen.core.errors import CorruptShard, InvalidSource
from articugen.core.records import dequantize
from articugen.learning.predict import cloud_of_shard
from articugen.meshes.points import LONGEST_EDGE, MOST_BYTES, cloud_of_file
from articugen.store.shards import open_shard

BOXES = {"train": 1, "test": 1, "states": 1}


def points(count: int = 200, size: float = 0.9) -> np.ndarray:
    return np.random.default_rng(0).uniform(-size / 2, size / 2, (count, 3))


def written(folder, suffix: str, cloud: np.ndarray):
    path = folder / f"cloud{suffix}"
    if suffix == ".ply":
        trimesh.PointCloud(cloud).export(path)
    elif suffix == ".npy":
        np.save(path, cloud)
    elif suffix == ".npz":
        np.savez(path, points=cloud, colour=np.zeros(3))
    elif suffix == "0.npz":
        np.savez(path, cloud)
    else:
        np.savetxt(path, np.hstack([cloud, np.ones_like(cloud)]))  # normals follow
    return path


def in_order(cloud: np.ndarray) -> np.ndarray:
    return cloud[np.lexsort(cloud.T)]


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".npz", "0.npz", ".xyz"])
def test_every_format_gives_the_same_points(tmp_path, suffix):
    path = written(tmp_path, suffix, points())
    cloud = cloud_of_file(path)
    np.testing.assert_allclose(in_order(cloud.points), in_order(points()), atol=1e-7)
    assert not np.allclose(cloud.points, points(), atol=1e-3)  # files have an order, this has none
    np.testing.assert_array_equal(cloud.points, cloud_of_file(path).points)
    assert (cloud.hint, cloud.frame.scale) == ("", 1.0)


def test_ascii_ply_with_more_properties(tmp_path):
    head = ["ply", "format ascii 1.0", "element vertex 70"]
    head += [f"property float {name}" for name in "xyz"]
    head += [f"property uchar {name}" for name in ("red", "green", "blue")] + ["end_header"]
    rows = [f"{x} {y} {z} 1 2 3" for x, y, z in points(70)]
    (tmp_path / "c.ply").write_text("\n".join(head + rows) + "\n")
    cloud = cloud_of_file(tmp_path / "c.ply").points
    np.testing.assert_allclose(in_order(cloud), in_order(points(70)), atol=1e-6)


def test_a_mesh_gives_points_on_its_surface(tmp_path):
    trimesh.creation.box([0.8, 0.8, 0.8]).export(tmp_path / "box.ply")
    cloud = cloud_of_file(tmp_path / "box.ply").points
    np.testing.assert_allclose(np.abs(cloud).max(1), 0.4, atol=1e-6)
    assert len(cloud) == 8192


def test_fit_brings_a_foreign_frame_to_the_unit_frame_and_back(tmp_path):
    foreign = 30.0 * points() + [100.0, 0.0, -50.0]
    path = written(tmp_path, ".npy", foreign)
    with pytest.raises(InvalidSource, match=r"beyond the unit frame.*--fit brings it there"):
        cloud_of_file(path)
    cloud = cloud_of_file(path, fit=True)
    size = np.ptp(cloud.points, axis=0)
    assert size.max() == pytest.approx(LONGEST_EDGE)
    np.testing.assert_allclose(cloud.points.min(0) + cloud.points.max(0), 0.0, atol=1e-9)
    back = cloud.frame.to_world(cloud.points)
    np.testing.assert_allclose(in_order(back), in_order(foreign), atol=1e-9)


@pytest.mark.parametrize("wrong", [0.1 * points(), 0.3 * points() + 0.3])
def test_a_frame_that_looks_wrong_is_hinted_at(tmp_path, wrong):
    path = written(tmp_path, ".ply", wrong)
    assert "--fit if its frame is another" in cloud_of_file(path).hint
    assert cloud_of_file(path, fit=True).hint == ""


def spoilt() -> np.ndarray:
    cloud = points()
    cloud[[3, 7], 1] = np.nan, np.inf
    return cloud


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".npz", ".xyz"])
@pytest.mark.parametrize(
    ("cloud", "said"),
    [
        (points(10), "has 10 points, too few to say anything; give 64 or more"),
        (spoilt(), "2 points are not finite numbers; remove them"),
    ],
)
@pytest.mark.parametrize("fit", [False, True])
def test_bad_clouds_are_refused(tmp_path, suffix, cloud, said, fit):
    with pytest.raises(InvalidSource, match=said):
        cloud_of_file(written(tmp_path, suffix, cloud), fit=fit)


def npy_of(dtype: str, shape: tuple[int, ...]) -> bytes:
    """A file that claims to hold such an array, and ends there."""
    file = io.BytesIO()
    about = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, about)
    return file.getvalue()


def test_files_that_are_no_clouds_are_refused(tmp_path):
    whole = written(tmp_path, ".ply", points()).read_bytes()
    np.savez(tmp_path / "other.npz", vertices=points())
    np.savez(tmp_path / "runs.npz", np.array({"pc": print}, dtype=object))
    np.savez(tmp_path / "texts.npz", np.array({"pc": np.array(["a"])}, dtype=object))
    view = {"pc": points(), "detection": np.ones(200), "segmentation": np.ones(200)}
    np.savez(tmp_path / "skew.npz", np.array(view | {"part": np.ones((2, 15))}, dtype=object))
    np.save(tmp_path / "flat.npy", np.zeros(300))
    np.save(tmp_path / "one.npy", np.zeros((100, 3)))
    np.save(tmp_path / "code.npy", np.array([print]), allow_pickle=True)
    (tmp_path / "cut.ply").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "lies.ply").write_bytes(whole.replace(b"vertex 200", b"vertex 2000000000"))
    (tmp_path / "text.ply").write_text("hello")
    (tmp_path / "words.xyz").write_text("a b c\n")
    (tmp_path / "cloud.txt").write_text("0 0 0\n")
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "bomb.npy").write_bytes(npy_of("<f8", (1 << 40, 3)))
    (tmp_path / "texts.npy").write_bytes(npy_of("<U9", (0, 3)))
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(MOST_BYTES + 1))
    with zipfile.ZipFile(tmp_path / "rare.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("points.npy", npy_of("<f8", (0, 3)))
    os.mkfifo(tmp_path / "fifo.npy")
    (tmp_path / "large.npy").touch()
    os.truncate(tmp_path / "large.npy", MOST_BYTES + 1)
    for name, said in {
        "bomb.npy": "its header does not fit its size",
        "texts.npy": "holds no numbers",
        "bomb.npz": "unpacks to too much",
        "rare.npz": "packed in an unusual way",
        "fifo.npy": "it is a FIFO, not a regular file",
        "large.npy": "more than the",
        "other.npz": "no array named points, only vertices",
        "runs.npz": "asks for [a-z]*.print",
        "texts.npz": "holds U1, no numbers",
        "skew.npz": "no rotation",
        "flat.npy": r"shape \(300,\), not points \(n, 3\)",
        "code.npy": "broken",
        "cut.ply": "broken",
        "lies.ply": "broken.*its PLY header claims more than",
        "text.ply": "broken.*has no PLY header",
        "words.xyz": "broken",
        "cloud.txt": r"neither a shard \(.h5\) nor points \(.ply, .npy, .npz, .xyz\)",
        "none.ply": "cannot be read",
        "folder.ply": "cannot be read",
    }.items():
        with pytest.raises(InvalidSource, match=f"{name}: .*{said}"):
            cloud_of_file(tmp_path / name)
    with pytest.raises(InvalidSource, match="all its points are one"):
        cloud_of_file(tmp_path / "one.npy", fit=True)


def test_a_shard_gives_its_instances_and_what_its_cameras_see(boxes):
    path = boxes / "test-00001.h5"
    with open_shard(path) as shard:
        instance = shard.instance(1)
    cloud = cloud_of_shard(path, 1, category="box")
    np.testing.assert_array_equal(cloud.points, dequantize(instance.surface_points))
    seen = cloud_of_shard(path, 1, camera=1)
    np.testing.assert_array_equal(seen.points, dequantize(instance.partial_points[1]))
    for options, said in (
        ({"row": 2}, "has 2 instances, from 0; there is no 2"),
        ({"category": "oven"}, "holds box, the model is of oven"),
        ({"camera": 2}, "has 2 cameras, from 0; there is no 2"),
    ):
        with pytest.raises(InvalidSource, match=said):
            cloud_of_shard(path, **options)
    with pytest.raises(CorruptShard, match="cannot be opened"):
        cloud_of_shard(boxes / "none.h5")
