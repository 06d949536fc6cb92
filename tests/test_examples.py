"""examples/, run as anybody runs them: in an empty folder, by their own command lines."""

import importlib.util
import io
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yourdfpy
from python_process import printed

CHECKOUT = Path(__file__).resolve().parents[1]
LITTLE = """\
extends: quick
objects: 6
articulation: {states: 6}
views: {count: 30, resolution: 128}
sampling: {surface_points: 2048, uniform_points: 64, near_points: 64, partial_views: 0, grids: [8]}
"""


def run(name: str, folder: Path, *arguments: object) -> str:
    script = str(CHECKOUT / "examples" / f"{name}.py")
    own = {"PYTHONPATH": str(CHECKOUT)}
    return printed(script, *map(str, arguments), folder=folder, seconds=900, **own)


@pytest.mark.skipif(not importlib.util.find_spec("torch"), reason="torch is not installed")
def test_a_model_of_ones_own_learns_parts(tmp_path: Path) -> None:
    (tmp_path / "little.yaml").write_text(LITTLE)
    told = run("train_your_model", tmp_path, "--recipe", "little.yaml", "--iterations", 120)
    scores = {
        name: (float(accuracy), float(iou))
        for name, accuracy, iou in re.findall(r"(\w+): accuracy ([\d.]+), part IoU ([\d.]+)", told)
    }
    assert scores.keys() == {"baseline", "PointNet"}
    assert scores["PointNet"][0] > scores["baseline"][0] + 0.03
    assert scores["PointNet"][1] > scores["baseline"][1] + 0.05
    assert scores["PointNet"][1] > 0.85


def test_a_urdf_is_articulated_and_exported_to_four_formats(tmp_path: Path) -> None:
    told = run("articulate_and_export", tmp_path, "--states", 2, "--resolution", 64)
    made = tmp_path / "made"
    half = trimesh.load_mesh(made / "half_open.ply")
    assert half.is_watertight
    assert "half open: {'hinge': 0.9}" in told
    (path,) = made.glob("urdf/train/*/cabinet.urdf")
    robot = yourdfpy.URDF.load(str(path))
    limit = robot.joint_map["hinge"].limit
    assert (limit.lower, limit.upper) == (0.0, 1.8)
    door = trimesh.load_scene(next(made.glob("glb/train/*.glb"))).geometry["part_1"]
    np.testing.assert_allclose(sorted(door.extents), [0.02, 0.38, 0.56], atol=0.01)
    clouds = sorted(made.glob("ply/train/*.ply"))
    assert len(clouds) == 3
    assert len(trimesh.load(clouds[0]).vertices) == 8192
    with tarfile.open(next(made.glob("webdataset/*.tar"))) as tar:
        arrays = [
            np.load(io.BytesIO(tar.extractfile(member).read()))
            for member in tar
            if member.name.endswith(".npz")
        ]
    assert len(arrays) == 3
    assert arrays[0]["joint_state"] == 0.0
    assert all(0.0 < each["joint_state"][0] < 1.8 for each in arrays[1:])


def test_a_urdf_of_ones_own_with_another_name_goes_as_well(tmp_path: Path) -> None:
    (tmp_path / "mein schrank.urdf").write_text(
        '<robot name="s"><link name="wall"><visual><geometry><box size="0.1 0.4 0.4"/></geometry>'
        '</visual></link><link name="bolt"><visual><geometry><box size="0.2 0.1 0.1"/></geometry>'
        '</visual></link><joint name="slide" type="prismatic"><parent link="wall"/>'
        '<child link="bolt"/><origin xyz="0.2 0 0"/><axis xyz="1 0 0"/>'
        '<limit lower="0" upper="0.2" effort="1" velocity="1"/></joint></robot>'
    )
    asked = ("mein schrank.urdf", "--out", "elsewhere", "--states", 1, "--resolution", 48)
    told = run("articulate_and_export", tmp_path, *asked)
    assert "half open: {'slide': 0.1}" in told
    assert all(f"{name}: " in told for name in ("glb", "urdf", "ply", "webdataset"))
    assert not (tmp_path / "made").exists()
