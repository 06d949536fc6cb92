"""Joints that hang on moving parts, found from poses of boxes whose motion is known."""

from collections.abc import Sequence

import numpy as np

import articugen as ag
from articugen.cli.discover import _table
from articugen.core.geometry import apply
from articugen.core.records import Floats
from articugen.discovery import discover, discover_chains
from articugen.discovery.objects import as_json
from tests.shapes import box
from tests.test_discovery import Motion, turn

Link = tuple[Sequence[float], Sequence[float], Motion]
"""The size and the middle of a box in pose 0, and how a joint moves it and all that hangs on it."""

BASE = (0.4, 0.4, 0.06), (0.0, 0.0, 0.03)
ARM = (0.06, 0.06, 0.4), (0.0, 0.08, 0.3), turn((0, 1, 0), (0, 0, 0.12))
FOREARM = (0.4, 0.06, 0.06), (0.2, 0.16, 0.47), turn((0, 1, 0), (0, 0, 0.47))
HAND = (0.06, 0.06, 0.3), (0.37, 0.24, 0.4), turn((1, 0, 0), (0, 0.16, 0.47))

COUNT = 500  # points of a box
DRAWN = np.random.default_rng(1).uniform(-1.0, 1.0, (9, 3)) * (0.7, 0.8, 0.9)
STATES = np.concatenate([np.zeros((1, 3)), DRAWN])


def moved(links: Sequence[Link], states: Floats) -> list[Floats]:
    """What moves each box from pose 0: each hangs on the one before."""
    T = [np.eye(4)]
    for (_, _, motion), state in zip(links, states, strict=False):
        T.append(T[-1] @ motion(float(state)))
    return T


def posed(links: Sequence[Link], states: Floats) -> tuple[list[Floats], list[Floats]]:
    """Clouds and normals of a base and links, each box drawn anew in each pose."""
    clouds, normals = [], []
    for k, row in enumerate(states):
        points, ways = [], []
        shapes = [BASE, *(link[:2] for link in links)]
        for n, (shape, T) in enumerate(zip(shapes, moved(links, row), strict=True)):
            mesh = box(*shape)
            some, face = mesh.sample(COUNT, return_index=True, seed=10 * k + n)
            points.append(apply(T, some))
            ways.append(mesh.face_normals[face] @ T[:3, :3].T)
        clouds.append(np.concatenate(points))
        normals.append(np.concatenate(ways))
    return clouds, normals


def test_parts_hang_on_those_before_and_move_as_they_do_whatever_way_all_is_turned() -> None:
    links = (ARM, FOREARM, HAND)
    R = turn((1, 2, 3), (0, 0, 0))(0.8)
    clouds, normals = ([some @ R[:3, :3].T for some in both] for both in posed(links, STATES))
    found = ag.discover(clouds, normals=normals)
    assert [joint["parent"] for joint in as_json(found)] == [0, 1, 2]
    assert list(_table(found.joints).columns[0].cells)[1:] == ["revolute on 1", "revolute on 2"]
    for pose, row in enumerate(STATES):
        for n, (now, true) in enumerate(zip(found.motion(pose), moved(links, row), strict=True)):
            points = clouds[0][COUNT * n : COUNT * (n + 1)]
            off = np.linalg.norm(apply(now, points) - apply(R @ true @ R.T, points), axis=1)
            assert off.max() < 0.02
    for joint, axis in zip(found.joints, np.eye(3)[[1, 1, 0]], strict=True):
        assert abs(joint.axis @ R[:3, :3] @ axis) > 0.999
    assert np.mean(found.part == np.repeat(np.arange(4), COUNT)) > 0.95


def test_few_poses_show_no_chain() -> None:
    clouds, normals = posed((ARM, FOREARM), STATES[:4])
    found = discover_chains(clouds, normals=normals)
    plain = discover(clouds, normals=normals)
    assert {joint.parent for joint in found.joints} == {0}
    for one, other in zip(found.joints, plain.joints, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
