"""A start that the paper does not have: joints and parts from what changes between an object's poses.

`articugen.discovery` finds them in the surface points of training objects, without labels; but it
must know which instances belong to one object, which the paper does not use. For the first
iterations they are targets: which candidate carries what, its axis, pivot and state, and whose each
occupied point is. Afterwards the losses of the paper alone go on from there.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool3d, binary_cross_entropy_with_logits

from articugen.discovery import Discovery, FoundJoint, discover
from articugen.errors import CorruptShard, InvalidArgument
from articugen.geometry import invert_rigid
from articugen.learning import processes
from articugen.learning.dataset import PackedSplit, unpacked, voxel_centres
from articugen.learning.method import Terms
from articugen.learning.ppd.losses import POINTS_OF_THE_PAPER
from articugen.learning.ppd.model import Pose, amount_of
from articugen.learning.ppd.settings import ModelSettings, WarmStart
from articugen.learning.tensors import read_tensors, write_tensors
from articugen.records import Floats, JointKind
from articugen.store.files import make_folder
from articugen.workers import Crew

FORMAT = "articugen joints 1"
"""Of the file that keeps what was found; to be raised when something else would be found."""

LEAST_SCORE = 0.4
"""Of every joint in an object, else it says nothing."""

LEAST_VOTES, GAIN, SOME_POSES = 0.08, 1.25, 0.1
"""What a cell of a moving part has at least: a share of the most votes there are for this part, and
so many times what the fixed part has where the cell comes to, in this share of the poses."""

CELLS = 64
"""Of the grids, on each axis, that say how far each part's points are."""

REST_TURN, REST_SLIDE = 0.3, 0.05
"""The least state of a candidate, so that none is asked for the ends that a tanh never reaches."""

_FLIPPED = 0.5
"""What it costs, in unit lengths, to give a joint to a candidate that turns the other way."""


@dataclass(frozen=True, eq=False)
class Targets:
    """What the instances of a split are like. I instances, P parts, J = P - 1 candidates, C cells.

    Attributes:
        known: (I,) 1 where something was found in the object, else 0: there is nothing to aim at.
        there: (I, J) 1 where the object has a joint for the candidate, else 0.
        state: (I, J) of that joint.
        axis, pivot: (I, J, 3) of that joint, in the unit frame.
        rotation, offset: (I, P, 3, 3), (I, P, 3) from the instance to its object's first one.
        grid: (I, P) which of `votes` belongs to a part; the first is that of parts without any.
        votes: (V, C^3) how often there is material in the cells of a part's rest frame, which is
            that of its object's first instance.
    """

    known: Tensor
    there: Tensor
    state: Tensor
    axis: Tensor
    pivot: Tensor
    rotation: Tensor
    offset: Tensor
    grid: Tensor
    votes: Tensor

    def of(self, rows: Tensor) -> Targets:
        """Those of some instances."""
        each = (self.known, self.there, self.state, self.axis, self.pivot)
        motion = (self.rotation, self.offset, self.grid)
        return Targets(*(x[rows] for x in (*each, *motion)), self.votes)

    def owner(self, points: Tensor, occupied: Tensor) -> Tensor:
        """(B, n) the part that each occupied point belongs to: where it stays material in most
        poses, if it moves along with that part; -1 for points in free space.

        Args:
            points: (B, n, 3) in the instances that these targets are of.
        """
        first = torch.einsum("bpij,bnj->bpni", self.rotation, points) + self.offset[:, :, None]
        cell, _ = _cells(first)
        found = self.votes.flatten()[self.grid[..., None] * CELLS**3 + cell]
        return torch.where(occupied, found.argmax(1), -1)


Found = list[Discovery | None]
"""What was found in each object; None where that cannot be told."""

Tell = Callable[[str], None]


def discovered(
    training: PackedSplit, beside: Path, tell: Tell = lambda _: None
) -> tuple[Found, list[NDArray[np.intp]]]:
    """What moves in each object, and the instances that are its poses.

    It is kept in a file `beside` the run, named after the clouds, since several seeds ask for it.

    Args:
        tell: called with a sentence for each object.

    Raises:
        CorruptShard: in no object anything is found.
        InvalidCheckpoint: the file is damaged.
    """
    names = list(dict.fromkeys(training.object_id.tolist()))
    rows = [training.poses_of(name) for name in names]
    clouds = [training.surface[torch.from_numpy(mine)].cpu().numpy() for mine in rows]
    path = beside / f"joints-{_digest(clouds)}.pt"
    if path.is_file():
        kept = read_tensors(path, FORMAT)["objects"]
        return [_read(each, cloud) for each, cloud in zip(kept, clouds, strict=True)], rows
    found: Found = []
    with Crew(_look, workers=os.cpu_count() or 1) as crew:
        for each in crew.in_order(clouds):
            found.append(each)
            tell(f"looking for joints in the training objects: {len(found)} of {len(names)}")
    if not any(found):
        raise CorruptShard(
            f"{beside}: the poses of no training object tell what moves in it; make the data set "
            "with more states, or set warm_start.iterations=0"
        )
    make_folder(beside)
    write_tensors(path, {"objects": [_plain(each) for each in found]}, FORMAT)
    return found, rows


def _look(stored: NDArray[np.int16]) -> Discovery | None:
    """What is found in an object's clouds (K, n, 3), as they are stored; with sure joints alone."""
    poses = unpacked(torch.from_numpy(stored)).double().numpy()
    try:
        found = discover(list(poses))
    except InvalidArgument:  # nothing moves, or not as one joint would
        return None
    sure = found.joints and min(joint.score for joint in found.joints) >= LEAST_SCORE
    return found if sure else None


def _digest(clouds: Sequence[NDArray[np.int16]]) -> str:
    hashed = hashlib.sha256()
    for cloud in clouds:
        hashed.update(f"{cloud.shape}".encode() + cloud.tobytes())
    return hashed.hexdigest()[:16]


def _plain(found: Discovery | None) -> dict[str, Any]:
    """As `write_tensors` wants it."""
    if found is None:
        return {}
    joints = [
        {
            "kind": int(joint.kind),
            "axis": torch.from_numpy(joint.axis),
            "pivot": torch.from_numpy(joint.pivot),
            "states": torch.from_numpy(joint.states),
            "score": float(joint.score),
        }
        for joint in found.joints
    ]
    return {"part": torch.from_numpy(found.part.astype(np.uint8)), "joints": joints}


def _read(kept: dict[str, Any], stored: NDArray[np.int16]) -> Discovery | None:
    if not kept:
        return None
    joints = tuple(
        FoundJoint(
            kind=JointKind(joint["kind"]),
            axis=joint["axis"].numpy(),
            pivot=joint["pivot"].numpy(),
            states=joint["states"].numpy(),
            score=joint["score"],
        )
        for joint in kept["joints"]
    )
    points = unpacked(torch.from_numpy(stored[0])).double().numpy()
    return Discovery(joints, points, kept["part"].numpy().astype(np.int64))


def targets(
    split: PackedSplit,
    found: Found,
    rows: Sequence[NDArray[np.intp]],
    model: ModelSettings,
) -> Targets:
    """The targets of a split, on its device.

    Args:
        split: holds voxels of the band around each instance's material.
        found: what was found in each object, its poses in the order of `rows`.
        rows: the instances of each object.
    """
    I, J = sum(map(len, rows)), model.joints
    known = np.zeros(I)
    there, state = np.zeros((I, J)), np.zeros((I, J))
    axis, pivot = np.zeros((I, J, 3)), np.zeros((I, J, 3))
    inverse = np.tile(np.eye(4), (I, J + 1, 1, 1))
    grid = np.zeros((I, J + 1), np.int64)
    votes = [torch.full((CELLS**3,), -1.0, dtype=torch.float16)]
    for each, mine in zip(found, rows, strict=True):
        if not each:
            continue
        known[mine] = 1.0
        taken = [(-1, 1.0), *assigned(each, model)]
        T = invert_rigid(np.stack([each.motion(k) for k in range(len(mine))]))
        volumes = material_votes(split, mine, each, T)
        for part, candidate in enumerate(taken):
            if candidate is None:
                continue
            slot, sense = candidate
            inverse[mine, slot + 1] = T[:, part]
            grid[mine, slot + 1] = len(votes)
            votes.append(volumes[part])
            if part:
                joint = each.joints[part - 1]
                there[mine, slot], axis[mine, slot] = 1.0, sense * joint.axis
                state[mine, slot], pivot[mine, slot] = sense * joint.states, joint.pivot
    least = np.where(there > 0, state, np.inf).min(0)
    rest = np.where(np.arange(J) < len(model.revolute), REST_TURN, REST_SLIDE)
    state = np.where(there > 0, state + rest - least, rest)

    device = split.surface.device

    def tensor(array: Floats) -> Tensor:
        return torch.from_numpy(array).float().to(device)

    return Targets(
        tensor(known), tensor(there), tensor(state), tensor(axis), tensor(pivot),
        tensor(inverse[..., :3, :3]), tensor(inverse[..., :3, 3]),
        torch.from_numpy(grid).to(device), torch.stack(votes).to(device),
    )  # fmt: skip


def material_votes(
    split: PackedSplit, rows: NDArray[np.intp], found: Discovery, inverse: Floats
) -> Tensor:
    """(P, C^3) how sure it is that the cells of each part's rest frame are that part's own.

    Of a part's own material all poses say the same, whatever moves over it and whether it is seen.
    So the poses in which a joint is nearly closed are counted, and those in which it is wide open,
    and the lesser count holds. A plate that slides within its own plane looks as if it stayed: a
    moving part owns cells alone that come, in some pose, to where the fixed part has less. It then
    has them in all poses. Elsewhere it has -1.

    Args:
        rows: the K poses of an object.
        inverse: (K, P, 4, 4) from each pose to each part's rest frame.
    """
    R = split.band.resolution
    bits = np.unpackbits(split.voxels[torch.from_numpy(rows)].cpu().numpy(), axis=1)
    material = [voxel_centres(torch.from_numpy(np.flatnonzero(b)), R) for b in bits]
    T = torch.from_numpy(inverse).float()
    forward = torch.from_numpy(invert_rigid(inverse)).float()
    halves = [_halves(joint.states) for joint in found.joints]
    fixed = torch.stack([_agreed(T[:, 0], material, half) for half in halves]).amin(0)
    votes = [fixed]
    for part, half in enumerate(halves, 1):
        own = _agreed(T[:, part], material, half)
        (cells,) = torch.where(own > LEAST_VOTES * own.max())
        posed = _moved(forward[:, part], voxel_centres(cells, CELLS).expand(len(rows), -1, 3))
        cell, inside = _cells(posed)
        stays = torch.where(inside, fixed[cell], 0.0).quantile(SOME_POSES, dim=0)
        sure = cells[own[cells] > GAIN * stays]
        votes.append(torch.full_like(own, -1.0).index_copy_(0, sure, GAIN * own[sure]))
    return torch.stack(votes).half()


def _halves(states: Floats) -> tuple[Tensor, Tensor]:
    """(K,) masks of the poses with small and with great states."""
    order = np.argsort(states, kind="stable")
    great = torch.zeros(len(states), dtype=torch.bool)
    great[torch.from_numpy(order[len(order) // 2 :])] = True
    return ~great, great


def _agreed(T: Tensor, material: list[Tensor], halves: tuple[Tensor, Tensor]) -> Tensor:
    """(C^3,) the share of the poses that have material in a cell, brought there by the motions
    (K, 4, 4); of the half of the poses that has less, and smoothed over three cells along each
    axis, for thin parts miss the centres of many."""
    shares = []
    for half in halves:
        total = torch.zeros(CELLS**3)
        for k in torch.where(half)[0].tolist():
            cell, inside = _cells(_moved(T[k : k + 1], material[k][None]))
            total[cell[inside].unique()] += 1.0
        shares.append(total / half.sum())
    least = torch.stack(shares).amin(0).view(1, 1, CELLS, CELLS, CELLS)
    return avg_pool3d(least, 3, stride=1, padding=1).flatten()


def _moved(T: Tensor, points: Tensor) -> Tensor:
    return torch.einsum("kij,knj->kni", T[:, :3, :3], points) + T[:, None, :3, 3]


def _cells(points: Tensor) -> tuple[Tensor, Tensor]:
    """The flat cells of points (..., 3), and whether they lie in the cube at all; others in its
    first or last cells."""
    at = ((points + 0.5) * CELLS).floor().long()
    inside = ((at >= 0) & (at < CELLS)).all(-1)
    at = at.clamp(0, CELLS - 1)
    return (at[..., 0] * CELLS + at[..., 1]) * CELLS + at[..., 2], inside


def assigned(found: Discovery, model: ModelSettings) -> list[tuple[int, float] | None]:
    """The candidate that each joint of an object goes to, and 1 or -1, the sense of its axis there.

    Candidates point as joints do, if there are such. Those that point alike are handed out as one
    reads, from the top or from the left, so that they mean the same in objects with as many parts.
    A joint for which no candidate of its kind is left gets None.
    """
    taken: list[tuple[int, float] | None] = [None] * len(found.joints)
    R = len(model.revolute)
    kinds = (JointKind.REVOLUTE, JointKind.PRISMATIC)
    for kind, first, directions in zip(kinds, (0, R), (model.revolute, model.prismatic)):
        own = [j for j, joint in enumerate(found.joints) if joint.kind == kind][: len(directions)]
        if own:
            own = [own[i] for i in _as_read(np.array([_middle(found, j) for j in own]))]
            along = np.array([found.joints[j].axis for j in own]) @ np.array(directions).T
            cost = (4.0 * (1.0 - np.abs(along)) + _FLIPPED * (along < 0)).round(3)
            options = permutations(range(len(directions)), len(own))
            best = min(options, key=lambda slots: sum(cost[i, s] for i, s in enumerate(slots)))
            for i, (j, slot) in enumerate(zip(own, best, strict=True)):
                taken[j] = first + slot, 1.0 if along[i, slot] >= 0 else -1.0
    return taken


def _middle(found: Discovery, joint: int) -> Floats:
    return found.points[found.part == joint + 1].mean(0)


def _as_read(places: Floats) -> NDArray[np.intp]:
    """The order of places (n, 3) along the axis on which they lie most apart: from the top, or with
    growing y or x."""
    axis = int(np.ptp(places, axis=0).argmax())
    return np.argsort(places[:, axis] * (-1.0 if axis == 2 else 1.0), kind="stable")


def aim_terms(
    pose: Pose, part_logits: Tensor, owner: Tensor, aim: Targets, weigh: WarmStart, revolute: int
) -> Terms:
    """How far a prediction is from its targets.

    Amounts are compared instead of states, since near the ends of a tanh nothing would be learned.

    Args:
        part_logits: (B, P, n) of the composed fields.
        owner: (B, n) from `Targets.owner`.
        revolute: how many of the candidates turn.
    """
    there = aim.there
    amount = amount_of(aim.state, revolute)
    states = ((pose.amount - amount).square() * there).sum(1).mean()
    lean = ((1.0 - (pose.direction * aim.axis).sum(2)) * there).sum(1).mean()
    away = pose.pivot[:, 1 : 1 + revolute] - aim.pivot[:, :revolute]
    along = (away * aim.axis[:, :revolute]).sum(2)
    square = away.square().sum(2) - along.square()
    return {
        "aim_parts": weigh.parts * parts_entropy(part_logits, owner, aim.known, weigh.rarity),
        "aim_state": weigh.state * states,
        "aim_direction": weigh.direction * lean,
        "aim_pivot": weigh.pivot * (square * there[:, :revolute]).sum(1).mean(),
    }


def parts_entropy(part_logits: Tensor, owner: Tensor, known: Tensor, rarity: float) -> Tensor:
    """The binary cross-entropy of each part's field, summed over parts, a mean over points.

    Where a part owns few of the batch's points these weigh more, (others / own)^rarity, at most 100
    times: else the field of a part that is nearly nowhere is empty.

    Args:
        part_logits: (B, P, n).
        owner: (B, n) which part each point belongs to, -1 for none.
        known: (B,) 0 for samples of which that is not known.
    """
    own = torch.arange(part_logits.shape[1], device=owner.device)[:, None] == owner[:, None]
    share = processes.gathered(own.float().mean((0, 2))[None]).mean(0).clamp(min=1e-6)
    weight = (1.0 / share - 1.0).pow(rarity).clamp(1.0, 100.0)[:, None]
    entropy = binary_cross_entropy_with_logits(
        part_logits, own.to(part_logits.dtype), pos_weight=weight, reduction="none"
    )
    return POINTS_OF_THE_PAPER * (entropy.sum(1).mean(1) * known).mean()
