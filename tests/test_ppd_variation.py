"""Training objects varied: what is asked of them afterwards is as true as before."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from ppd_data import write_boxes

from articugen.core.errors import InvalidRecipe
from articugen.core.records import JointKind
from articugen.core.yaml_files import with_settings
from articugen.discovery import Discovery, FoundJoint
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import load_split, unpacked
from articugen.learning.method import load_recipe
from articugen.learning.ppd import learner as learner_module
from articugen.learning.ppd.kinematics import inverse_motion, rotation_from_z
from articugen.learning.ppd.learner import PPDLearner
from articugen.learning.ppd.network import rest_states
from articugen.learning.ppd.settings import ModelSettings, PPDRecipe, VarySettings
from articugen.learning.ppd.warm.found import Known, stored
from articugen.learning.ppd.warm.targets import targets
from articugen.learning.ppd.warm.variation import CHANCES, Variation

MODEL = ModelSettings(part_boxes=True)
R = len(MODEL.revolute)
WILD = VarySettings(stretch=0.5, shrink=0.4, mirror=True, shift=True)
SPEC = BatchSpec(
    surface_points=128, uniform_points=256, near_points=64, poses=True, normals=True,
    chances=CHANCES,
)  # fmt: skip

STATES = np.array([0.0, 0.3, 0.1, 0.25, 0.05, 0.2, 0.15])


def joint(kind: JointKind, axis: tuple, pivot: tuple, share: float = 1.0) -> FoundJoint:
    return FoundJoint(kind, np.array(axis, float), np.array(pivot), share * STATES, 0.9)


HINGE = joint(JointKind.REVOLUTE, (0.0, 0.0, 1.0), (0.1, -0.2, 0.05), 4.0)
DRAWER = joint(JointKind.PRISMATIC, (1.0, 0.0, 0.0), (0.2, 0.2, 0.1))
ACROSS = joint(JointKind.REVOLUTE, (0.0, 1.0, 0.0), (0.1, 0.0, -0.1), 3.0)


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    folder = write_boxes(tmp_path_factory.mktemp("boxes"), train=1, test=1, states=6)
    return load_split(folder, "train", SPEC, ())


def aims(split, *joints):
    points = unpacked(split.surface[:1])[0].double().numpy()
    found = Discovery(joints, points, np.arange(len(points)) % (1 + len(joints)))
    rows = split.poses_of(split.object_id[0])
    found = Known.of(found, stored(split, rows))
    return targets(split, [found], [rows], MODEL, mirrored=True)


@pytest.mark.parametrize("joints", [(HINGE,), (DRAWER,), (ACROSS,), (HINGE, DRAWER)])
@pytest.mark.parametrize("seed", range(3))
def test_a_varied_sample_moves_as_is_asked_of_it(split, joints, seed):
    """Brought to rest and varied is varied and brought to rest, by the axes, pivots and states that
    are asked for."""
    rows = torch.arange(len(split))
    chance = torch.rand(len(rows), CHANCES, generator=torch.Generator().manual_seed(seed))
    mirrored = chance[:, 0] < 0.5
    assert mirrored.any()
    assert not mirrored.all()
    aim = aims(split, *joints).of(rows, mirrored)
    variation = Variation.of(chance, mirrored, aim, WILD)
    points = unpacked(split.surface[rows, :50])
    rest = torch.einsum("bpij,bnj->bpni", aim.rotation, points) + aim.offset[:, :, None]
    wanted = variation.moved(rest.flatten(1, 2)).view_as(rest)

    asked = variation.targets(aim, R)
    state = asked.state - rest_states(asked.state, R)
    motion = inverse_motion(rotation_from_z(asked.axis), state, asked.pivot[:, :R], R, "world")
    found = motion.apply(variation.moved(points))
    found[:, 1 : 1 + R] += asked.pivot[:, :R, None]
    there = asked.there > 0
    assert there.sum(1).eq(len(joints)).all()
    torch.testing.assert_close(found[:, 1:][there], wanted[:, 1:][there], atol=2e-5, rtol=0)
    beyond = (rest - aim.middle[:, :, None]).abs() - aim.size[:, :, None]
    still = (wanted - asked.middle[:, :, None]).abs() - asked.size[:, :, None]
    told = beyond.abs() > 1e-5
    assert torch.equal((still > 0)[told], (beyond > 0)[told])


def test_objects_stay_in_the_cube_and_are_no_larger(split):
    rows = torch.arange(len(split)).repeat(40)
    chance = torch.rand(len(rows), CHANCES, generator=torch.Generator().manual_seed(1))
    aim = aims(split, DRAWER).of(rows, chance[:, 0] < 0.5)
    variation = Variation.of(chance, chance[:, 0] < 0.5, aim, WILD)
    moved = variation.moved(unpacked(split.surface[rows]))
    assert moved.abs().max() <= 0.5
    edges = (variation.scale.abs() * aim.extent).amax(1) / aim.extent.amax(1)
    assert edges.max() <= 1.0 + 1e-5
    assert edges.min() >= 1.0 - WILD.shrink - 1e-5
    assert edges.std() > 0.05
    assert moved.mean(1).std(0).min() > 0.03  # elsewhere


def test_points_spread_over_the_cube_stay_so_and_know_what_is_free(split):
    """The labels of varied points are those of where they came from; what was beyond is free."""
    rows = [0, 1, 2, 3] * 20
    batch = split.batch(rows, SPEC, 32, torch.Generator().manual_seed(0))
    aim = aims(split, DRAWER).of(batch.rows)
    small = VarySettings(shrink=0.5)
    variation = Variation.of(
        batch.chance, torch.zeros(len(batch.rows), dtype=torch.bool), aim, small
    )
    varied, freed = variation.batch(batch)
    assert varied.points.abs().max() <= 0.5 + 1e-6
    assert torch.equal(varied.occupied, batch.occupied & ~freed)
    kept = ~freed
    torch.testing.assert_close(varied.points[kept], variation.moved(batch.points)[kept])
    assert freed[:, : batch.spread].any()
    assert not freed[:, batch.spread :].any()
    even = varied.points[:, : batch.spread].flatten(0, 1)
    counts = torch.histogramdd(even, bins=[4, 4, 4], range=[-0.5, 0.5] * 3).hist.flatten()
    wanted = len(even) / 64
    assert (counts - wanted).abs().max() < 6.0 * wanted**0.5


def test_normals_stay_upright_on_what_is_stretched_and_mirrored(split):
    """A ball becomes an ellipsoid, on which they go like x / a^2."""
    batch = split.batch(range(len(split)), SPEC, 32, torch.Generator().manual_seed(0))
    out = torch.nn.functional.normalize(torch.randn(batch.cloud.shape), dim=2)
    batch = replace(batch, cloud=0.3 * out, normals=out)
    mirrored = batch.chance[:, 0] < 0.5
    variation = Variation.of(batch.chance, mirrored, aims(split, DRAWER).of(batch.rows), WILD)
    varied, _ = variation.batch(batch)
    expected = (varied.cloud - variation.shift[:, None]) / variation.scale[:, None] ** 2
    expected /= expected.norm(dim=2, keepdim=True)
    torch.testing.assert_close(varied.normals, expected)


def test_the_points_of_a_batch_keep_their_normals(split):
    """Of boxes, along an axis, on whose faces the points lie."""
    spec = replace(SPEC, sides=True)
    batch = split.for_batches(spec).batch([3, 1], spec, 32, torch.Generator().manual_seed(0))
    stored = {
        tuple(point): normal for row in (1, 3) for point, normal in
        zip(unpacked(split.surface[row]).tolist(), split.normals[row].tolist(), strict=True)
    }  # fmt: skip
    for point, normal in zip(
        batch.cloud.flatten(0, 1).tolist(), (127 * batch.normals).flatten(0, 1), strict=True
    ):
        assert normal.round().tolist() == stored[tuple(point)]
    assert split.batch([0], SPEC, 32, None).normals is None


def test_without_chances_and_settings_nothing_changes(split):
    batch = split.batch([0, 1], SPEC, 32, torch.Generator().manual_seed(0))
    aim = aims(split, HINGE).of(batch.rows)
    none = VarySettings()
    assert not none
    variation = Variation.of(
        batch.chance, torch.zeros(len(batch.rows), dtype=torch.bool), aim, none
    )
    varied, freed = variation.batch(batch)
    assert not freed.any()
    torch.testing.assert_close(varied.cloud, batch.cloud, atol=1e-6, rtol=0)
    asked = variation.targets(aim, R)
    for name in ("state", "axis", "pivot", "middle", "size"):
        torch.testing.assert_close(getattr(asked, name), getattr(aim, name), atol=1e-6, rtol=0)


def test_what_turns_is_not_bent(split):
    for joints, together in (
        ((HINGE,), [[1, 1, 0], [1, 1, 0], [0, 0, 1]]),
        ((ACROSS,), [[1, 0, 1], [0, 1, 0], [1, 0, 1]]),
        ((HINGE, ACROSS), [[1, 1, 1]] * 3),
        ((DRAWER,), np.eye(3).tolist()),
        ((joint(JointKind.REVOLUTE, (0.0, 0.6, 0.8), (0, 0, 0)),), [[1, 1, 1]] * 3),
    ):
        alike = aims(split, *joints).alike[0]
        wanted = torch.tensor(together, dtype=torch.float32)
        torch.testing.assert_close(alike, wanted / wanted.sum(1, keepdim=True))


def test_a_mirrored_door_has_the_candidate_of_the_other_side(split):
    aim = aims(split, HINGE)
    count = len(split)
    assert aim.there[:count].argmax(1).eq(0).all()
    assert aim.there[count:].argmax(1).eq(1).all()


@pytest.mark.parametrize("lean", [0.0, 0.2])
def test_glasses_are_not_mirrored(split, lean, monkeypatch, tmp_path):
    """One temple always folds over the other: in a mirror it is the other one."""
    left = joint(JointKind.REVOLUTE, (0.0, lean, 1.0), (0.1, -0.2, 0.0), 4.0)
    right = joint(JointKind.REVOLUTE, (0.0, -lean, -1.0), (0.1, 0.2, 0.0), 4.0)
    points = unpacked(split.surface[:1])[0].double().numpy()
    rows = [split.poses_of(split.object_id[0])]
    glasses = Discovery((left, right), points, np.arange(len(points)) % 3)
    glasses = Known.of(glasses, stored(split, rows[0]))
    monkeypatch.setattr(learner_module, "discovered", lambda *_: ([glasses], rows))
    recipe = load_recipe("ppd_quick")
    assert isinstance(recipe, PPDRecipe)
    learner = PPDLearner(recipe, seed=0, device=torch.device("cpu"))
    said = []
    learner.begin(split, tmp_path, said.append)
    assert len(learner.targets.known) == (len(split) if lean else 2 * len(split))
    assert said[:2] == [
        "7 training instances show 1 object, by their clouds",
        "joints are known of 1 of 1 training objects",
    ]
    assert len(said) == 2 + (lean > 0)
    batch = split.batch(list(range(len(split))), SPEC, 32, torch.Generator())
    varied, asked, aim = learner.prepared(batch)
    assert asked
    terms = asked(learner.model(varied.cloud), torch.zeros(len(split), 8, varied.points.shape[1]))
    assert all(bool(term.isfinite()) for term in terms.values())
    parts = torch.eye(8)[:, torch.arange(64) % 3].expand(len(split), -1, -1)
    monkeypatch.setattr(learner.model, "fields", lambda *_: SimpleNamespace(product=parts))
    predicted = learner.model(varied.cloud)
    read = learner.reading.learn(learner.model, predicted, varied.cloud, aim, 0, 1e-3)
    assert 0.0 < read["states"].item() < np.pi
    flipped = (varied.cloud[:, :, 1] * batch.cloud[:, :, 1]).sum(1) < 0
    assert bool(flipped.any()) == (lean == 0)


def test_a_recipe_that_varies_what_it_does_not_know_is_refused():
    with pytest.raises(InvalidRecipe, match="vary needs a warm start"):
        with_settings(load_recipe("ppd_plain"), ["vary.stretch=0.2"])
