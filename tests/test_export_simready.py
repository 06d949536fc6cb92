"""Exports for simulators at work: joints that rest, give way and stop; NVIDIA's own validator."""

import re
import subprocess
import sys
from functools import cache

import exports
import numpy as np
import pytest
import trimesh
from exports import MESHES
from instances import LOWER, UPPER
from PIL import Image

import articugen as ag

BOXES, rows, exported = exports.BOXES, exports.rows, exports.exported


@pytest.fixture(scope="module")
def models(laptops, tmp_path_factory):
    """The folder of the laptops in a format, with convex pieces, written once."""
    out = tmp_path_factory.mktemp("models")
    return cache(lambda to: ag.export(laptops, to, out / to, collision=True, resolution=64).folder)


def test_a_lid_rests_opens_by_a_push_and_stays_within_its_limits(models):
    """2,000 steps at rest; pushed by half its friction, by twice, by ten times to the stops."""
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    paths = sorted(models("mjcf").glob("*/*/*.xml"))
    assert len(paths) == 2
    for path in paths:
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        (low, high), (friction,) = model.jnt_range[0], model.dof_frictionloss

        def moved(push: float, steps: int, model=model, data=data) -> np.ndarray:
            """The lid's angle at each step, from rest, when pushed so besides its weight."""
            mujoco.mj_resetData(model, data)
            angles = []
            for _ in range(steps):
                mujoco.mj_forward(model, data)
                data.qfrc_applied[:] = push + (data.qfrc_bias if push else 0.0)
                mujoco.mj_step(model, data)
                angles.append(data.qpos[0])
            return np.array(angles)

        rest = moved(0.0, 2000)
        assert np.abs(rest).max() < 0.002
        assert abs(rest[-1] - rest[1000]) < 1e-4
        assert np.abs(moved(0.5 * friction, 1000)).max() < 0.002
        assert moved(2.0 * friction, 1000)[-1] > 0.5
        for push in (10.0 * friction, -10.0 * friction):
            angles = moved(push, 2000)
            assert low - 0.05 < angles.min()
            assert angles.max() < high + 0.05


def test_usd_states_what_simready_wants_to_know(exported, rows):
    pytest.importorskip("pxr", reason="make exporters installs it")
    from pxr import Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdShade  # noqa: PLC0415

    row = rows[0]
    path = exported("usd", **MESHES) / row.split / row.object_id / "usd" / f"{row.object_id}.usdc"
    stage = Usd.Stage.Open(str(path))
    facts = stage.GetRootLayer().customLayerData["SimReady_Metadata"]
    assert (facts["asset_name"], facts["rigid_body_count"]) == (row.object_id, 3)
    assert (facts["category"], facts["qcode"]) == ("box", "Q188075")
    size = UPPER.max(axis=0) - LOWER.min(axis=0)
    np.testing.assert_allclose(facts["asset_extents"], size, atol=2 * row.scale / 64)
    volume = np.prod(UPPER - LOWER, axis=1).sum()
    assert facts["mass"] == pytest.approx(500 * volume, rel=0.25)
    for prim in (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)):
        mesh = UsdGeom.Mesh(prim)
        faces = np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3))
        truth = trimesh.Trimesh(mesh.GetPointsAttr().Get(), faces, process=False).face_normals
        np.testing.assert_allclose(mesh.GetNormalsAttr().Get(), truth, atol=1e-4)
        body = prim.GetParent()
        labels = UsdSemantics.LabelsAPI(body, "class").GetLabelsAttr().Get()
        assert list(labels) == [body.GetName()]  # the boxes' parts have no names
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        assert UsdPhysics.MaterialAPI(material.GetPrim()).GetStaticFrictionAttr().Get() == 0.5
    with Image.open(path.parent / ".thumbs" / "256x256" / f"{path.name}.png") as picture:
        assert picture.size == (256, 256)
        assert len(picture.getcolors(65536) or ()) > 100  # something is drawn


def test_usd_passes_nvidias_own_validator(models):
    pytest.importorskip("pxr", reason="make exporters installs it")
    why = "make exporters installs it, on Python 3.11 and 3.12"
    validate = pytest.importorskip("simready.validate", reason=why)
    paths = sorted(models("usd").glob("*/*/usd/*.usdc"))
    assert len(paths) == 2
    there = ("rules_and_requirements_paths", "features_paths", "profiles_paths")
    validate.initialize(**{name: [] for name in there})  # the installed ones
    for path in paths:
        for version in ("3.3.0", "4.0.0"):
            result = validate.validate_asset(
                validate.AssetValidationConfig(str(path), "Robotics-Prop", version)
            )
            blocking = {
                name: feature.get("requirement_messages")
                for name, feature in result.features_summary.items()
                if feature["blocking_failure"]
            }
            assert blocking == {}


def checked(folder, program, *arguments):
    """What one of the programs that check robots' models says, in no colours."""
    pytest.importorskip(program, reason="make exporters installs it")
    code = f"import sys; from {program}.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        check=True, capture_output=True, text=True, cwd=folder,
    )  # fmt: skip
    return re.sub(r"\x1b\[[0-9;]*m", "", done.stdout)


def test_programs_that_check_robots_find_nothing(models, tmp_path):
    for path in models("mjcf").glob("*/*/*.xml"):
        assert f"{path.name}  — clean" in checked(tmp_path, "mjcf_doctor", "check", path)
    paths = sorted(models("urdf").glob("*/*/*.urdf"))
    assert len(paths) == 2
    for path in paths:
        words = checked(tmp_path, "isaaclab_robot_doctor", "check", path)
        assert "0 errors, 0 warnings" in words
        words = checked(tmp_path, "urdf_validator_main", path, "--output-dir", tmp_path)
        assert re.search(r"\[OVERALL\] +PASS", words)
        assert "FAIL" not in words
