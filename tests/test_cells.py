"""Query points at voxels where an object's poses differ, and in the band around one pose."""

import dataclasses
from contextlib import nullcontext
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from instances import SMALL, edited, hinged_box
from ppd_data import one_box, rewrite, write_boxes

from articugen.core.errors import UnfitData
from articugen.core.records import is_material
from articugen.learning.commands import hints
from articugen.learning.data import cells
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.cells import LabelledCells, voxel_centres
from articugen.learning.data.fitness import apart, check_fixed_part, lying_otherwise
from articugen.learning.data.split import load_split
from articugen.store.shards import Shard, open_shard

BOXES = {"train": 2, "test": 0}

ASK = BatchSpec(
    surface_points=100, grid_points=40, near_points=30, band_points=60, varying_points=50
)


@pytest.fixture(scope="module")
def packed(boxes):
    return load_split(boxes, "train", ASK, [8])


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def grids_of(folder, index, resolution=32):
    """(N, R, R, R) the stored labels of an object's poses."""
    with open_shard(folder / f"train-{index:05d}.h5") as shard:
        return shard.read(f"occupancy_{resolution}")


def naive_band(inside):
    """Each cell by itself: whether the cube of seven cells around it holds both labels."""
    found = np.zeros_like(inside)
    for cell in np.ndindex(inside.shape):
        around = inside[tuple(slice(max(x - cells.REACH, 0), x + cells.REACH + 1) for x in cell)]
        found[cell] = around.any() and not around.all()
    return found


@pytest.mark.parametrize("resolution", [5, 8, 11])
@pytest.mark.parametrize("share", [0.002, 0.5, 0.99])
def test_the_band_is_where_both_labels_are_near(resolution, share):
    inside = np.random.default_rng(resolution).random((resolution,) * 3) < share
    found = cells.band(inside)
    np.testing.assert_array_equal(found, naive_band(inside))


def test_the_band_of_half_a_cube_is_six_cells_thick():
    inside = np.zeros((16, 16, 16), bool)
    inside[:, :, :9] = True
    found = cells.band(inside)
    assert np.flatnonzero(found.all(axis=(0, 1))).tolist() == [6, 7, 8, 9, 10, 11]
    assert found.sum() == 6 * 256


def test_what_differs_is_told_for_each_object_by_itself():
    occupied = np.zeros((5, 4, 4, 4), bool)
    occupied[:, 0] = True  # in all poses of all objects
    occupied[0, 1, 2, 3] = occupied[3, 3, 2, 1] = True
    names = np.array(["a", "b", "a", "b", "b"])
    found = cells.differing(occupied, names)
    assert [np.argwhere(mask).tolist() for mask in found] == [
        [[1, 2, 3]], [[3, 2, 1]], [[1, 2, 3]], [[3, 2, 1]], [[3, 2, 1]]
    ]  # fmt: skip


def test_few_cells_are_all_kept_and_of_many_as_many_as_fit():
    mask = np.ones((1, 16, 16, 16), bool)
    inside = np.zeros((1, 16, 16, 16), bool)
    inside.ravel()[5:3000:7] = True
    (index,), (count,) = cells.pack("band", mask, inside, np.array(["a"]), np.array([0]))
    assert count.tolist() == [cells.KEPT, inside.sum()]
    assert sorted(index[1, : count[1]]) == np.flatnonzero(inside).tolist()
    assert len(set(index[0].tolist())) == cells.KEPT
    assert not inside.ravel()[index[0]].any()
    again = cells.pack("band", mask, inside, np.array(["a"]), np.array([0]))
    np.testing.assert_array_equal(again[0][0], index)
    other = cells.pack("band", mask, inside, np.array(["a"]), np.array([1]))
    assert (other[0][0] != index).any()


def test_half_of_what_is_drawn_is_occupied_however_few_those_are():
    index = torch.zeros(3, 2, 8, dtype=torch.int32)
    index[0] = torch.arange(16).view(2, 8)
    index[1, 0, :2], index[1, 1, 0] = torch.tensor([7, 9]), 11
    index[2, 0, :3] = torch.tensor([1, 2, 3])
    some = LabelledCells(4, index, torch.tensor([[8, 8], [2, 1], [3, 0]], dtype=torch.int32))
    points, occupied = some.draw(torch.tensor([0, 1, 2, 1]), 400, rng())
    assert points.shape == (4, 400, 3)
    assert occupied.sum(1).tolist() == [200, 200, 0, 200]
    drawn = [
        (b, tuple(((points[b, i] + 0.5) * 4 - 0.5).round().int().tolist()), bool(occupied[b, i]))
        for b in range(4)
        for i in range(400)
    ]
    flat = {(b, 16 * x + 4 * y + z, inside) for b, (x, y, z), inside in drawn}
    assert {(i, inside) for b, i, inside in flat if b == 0} == {(i, i > 7) for i in range(16)}
    assert {(i, inside) for b, i, inside in flat if b in (1, 3)} == {
        (7, False), (9, False), (11, True)
    }  # fmt: skip
    assert {(i, inside) for b, i, inside in flat if b == 2} == {(i, False) for i in (1, 2, 3)}
    each = torch.bincount(
        (points[0] + 0.5).mul(4).sub(0.5).round().long() @ torch.tensor([16, 4, 1])
    )
    assert 15 < int(each.min()) <= int(each.max()) < 90  # 25 each


def test_voxels_are_numbered_as_grids_are_stored(boxes, packed):
    """Every cell that is packed: its label is that of the stored grid, and it is of its kind."""
    for row in range(len(packed)):
        inside = grids_of(boxes, row // 4) > 0
        masks = {
            "band": naive_band(inside[row % 4]) if row in (0, 5) else None,
            "varying": inside.any(0) & ~inside.all(0),
        }
        for kind, mask in masks.items():
            some = getattr(packed, kind)
            assert some.resolution == 32
            for label in (0, 1):
                held = some.index[row, label, : some.count[row, label]].numpy()
                assert len(set(held.tolist())) == len(held)
                assert (inside[row % 4].ravel()[held] == label).all()
                if mask is not None:
                    assert mask.ravel()[held].all()
                    every = int((mask & (inside[row % 4] == label)).sum())
                    assert len(held) == min(every, cells.KEPT)


def test_a_batch_has_them_last_and_spread_evenly_are_the_first_alone(boxes, packed):
    batch = packed.batch([6, 0, 6], ASK, 8, rng())
    assert batch.points.shape == (3, 180, 3)
    assert batch.spread == 40
    assert batch.occupied.dtype == torch.bool
    cell = ((batch.points + 0.5) * 32).floor().long()
    np.testing.assert_allclose(
        batch.points[:, 70:], (cell[:, 70:] + 0.5) / 32 - 0.5, atol=1e-6
    )  # voxels' centres
    for b, row in enumerate((6, 0, 6)):
        inside = grids_of(boxes, row // 4) > 0
        x, y, z = cell[b, 70:].T.numpy()
        np.testing.assert_array_equal(inside[row % 4, x, y, z], batch.occupied[b, 70:].numpy())
        assert (inside.any(0) & ~inside.all(0))[x[60:], y[60:], z[60:]].all()
    assert (batch.occupied[:, 70:130].sum(1) == 30).all()
    assert (batch.occupied[:, 130:].sum(1) == 25).all()
    assert not torch.equal(batch.points[0], batch.points[2])
    again = packed.batch([6, 0, 6], ASK, 8, rng())
    assert torch.equal(again.points, batch.points)


def test_what_is_packed_takes_sixteen_kilobytes_an_instance_and_kind(boxes, packed):
    none = dataclasses.replace(ASK, band_points=0, varying_points=0)
    less = load_split(boxes, "train", none, [8])
    assert less.band.index.shape == (8, 2, 0)
    kept = (packed.band.index, packed.varying.index)
    assert sum(index.nbytes for index in kept) == 8 * 2 * (2 * 2048 * 4)
    some = packed.of(["box-1"])
    assert torch.equal(some.varying.index, packed.varying.index[4:])
    assert torch.equal(some.band.count, packed.band.count[4:])


def test_the_finest_grid_up_to_the_limit_is_taken(boxes, monkeypatch):
    monkeypatch.setattr(cells, "FINEST", 20)
    assert load_split(boxes, "train", ASK, [8]).varying.resolution == 16
    monkeypatch.setattr(cells, "FINEST", 4)
    with pytest.raises(UnfitData, match=r"train-00000\.h5: has no grid of 4 or less"):
        load_split(boxes, "train", ASK, [8])


def test_enclosed_space_varies_only_where_it_counts_as_occupied(tmp_path):
    def edit(rows):
        grid = rows[1].occupancy[32].copy()
        grid[0, 0, 0] = 255
        return [rows[0], dataclasses.replace(rows[1], occupancy={**rows[1].occupancy, 32: grid})]

    one_box(tmp_path, edit)
    for occupancy, differs in (("visible", True), ("material", False)):
        ask = dataclasses.replace(ASK, occupancy=occupancy)
        some = load_split(tmp_path, "train", ask, [8]).varying
        assert (0 in some.index[0, 0, : some.count[0, 0]].tolist()) == differs
        assert is_material(grids_of(tmp_path, 0)[1])[0, 0, 0] == 0


def still(rows):
    """Both in the canonical pose."""
    return list(hinged_box(((0.0, 0.0), (0.0, 0.0)), recipe=SMALL))


def elsewhere(rows):
    return [rows[0], dataclasses.replace(rows[1], center=rows[1].center + 0.01)]


def larger(rows):
    return [rows[0], dataclasses.replace(rows[1], scale=rows[1].scale * 1.001)]


def carried_off(rows):
    motion = rows[1].part_motion.copy()
    motion[:, 2, 3] += 0.02
    return [rows[0], dataclasses.replace(rows[1], part_motion=motion)]


def shifted(rows):
    grids = {r: np.roll(grid, r // 4, axis=2) for r, grid in rows[1].occupancy.items()}
    return [rows[0], dataclasses.replace(rows[1], occupancy=grids)]


FRAME = "the poses of box-0 share no frame: "
CASES = [
    (lambda rows: rows[:1], "holds one pose of box-0, the recipe compares poses"),
    (still, "no cell of occupancy_32 differs between the poses of box-0"),
    (elsewhere, f"{FRAME}center, scale or the place of the fixed part differ"),
    (larger, f"{FRAME}center, scale or the place of the fixed part differ"),
    (carried_off, f"{FRAME}center, scale or the place of the fixed part differ"),
    (shifted, f"{FRAME}most of its fixed part is not where it was in the first"),
]


@pytest.mark.parametrize(("edit", "said"), CASES)
def test_poses_that_cannot_be_compared_are_refused_in_one_sentence(tmp_path, edit, said):
    one_box(tmp_path, edit)
    with pytest.raises(UnfitData, match=f"train-00000.h5: {said}") as told:
        load_split(tmp_path, "train", ASK, [8])
    assert "; " in str(told.value)  # what to do about it


@pytest.mark.parametrize("emptied", [[0], [1], [0, 1]])
def test_coarse_grids_that_hold_nothing_tell_nothing_of_frames(tmp_path, emptied):
    def edit(rows):
        none = {8: np.zeros((8, 8, 8), np.uint8)}
        return [
            dataclasses.replace(row, occupancy={**row.occupancy, **none}) if i in emptied else row
            for i, row in enumerate(rows)
        ]

    one_box(tmp_path, edit)
    assert len(load_split(tmp_path, "train", ASK, [8])) == 2


def test_labels_of_the_first_format_tell_nothing_of_frames(tmp_path):
    """There enclosed space was labelled as the fixed part, and opens with a door."""
    grid = np.stack([row.occupancy[32] for row in shifted(hinged_box()[:2])])
    for version in (1, 2):
        shard = SimpleNamespace(path=tmp_path, attributes={"schema_version": version})
        with pytest.raises(UnfitData) if version == 2 else nullcontext():
            check_fixed_part(cast(Shard, shard), np.array(["a", "a"]), grid)


def test_objects_whose_joints_lie_otherwise_than_most_are_told():
    hinge, slide = np.array([1], np.uint8), np.array([2], np.uint8)
    y, z = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    tilted = np.array([[0.0, np.cos(0.5), np.sin(0.5)]])  # 29 degrees
    most = {f"{i}": (hinge, y) for i in range(3)} | {"opposite": (hinge, -y)}
    assert apart(most | {"tilted": (hinge, tilted)}) == []
    assert apart(most | {"lying": (hinge, z), "drawer": (slide, y)}) == ["lying", "drawer"]
    both = (np.array([1, 2], np.uint8), np.concatenate([z, y]))
    assert apart(most | {"both": both}) == ["both"]
    assert apart({"a": (hinge, y), "b": (hinge, z)}) == ["a", "b"]
    assert apart({"alone": (hinge, y)}) == []
    still = (np.zeros(0, np.uint8), np.zeros((0, 3)))
    assert apart({"a": still, "b": still, "c": (hinge, y), "d": (hinge, y)}) == []


def test_what_lies_otherwise_is_a_hint_before_training(boxes, tmp_path):
    assert lying_otherwise(boxes) == []

    write_boxes(tmp_path, train=3, test=1, states=1)
    rewrite(
        tmp_path / "train-00001.h5",
        lambda rows: [edited(row, "joint_axis", lambda axes: axes[:, [2, 0, 1]]) for row in rows],
    )
    assert lying_otherwise(tmp_path) == ["box-1"]
    (hint,) = [h for h in hints(tmp_path) if "along other axes" in h]
    assert (
        "the joints of 1 of the 3 training objects lie along other axes than most (box-1);" in hint
    )


def test_one_pose_is_enough_where_none_are_compared(tmp_path):
    one_box(tmp_path, lambda rows: rows[:1])
    band = dataclasses.replace(ASK, varying_points=0)
    assert len(load_split(tmp_path, "train", band, [8])) == 1
    with pytest.raises(UnfitData, match="holds one pose"):
        load_split(tmp_path, "train", dataclasses.replace(band, poses=True), [8])


def test_a_joint_that_no_candidate_can_follow_is_refused(boxes):
    for joints in ((0, 4), (3, 0)):
        said = f"model {joints[0]} and {joints[1]} such parts; take one with more"
        with pytest.raises(UnfitData, match=said):
            load_split(boxes, "train", dataclasses.replace(ASK, joints=joints), [8])


def test_centres_are_exact_for_integers_of_32_bits():
    index = torch.tensor([0, 64**3 - 1, 64 * 64 + 2 * 64 + 3], dtype=torch.int32)
    want = torch.tensor([[0, 0, 0], [63, 63, 63], [1, 2, 3]])
    torch.testing.assert_close(voxel_centres(index, 64), (want + 0.5) / 64 - 0.5)
