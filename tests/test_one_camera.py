"""Joints from what one camera each sees of boxes whose motion is known."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from test_discovery import BODY, Motion, degrees_between, line_distance, sampled, turn

import articugen as ag
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import apply, invert_rigid, transform
from articugen.core.records import Floats, JointKind
from articugen.discovery import KINDS, discover_views
from articugen.discovery.clouds import change
from articugen.discovery.discover import Finder
from articugen.discovery.objects import discover_all
from articugen.discovery.one_camera import _Exact, _Fit
from articugen.discovery.search import Candidate
from articugen.discovery.views import Sight

LID, HINGE = ((0.4, 0.5, 0.03), (-0.2, 0.0, 0.265)), turn((0.0, 1.0, 0.0), (-0.4, 0.0, 0.25))
DOOR = ((0.03, 0.5, 0.5), (0.015, 0.0, 0.0))
STATES = -np.array([0.1, 1.3, 0.5, 1.6, 0.8, 0.3, 1.1])


def hidden(points: Floats, eye: Floats, box: tuple[Floats, Floats], T: Floats) -> np.ndarray:
    """Say of each point whether a moved box stands before it, by where lines enter and leave it."""
    back = invert_rigid(T)
    a, b = apply(back, eye), apply(back, points)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.array([-0.5, 0.5])[:, None, None] * box[0] + box[1] - a) / (b - a)
    enters, leaves = np.nanmax(ends.min(0), axis=1), np.nanmin(ends.max(0), axis=1)
    return (enters < np.minimum(leaves, 1.0)) & (enters < 0.995) & (leaves > 0.0)


def seen(eye: Floats, T: Floats, rng: np.random.Generator, part: Any = LID, *more: Any) -> Floats:
    """Points of the body, of a part at T and of others (box, T) that nothing hides."""
    boxes = [(BODY, np.eye(4)), (part, T), *more]
    points = np.concatenate([apply(M, sampled(*shape, rng, 5000)) for shape, M in boxes])
    for (size, centre), M in boxes:
        points = points[~hidden(points, eye, (np.array(size), np.array(centre)), M)]
    return points


def views(motion: Motion, eyes: Floats, part: Any = LID) -> list[Floats]:
    rng = np.random.default_rng(0)
    return [seen(eye, motion(state), rng, part) for state, eye in zip(STATES, eyes, strict=True)]


def around(count: int, back: float = 0.0) -> Floats:
    """Places at a distance of 2, above and to the front, or `back` from there, in radians."""
    side = np.linspace(-0.9, 0.9, count) + back
    return 2.0 * np.stack([np.cos(side), np.sin(side), np.full(count, 0.8)], axis=1)


def test_free_is_what_a_camera_sees_through() -> None:
    rng, eye = np.random.default_rng(1), around(1)[0]
    T = HINGE(-0.8)
    sight = Sight.of([seen(eye, T, rng)], eye[None])
    places = rng.uniform(-0.6, 0.6, (20000, 3))
    before = [hidden(places, eye, (np.array(s), np.array(c)), M) for (s, c), M in
              [(BODY, np.eye(4)), (LID, T)]]  # fmt: skip
    free = sight.free(places)[0]
    assert not (free & (before[0] | before[1])).mean() > 0.01  # but for what is cut by an edge
    assert free[~(before[0] | before[1])].mean() > 0.85  # what is close to a surface is not sure
    of_each = Sight.of([sight_cloud := seen(eye, T, rng)] * 2, np.tile(eye, (2, 1)))
    both = of_each.free(np.stack([places, places[::-1]]))
    np.testing.assert_array_equal(both[0], both[1][::-1])
    assert not of_each[1:].free(sight_cloud).any()


def test_a_lid_is_found_whatever_side_of_it_is_seen() -> None:
    eyes = around(len(STATES))
    found = discover_views(views(HINGE, eyes), eyes)
    (lid,) = found.joints
    assert lid.kind == JointKind.REVOLUTE
    assert degrees_between(lid.axis * np.sign(lid.axis[1]), (0.0, 1.0, 0.0)) < 2.0
    assert line_distance(found, 0, lid.axis, (-0.4, 0.0, 0.25)) < 0.015
    known = np.isfinite(lid.states)
    assert known.sum() >= 3
    assert known[found.reference]
    truth = np.sign(lid.axis[1]) * (STATES - STATES[found.reference])
    np.testing.assert_allclose(lid.states[known], truth[known], atol=0.03)
    moved = found.points[found.part == 1]
    there = apply(invert_rigid(HINGE(STATES[found.reference])), moved)
    assert (there[:, 2] > 0.24).mean() > 0.95  # of the lid
    assert len(moved) > 500


def test_a_door_is_found_in_the_order_of_the_clouds() -> None:
    eyes = around(len(STATES), back=0.4)
    motion = turn((0.0, 0.0, 1.0), (0.0, -0.25, 0.0))
    found = discover_views(views(motion, eyes, DOOR), eyes, kinds=[JointKind.REVOLUTE])
    (door,) = found.joints
    assert degrees_between(door.axis * np.sign(door.axis[2]), (0.0, 0.0, 1.0)) < 2.0
    known = np.isfinite(door.states)
    assert known.sum() >= 3
    truth = np.sign(door.axis[2]) * (STATES - STATES[found.reference])
    np.testing.assert_allclose(door.states[known], truth[known], atol=0.03)
    assert door.states[found.reference] == 0.0


def with_a_drawer(eyes: Floats, *, slides: bool) -> list[Floats]:
    """Views of a lid that turns and a drawer below it, which may slide, too."""
    rng, drawer = np.random.default_rng(0), ((0.4, 0.4, 0.3), (-0.18, 0.0, -0.05))
    slid = [transform(translation=(slides * (0.17 * k % 0.5), 0, 0)) for k in range(len(STATES))]
    posed = zip(eyes, STATES, slid, strict=False)
    return [seen(eye, HINGE(q), rng, LID, (drawer, T)) for eye, q, T in posed]


def test_a_lid_alone_is_refused_where_a_drawer_slides_too() -> None:
    eyes = around(len(STATES))[:4]
    clouds = with_a_drawer(eyes, slides=True)
    with pytest.raises(InvalidArgument, match="more moves than the joints that are found explain"):
        discover_views(clouds, eyes, kinds=[JointKind.REVOLUTE])


@pytest.mark.parametrize("slides", [False, True])
def test_what_the_true_hinge_leaves_unexplained_is_the_drawers(slides: bool) -> None:
    eyes, shares = around(len(STATES)), []
    clouds = with_a_drawer(eyes, slides=slides)
    for first in (0, 2):  # the drawer is shut, and what it shows elsewhere is new; it is open
        order = np.roll(np.arange(len(STATES)), -first)
        diff = change([clouds[k] for k in order], cameras=eyes[order])
        pivot, states = diff.frame.to_unit(np.array([-0.4, 0.0, 0.25])), STATES[order]
        hinge = Candidate(True, np.array([0.0, 1.0, 0.0]), pivot, states[1:] - states[0])
        fits = [_Fit(hinge, np.ones(len(STATES) - 1, np.bool_), np.ones(len(STATES) - 1))]
        exact = _Exact(diff, eyes[order])
        shares.append((exact._lost(Finder(diff, KINDS, {}), fits), exact._strange(fits)))
    if slides:
        assert shares[0][1] > 0.15
        assert shares[1][0] > 0.3
    else:
        assert np.max(shares) < 0.01


def test_what_is_never_seen_twice_is_refused() -> None:
    eyes = np.array([[1.6, 0.0, 1.6], [-1.6, 0.0, -1.6]])
    clouds = [seen(eye, HINGE(q), np.random.default_rng(0))
              for eye, q in zip(eyes, (0.0, -1.5), strict=True)]  # fmt: skip
    with pytest.raises(InvalidArgument, match=r"no joint is found .*give more views, or whole"):
        discover_views(clouds, eyes)
    with pytest.raises(InvalidArgument, match=r"cameras of shape \(1, 3\) are no places"):
        discover_views(clouds, eyes[:1])
    with pytest.raises(InvalidArgument, match=r"cameras that are no numbers"):
        discover_views(clouds, eyes * np.nan)
    with pytest.raises(InvalidArgument, match="1 pose of the object"):
        discover_views(clouds[:1], eyes[:1])
    with pytest.raises(InvalidArgument, match="leave out `normals`"):
        ag.discover(clouds, normals=clouds, cameras=eyes)
    with pytest.raises(InvalidArgument, match=r"cameras of shape \(2, 2\) are no places"):
        ag.discover(clouds, cameras=eyes[:, :2])


def test_views_of_a_data_set_are_judged_by_its_truth(tmp_path: Path) -> None:
    changes = ["sampling.partial_views=2", "sampling.partial_points=3000"]
    ag.generate("oven", out=tmp_path, recipe="quick", objects=1, states=7, changes=changes, jobs=0)
    (one,) = discover_all(tmp_path / "oven", view=1)
    assert one.found is not None
    assert one.judged.axis
    assert one.judged.states
    printed = run("discover", tmp_path / "oven", "--view", 1, "--json", tmp_path / "j.json")
    assert "of 8" in printed.output
    assert "null" in (tmp_path / "j.json").read_text()
    refused = run("discover", tmp_path / "oven", "--view", 2)
    assert refused.exit_code
    assert "view 2 is none of the 2" in refused.output
