"""Articulation against closed forms; forward kinematics against yourdfpy and SAPIEN."""

import importlib.util
import math
import time
from dataclasses import replace

import numpy as np
import pytest
import yourdfpy
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree
from real_models import REAL_MODELS, needs_real_models

from articugen.core.errors import InvalidSource, NotOfCategory, RejectedInstance
from articugen.core.geometry import apply, rotation_about, rotation_from_rpy, transform
from articugen.core.recipe import Articulation, Recipe
from articugen.core.records import (
    ArticulatedObject,
    Joint,
    JointKind,
    JointState,
    Link,
    Mesh,
    Mimic,
)
from articugen.instance.articulation import (
    canonical_state,
    forward_kinematics,
    part_motions,
    resolve,
    sample_joint_state,
)
from articugen.sources.urdf import load_urdf

NO_MESH = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
X, Y, Z = np.eye(3)


def joint(name, kind="revolute", *, parent="base", at=(0, 0, 0), axis=Z, limits=(0.0, 1.0), **more):
    """A joint `name` to a link of the same name."""
    T = at if np.shape(at) == (4, 4) else transform(translation=at)
    lower, upper = limits
    kind = JointKind[kind.upper()]
    return Joint(name, kind, parent, name, np.asarray(T), np.asarray(axis), lower, upper, **more)


def tree(*joints, semantics=None, T_world_root=None):
    """An object of a link `base` and one link a joint."""
    semantics = semantics or {}
    names = ["base", *(j.child for j in joints)]
    return ArticulatedObject(
        object_id="tree",
        category="test",
        links=tuple(Link(name, NO_MESH, semantics.get(name, "")) for name in names),
        joints=joints,
        T_world_root=np.eye(4) if T_world_root is None else T_world_root,
        sha256="",
    )


def child_at(obj, q, link=-1):
    """T_world_link of one link (the last one) with the moving joints at `q`."""
    return forward_kinematics(obj, JointState(np.array(q, float))).T_world_link[link]


def test_a_hinge_turns_points_about_its_axis():
    obj = tree(joint("lid", at=(1, 0, 0), axis=Y))
    moved = apply(child_at(obj, [math.pi / 2]), [-1, 0, 0])
    # Right-handed about +y: -x goes to +z, about the pivot at x = 1.
    np.testing.assert_allclose(moved, [1, 0, 1], atol=1e-15)


def test_a_slider_moves_along_its_axis():
    oblique = np.array([0.6, 0.0, 0.8])
    obj = tree(joint("box", "prismatic", at=(0, 2, 0), axis=oblique))
    np.testing.assert_allclose(child_at(obj, [0.5])[:3, 3], [0.3, 2, 0.4], atol=1e-15)
    pivots = forward_kinematics(obj, JointState(np.array([0.7]))).pivots
    np.testing.assert_array_equal(pivots, [[0, 2, 0]], "where it starts")


def test_a_chain_is_the_planar_two_link_arm():
    a, b = 0.3, -1.1
    obj = tree(
        joint("upper_arm", at=(0, 0, 0)),
        joint("forearm", parent="upper_arm", at=(2, 0, 0)),
        joint("hand", "fixed", parent="forearm", at=(1, 0, 0)),
    )
    posed = forward_kinematics(obj, JointState(np.array([a, b])))
    reach = [2 * math.cos(a) + math.cos(a + b), 2 * math.sin(a) + math.sin(a + b), 0]
    np.testing.assert_allclose(posed.T_world_link[3, :3, 3], reach, atol=1e-15)
    np.testing.assert_allclose(posed.pivots[1], [2 * math.cos(a), 2 * math.sin(a), 0], atol=1e-15)
    np.testing.assert_array_equal(obj.part_of_link, [0, 1, 2, 2])


def test_the_world_transform_carries_links_pivots_and_axes():
    T = transform(rotation_about(Z, math.pi / 2), (5, 0, 0))
    hinge = joint("lid", at=(1, 0, 0), axis=X)
    posed = forward_kinematics(tree(hinge, T_world_root=T), JointState(np.zeros(1)))
    np.testing.assert_allclose(posed.T_world_link[0], T)
    np.testing.assert_allclose(posed.T_world_part[0], T)
    np.testing.assert_allclose(posed.pivots, [[5, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(posed.axes, [[0, 1, 0]], atol=1e-15)


def test_forward_kinematics_changes_nothing():
    obj, state = tree(joint("lid")), JointState(np.array([0.4]))
    first = forward_kinematics(obj, state)
    forward_kinematics(obj, JointState(np.array([2.0])))
    np.testing.assert_array_equal(forward_kinematics(obj, state).T_world_link, first.T_world_link)


def test_a_state_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="2 joint values for 1 moving"):
        forward_kinematics(tree(joint("lid")), JointState(np.zeros(2)))


@given(st.floats(-3, 3), st.floats(-1, 1))
def test_part_motions_carry_the_canonical_pose_to_the_posed_one(angle, slide):
    T = transform(rotation_from_rpy((0.3, -0.2, 1.0)), (1, 2, 3))
    obj = tree(
        joint("door", at=T, axis=Y),
        joint("shelf", "prismatic", parent="door", at=(0.1, 0, 0), axis=X),
        T_world_root=T,
    )
    canonical = forward_kinematics(obj, canonical_state(obj))
    posed = forward_kinematics(obj, JointState(np.array([angle, slide])))
    motions = part_motions(posed, canonical)
    np.testing.assert_array_equal(motions[0], np.eye(4))
    point = np.array([0.2, -0.3, 0.4])
    for link, part in enumerate(obj.part_of_link):
        before = apply(canonical.T_world_link[link], point)
        after = apply(posed.T_world_link[link], point)
        np.testing.assert_allclose(apply(motions[part], before), after, atol=1e-12)
    # The door's own motion keeps its axis where it is.
    np.testing.assert_allclose(apply(motions[1], canonical.pivots[0]), canonical.pivots[0])


def only(obj, settings=None, **choices):
    """The one moving joint of the resolved object."""
    (moving,) = resolve(obj, settings or Articulation(), **choices).moving_joints
    return moving


def test_paper_protocol():
    """Hinges from 0 to 135 degrees, sliders up to their limit."""
    moving = only(tree(joint("box", "prismatic", limits=(-0.1, 0.5))))
    assert (moving.lower, moving.upper) == (0.0, 0.5)
    moving = only(tree(joint("lid", limits=(0.0, 1.0))), Articulation(clip_to_limits=False))
    assert (moving.lower, moving.upper) == (0.0, pytest.approx(math.radians(135)))
    np.testing.assert_array_equal(moving.axis, Z)


def test_a_slider_from_its_lower_limit_has_the_whole_way():
    moving = only(tree(joint("box", "prismatic", limits=(-0.2, 0.2))), canonical="lower")
    assert (moving.lower, moving.upper) == (0.0, pytest.approx(0.4))
    np.testing.assert_allclose(moving.T_parent_joint[:3, 3], [0, 0, -0.2])


def test_the_recipe_sets_the_way_of_a_slider_without_limits():
    free = tree(joint("box", "prismatic", limits=(-math.inf, math.inf)))
    with pytest.raises(RejectedInstance, match=r"'box' has no limit at an end; .*metres"):
        resolve(free, Articulation())
    moving = only(free, Articulation(prismatic_metres=(0.0, 0.3)))
    assert (moving.lower, moving.upper) == (0.0, 0.3)
    np.testing.assert_array_equal(moving.axis, Z)


def test_a_laptop_that_opens_against_its_axis_is_turned_around():
    # Real laptops: axis -x, limits [-2.34, 0.75], and the lid shut at the lower limit.
    laptop = tree(joint("lid", axis=-X, limits=(-2.34, 0.75)))
    from_rest = only(laptop)
    np.testing.assert_array_equal(from_rest.axis, X)
    shut = only(laptop, canonical="lower")
    np.testing.assert_array_equal(shut.axis, -X)
    np.testing.assert_allclose(
        shut.T_parent_joint[:3, :3], rotation_about(-X, -2.34), rtol=0, atol=1e-15
    )
    assert shut.lower == from_rest.lower == 0.0


def test_from_the_upper_limit_the_axis_is_turned_around():
    obj = tree(joint("lid", limits=(-1.5, 0.2)))
    resolved = resolve(obj, Articulation(canonical="upper", clip_to_limits=True))
    (moving,) = resolved.moving_joints
    np.testing.assert_array_equal(moving.axis, -Z)
    assert (moving.lower, moving.upper) == (0.0, pytest.approx(1.7))
    assert any("turned around" in note and "lid" in note for note in resolved.notes)


def test_the_recipe_overrides_the_source():
    obj = tree(joint("lid", limits=(-1.0, 2.0)), joint("knob"), semantics={"knob": "dial"})
    by_recipe = Articulation(canonical="lower", movable=("di*",))
    moving = only(obj, by_recipe, canonical="upper", movable=("lid",))
    assert moving.name == "knob"
    moving = only(obj, Articulation(), canonical="upper", movable=("lid",))
    assert moving.name == "lid"
    np.testing.assert_allclose(moving.T_parent_joint[:3, :3], rotation_about(Z, 2.0), atol=1e-15)


def test_clipping_keeps_to_the_limits():
    obj = tree(joint("lid", limits=(-0.5, 1.0)))
    assert only(obj, Articulation(clip_to_limits=True)).upper == 1.0
    beyond = resolve(obj, Articulation(clip_to_limits=False))
    assert any("beyond the limits" in note for note in beyond.notes)
    assert only(obj, Articulation(clip_to_limits="source")).upper == 1.0
    free = Recipe(name="free").for_source(clips_to_limits=False).articulation
    assert only(obj, free).upper == pytest.approx(math.radians(135)), "the source's choice"
    kept = Recipe(name="kept", articulation=Articulation(clip_to_limits=True))
    assert only(obj, kept.for_source(clips_to_limits=False).articulation).upper == 1.0, (
        "the recipe's"
    )
    wide = Articulation(revolute_degrees=(-90.0, 90.0), clip_to_limits=True)
    assert (only(obj, wide).lower, only(obj, wide).upper) == (-0.5, 1.0)


def test_a_rest_pose_outside_the_limits_is_noted():
    # The real washing machine's door: limits [-3.11, -1.22], at rest it stands open at 0.
    obj = tree(joint("door", limits=(-3.11, -1.22)))
    resolved = resolve(obj, Articulation(clip_to_limits=True, revolute_degrees=(0.0, 180.0)))
    (moving,) = resolved.moving_joints
    np.testing.assert_array_equal(moving.axis, -Z)
    assert (moving.lower, moving.upper) == (pytest.approx(1.22), pytest.approx(3.11))
    assert any("outside the limits" in note for note in resolved.notes)
    with pytest.raises(RejectedInstance, match=r"'door'.*choose another"):
        resolve(obj, Articulation(clip_to_limits=True, revolute_degrees=(0.0, 45.0)))


@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_a_joint_without_the_limit_asked_for_starts_at_zero(kind):
    obj = tree(joint("knob", kind, limits=(-math.inf, math.inf)))
    resolved = resolve(obj, Articulation(canonical="lower", clip_to_limits=True))
    (moving,) = resolved.moving_joints
    assert (str(moving.kind), moving.lower) == (kind, 0.0)
    assert moving.upper == pytest.approx(math.radians(135))
    np.testing.assert_array_equal(moving.axis, Z)
    np.testing.assert_array_equal(moving.T_parent_joint, np.eye(4))
    noted = "no lower limit, canonical pose at 0 instead: knob" in resolved.notes
    assert noted == (kind == "revolute"), "a continuous joint never has a limit"


def test_locked_joints_ride_on_what_they_hang_on():
    obj = tree(
        joint("door", at=(1, 0, 0)),
        joint("knob", parent="door", limits=(0.25, 1.0)),
        joint("tray", "prismatic", axis=X),
        semantics={"knob": "dial", "tray": "drawer"},
    )
    resolved = resolve(obj, Articulation(), canonical="lower", movable=("door", "draw*"))
    assert [j.name for j in resolved.moving_joints] == ["door", "tray"]
    np.testing.assert_array_equal(resolved.part_of_link, [0, 1, 1, 2])
    (knob,) = [j for j in resolved.joints if j.name == "knob"]
    assert knob.kind == JointKind.FIXED
    np.testing.assert_allclose(
        forward_kinematics(resolved, canonical_state(resolved)).T_world_link[2],
        transform(rotation_about(Z, 0.25), (1, 0, 0)),
        atol=1e-15,
    )
    assert "locked, not among the movable joints: knob" in resolved.notes


def test_an_object_in_which_nothing_moves_is_not_of_the_category():
    lid = tree(joint("lid"), semantics={"lid": "screen"})
    with pytest.raises(NotOfCategory, match=r"^no joint moves: .*'handle'.*lid \(screen\)"):
        resolve(lid, Articulation(movable=("handle",)))
    with pytest.raises(NotOfCategory, match="all joints of its URDF are fixed"):
        resolve(tree(joint("lid", "fixed")), Articulation())
    with pytest.raises(NotOfCategory, match=r"leave no range to box .*correct the <limit>"):
        resolve(tree(joint("box", "prismatic", limits=(0.0, 0.0))), Articulation())


limits = st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(lambda ends: (min(ends), max(ends)))


@given(
    limits,
    st.sampled_from(["zero", "lower", "upper"]),
    st.sampled_from([(0.0, 135.0), (-60.0, 0.0), (10.0, 20.0)]),
    st.sampled_from(["revolute", "prismatic"]),
    st.floats(0, 1),
)
def test_the_resolved_joint_reaches_the_same_poses_as_the_urdf(ends, canonical, degrees, kind, t):
    obj = tree(joint("part", kind, at=(1, 2, 3), axis=[0.6, 0, 0.8], limits=ends))
    settings = Articulation(revolute_degrees=degrees, clip_to_limits=False)
    try:
        resolved = resolve(obj, settings, canonical=canonical)
    except NotOfCategory:
        assert kind == "prismatic"
        assert max(abs(e) for e in ends) == 0.0 or ends[0] == ends[1]
        return
    (moving,) = resolved.moving_joints
    start = {"zero": 0.0, "lower": ends[0], "upper": ends[1]}[canonical]
    sign = 1.0 if np.dot(moving.axis, [0.6, 0, 0.8]) > 0 else -1.0
    assert moving.lower >= 0.0
    q = moving.lower + t * (moving.upper - moving.lower)
    np.testing.assert_allclose(
        child_at(resolved, [q]), child_at(obj, [start + sign * q]), atol=1e-12
    )
    np.testing.assert_allclose(
        child_at(resolved, canonical_state(resolved).q), child_at(obj, [start]), atol=1e-12
    )


def plate(y, z, size=0.1):
    """A little square about (0, y, z)."""
    corners = [(0, y - size, z - size), (0, y + size, z - size), (0, y, z + size)]
    return Mesh(np.array(corners, float), np.array([[0, 1, 2]]))


def front(places, *, order, kinds=None, semantics=None, turn=0.0):
    """A tree whose links, by name, have little plates at (y, z); its joints come in `order`."""
    kinds = kinds or {}
    links = [Link("base", plate(0, 0, 1.0))]
    links += [Link(n, plate(*places[n]), (semantics or {}).get(n, "part")) for n in order]
    root = transform(rotation_about(Z, turn))
    back = transform(rotation_about(Z, -turn))
    joints = [joint(n, kinds.get(n, "prismatic"), at=back, axis=X) for n in order]
    made = tree(*joints, T_world_root=root)
    return replace(made, links=tuple(links))


def numbered(obj, movable=("part",), **choices):
    resolved = resolve(obj, Articulation(), movable=movable, **choices)
    return [j.name for j in resolved.moving_joints]


CHEST = {"a": (-0.5, 0.6), "b": (0.5, 0.601), "c": (-0.5, 0), "d": (0.5, 0), "e": (0, -0.6)}


@given(st.permutations(sorted(CHEST)), st.floats(-3, 3))
def test_parts_are_numbered_as_one_reads_whatever_the_order_of_the_file(order, turn):
    assert numbered(front(CHEST, order=order, turn=turn)) == sorted(CHEST)


def test_the_left_temple_comes_first_also_where_the_right_one_sits_a_little_higher():
    glasses = {"left": (-0.6, 0.1), "right": (0.6, 0.11)}
    for order in (("left", "right"), ("right", "left")):
        assert numbered(front(glasses, order=order)) == ["left", "right"]
        mirrored = {name: (-y, z) for name, (y, z) in glasses.items()}
        assert numbered(front(mirrored, order=order)) == ["right", "left"]


def test_the_patterns_of_the_source_go_before_the_places_and_kinds_before_both():
    obj = front(
        CHEST,
        order="abcde",
        kinds={"e": "revolute"},
        semantics={"d": "door", "e": "door", "a": "lid"},
    )
    assert numbered(obj, ("door", "part", "lid")) == ["e", "d", "b", "c", "a"]
    by_recipe = resolve(obj, Articulation(movable=("part", "door")), movable=("door", "part"))
    assert [j.name for j in by_recipe.moving_joints] == ["e", "b", "c", "d"]


def test_parts_of_a_source_that_names_none_keep_the_order_of_the_file():
    obj = front(CHEST, order="ecadb")
    assert "".join(numbered(obj, ())) == "ecadb"
    chosen = resolve(obj, Articulation(movable=("part",)))
    assert "".join(j.name for j in chosen.moving_joints) == "ecadb"


def test_parts_without_a_mesh_are_numbered_by_their_pivots():
    obj = tree(joint("low", at=(0, 0, 0)), joint("high", at=(0, 0, 1)))
    assert numbered(obj, ("low", "high")) == ["low", "high"]
    assert numbered(obj, ("*",)) == ["high", "low"]


def scissors(**driver):
    """Two blades and a slider: `b` turns -0.5 times as far as `a`, plus 0.25; `c` follows `b`."""
    return tree(
        joint("a", axis=Y, **driver),
        joint("b", axis=Z, limits=(-9.0, 9.0), mimic=Mimic("a", -0.5, 0.25)),
        joint("c", "prismatic", axis=X, limits=(-9.0, 9.0), mimic=Mimic("b", 2.0, 0.1)),
    )


@pytest.mark.parametrize("canonical", ["zero", "lower", "upper"])
@pytest.mark.parametrize("limits", [(0.0, 1.0), (-2.0, 0.5)])
def test_followers_stay_with_their_driver_after_it_is_zeroed_and_turned(canonical, limits):
    obj = scissors(limits=limits)
    resolved = resolve(obj, Articulation(), canonical=canonical)
    a, follower, c = resolved.moving_joints
    assert follower.mimic == Mimic("a", 0.5, 0.0)
    assert c.mimic == Mimic("a", 1.0, 0.0)
    assert (follower.lower, follower.upper, c.upper) == (0.0, 0.5 * a.upper, a.upper)
    start = {"zero": 0.0, "lower": limits[0], "upper": limits[1]}[canonical]
    sign = 1.0 if a.axis[1] > 0 else -1.0
    for seed in range(3):
        state = sample_joint_state(resolved, rng=np.random.default_rng(seed))
        turned = start + sign * state.q[0]
        b = -0.5 * turned + 0.25
        expected = child_at(obj, [turned, b, 2 * b + 0.1], slice(None))
        posed = forward_kinematics(resolved, state)
        np.testing.assert_allclose(posed.T_world_link, expected, atol=1e-12)


@pytest.mark.parametrize(("limits", "beyond"), [((0.2, 1.2), True), ((-0.4, 0.4), False)])
def test_a_follower_beyond_its_limits_is_noted(limits, beyond):
    """It goes from 0.4 to -0.4, whichever way the driver is turned."""
    driver = joint("a", "prismatic", limits=(0.0, 1.0))
    follower = joint("b", limits=np.float64(limits), mimic=Mimic("a", -0.8, 0.4))
    notes = [note for note in resolve(tree(driver, follower), Articulation()).notes if "b" in note]
    assert any(note.endswith("where another joint takes it: b") for note in notes) == beyond


def test_canonical_state_of_an_unresolved_object_obeys_its_mimics():
    np.testing.assert_allclose(canonical_state(scissors()).q, [0.0, 0.25, 0.6])


def test_a_locked_driver_locks_its_followers():
    obj = tree(
        joint("a", axis=Y), joint("b", mimic=Mimic("a", 2.0, 0.5), limits=(0, 0)), joint("lid")
    )
    resolved = resolve(obj, Articulation(), canonical="upper", movable=("b", "lid"))
    assert [j.name for j in resolved.moving_joints] == ["lid"]
    locked = forward_kinematics(resolved, canonical_state(resolved)).T_world_link[2]
    np.testing.assert_allclose(locked[:3, :3], rotation_about(Z, 2.5), atol=1e-15)
    assert any("drive them" in note and ": b" in note for note in resolved.notes)


def test_a_follower_moves_though_no_pattern_names_it():
    resolved = resolve(scissors(), Articulation(), movable=("a",))
    assert [j.name for j in resolved.moving_joints] == ["a", "b", "c"]


def test_mimics_in_a_circle_and_mimics_of_nothing_are_rejected():
    circle = tree(joint("a", mimic=Mimic("b")), joint("b", mimic=Mimic("a")), joint("lid"))
    with pytest.raises(RejectedInstance, match="a -> b -> a end at no joint"):
        resolve(circle, Articulation())
    with pytest.raises(RejectedInstance, match="a -> ghost end at no joint"):
        resolve(tree(joint("a", mimic=Mimic("ghost")), joint("lid")), Articulation())


def test_a_follower_that_is_driven_too_far_is_rejected():
    far = tree(joint("a"), joint("b", mimic=Mimic("a", 1e4)), joint("c", mimic=Mimic("b", 1e4)))
    with pytest.raises(RejectedInstance, match="'c' follows 'a' beyond 1,000,000 rad"):
        resolve(far, Articulation())


def test_a_long_chain_of_mimics_takes_no_time():
    """Each joint is led to its driver; with all of them looked up at each step, that took 22 s."""
    joints = [joint(f"j{i}", mimic=Mimic(f"j{i - 1}") if i else None) for i in range(500)]
    chain = tree(*joints)
    began = time.process_time()
    assert len(resolve(chain, Articulation()).moving_joints) == 500
    assert time.process_time() - began < 1.0


def test_states_are_uniform_independent_and_inside_their_ranges():
    obj = resolve(
        tree(joint("lid"), joint("box", "prismatic", limits=(0.0, 0.4)), joint("door")),
        Articulation(revolute_degrees=(20.0, 90.0)),
    )
    rng = np.random.default_rng(0)
    q = np.array([sample_joint_state(obj, rng=rng).q for _ in range(2000)])
    lower = np.array([j.lower for j in obj.moving_joints])
    upper = np.array([j.upper for j in obj.moving_joints])
    unit = (q - lower) / (upper - lower)
    assert ((unit >= 0) & (unit <= 1)).all()
    # The mean of 2000 uniform numbers has a standard deviation of 0.0065, a correlation 0.022.
    np.testing.assert_allclose(unit.mean(axis=0), 0.5, atol=5 * 0.0065)
    np.testing.assert_allclose(unit.var(axis=0), 1 / 12, atol=0.01)
    np.testing.assert_allclose(np.corrcoef(unit.T), np.eye(3), atol=5 * 0.022)


def test_after_a_state_one_joint_alone_is_drawn_anew():
    obj = resolve(tree(joint("a"), joint("b"), joint("c")), Articulation())
    before = JointState(np.array([0.1, 0.2, 0.3]))
    for turn in range(4):
        q = sample_joint_state(obj, rng=np.random.default_rng(turn), before=before, turn=turn).q
        np.testing.assert_array_equal(q != before.q, np.arange(3) == turn % 3)


@pytest.mark.parametrize("at", [-0.5, 0.0, 0.2, 0.5, 0.9, 1.0])
def test_from_a_state_a_joint_goes_a_step_of_its_range_at_least(at):
    """Uniform in what is left of it, whatever the joint's place; 0.3 as in Ditto's own scenes."""
    lid = joint("lid", "prismatic", limits=(0.0, 2.0))
    obj, rng = resolve(tree(lid), Articulation(clip_to_limits=True)), np.random.default_rng(0)
    before = JointState(np.array([2.0 * at]))
    q = np.array([sample_joint_state(obj, rng=rng, before=before).q[0] for _ in range(2000)]) / 2.0
    assert np.abs(q - at).min() >= 0.3
    left = np.linspace(0.0, 1.0, 100_001)
    left = left[np.abs(left - at) >= 0.3]
    share = np.linspace(0.05, 0.95, 18)
    np.testing.assert_allclose(np.quantile(q, share), np.quantile(left, share), atol=0.06)


def test_one_generator_gives_one_state():
    obj = resolve(scissors(), Articulation())
    first, again = (sample_joint_state(obj, rng=np.random.default_rng(0)) for _ in range(2))
    other = sample_joint_state(obj, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(first.q, again.q)
    assert not np.array_equal(first.q, other.q)


READABLE = sorted(
    path for path in REAL_MODELS.rglob("*.urdf") if not path.name.startswith("error_")
)


def within_reach(joint):
    """The joint with limits to sample from: at most a turn or so, in either sense, or 3 metres."""
    ends = np.clip(sorted((joint.lower, joint.upper)), -3.0, 3.0)
    return replace(joint, lower=ends[0], upper=ends[1])


NEEDS_SAPIEN = pytest.mark.skipif(
    importlib.util.find_spec("sapien") is None, reason="sapien is not installed"
)


@needs_real_models
@pytest.mark.parametrize("program", ["yourdfpy", pytest.param("sapien", marks=NEEDS_SAPIEN)])
@pytest.mark.parametrize("path", READABLE, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_forward_kinematics_agrees_with_other_programs(path, program, tmp_path):
    try:
        obj = load_urdf(path, object_id="real", category="any", missing_ok="*")
    except InvalidSource as refused:
        pytest.skip(f"refused: {refused}")
    obj = replace(obj, joints=tuple(within_reach(joint) for joint in obj.joints))
    bare = tmp_path / "kinematics.urdf"
    bare.write_bytes(kinematics_only(path))
    their_links = {"yourdfpy": yourdfpy_links, "sapien": sapien_links}[program](bare)
    rng = np.random.default_rng(0)
    for _ in range(4):
        state = sample_joint_state(obj, rng=rng)
        ours = forward_kinematics(obj, state).T_world_link
        theirs = their_links(dict(zip(obj.moving_joints, state.q, strict=True)))
        reach = max(1.0, np.abs(ours).max())  # SAPIEN computes in float32
        for link, T in zip(obj.links, ours, strict=True):
            np.testing.assert_allclose(T, theirs[link.name], rtol=0, atol=1e-6 * reach)


def kinematics_only(path):
    """The URDF without shapes and masses, which SAPIEN would want a renderer or sense for."""
    root = etree.parse(path, etree.XMLParser(remove_comments=True)).getroot()
    for unused in root.xpath("//visual | //collision | //inertial | //dynamics"):
        unused.getparent().remove(unused)
    for joint in root.xpath("joint[not(limit)]"):  # SAPIEN refuses a joint without
        etree.SubElement(joint, "limit", lower="-3", upper="3")
    return etree.tostring(root)


def yourdfpy_links(path):
    """Link poses by yourdfpy. It moves sliders by q times the axis's length in the file."""
    model = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
    length = {
        j.name: np.linalg.norm(j.axis) if j.type == "prismatic" else 1.0 for j in model.robot.joints
    }

    def links(values):
        drivers = {joint.name: q for joint, q in values.items() if joint.mimic is None}
        model.update_cfg({name: q / length[name] for name, q in drivers.items()})
        return {k.name: model.get_transform(k.name, model.base_link) for k in model.robot.links}

    return links


def sapien_links(path):
    """Link poses by SAPIEN, to which a mimic joint is one like any other."""
    sapien = importlib.import_module("sapien")
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    robot = loader.load(str(path))
    order = [joint.name for joint in robot.get_active_joints()]

    def links(values):
        assert scene  # the robot lives as long as its scene
        q = {joint.name: value for joint, value in values.items()}
        robot.set_qpos(np.array([q[name] for name in order], np.float32))
        return {link.name: link.entity_pose.to_transformation_matrix() for link in robot.links}

    return links
