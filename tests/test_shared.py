"""Joints that different objects share, found from one pose of each: boxes whose motion is known."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from ppd_data import write_boxes

import articugen as ag
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import rotation_about
from articugen.core.records import Floats, JointKind
from articugen.discovery import Category, discover_shared
from articugen.discovery.alignment import Alignment, facing_of
from articugen.discovery.objects import _matched
from tests.shapes import box

ANGLES = np.radians([5.0, 100.0, 40.0, 75.0, 120.0, 20.0, 60.0, 90.0])


def plate(size: Floats, centre: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Points (900, 3) of a box, and their normals."""
    mesh = box(size.tolist(), centre.tolist())
    face = rng.choice(len(mesh.faces), 900, p=mesh.area_faces / mesh.area)
    shares = rng.dirichlet(np.ones(3), 900)
    return np.einsum("nc,ncd->nd", shares, mesh.vertices[mesh.faces[face]]), mesh.face_normals[face]


def in_unit_frame(cloud: Floats) -> tuple[Floats, float, Floats]:
    middle, size = 0.5 * (cloud.min(0) + cloud.max(0)), float(np.ptp(cloud, axis=0).max())
    return (cloud - middle) / size, size, middle


def lids(angles: Floats = ANGLES) -> tuple[list[Floats], list[Floats], Floats]:
    """Clouds and normals of bases, each with other edges, under lids that turn about the upper edge
    at the back; and where those edges are, each in its unit frame."""
    rng, clouds, normals, hinges = np.random.default_rng(0), [], [], []
    for angle in angles:
        size = np.array([0.7, 1.0, 0.2]) * rng.uniform(0.75, 1.25, 3)
        base, up = plate(size, np.zeros(3), rng)
        thick = np.array([size[0], size[1], 0.04])
        hinge = np.array([0.5 * size[0], 0.0, 0.5 * size[2]])
        lid, out = plate(thick, np.array([0.0, 0.0, 0.5 * size[2] + 0.02]), rng)
        R = rotation_about(np.array([0.0, 1.0, 0.0]), angle)
        cloud, scale, middle = in_unit_frame(np.concatenate([base, (lid - hinge) @ R.T + hinge]))
        clouds.append(cloud)
        normals.append(np.concatenate([up, out @ R.T]))
        hinges.append((hinge - middle) / scale)
    return clouds, normals, np.array(hinges)


@pytest.fixture(scope="module")
def laptops() -> Category:
    clouds, normals, _ = lids()
    return discover_shared(clouds, normals)


def test_bases_of_other_edges_come_to_lie_on_one_another() -> None:
    clouds, normals, _ = lids()
    stretch, shift, agreement = Alignment(clouds, [facing_of(ways) for ways in normals]).best()
    bases = [c[:900] * a + b for c, a, b in zip(clouds, stretch, shift, strict=True)]
    faces = np.array([[base.min(0), base.max(0)] for base in bases])
    assert np.abs(faces - np.median(faces, axis=0)).mean() < 0.02
    assert np.abs(np.log(stretch).mean(0)).max() < 0.1  # on the whole nothing shrinks
    assert np.all((agreement > 0.4) & (agreement <= 1.0))


def test_lids_of_different_objects_share_a_hinge(laptops: Category) -> None:
    joint = laptops.joints[0]
    assert joint.kind is JointKind.REVOLUTE
    assert joint.axis.tolist() == [0.0, 1.0, 0.0]
    off = np.linalg.norm((joint.pivot - lids()[2])[:, [0, 2]], axis=1)
    assert np.median(off) < 0.06
    assert abs(np.corrcoef(joint.states, ANGLES)[0, 1]) > 0.97
    assert joint.states.min() == 0.0
    one = joint.of(3)
    assert one.pivot.tolist() == joint.pivot[3].tolist()
    truth = np.repeat([0, 1], 900)
    right = [(part == truth).mean() for part in laptops.part]
    assert np.mean(right) > 0.8


def test_the_same_clouds_give_the_same_joints(laptops: Category) -> None:
    clouds, normals, _ = lids()
    again = discover_shared(clouds, normals)
    assert np.array_equal(again.joints[0].states, laptops.joints[0].states)
    assert all(np.array_equal(a, b) for a, b in zip(again.part, laptops.part, strict=True))


def test_objects_that_agree_all_over_have_no_joint() -> None:
    clouds, normals, _ = lids(np.full(8, 1.2))
    found = discover_shared([clouds[0]] * 8, [normals[0]] * 8)
    assert found.joints == ()
    assert found.doubtful is None
    assert np.concatenate(found.part).max() == 0


def test_what_cannot_be_searched_is_refused() -> None:
    clouds, normals, _ = lids()
    with pytest.raises(InvalidArgument, match=r"5 objects say little .* give 6 or more"):
        discover_shared(clouds[:5], normals[:5])
    with pytest.raises(InvalidArgument, match="normals are not one for each point"):
        discover_shared(clouds, [*normals[:7], normals[7][:9]])
    with pytest.raises(InvalidArgument, match="pose 2: has 9 points, too few"):
        discover_shared([*clouds[:2], clouds[2][:9], *clouds[3:]], normals)


def test_objects_may_have_more_joints_than_they_share() -> None:
    """The second joint of some object is none of the category's."""
    found, true = np.array([1, 1, 1, 0, 0]), np.array([1, 1, 2, 2, 0], np.uint8)
    assert _matched(found, 1, true, 1) == {0: 0}


def test_the_command_judges_what_a_data_set_shares(tmp_path: Path) -> None:
    data = write_boxes(tmp_path / "boxes", train=6, test=0, states=1)
    done = run("discover", data, "--shared", "--json", tmp_path / "j")
    assert done.exit_code == 0, done.output
    words = " ".join(done.output.split())
    assert "in 6 objects" in words
    numbers = json.loads((tmp_path / "j").read_text())
    assert len(numbers["objects"]) == len(numbers["stretch"]) == 6
    hinge, rows = numbers["joints"][0], [list(ag.open(data).of(o))[-1] for o in numbers["objects"]]
    true = [row.joints[0] for row in rows]
    off = np.array(hinge["pivots"]) - [one.pivot for one in true]
    away = np.linalg.norm(np.cross(off, [one.axis for one in true]), axis=1)
    states = abs(np.corrcoef(hinge["states"], [one.state_unit for one in true])[0, 1])
    assert hinge["judged"]["axis"] == pytest.approx(0.0, abs=1e-4)
    assert hinge["judged"]["pivot"] == pytest.approx(np.median(away), abs=1e-6)
    assert abs(hinge["judged"]["states"]) == pytest.approx(states)
    assert states > 0.9
    assert f"pivot off by {np.median(away):.3f}" in words
    few = run("discover", write_boxes(tmp_path / "few", train=2, test=0, states=1), "--shared")
    assert few.exit_code == 1
    assert "2 objects say little" in few.output
    np.save(tmp_path / "a.npy", np.zeros((99, 3)))
    files = run("discover", tmp_path / "a.npy", "--shared")
    assert "--shared: give one data set's folder or shard" in " ".join(files.output.split())
    both = run("discover", data, "--shared", "--groups")
    assert both.exit_code == 1
    assert "ask one at a time" in " ".join(both.output.split())
    for choice in ("--view", "--poses"):
        done = run("discover", data, "--shared", choice, 2)
        assert "take neither --view nor --poses" in " ".join(done.output.split())
