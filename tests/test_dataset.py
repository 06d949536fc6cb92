"""PPD's data: what a batch holds is what the shards hold."""

import dataclasses

import numpy as np
import pytest
import torch
from instances import changed
from ppd_data import one_box, rewrite, write_boxes

from articugen.core import geometry, schema
from articugen.core.errors import CorruptShard, UnfitData
from articugen.core.records import dequantize
from articugen.learning import tensors
from articugen.learning.data import split
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import _places, load_split, unpacked, voxel_centres
from articugen.store.shards import open_shard

ASK = BatchSpec(
    surface_points=300, grid_points=200, uniform_points=100, near_points=50, joints=(3, 4)
)
SEEN = dataclasses.replace(ASK, partial=True)


@pytest.fixture(scope="module")
def packed(boxes):
    return load_split(boxes, "train", ASK, [8], category="box")


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def rows_of(array):
    """Points as they are stored."""
    return {tuple(row) for row in stored(array).tolist()}


def stored(points):
    return np.round((np.asarray(points, np.float64) + 0.5) * 65535).astype(int)


def size_of(split):
    """Return the bytes of its tensors."""
    sizes = []
    tensors.changed(split, torch.Tensor, lambda tensor: sizes.append(tensor.nbytes) or tensor)
    return sum(sizes)


def test_everything_of_the_split_is_there(packed):
    assert len(packed) == 16
    assert sorted(set(packed.object_id)) == [f"box-{i}" for i in range(4)]
    assert packed.state_index.tolist() == [0, 1, 2, 3] * 4
    assert size_of(packed) == 16 * (2048 * 6 + 512 + 1024 * 7 + 2048 * 7 + 2 * 8)


def test_points_are_carried_to_the_canonical_pose_and_joints_are_those_of_the_shards(boxes):
    """What a supervised learner asks for, against the rows of the shards."""
    spec = BatchSpec(surface_points=2048, parts=True, motions=True)
    packed = load_split(boxes, "train", spec, [], category="box")
    batch = packed.batch([5, 0], spec, 8, rng())
    assert batch.rest is not None
    assert set(batch.joints) == {"kind", "state", "axis", "pivot"}
    with open_shard(sorted(boxes.glob("train-*.h5"))[1]) as shard:
        instance = shard.instance(1)
    points, part = dequantize(instance.surface_points), instance.surface_part
    back = geometry.invert_rigid(instance.part_motion)[part]
    rest = (back[:, :3, :3] @ points[..., None])[..., 0] + back[:, :3, 3]
    np.testing.assert_allclose(batch.rest[0], rest, atol=1e-6)
    assert (batch.part[0].numpy() == part).all()
    for name, values in batch.joints.items():
        np.testing.assert_allclose(values[0], getattr(instance, f"joint_{name}"), atol=1e-6)
    assert torch.equal(batch.rest[1], batch.cloud[1])  # the canonical pose itself


def test_an_object_with_fewer_joints_has_zeros_in_their_place():
    one, two = np.ones((3, 2, 4, 4)), np.ones((1, 3, 4, 4))
    joined = split._joined("part_motion", [one, two])
    assert joined.shape == (4, 3, 4, 4)
    assert not joined[:3, 2].any()
    assert joined[3].all()


def test_fixed_point_is_unpacked_exactly():
    stored = np.arange(65536, dtype=np.uint16)
    wanted = dequantize(stored)
    have = unpacked(torch.from_numpy(stored.view(np.int16)))
    np.testing.assert_allclose(have.numpy(), wanted, atol=6e-8)


def test_a_batch_holds_points_of_the_instances_it_was_asked_for(boxes, packed):
    batch = packed.batch([5, 2, 5], ASK, 8, rng())
    assert batch.cloud.shape == (3, 300, 3)
    assert batch.points.shape == (3, 350, 3)
    assert batch.spread == 300
    for b, row in enumerate((5, 2, 5)):
        with open_shard(boxes / f"train-{row // 4:05d}.h5") as shard:
            instance = shard.instance(row % 4)
        cloud = batch.cloud[b].numpy()
        assert rows_of(cloud) <= rows_of(dequantize(instance.surface_points))
        assert len(rows_of(cloud)) == 300  # without replacement
        labels = {}
        for points, label in (
            (instance.uniform_points, instance.uniform_label),
            (instance.near_points, instance.near_label),
        ):
            labels |= {tuple(p): m > 0 for p, m in zip(points.tolist(), label, strict=True)}
        for point, occupied in zip(batch.points[b, 200:], batch.occupied[b, 200:], strict=True):
            assert labels[tuple(stored(point).tolist())] == occupied
        cell = np.floor((batch.points[b, :200].numpy() + 0.5) * 8).astype(int)
        occupied = instance.occupancy[8][cell[:, 0], cell[:, 1], cell[:, 2]] > 0
        np.testing.assert_array_equal(occupied, batch.occupied[b, :200].numpy())
    assert not torch.equal(batch.cloud[0], batch.cloud[2])


def test_a_batch_depends_on_its_generator_alone(packed):
    one, two = (packed.batch([1, 2], ASK, 8, rng(7)) for _ in range(2))
    other = packed.batch([1, 2], ASK, 8, rng(8))
    assert torch.equal(one.cloud, two.cloud)
    assert torch.equal(one.points, two.points)
    assert not torch.equal(one.cloud, other.cloud)


@pytest.mark.parametrize(("n", "count"), [(40, 30), (40, 10), (41, 10), (43, 3), (7, 1)])
def test_every_stored_point_is_taken_as_often_and_none_twice(n, count):
    """One in n / count draws, within five standard deviations, whatever the way of drawing."""
    draws = 20_000
    places = _places(torch.zeros(draws, dtype=torch.long), n, count, rng())
    assert places.shape == (draws, count)
    assert (places.sort(dim=1).values.diff(dim=1) > 0).all()
    share = count / n
    seen = torch.bincount(places.flatten(), minlength=n) / draws
    assert len(seen) == n
    assert float((seen - share).abs().max()) < 5 * (share * (1 - share) / draws) ** 0.5


def test_a_whole_grid_is_taken_as_it_is(packed):
    ask = BatchSpec(surface_points=10, grid_points=512)
    batch = packed.batch([0], ask, 8, rng())
    assert torch.equal(batch.points[0], voxel_centres(torch.arange(512), 8))
    assert torch.equal(batch.occupied[0], packed.grids[8][0] > 0)


def test_voxel_centres_are_those_of_the_conventions():
    centres = voxel_centres(torch.arange(27), 3).view(3, 3, 3, 3)
    np.testing.assert_allclose(centres.view(-1, 3), geometry.voxel_centres(3), atol=1e-7)
    np.testing.assert_allclose(centres[2, 0, 1].numpy(), [1 / 3, -1 / 3, 0.0], atol=1e-7)


def test_some_objects_alone(packed):
    some = packed.of(["box-2"])
    assert set(some.object_id) == {"box-2"}
    assert torch.equal(some.surface, packed.surface[8:12])
    assert torch.equal(some.near[1], packed.near[1][8:12])
    two = packed.of(["box-3", "box-1"])
    assert two.poses_of("box-3").tolist() == [4, 5, 6, 7]
    backwards = dataclasses.replace(packed, state_index=packed.state_index[::-1].copy())
    assert backwards.poses_of("box-2").tolist() == [11, 10, 9, 8]


def test_what_is_not_asked_for_is_not_kept(boxes):
    packed = load_split(boxes, "test", BatchSpec(surface_points=10, grid_points=10), [16])
    assert packed.near[0].shape == (8, 0, 3)
    assert packed.uniform[1].shape == (8, 0)
    assert list(packed.grids) == [16]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"split": "val"}, "has no object in split 'val', only in: test, train"),
        ({"category": "laptop"}, "holds box, not laptop"),
        ({"resolutions": [64]}, "has no occupancy_64; add 64 to sampling.grids"),
        (
            {"ask": dataclasses.replace(ASK, joints=(3, 0))},
            "and 1 prismatic joints, the recipe's model 3 and 0 such parts",
        ),
        ({"ask": BatchSpec(surface_points=5000)}, "has 2048 surface_points an instance"),
    ],
)
def test_unfit_data_are_refused_in_one_sentence(boxes, change, said):
    wanted = {"split": "train", "ask": ASK, "resolutions": [8], "category": "box"} | change
    split, ask, resolutions = wanted.pop("split"), wanted.pop("ask"), wanted.pop("resolutions")
    with pytest.raises(UnfitData, match=said.replace("(", r"\(")):
        load_split(boxes, split, ask, resolutions, **wanted)


def test_a_folder_without_a_manifest_is_refused(tmp_path):
    with pytest.raises(CorruptShard, match="cannot be read"):
        load_split(tmp_path, "train", ASK, [8])


def test_shards_that_cannot_be_learnt_from_are_refused(tmp_path):
    none = np.zeros(0)
    still = dict.fromkeys(("joint_kind", "joint_parent", "joint_state"), none)
    still |= {"joint_lower": none, "joint_upper": none, "part_motion": np.eye(4)[None]}
    still |= {"joint_axis": np.zeros((0, 3)), "joint_pivot": np.zeros((0, 3))}
    blind = {"partial_points": np.zeros((0, 0, 3)), "partial_part": np.zeros((0, 0))}
    blind |= {"partial_T_camera_world": np.zeros((0, 4, 4)), "partial_intrinsics": np.zeros((0, 4))}
    for name, change, about, error, said in (
        ("still", still, {}, UnfitData, "has no joint; what never moves teaches no parts"),
        ("blind", blind, {}, UnfitData, "has no partial clouds; set sampling.partial_views"),
        (
            "oven",
            {},
            {"category": "oven"},
            CorruptShard,
            "is of category 'oven', the manifest says 'box'",
        ),
        (
            "test",
            {},
            {"split": "test"},
            CorruptShard,
            "is of split 'test', the manifest says 'train'",
        ),
    ):
        folder = tmp_path / name
        one_box(folder, lambda rows, change=change: [changed(r, **change) for r in rows], **about)
        with pytest.raises(error, match=f"train-00000.h5: {said}"):
            load_split(folder, "train", SEEN, [8])


def test_shards_of_another_version_are_refused(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(schema, "SCHEMA_VERSION", 7)
        folder = write_boxes(tmp_path / "new", train=1, test=0, states=1)
    with pytest.raises(CorruptShard, match=r"h5: schema version 7, this articugen reads 1 to 3"):
        load_split(folder, "train", ASK, [8])


def test_shards_that_do_not_fit_together_are_refused(tmp_path):
    folder = write_boxes(tmp_path, train=2, test=0, states=1)
    names = ("surface_points", "surface_normals", "surface_part")
    rewrite(
        folder / "train-00001.h5",
        lambda rows: [changed(rows[0], **{name: getattr(rows[0], name)[:500] for name in names})],
    )
    with pytest.raises(UnfitData, match="shards of different shapes"):
        load_split(folder, "train", ASK, [8])


def with_enclosed(label):
    label = np.array(label)
    label.ravel()[::7] = np.where(label.ravel()[::7] == 0, 255, label.ravel()[::7])
    return label


def test_several_data_sets_are_as_one(boxes, packed, tmp_path):
    other = write_boxes(tmp_path / "other", train=2, test=1, states=2, first=10)
    alone = load_split(other, "train", ASK, [8])
    both = load_split((boxes, other), "train", ASK, [8], category="box")
    assert both.object_id.tolist() == [*packed.object_id, *alone.object_id]
    assert torch.equal(both.surface, torch.cat([packed.surface, alone.surface]))
    assert torch.equal(both.grids[8], torch.cat([packed.grids[8], alone.grids[8]]))
    assert size_of(both) == size_of(packed) + size_of(alone)


def test_data_sets_that_do_not_go_together_are_refused(boxes, tmp_path):
    jars = write_boxes(tmp_path / "jars", train=1, test=0, states=1, category="jar", first=10)
    tested = write_boxes(tmp_path / "tested", train=1, test=0, states=1, first=5)
    for other, said in (
        (jars, "jars: holds jar, not box"),
        (tested, "tested: has an object box-5, as .* has; leave it out of one"),
    ):
        with pytest.raises(UnfitData, match=said):
            load_split((boxes, other), "train", ASK, [8])


def test_enclosed_space_is_occupied_or_free_as_the_recipe_says(tmp_path):
    """No label reaches a batch as a part's number: 255 names none."""

    def enclosing(row):
        return changed(
            row,
            near_label=with_enclosed(row.near_label),
            uniform_label=with_enclosed(row.uniform_label),
            occupancy={r: with_enclosed(grid) for r, grid in row.occupancy.items()},
        )

    rows = one_box(tmp_path, lambda rows: list(map(enclosing, rows)))
    enclosed = list(map(enclosing, rows))
    assert (enclosed[1].occupancy[8] == 255).any()
    for occupancy in ("visible", "material"):
        ask = dataclasses.replace(ASK, occupancy=occupancy)
        packed = load_split(tmp_path, "train", ask, [8])
        want = enclosed if occupancy == "visible" else rows
        for i, row in enumerate(want):
            for have, label in (
                (packed.grids[8][i], row.occupancy[8].ravel()),
                (packed.near[1][i], row.near_label),
                (packed.uniform[1][i], row.uniform_label),
            ):
                np.testing.assert_array_equal(have.numpy() > 0, label > 0)


def test_a_grid_that_holds_no_voxel_is_learnt_by_its_surface(tmp_path):
    """A plate between the centres of a coarse grid: each voxel that its surface passes through."""
    empty = {8: np.zeros((8, 8, 8), np.uint8)}
    rows = one_box(
        tmp_path,
        lambda rows: [rows[0], changed(rows[1], occupancy={**rows[1].occupancy, **empty})],
    )
    packed = load_split(tmp_path, "train", ASK, [8, 16])
    np.testing.assert_array_equal(packed.grids[8][0].numpy(), rows[0].occupancy[8].ravel())
    np.testing.assert_array_equal(packed.grids[16][1].numpy(), rows[1].occupancy[16].ravel())
    cell = np.floor((dequantize(rows[1].surface_points) + 0.5) * 8).astype(int).clip(0, 7)
    expected = np.zeros((8, 8, 8), bool)
    expected[tuple(cell.T)] = True
    filled = packed.grids[8][1].numpy().reshape(8, 8, 8) > 0
    np.testing.assert_array_equal(filled, expected)
    assert 0 < filled.sum() < 256
    whole = dataclasses.replace(ASK, grid_points=512)
    assert packed.batch([1], whole, 8, rng()).occupied[0, :512].sum() == filled.sum()


def test_partial_clouds_come_as_stored(boxes):
    packed = load_split(boxes, "test", SEEN, [8])
    with open_shard(boxes / "test-00004.h5") as shard:
        seen = shard.instance(1).partial_points
    np.testing.assert_array_equal(packed.partial[1].numpy().view(np.uint16), seen)
    assert packed.of(["box-5"]).partial.shape == (4, 2, 256, 3)
    assert load_split(boxes, "test", ASK, [8]).partial.shape[1] == 0


def test_a_batch_of_partial_clouds_holds_what_one_camera_sees(boxes):
    packed = load_split(boxes, "test", SEEN, [8])
    batches = [packed.batch([1, 6], SEEN, 8, rng(seed)) for seed in range(8)]
    cameras = set()
    for batch in batches:
        assert batch.rows.tolist() == [1, 6]
        for b, row in enumerate((1, 6)):
            (camera,) = [
                c for c in range(2) if torch.equal(batch.cloud[b], unpacked(packed.partial[row, c]))
            ]
            cameras.add(camera)
    assert cameras == {0, 1}


def test_a_batch_tells_the_true_parts_of_its_cloud(boxes):
    ask = BatchSpec(surface_points=200, parts=True)
    packed = load_split(boxes, "train", ask, [])
    batch = packed.batch([5], ask, 8, rng())
    assert batch.points.shape == (1, 0, 3)
    with open_shard(boxes / "train-00001.h5") as shard:
        instance = shard.instance(1)
    part = dict(
        zip(map(tuple, instance.surface_points.tolist()), instance.surface_part, strict=True)
    )
    for point, told in zip(batch.cloud[0], batch.part[0].tolist(), strict=True):
        assert part[tuple(stored(point).tolist())] == told
    assert len(set(batch.part[0].tolist())) == 3
    assert packed.of(["box-1"]).part.shape == (4, 2048)
