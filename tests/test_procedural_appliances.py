"""Ovens, washing machines and drawers: exact kinematics, real hollows, no two alike."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from articugen.core.arrays import Floats
from articugen.core.geometry import apply, bounds, rotation_about, transform
from articugen.core.records import ArticulatedObject
from articugen.procedural import build_model, drawer, oven, washing_machine
from articugen.procedural.kit.model import Model, ModelJoint
from articugen.procedural.truth import Truth
from tests.procedural_truth import link_frames, model_of, random_state, written

CATEGORIES = ("oven", "washing_machine", "drawer")
GENERATORS = (oven, washing_machine, drawer)
CASES = [(category, f"{category}_{k:04d}") for category in CATEGORIES for k in range(4)]


@cache
def read(category: str, name: str) -> tuple[ArticulatedObject, Truth]:
    with TemporaryDirectory() as folder:
        return written(category, name, Path(folder) / name)


def link_motions(model: Model, q: list[float]) -> dict[str, Floats]:
    """The motion of each link of an object whose joints all hang on the body; a naive oracle."""
    motions = {model.links[0].name: np.eye(4)}
    for joint, value in zip(model.joints, q, strict=True):
        assert joint.parent == model.links[0].name
        axis, pivot = np.asarray(joint.axis), np.asarray(joint.origin)
        if joint.kind == "revolute":
            R = rotation_about(axis, value)
            motions[joint.child] = transform(R, pivot - R @ pivot)
        else:
            motions[joint.child] = transform(translation=axis * value)
    return motions


def hit(truth: Truth, frames: dict[str, Floats], link: str, start: Floats, way: tuple) -> float:
    """How far from `start` along `way` the first point in `link` is, in steps of 1 mm; inf."""
    distance = np.arange(0.0, 1.5, 0.001)
    held = truth.holds(start + distance[:, None] * np.array(way, float), frames)
    inside = held[:, truth.links.index(link)]
    return float(distance[inside.argmax()]) if inside.any() else np.inf


@pytest.mark.parametrize("generator", GENERATORS, ids=CATEGORIES)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_seed_builds_convex_cells_of_sane_size(generator, seed: int):
    model = generator.build(np.random.default_rng(seed))
    solids = [s for link in model.links for s in link.solids]
    assert all(planes.shape[1] == 4 for s in solids for planes in s.half_spaces)
    assert 400 <= sum(len(s.faces) for s in solids) <= 8000
    size = np.ptp(model.bounds, axis=0)
    assert np.all((size > 0.2) & (size < 2.2))
    assert model.bounds[0, 2] > -1e-9, "closed, it stands on the floor"
    opened = extent_when_open(model)
    sheets = [s.sheet.thickness for s in solids if s.sheet is not None]
    assert all(t >= 0.01 * opened for t in sheets)


@pytest.mark.parametrize("seed", [4, 59, 151, 175])
def test_washing_machines_whose_outlines_would_cross_are_drawn_again(seed: int) -> None:
    model = washing_machine.build(np.random.default_rng(seed))
    for solid in (s for link in model.links for s in link.solids):
        assert len(solid.half_spaces) == len(solid.cells)


def extent_when_open(model: Model) -> float:
    """The longest side of the box around the object closed and fully open."""
    points = []
    for share in (0.0, 0.67, 1.0):
        motions = link_motions(model, [share * joint.upper for joint in model.joints])
        points += [apply(motions[k.name], s.vertices) for k in model.links for s in k.solids]
    return float(np.ptp(np.concatenate(points), axis=0).max())


@pytest.mark.parametrize(("category", "name"), CASES)
def test_kinematics(category: str, name: str):
    model = model_of(category, name)
    if category == "drawer":
        assert [j.kind for j in model.joints] == ["prismatic"] * 3
        for joint in model.joints:
            assert tuple(np.asarray(joint.axis)) == (1.0, 0.0, 0.0)
            assert joint.lower == 0.0
            depth = np.ptp(box_of(model, joint)[:, 0])
            assert 0.5 * depth < joint.upper < 0.9 * depth
        return
    (joint,) = model.joints
    assert (joint.kind, joint.lower) == ("revolute", 0.0)
    assert joint.upper == pytest.approx(np.deg2rad(135.0))
    axes = [(0.0, 1.0, 0.0)] if category == "oven" else [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
    assert tuple(np.asarray(joint.axis)) in axes
    if name == "washing_machine_0000":
        machines = [model_of(category, n).joints[0] for c, n in CASES if c == category]
        assert {tuple(np.asarray(m.axis)) for m in machines} == {*axes}, "hinged on both sides"


def box_of(model: Model, joint: ModelJoint) -> Floats:
    """The box (2, 3) around a joint's child, closed."""
    (link,) = (link for link in model.links if link.name == joint.child)
    return bounds(np.concatenate([s.vertices for s in link.solids]))


@pytest.mark.parametrize(("category", "name"), CASES)
def test_doors_and_drawers_open_towards_plus_x(category: str, name: str):
    model = model_of(category, name)
    for share in (0.05, 0.4, 1.0):
        motions = link_motions(model, [share * joint.upper for joint in model.joints])
        for joint in model.joints:
            middle = box_of(model, joint).mean(axis=0)
            moved = apply(motions[joint.child], middle) - middle
            assert moved[0] > 0.0
            if category == "oven" and share > 0.1:
                assert moved[2] < 0.0, "an oven's door goes down"


@pytest.mark.parametrize("name", [name for category, name in CASES if category == "drawer"])
def test_drawers_are_hollow_boxes_open_above(name: str):
    model, (obj, truth) = model_of("drawer", name), read("drawer", name)
    q = random_state(obj, np.random.default_rng(1))
    frames = link_frames(obj, q)
    for joint, value in zip(model.joints, q, strict=True):
        low, high = box_of(model, joint)
        middle = np.array([low[0] + 0.4 * (high[0] - low[0]) + value, *joint.origin[1:]])
        assert not truth.holds(middle[None], frames).any(), "the air inside is free"
        walls = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, -1))
        assert all(hit(truth, frames, joint.child, middle, way) < 1.0 for way in walls)
        assert hit(truth, frames, joint.child, middle, (0, 0, 1)) == np.inf


@pytest.mark.parametrize("name", [name for category, name in CASES if category == "oven"])
def test_an_ovens_cavity_is_empty_but_for_its_racks(name: str):
    model, (obj, truth), rng = model_of("oven", name), read("oven", name), np.random.default_rng(2)
    (joint,) = model.joints
    low, high = box_of(model, joint)
    center, half = (low + high) / 2, (high - low) / 2
    depth = -model.bounds[0, 0]
    center[0], half[0] = -0.45 * depth, 0.3 * depth
    points = center + rng.uniform(-0.6, 0.6, (4000, 3)) * half
    frames = link_frames(obj, np.zeros(1))
    assert truth.holds(points, frames).any(axis=1).mean() < 0.15
    free = points[~truth.holds(points, frames).any(axis=1)][0]
    walls = ((-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
    assert all(hit(truth, frames, "body", free, way) < 1.0 for way in walls)
    assert hit(truth, frames, "door", free, (1, 0, 0)) < 1.0, "closed"
    opened = link_frames(obj, np.array([np.pi / 2]))
    assert hit(truth, opened, "door", free, (1, 0, 0)) == np.inf, "open"


@pytest.mark.parametrize("name", [name for category, name in CASES if category[0] == "w"])
def test_a_washing_machines_drum_is_round_and_empty(name: str):
    model, (obj, truth) = model_of("washing_machine", name), read("washing_machine", name)
    (joint,) = model.joints
    frames = link_frames(obj, np.array([joint.upper]))
    depth, (_, y, z) = -model.bounds[0, 0], joint.origin
    radius = abs(y)
    inside = np.array([-0.4 * depth, 0.0, z])
    assert not truth.holds(inside[None], frames).any()
    angles = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    reach = [hit(truth, frames, "body", inside, (0.0, np.cos(a), np.sin(a))) for a in angles]
    assert 0.4 * radius < min(reach), "only the lifters stand in"
    assert max(reach) == pytest.approx(np.median(reach), rel=0.05)
    assert hit(truth, frames, "body", inside, (1, 0, 0)) == np.inf, "open in front"
    assert hit(truth, frames, "body", inside, (-1, 0, 0)) < depth
    closed = link_frames(obj, np.zeros(1))
    assert hit(truth, closed, "door", inside, (1, 0, 0)) < 0.4 * depth + 0.1


@pytest.mark.parametrize("category", CATEGORIES)
def test_twenty_objects_are_twenty_products(category: str):
    """No two are alike in proportions and build; both vary widely."""
    builds, shapes = [], []
    for k in range(20):
        model = build_model(category, f"{category}_{k:04d}")
        builds.append(tuple(len(s.vertices) for link in model.links for s in link.solids))
        size = np.ptp(model.bounds, axis=0)
        shapes.append(size / size.max())
    assert len(set(builds)) >= 18
    assert np.all(np.std(shapes, axis=0).max() > 0.08)
