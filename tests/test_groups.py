"""Instances are grouped by the object that they show, from their clouds alone."""

import json
from functools import partial

import numpy as np
import pytest
from command_line import run
from hypothesis import given
from hypothesis import strategies as st

import articugen
from articugen.core.errors import InvalidArgument, UnfitData
from articugen.discovery import groups
from articugen.discovery.groups import CUT, agreement, group_instances
from articugen.discovery.objects import group_all
from articugen.learning.data.groups import found_objects
from articugen.store.shards import open_shard


def box_cloud(low, high, rng, n=1500):
    """Points on a box and their normals out of it."""
    low, high = np.array(low), np.array(high)
    points = rng.uniform(low, high, (n, 3))
    axis, side = rng.integers(3, size=n), rng.integers(2, size=n)
    rows = np.arange(n)
    points[rows, axis] = np.where(side, high[axis], low[axis])
    normals = np.zeros((n, 3))
    normals[rows, axis] = 2 * side - 1
    return points, normals


def drawer(seed, pose):
    """A box of random size, and a smaller one that slides out of it."""
    size = np.random.default_rng(seed).uniform(0.1, 0.3, 3)
    rng = np.random.default_rng((seed, pose))
    fixed = box_cloud(-size, size, rng)
    out = np.array([rng.uniform(0.0, 0.2), 0.0, 0.0])
    moving = box_cloud(out - 0.8 * size, out + 0.8 * size, rng, 700)
    points, normals = (np.concatenate(pair) for pair in zip(fixed, moving, strict=True))
    return points, normals


def shuffled(objects, poses, seed=0):
    pairs = [(o, p) for o in range(objects) for p in range(poses)]
    np.random.default_rng(seed).shuffle(pairs)
    return [drawer(o, p) for o, p in pairs], np.array([o for o, _ in pairs])


@pytest.mark.parametrize(("objects", "poses"), [(8, 5), (2, 9), (12, 2), (1, 4)])
def test_poses_of_an_object_are_grouped(objects, poses):
    clouds, truth = shuffled(objects, poses)
    got = group_instances(clouds)
    assert agreement(got.number, truth) == (1.0, 1.0, 1.0)
    assert got.between < CUT < 0.7 < got.within


def test_groups_are_counted_as_they_appear_and_do_not_depend_on_order():
    clouds, _ = shuffled(5, 4)
    number = group_instances(clouds).number
    first = [int(np.flatnonzero(number == g)[0]) for g in range(number.max() + 1)]
    assert first == sorted(first)
    back = group_instances(clouds[::-1]).number[::-1]
    assert agreement(number, back)[0] == 1.0


def test_an_instance_that_is_alone_stays_alone():
    clouds, truth = shuffled(4, 4)
    alone = [*clouds, drawer(99, 0)]
    number = group_instances(alone).number
    assert (number[:-1] != number[-1]).all()
    assert agreement(number[:-1], truth)[0] == 1.0


def test_more_than_are_compared_join_the_groups_of_the_others(monkeypatch):
    clouds, truth = shuffled(6, 8)
    monkeypatch.setattr(groups, "MOST", 30)
    assert agreement(group_instances(clouds).number, truth)[0] == 1.0


def test_one_and_no_instance():
    assert group_instances([]).number.tolist() == []
    alone = group_instances([drawer(0, 0)])
    assert (alone.number.tolist(), alone.within, alone.between) == ([0], 1.0, 0.0)


def test_poses_that_share_no_frame_are_not_grouped():
    clouds, truth = shuffled(4, 4)
    moved = [(points + 0.02 * i, normals) for i, (points, normals) in enumerate(clouds)]
    assert agreement(group_instances(moved).number, truth)[2] < 0.5


def test_clouds_without_normals_are_refused():
    points, _ = drawer(0, 0)
    with pytest.raises(InvalidArgument, match="these have none"):
        group_instances([(points, np.zeros((0, 3)))])


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=2, max_size=12))
def test_agreement_counts_pairs(pairs):
    number, truth = np.array(pairs).T
    i, j = np.triu_indices(len(pairs), 1)
    grouped, same = number[i] == number[j], truth[i] == truth[j]
    both = (grouped & same).sum()
    rand, precision, recall = agreement(number, truth)
    assert precision == both / max(grouped.sum(), 1)
    assert recall == both / max(same.sum(), 1)
    chance, most = grouped.sum() * same.sum() / len(i), (grouped.sum() + same.sum()) / 2
    assert rand == pytest.approx(1.0 if most == chance else (both - chance) / (most - chance))


@pytest.fixture(scope="module")
def laptops(tmp_path_factory):
    small = ["sampling.grids=[32]", "sampling.surface_points=4096", "sampling.partial_views=0"]
    out = tmp_path_factory.mktemp("groups")
    articugen.generate("laptop", out=out, objects=4, states=3, jobs=0, changes=small)
    return out / "laptop"


def test_a_data_set_is_grouped_and_compared_with_its_objects(laptops):
    grouped = group_all(laptops)
    assert (grouped.count, grouped.agreement) == (4, (1.0, 1.0, 1.0))
    members = grouped.as_json()
    assert [len(group) for group in members] == [4] * 4
    assert all(len({row["object"] for row in group}) == 1 for group in members)


def test_the_command_prints_and_writes_groups(laptops, tmp_path):
    refused = run("discover", laptops, "--groups", "--joints", "revolute")
    assert (refused.exit_code, "takes no --joints" in refused.stderr) == (1, True)
    done = run("discover", laptops, "--groups", "--json", tmp_path / "groups.json")
    assert done.exit_code == 0
    assert "16 instances in 4 groups; the data set names 4 objects" in done.output
    assert json.loads((tmp_path / "groups.json").read_text()) == group_all(laptops).as_json()


def test_the_command_writes_how_right_each_object_is(laptops, tmp_path):
    done = run("discover", laptops, "--poses", 3, "--json", tmp_path / "joints.json")
    judged = [row["judged"] for row in json.loads((tmp_path / "joints.json").read_text())]
    apart = [o["apart"] for o in judged if o["apart"] is not None]
    assert len(judged) == 4
    assert all(isinstance(o["pivot"], bool) for o in judged)
    assert apart
    assert f"E {sum(apart) / len(apart):.4f}" in " ".join(done.output.split())


def test_the_command_wants_a_data_set_for_groups(tmp_path):
    cloud = tmp_path / "closed.ply"
    cloud.touch()
    done = run("discover", cloud, "--groups")
    assert done.exit_code != 0
    assert "give one data set" in " ".join(done.output.split())


def test_poses_that_are_of_no_one_object_teach_no_motion(tmp_path):
    """One pose of each object: there is nothing to compare."""
    small = ["sampling.grids=[32]", "views.count=30", "views.resolution=128"]
    articugen.generate("oven", out=tmp_path, objects=3, states=0, jobs=0, changes=small)
    shards = sorted((tmp_path / "oven").glob("train-*.h5"))
    with pytest.raises(UnfitData, match="no two training instances show one object"):
        found_objects([partial(open_shard, path) for path in shards], "here")


def test_groups_found_are_as_good_as_groups_given_to_the_bit(laptops):
    """So every published number holds for both, where the groups are the objects."""
    torch = pytest.importorskip("torch")
    from articugen.learning.data.batch import BatchSpec  # noqa: PLC0415
    from articugen.learning.data.split import load_split  # noqa: PLC0415

    wanted = {"surface_points": 512, "varying_points": 64, "poses": True, "normals": True}
    splits = [
        load_split(laptops, "train", BatchSpec(groups=groups, **wanted), [32])
        for groups in ("found", "given")
    ]
    assert splits[0].object_id.tolist() == splits[1].object_id.tolist()
    for one, other in zip(*([split.varying.index, split.surface] for split in splits), strict=True):
        assert torch.equal(one, other)
