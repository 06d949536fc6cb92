"""The warm start: what is found in boxes whose motion is known, and what is asked for then."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from ppd_data import write_boxes
from test_ownership import part_of

from articugen.core.errors import UnfitData
from articugen.core.records import JointKind
from articugen.discovery import Discovery, FoundJoint, Ownership
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import load_split, unpacked
from articugen.learning.method import find_method, load_recipe
from articugen.learning.ppd.network import Prediction, amount_of, rest_states
from articugen.learning.ppd.settings import ModelSettings, WarmStart, directions_of
from articugen.learning.ppd.shape import PartBox
from articugen.learning.ppd.warm import found as found_module
from articugen.learning.ppd.warm.found import (
    Known,
    _Asked,
    discovered,
    stored,
)
from articugen.learning.ppd.warm.targets import (
    _from_closed,
    assigned,
    is_one_sided,
    likely,
    targets,
)
from articugen.learning.ppd.warm.terms import LEAST_SIZE, aim_terms, labels_entropy, parts_entropy
from articugen.store.shards import open_shard

MODEL = ModelSettings()
SPEC = BatchSpec(surface_points=256, parts=True, poses=True, normals=True)
WAYS = directions_of(MODEL)


def found(*joints: tuple[JointKind, tuple, tuple]) -> Discovery:
    """Joints of a kind, an axis and a part at a place."""
    places = [place for _, _, place in joints]
    points = np.array([(0.0, 0.0, 0.0), *places], np.float64)
    made = [
        FoundJoint(kind, np.array(axis, np.float64), np.array(place), np.array([0.0, 0.5]), 0.9)
        for kind, axis, place in joints
    ]
    return Discovery(tuple(made), points, np.arange(len(points)))


R, S = JointKind.REVOLUTE, JointKind.PRISMATIC


def test_a_joint_goes_to_the_candidate_that_points_as_it_does():
    left = found((R, (0.0, 0.1, -0.995), (0, 0.4, 0)))
    right = found((R, (0.0, 0.1, 0.995), (0, 0.4, 0)))
    both = found((R, (0, 0, -1), (0, 0.4, 0)), (R, (0, 0, 1), (0, -0.4, 0)))
    assert assigned(right, MODEL) == [(0, 1.0)]
    assert assigned(left, MODEL) == [(1, 1.0)]
    assert assigned(both, MODEL) == [(1, 1.0), (0, 1.0)]


def test_one_that_no_candidate_points_as_turns_the_other_way():
    assert assigned(found((R, (0, -1, 0), (0, 0, 0))), MODEL) == [(2, -1.0)]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_candidates_that_point_alike_are_handed_out_as_one_reads(order):
    stack = [(S, (1, 0, 0), (0, 0, z)) for z in (0.3, 0.0, -0.3)]
    row = [(S, (1, 0, 0), (0, y, 0.2)) for y in (-0.3, 0.0, 0.3)]
    for joints in (stack, row):
        taken = assigned(found(*(joints[i] for i in order)), MODEL)
        assert taken == [(3 + i, 1.0) for i in order]


def test_joints_without_a_candidate_get_none():
    many = found(*((S, (1, 0, 0), (0, 0, -0.1 * i)) for i in range(5)))
    assert assigned(many, MODEL) == [(3, 1.0), (4, 1.0), (5, 1.0), (6, 1.0), None]


def test_objects_unlike_the_others_say_nothing():
    usual = [found((S, (1, 0, 0), (0, 0, 0))) for _ in range(8)]
    odd, leaning = found((R, (0, 0, 1), (0, 0, 0))), found((S, (0.7, 0, 0.7), (0, 0, 0)))
    assert likely([*usual, odd, leaning, None], MODEL) == [*usual, None, None, None]


def test_objects_whose_joints_lean_to_one_side_have_no_mirror_image():
    """Glasses, whose hinges lean by the same few degrees, and doors of either side; a joint that
    was found askew in one object of many says nothing."""

    def glasses(lean: float) -> Discovery:
        y, z = np.sin(np.radians(lean)), np.cos(np.radians(lean))
        return found((R, (0, y, z), (0, -0.4, 0)), (R, (0, -y, -z), (0, 0.4, 0)))

    leans = np.arange(4.0, 12.0)
    assert is_one_sided([glasses(lean) for lean in leans], MODEL)
    assert not is_one_sided([glasses(lean) for lean in (*leans, *-leans)], MODEL)
    assert not is_one_sided([glasses(lean) for lean in (-1.0, 0.0, 2.0)], MODEL)
    left = found((R, (0, 0.02, -1), (0, 0.4, 0)))
    right = found((R, (0, 0.02, 1), (0, -0.4, 0)))
    askew = found((R, (0, 0.3, 0.95), (0, -0.4, 0)), (R, (0, 0.3, -0.95), (0, 0.4, 0)))
    lids = [found((R, (0, 1, 0), (0, 0, z))) for z in (0.0, 0.1)]
    assert not is_one_sided([left, left, right, right, right], MODEL)
    assert not is_one_sided([*lids, *lids, askew], MODEL)
    assert not is_one_sided([left, None], MODEL)  # no candidate has joints in both views
    assert not is_one_sided([None], MODEL)


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """Hinged boxes, their split, and what is true of them: lid and knob move as one."""
    folder = write_boxes(tmp_path_factory.mktemp("boxes"), train=2, test=1, states=7, slides=0.0)
    split = load_split(folder, "train", SPEC, ())
    names = list(dict.fromkeys(split.object_id.tolist()))
    true = []
    for path in sorted(folder.glob("train-*.h5")):
        with open_shard(path) as shard:
            rows = [shard.instance(i) for i in range(len(shard.object_ids()))]
        first = rows[0]
        hinge = FoundJoint(
            R, first.joint_axis[0], first.joint_pivot[0],
            np.array([row.joint_state[0] for row in rows]), 1.0,
        )  # fmt: skip
        part = np.minimum(first.surface_part.astype(int), 1)
        one = Discovery((hinge,), first.surface_points / 65535 - 0.5, part)
        true.append(Known.of(one, stored(split, split.poses_of(names[len(true)]))))
    return split, true, [split.poses_of(name) for name in names]


def test_points_belong_to_the_part_that_they_move_with(boxes):
    split, true, rows = boxes
    aims = targets(split, true, rows, MODEL)
    everything = torch.arange(len(split))
    points = unpacked(split.surface)
    owner = aims.of(everything).owner(points, torch.ones(points.shape[:2], dtype=torch.bool))
    (slot, _) = assigned(true[0], MODEL)[0]
    assert (owner[split.part > 0] == slot + 1).float().mean() > 0.85
    assert (owner[split.part == 0] == 0).float().mean() > 0.85
    free = aims.of(everything).owner(points, torch.zeros(points.shape[:2], dtype=torch.bool))
    assert (free == -1).all()


def test_batches_ask_for_owners_as_ownership_does(boxes):
    """The same rule, once for batches on any device and once in numpy."""
    split, true, rows = boxes
    aims = targets(split, true, rows, MODEL)
    for each, mine in zip(true, rows, strict=True):
        taken = [(-1, 1.0), *assigned(each, MODEL)]
        motion = _from_closed(each, tuple(sense for _, sense in taken))
        clouds = list(unpacked(split.surface[mine]).double().numpy())
        own = Ownership.of(clouds, each.owner, motion)
        back = np.linalg.inv(motion)
        slots = np.array([slot + 1 for slot, _ in taken])
        for k, row in enumerate(mine):
            points = unpacked(split.surface[[row]])
            owner = aims.of(torch.tensor([row])).owner(points, torch.ones(1, points.shape[1]) > 0)
            cloud = points[0].double().numpy()
            rest = np.einsum("pij,nj->pni", back[k, :, :3, :3], cloud) + back[k, :, None, :3, 3]
            same = owner[0].numpy() == slots[part_of(own, rest)]
            assert same.mean() > 0.999  # single precision decides at the faces of cells and boxes


def test_poses_that_were_not_looked_at_have_no_targets(boxes):
    split, true, rows = boxes
    some = []
    for each, mine in zip(true, rows, strict=True):
        joints = tuple(replace(j, states=j.states[:5]) for j in each.joints)
        some.append(Known.of(replace(each, joints=joints), stored(split, mine[:5])))
    aims = targets(split, some, [mine[:5] for mine in rows], MODEL)
    for mine in rows:
        assert aims.known[mine].tolist() == [1.0] * 5 + [0.0] * (len(mine) - 5)


def test_targets_bring_every_pose_back_to_the_closed_one(boxes):
    split, true, rows = boxes
    aims = targets(split, true, rows, MODEL)
    for each, mine in zip(true, rows, strict=True):
        for joint, (slot, sense) in enumerate(assigned(each, MODEL)):
            closed = each.motion(int((sense * each.joints[joint].states).argmin()))[joint + 1]
            for k, row in enumerate(mine):
                T = each.motion(k)[joint + 1] @ np.linalg.inv(closed)
                posed = T[:3, :3] @ [0.1, 0.2, 0.3] + T[:3, 3]
                back = aims.rotation[row, slot + 1].numpy() @ posed
                back = back + aims.offset[row, slot + 1].numpy()
                np.testing.assert_allclose(back, [0.1, 0.2, 0.3], atol=1e-6)
            change = aims.state[mine, slot] - aims.state[mine[0], slot]
            np.testing.assert_allclose(change, sense * each.joints[joint].states, atol=1e-6)
            assert (aims.there[mine, slot] == 1).all()
    assert (aims.state > 0).all()
    assert aims.there.sum(1).eq(len(true[0].joints)).all()


def test_it_does_not_matter_which_pose_is_looked_at_first(boxes):
    """States and rest frames are those of the pose in which a joint is closed."""
    split, true, rows = boxes
    usual = targets(split, true, rows, MODEL)
    turned, others = [], []
    for each, mine in zip(true, rows, strict=True):
        order = np.argsort(-each.joints[0].states)  # wide open first
        states = each.joints[0].states[order]
        joint = replace(each.joints[0], states=states - states[0])
        turned.append(Known.of(replace(each, joints=(joint,)), stored(split, mine[order])))
        others.append(mine[order])
    found = targets(split, turned, others, MODEL)
    for name in ("state", "rotation", "offset"):
        torch.testing.assert_close(getattr(found, name), getattr(usual, name), atol=1e-6, rtol=0)
    for name in ("middle", "size"):
        torch.testing.assert_close(getattr(found, name), getattr(usual, name), atol=0.02, rtol=0)


def test_a_prediction_that_is_as_aimed_costs_nothing(boxes):
    split, true, rows = boxes
    aims = targets(split, true, rows, MODEL).of(torch.arange(3))
    learner = find_method("ppd").start(load_recipe("ppd_quick"), seed=0, device=torch.device("cpu"))
    with torch.no_grad():
        predicted = learner.model(unpacked(split.surface[:3, :128]))
    pose, turning = predicted.pose, len(MODEL.revolute)
    frames = pose.frames.clone()
    frames[..., 2] = torch.where(aims.there[..., None] > 0, aims.axis, pose.direction)
    pivot = torch.cat([pose.pivot[:, :1], aims.pivot], 1)
    right = {"amount": amount_of(aims.state, turning), "frames": frames, "pivot": pivot}
    middle, size = aims.middle.clone(), aims.size.clamp(min=LEAST_SIZE)
    middle[:, 1 : 1 + turning] -= aims.pivot[:, :turning]  # a part that turns is at its pivot
    logits, owner = torch.zeros(3, 8, 5), torch.zeros(3, 5, dtype=torch.long)

    as_aimed = PartBox(middle, size)

    def terms(box=as_aimed, **changed):
        shape = replace(predicted.shape, box=box)
        some = Prediction(shape, replace(pose, **{**right, **changed}))
        return aim_terms(some, logits, owner, aims, WarmStart(), turning)

    for name in ("aim_state", "aim_still", "aim_direction", "aim_pivot", "aim_box"):
        assert float(terms()[name]) == pytest.approx(0.0, abs=1e-9)
    slot = assigned(true[0], MODEL)[0][0]
    off = pivot.clone()
    off[:, slot + 1, 0] += 0.1
    assert float(terms(pivot=off)["aim_pivot"]) == pytest.approx(WarmStart().pivot * 0.01, rel=1e-4)
    free = int(torch.where(aims.there[0] == 0)[0][0])  # a candidate without a joint: nothing asked
    off = pivot.clone()
    off[:, free + 1] += 0.1
    assert float(terms(pivot=off)["aim_pivot"]) == pytest.approx(0.0, abs=1e-9)
    assert "aim_box" not in terms(box=None)
    owned = int(aims.owns[0].sum())
    assert owned == 2  # the fixed part and the lid
    wide = terms(box=PartBox(middle, np.e * size))["aim_box"]
    assert float(wide) == pytest.approx(WarmStart().box * 3 * owned, rel=1e-4)


def test_a_candidate_that_only_other_objects_have_is_asked_to_stand_still(boxes):
    split, true, rows = boxes
    model = ModelSettings(revolute=((0, 1, 0), (0, -1, 0), (0, 0, 1)))
    hinge = true[1].joints[0]
    turned = replace(hinge, axis=-hinge.axis, states=-hinge.states)
    true = [true[0], replace(true[1], joints=(turned,))]
    first, second = (assigned(each, model)[0][0] for each in true)
    assert {first, second} == {0, 1}
    aims = targets(split, true, rows, model)
    wanted = torch.zeros_like(aims.there)
    wanted[rows[0], second] = wanted[rows[1], first] = 1.0
    assert torch.equal(aims.still, wanted)
    assert torch.equal(aims.state[rows[0], second], rest_states(aims.state, 3)[second].expand(8))
    unknown = targets(split, [true[0], None], rows, model)
    assert not unknown.still.any()

    aims, turning = aims.of(torch.from_numpy(rows[0][:2])), len(model.revolute)
    learner = find_method("ppd").start(load_recipe("ppd_quick"), seed=0, device=torch.device("cpu"))
    with torch.no_grad():
        predicted = learner.model(unpacked(split.surface[rows[0][:2], :128]))
    amount = amount_of(aims.state, turning)
    amount[0, second] += 0.1
    some = replace(predicted, pose=replace(predicted.pose, amount=amount))
    logits, owner = torch.zeros(2, 8, 5), torch.zeros(2, 5, dtype=torch.long)
    terms = aim_terms(some, logits, owner, aims, WarmStart(still=3.0), turning)
    assert float(terms["aim_state"]) == pytest.approx(0.0, abs=1e-9)
    assert float(terms["aim_still"]) == pytest.approx(3.0 * 0.01 / 2, rel=1e-4)


def test_parts_entropy_is_what_it_says():
    rng = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 3, 5, generator=rng, dtype=torch.float64)
    owner = torch.tensor([[0, 1, -1, 2, 0], [-1, -1, 1, 1, 2]])
    known = torch.tensor([1.0, 0.0])
    total = 0.0
    for p in range(3):
        for i in range(5):
            share = 1.0 / (1.0 + np.exp(-float(logits[0, p, i])))
            total -= 4.0 * np.log(share) if owner[0, i] == p else np.log(1.0 - share)
    wanted = 4096 * total / 5 / 2
    assert float(parts_entropy(logits, owner, known, 4.0)) == pytest.approx(wanted)


def test_labels_entropy_is_what_it_says():
    rng = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 3, 5, generator=rng, dtype=torch.float64)
    owner = torch.tensor([[0, 1, 1, 2, 0], [0, 0, 1, 1, 2]])
    known = torch.tensor([1.0, 0.0])
    total = 0.0
    for i in range(5):
        e = np.exp(logits[0, :, i].numpy())
        total -= np.log(e[owner[0, i]] / e.sum())
    wanted = 4096 * total / 5 / 2
    logits.requires_grad_()
    entropy = labels_entropy(logits, owner, known)
    assert float(entropy.detach()) == pytest.approx(wanted)
    entropy.backward()
    mine = owner[:, None] == torch.arange(3)[:, None]
    assert (logits.grad[0][mine[0]] == 0).all()  # the part's own field is left alone
    assert (logits.grad[0][~mine[0]] > 0).all()  # the others' go down
    assert (logits.grad[1] == 0).all()


def test_what_was_found_is_kept_and_read_again(boxes, tmp_path, monkeypatch):
    """Also what a run that was killed had found when it was: it goes on with the others."""
    split, _, _ = boxes

    def kill(_: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        discovered(split, tmp_path, WAYS, kill)
    every = [
        stored(split, split.poses_of(name)) for name in dict.fromkeys(split.object_id.tolist())
    ]
    kept, missing = (_Asked(poses, WAYS, tmp_path / "joints").path for poses in every)
    before = kept.stat().st_mtime_ns
    missing.write_bytes(b"lost with the power")
    sentences = []
    first, rows = discovered(split, tmp_path, WAYS, sentences.append)
    assert kept.stat().st_mtime_ns == before
    assert len(rows) == 2
    assert sentences == ["looking for joints in the training objects: 2 of 2"]
    monkeypatch.setattr(found_module, "_look", None)  # the second time nothing is looked for
    # Nor where the recipe was read again: 0.0 stands there where the default is 0.
    read_again = ModelSettings.model_validate(MODEL.model_dump(mode="json"))
    again, _ = discovered(split, tmp_path, directions_of(read_again))
    for one, other in zip(first, again, strict=True):
        assert (one is None) == (other is None)
        if one and other:
            np.testing.assert_array_equal(one.owner, other.owner)
            for a, b in zip(one.joints, other.joints, strict=True):
                np.testing.assert_array_equal(a.states, b.states)
                assert a.kind == b.kind
    discovered(split.of(split.object_id[:1]), tmp_path, WAYS)  # nor in a smaller set


def test_where_nothing_moves_one_sentence_says_so(boxes, tmp_path):
    split, _, rows = boxes
    surface = split.surface.clone()
    for mine in rows:
        surface[mine] = surface[mine[0]].clone()
    still = type(split)(**{**vars(split), "surface": surface})
    with pytest.raises(UnfitData, match="in no training object do the poses show"):
        discovered(still, tmp_path, WAYS)
