"""Every check of an instance or object passes on sound data and is tripped by its one fault."""

import math
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import RICH, SMALL, changed, edited, hinged_box, put
from test_manifest import STATES

from articugen.core.geometry import voxel_centres
from articugen.core.near import any_within, by_cell, nearest_within
from articugen.core.recipe import Recipe, Sampling
from articugen.core.records import dequantize, quantize
from articugen.core.schema import Instance
from articugen.store.manifest import Manifest
from articugen.store.shards import open_shard
from articugen.verify import bounds, exact, invariants, sampled
from tests.benchmarks.soundness import made_sets

ROWS = hinged_box()
RICH_ROWS = hinged_box(recipe=RICH)
COVERED = RICH.model_copy(update={"sampling": RICH.sampling.model_copy(update={"coverage": True})})
CHECKS = {
    "flow",
    *exact.VALUE_CHECKS,
    *exact.GEOMETRY_CHECKS,
    *sampled.SHARE_CHECKS,
    *exact.OBJECT_CHECKS,
} - {"distances", "images"}
"""But for those that test_extras.py harms."""


@pytest.mark.parametrize("rows", [ROWS, RICH_ROWS, ROWS[:1]], ids=["small", "rich", "canonical"])
def test_sound_instances(rows):
    assert list(invariants.faults(rows, RICH if rows is RICH_ROWS else SMALL)) == []


def test_part_without_surface_points_has_no_flow_to_judge():
    rows = [edited(row, "surface_part", lambda part: np.minimum(part, 1)) for row in RICH_ROWS]
    checked = [f for f in invariants.faults(rows, RICH) if f.check == "flow"]
    assert checked == []


def test_default_recipe_and_an_empty_one_are_sound():
    full = Recipe(name="full")
    assert list(invariants.faults(hinged_box(STATES, recipe=full), full)) == []
    nothing = Sampling(
        grids=(), surface_points=0, uniform_points=0, near_points=0, partial_views=1,
        partial_points=0,
    )  # fmt: skip
    none = Recipe(name="none", sampling=nothing)
    assert list(invariants.faults(hinged_box(STATES, recipe=none), none)) == []


def test_without_surface_points_nothing_is_known_to_be_far_from_the_surface(laptops):
    recipe = Recipe.model_validate_json(Manifest.read(laptops).recipe)
    sampling = recipe.sampling.model_copy(update={"surface_points": 0})
    recipe = recipe.model_copy(update={"sampling": sampling})
    with open_shard(next(laptops.glob("train*.h5"))) as shard:
        rows = [shard.instance(i) for i in range(len(shard))]
    names = ("surface_points", "surface_normals", "surface_part")
    bare = [replace(r, **{n: getattr(r, n)[:0] for n in names}) for r in rows]
    assert list(invariants.faults(bare, recipe)) == []


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 1.74), st.floats(0, 0.3)), max_size=3), st.integers(0, 99))
def test_any_joint_states_are_sound(states, seed):
    rows = hinged_box([(0.0, 0.0), *states], seed=seed)
    assert list(invariants.faults(rows, SMALL)) == []


def grids(row: Instance, edit) -> Instance:
    return changed(row, occupancy={r: edit(r, grid) for r, grid in row.occupancy.items()})


def covered(row: Instance) -> dict[int, np.ndarray]:
    """Coverage by the labels of the finest grid."""
    fine = row.occupancy[64] > 0
    blocks = {r: fine.reshape(r, 64 // r, r, 64 // r, r, 64 // r) for r in row.occupancy}
    return {r: np.round(255 * b.mean(axis=(1, 3, 5))).astype("u1") for r, b in blocks.items()}


def moved_camera(row: Instance) -> Instance:
    return edited(row, "partial_T_camera_world", lambda T: T @ np.diag([1.0, -1.0, -1.0, 1.0]))


def other_part(part):
    return (part + 1) % 3


def others(*names: str):
    """With fields of another instance: consistent among themselves."""
    return lambda row: changed(row, **{name: getattr(RICH_ROWS[3], name) for name in names})


FAULTS = {
    "not a number": ("numbers", lambda r: edited(r, "joint_axis", put((0, 0), np.nan))),
    "infinite scale": ("numbers", lambda r: changed(r, scale=np.inf)),
    "negative scale": ("numbers", lambda r: changed(r, scale=-1.0)),
    "range turned around": ("numbers", lambda r: edited(r, "joint_lower", put(0, 9.0))),
    "range is no number": ("numbers", lambda r: edited(r, "joint_upper", put(0, np.nan))),
    "unknown kind": ("numbers", lambda r: edited(r, "joint_kind", put(0, 3))),
    "unknown parent": ("numbers", lambda r: edited(r, "joint_parent", put(0, 3))),
    "its own parent": ("numbers", lambda r: edited(r, "joint_parent", put(1, 2))),
    "a point too few": (
        "counts",
        lambda r: changed(r, near_points=r.near_points[1:], near_label=r.near_label[1:]),
    ),
    "a grid too few": ("counts", lambda r: changed(r, occupancy={16: r.occupancy[16]})),
    "label of no part": ("labels", lambda r: edited(r, "uniform_label", put(5, 4))),
    "near label of no part": ("labels", lambda r: edited(r, "near_label", put(5, 4))),
    "voxel of no part": (
        "labels",
        lambda r: grids(r, lambda _, g: np.where(g == 3, 4, g).astype("u1")),
    ),
    "surface of no part": ("labels", lambda r: edited(r, "surface_part", put(0, 3))),
    "view of no part": ("labels", lambda r: edited(r, "partial_part", put((0, 0), 3))),
    "long normal": ("normals", lambda r: edited(r, "surface_normals", put(7, (127, 20, 0)))),
    "no normal": ("normals", lambda r: edited(r, "surface_normals", put(7, 0))),
    "beyond its range": ("joint range", lambda r: edited(r, "joint_upper", put(0, 0.1))),
    "below its range": ("joint range", lambda r: edited(r, "joint_lower", put(0, 1.6))),
    "motion that scales": ("rigid", lambda r: edited(r, "part_motion", lambda T: T * [[[1.01]]])),
    "motion that mirrors": (
        "rigid",
        lambda r: edited(r, "part_motion", put((1, slice(0, 3), 0), -r.part_motion[1, :3, 0])),
    ),
    "camera that shears": (
        "rigid",
        lambda r: edited(r, "partial_T_camera_world", put((0, 0, 1), 0.9)),
    ),
    "fixed part moves": ("motion", lambda r: edited(r, "part_motion", put((0, 0, 3), 1e-6))),
    "motion of another state": ("motion", others("part_motion")),
    "state of another motion": ("motion", lambda r: edited(r, "joint_state", lambda q: q + 1e-5)),
    "pivot beside its axis": ("motion", lambda r: edited(r, "joint_pivot", put((0, 2), 0.0))),
    "axis in the wrong frame": (
        "motion",
        lambda r: edited(r, "joint_axis", put(1, RICH_ROWS[0].joint_axis[1])),
    ),
    "axis not of unit length": (
        "motion",
        lambda r: edited(r, "joint_axis", put(0, (0, -1.001, 0))),
    ),
    "wrong kind": ("motion", lambda r: changed(r, joint_kind=np.array([1, 1], np.uint8))),
    "wrong parent": ("motion", lambda r: changed(r, joint_parent=np.array([0, 0], np.uint8))),
    "surface out of the box": ("box", lambda r: edited(r, "surface_points", put(0, 65535))),
    "occupied out of the box": (
        "box",
        lambda r: edited(r, "uniform_points", put(np.argmax(r.uniform_label), 0)),
    ),
    "coarse grid mirrored": (
        "grids",
        lambda r: grids(r, lambda n, g: g[:, :, ::-1].copy() if n == 32 else g),
    ),
    "coarse grid of other labels": (
        "filling",
        lambda r: grids(r, lambda n, g: g + (g > 0) * (g < 3) if n == 16 else g),
    ),
    "coarse grid full": ("grids", lambda r: grids(r, lambda n, g: g * 0 + 1 if n == 16 else g)),
    "grids of another state": ("filling", others("occupancy")),
    "grids indexed z y x": ("filling", lambda r: grids(r, lambda _, g: g.T.copy())),
    "grids empty": ("grids", lambda r: grids(r, lambda _, g: g * 0)),
    "grids full": ("filling", lambda r: grids(r, lambda _, g: g * 0 + 1)),
    "uniform points of another state": ("grids", others("uniform_points", "uniform_label")),
    "coverage of another state": ("coverage", lambda r: changed(r, coverage=covered(RICH_ROWS[3]))),
    "near points of another state": ("near", others("near_points", "near_label")),
    "points without their labels": ("near", others("near_points", "uniform_points")),
    "surface beside the zero level": (
        "zero level",
        lambda r: changed(
            r,
            surface_points=quantize(dequantize(r.surface_points) + 0.005 * r.surface_normals / 127),
        ),
    ),
    "surface of another state": ("near", others("surface_points", "surface_part")),
    "normals inwards": ("zero level", lambda r: edited(r, "surface_normals", np.negative)),
    "surface of another part": ("zero level", lambda r: edited(r, "surface_part", other_part)),
    "camera that looks away": ("cameras", moved_camera),
    "camera of another state": (
        "cameras",
        lambda r: edited(r, "partial_T_camera_world", lambda T: T[::-1]),
    ),
    "transform inverted": ("cameras", lambda r: edited(r, "partial_T_camera_world", np.linalg.inv)),
    "no focal length": ("cameras", lambda r: edited(r, "partial_intrinsics", put((0, 0), 0.0))),
    "shorter focal length": (
        "cameras",
        lambda r: edited(r, "partial_intrinsics", put((0, slice(0, 2)), 95.0)),
    ),
    "longer focal length": (
        "cameras",
        lambda r: edited(r, "partial_intrinsics", put((0, slice(0, 2)), 900.0)),
    ),
    "pixel corners": (
        "cameras",
        lambda r: edited(r, "partial_intrinsics", lambda k: k - [0, 0, 0.5, 0.5]),
    ),
    "seen part is another": ("partial parts", lambda r: edited(r, "partial_part", other_part)),
    "seen points are elsewhere": (
        "partial parts",
        lambda r: changed(
            r, partial_points=quantize(np.clip(dequantize(r.partial_points) * 0.5, -0.5, 0.5))
        ),
    ),
    "joints of another state": (
        "flow",
        others("joint_state", "joint_axis", "joint_pivot", "part_motion"),
    ),
}


def harmed(what) -> tuple[Recipe, list[Instance]]:
    check, harm = FAULTS[what]
    recipe, rows = RICH, list(RICH_ROWS)
    if check == "coverage":
        recipe, rows = COVERED, [changed(row, coverage=covered(row)) for row in rows]
    rows[2] = harm(rows[2])
    return recipe, rows


@pytest.mark.parametrize("what", FAULTS)
def test_fault_is_found(what):
    check, (recipe, rows) = FAULTS[what][0], harmed(what)
    found = list(invariants.faults(rows, recipe))
    assert check in {fault.check for fault in found if fault.state_index == 2}, found
    assert {fault.state_index for fault in found} <= {2}
    assert all("\n" not in fault.sentence for fault in found)


def _all(harm):
    return lambda rows: [harm(row) for row in rows]


def _last(harm):
    return lambda rows: [*rows[:3], harm(rows[3])]


def _halved(row: Instance) -> Instance:
    """Half as large in the cube, everything else in order: only the box is not filled."""
    half = {
        name: quantize(dequantize(getattr(row, name)) / 2)
        for name in ("surface_points", "near_points", "uniform_points", "partial_points")
    }
    return changed(row, **half)


def _one_freed(grid):
    """A grid without one of part 0's voxels, which others in every pose have."""
    grid = grid.copy()
    grid.ravel()[np.flatnonzero(grid == 1)[0]] = 0
    return grid


OBJECT_FAULTS = {
    "a state twice": ("states", lambda rows: [*rows, rows[2]]),
    "no canonical pose": ("states", lambda rows: rows[1:]),
    "canonical pose moved": (
        "states",
        lambda rows: [changed(rows[1], state_index=0), changed(rows[0], state_index=1), *rows[2:]],
    ),
    "two centers": ("shared", _last(lambda r: edited(r, "center", lambda c: c + 1e-6))),
    "two scales": ("shared", _last(lambda r: changed(r, scale=1.0))),
    "two ranges": ("shared", _last(lambda r: edited(r, "joint_upper", lambda q: q + 1))),
    "a hinge that wanders": (
        "shared",
        _last(lambda r: edited(r, "joint_pivot", lambda p: p + 0.1)),
    ),
    "half the box": ("fills box", _all(_halved)),
    "a voxel of the fixed part that comes and goes": (
        "fixed part",
        _last(lambda r: grids(r, lambda n, g: g if n != 64 else _one_freed(g))),
    ),
}


@pytest.mark.parametrize("what", OBJECT_FAULTS)
def test_fault_of_an_object_is_found(what):
    check, harm = OBJECT_FAULTS[what]
    found = list(invariants.faults(harm(list(RICH_ROWS)), RICH))
    assert check in {fault.check for fault in found}, found


def test_coverage_is_asked_for_and_agrees():
    rows = [changed(row, coverage=covered(row)) for row in RICH_ROWS]
    assert list(invariants.faults(rows, COVERED)) == []
    assert {fault.check for fault in invariants.faults(RICH_ROWS, COVERED)} == {"counts"}
    assert {fault.check for fault in invariants.faults(rows, RICH)} == {"counts"}


def _with_enclosed(row: Instance) -> Instance:
    """What is free but far from every surface is said to be enclosed, by all samples alike."""
    surface = dequantize(row.surface_points)

    def relabelled(points, label):
        flat = points.reshape(-1, 3)
        far = ~any_within(by_cell(surface), flat, 0.03) & (np.abs(flat) < 0.4).all(axis=1)
        return np.where((label == 0) & far.reshape(label.shape), 255, label).astype(np.uint8)

    queries = {
        f"{name}_label": relabelled(
            dequantize(getattr(row, f"{name}_points")), getattr(row, f"{name}_label")
        )
        for name in ("uniform", "near")
    }
    centres = {r: voxel_centres(r).reshape(r, r, r, 3) for r in row.occupancy}
    occupancy = {r: relabelled(centres[r], grid) for r, grid in row.occupancy.items()}
    return changed(row, occupancy=occupancy, **queries)


def test_enclosed_space_is_a_label_but_where_the_rule_knows_none():
    rows = [_with_enclosed(row) for row in RICH_ROWS]
    assert (rows[0].occupancy[64] == 255).any()
    found = {fault.check for fault in invariants.faults(rows, RICH)}
    assert not found - {"filling"}  # so much of it is not made by any object
    rigid = RICH.model_copy(update={"fusion": RICH.fusion.model_copy(update={"rule": "rigid"})})
    assert "labels" in {fault.check for fault in invariants.faults(rows, rigid)}
    assert "labels" not in {fault.check for fault in invariants.faults(RICH_ROWS, rigid)}


def test_every_check_has_a_fault():
    assert {check for check, _ in (*FAULTS.values(), *OBJECT_FAULTS.values())} == CHECKS


def test_tolerances_leave_room_for_what_is_sound():
    for tolerance in bounds.TOLERANCES.values():
        assert 0.0 <= tolerance.sound < tolerance.most
        assert not tolerance.exceeded_by(tolerance.sound)
        assert tolerance.exceeded_by([0.0, 1.01 * tolerance.most]).tolist() == [False, True]


def test_bounds_lie_between_what_is_sound_and_what_is_not():
    for bound in bounds.BOUNDS.values():
        assert bound.faulty < bound.least < bound.sound
    used = set()
    for what, (check, _) in FAULTS.items():
        if check in sampled.SHARE_CHECKS or check == "flow":
            recipe, rows = harmed(what)
            tell = [
                share
                for state, c, share in invariants.shares([rows[0], rows[2]], recipe)
                if (state, c) == (2, check) and share.is_refused
            ]
            used |= {s.bound for s in tell}
            assert any(s.agree / s.judged <= bounds.BOUNDS[s.bound].faulty for s in tell), what
    assert used == set(bounds.BOUNDS)


@pytest.mark.parametrize("name", bounds.BOUNDS)
def test_chance_alone_refuses_no_sound_share(name):
    """The exact binomial distribution, of as many draws as count as independent ones."""
    bound = bounds.BOUNDS[name]
    for draws in (1, 5, 10, 20, 50, 200, 1000):
        refused = [k for k in range(draws) if bound.refuses(k * bound.per, draws * bound.per)]
        assert refused == list(range(len(refused)))  # the fewer agree, the surer
        p = bound.least
        tail = sum(math.comb(draws, k) * p**k * (1.0 - p) ** (draws - k) for k in refused)
        assert tail <= bounds.CHANCE
        assert refused or draws <= 20


@pytest.mark.parametrize("name", bounds.BOUNDS)
def test_enough_places_tell_a_fault_but_few_do_not(name):
    bound = bounds.BOUNDS[name]
    few, enough = 8 * bound.per, 1000 * bound.per
    assert not bound.refuses(0, few)
    assert not bound.refuses(0, 0)
    assert bound.refuses(int(bound.faulty * enough), enough)
    assert not bound.refuses(int(bound.least * enough) + 1, enough)


def test_a_fault_too_small_to_tell_in_one_instance_tells_in_all():
    few = {"surface_points": 600, "uniform_points": 600, "near_points": 600}
    recipe = RICH.model_copy(update={"sampling": RICH.sampling.model_copy(update=few)})
    states = [(0.0, 0.0), (0.4, 0.1), (0.8, 0.1), (1.2, 0.25), (1.6, 0.02), (1.7, 0.1)]
    rows = [
        edited(row, "surface_normals", np.negative) for row in hinged_box(states, recipe=recipe)
    ]
    for row in rows:
        assert "zero level" not in {fault.check for fault in invariants.faults([row], recipe)}
    every = [fault for fault in invariants.faults(rows, recipe) if fault.check == "zero level"]
    assert [fault.state_index for fault in every] == [None]


@pytest.mark.slow
def test_sound_objects_of_all_kinds_are_left_in_peace():
    """A lap of rules, views and samples; `python -m tests.benchmarks.soundness` takes 230."""
    for made in islice(made_sets(), 6):
        assert made.refused() == [], made.name


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 200), st.integers(0, 50), st.floats(0.005, 0.4))
def test_nearest_is_the_nearest(seed, many, few, radius):
    rng = np.random.default_rng(seed)
    points, queries = rng.random((many, 3)) - 0.5, 1.1 * (rng.random((few, 3)) - 0.5)
    distance = np.linalg.norm(queries[:, None] - points[None], axis=2)
    expected = np.full(few, -1)
    if many:
        found = distance.min(axis=1) <= radius
        expected[found] = distance.argmin(axis=1)[found]
    np.testing.assert_array_equal(nearest_within(by_cell(points), queries, radius), expected)
    np.testing.assert_array_equal(any_within(by_cell(points), queries, radius), expected >= 0)
    some = np.arange(len(points)) % 3 == 1
    among = any_within(by_cell(points), queries, radius, some)
    np.testing.assert_array_equal(among, any_within(by_cell(points[some]), queries, radius))


def test_labels_about_a_point_are_those_of_the_eight_nearest_voxels():
    rng = np.random.default_rng(0)
    grid = rng.integers(0, 5, (7, 7, 7)).astype(np.uint8)
    points = rng.random((50, 3)) - 0.5
    at = (np.arange(7) + 0.5) / 7 - 0.5
    for point, labels in zip(points, sampled._about(grid, points), strict=True):
        if (np.abs(point) > at[-1]).any():
            continue
        near = [np.argsort(np.abs(at - p))[:2] for p in point]
        expected = [grid[i, j, k] for i in near[0] for j in near[1] for k in near[2]]
        assert sorted(labels) == sorted(expected)
