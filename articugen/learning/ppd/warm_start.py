"""A start that the paper does not have: joints and parts from what changes between poses.

`articugen.discovery` finds them in the surface points of training objects, without labels; but it
must know which instances belong to one object, which the paper does not use. For the first
iterations they are targets: which candidate carries what, its axis, pivot and state, and whose each
occupied point is. Afterwards the losses of the paper alone go on from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import permutations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool3d, binary_cross_entropy_with_logits

from articugen.discovery import Discovery
from articugen.geometry import invert_rigid
from articugen.learning.dataset import PackedSplit, voxel_centres
from articugen.learning.method import Terms
from articugen.learning.ppd.found import Found
from articugen.learning.ppd.losses import POINTS_OF_THE_PAPER
from articugen.learning.ppd.model import Pose, amount_of
from articugen.learning.ppd.settings import ModelSettings, WarmStart
from articugen.records import Floats, JointKind

FEW_OBJECTS, LEAN = 0.25, np.cos(np.radians(30.0))
"""A kind of joint that a smaller share of the objects has is a mistake, and so is one that leans
further from all candidates of its kind."""

LEAST_VOTES, GAIN, SOME_POSES = 0.08, 1.25, 0.1
"""What a cell of a moving part has at least: a share of the most votes there are for this part, and
so many times what the fixed part has where the cell comes to, in this share of the poses."""

VOTING_POSES = 41
"""So many poses of an object say whose its material is."""

REST_TURN, REST_SLIDE = 0.3, 0.05
"""The least state of a candidate, so that none is asked for the ends that a tanh never reaches."""

_FLIPPED = 0.5
"""What it costs to give a joint to a candidate that turns the other way: as much as a lean of 29
degrees."""


@dataclass(frozen=True, eq=False)
class Targets:
    """What the instances of a split are like. I instances, P parts, J = P - 1 candidates; C cells
    on each axis.

    Attributes:
        known: (I,) 1 where it was found how the instance moves, else 0: nothing to aim at.
        there: (I, J) 1 where the object has a joint for the candidate, else 0.
        state: (I, J) of that joint.
        axis, pivot: (I, J, 3) of that joint, in the unit frame.
        rest: (J,) the least state of each candidate.
        rotation, offset: (I, P, 3, 3), (I, P, 3) from the instance to its object's first one.
        grid: (I, P) which of `votes` belongs to a part; the first is that of parts without any.
        votes: (V, C^3) how often there is material in the cells of a part's rest frame, which is
            that of its object's first instance.
        cells: C.
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
    rest: Tensor
    cells: int

    def of(self, rows: Tensor) -> Targets:
        """Those of some instances."""
        some = {f.name: getattr(self, f.name)[rows] for f in fields(self)[:-3]}
        return replace(self, **some)

    def owner(self, points: Tensor, occupied: Tensor) -> Tensor:
        """(B, n) the part that each occupied point belongs to: where it stays material in most
        poses, if it moves along with that part; -1 for points in free space.

        Args:
            points: (B, n, 3) in the instances that these targets are of.
        """
        first = torch.einsum("bpij,bnj->bpni", self.rotation, points) + self.offset[:, :, None]
        cell, _ = _cells(first, self.cells)
        found = self.votes.flatten()[self.grid[..., None] * self.cells**3 + cell]
        return torch.where(occupied, found.argmax(1), -1)


def targets(
    split: PackedSplit,
    found: Found,
    rows: Sequence[NDArray[np.intp]],
    model: ModelSettings,
) -> Targets:
    """The targets of a split, on its device.

    Args:
        split: with voxels.
        found: what was found in each object, its poses in the order of `rows`.
        rows: the instances of each object that were looked at.
    """
    count, J = len(split), model.joints
    known = np.zeros(count)
    there, state = np.zeros((count, J)), np.zeros((count, J))
    axis, pivot = np.zeros((count, J, 3)), np.zeros((count, J, 3))
    inverse = np.tile(np.eye(4), (count, J + 1, 1, 1))
    grid = np.zeros((count, J + 1), np.int64)
    R = split.band.resolution
    votes = [torch.full((R**3,), -1.0, dtype=torch.float16)]
    for each, mine in zip(likely(found, model), rows, strict=True):
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
    widest = np.where(np.arange(J) < len(model.revolute), np.pi, 1.0)
    state = np.where(there > 0, state + rest - least, rest).clip(0.5 * rest, widest - 0.5 * rest)

    device = split.surface.device

    def tensor(array: Floats) -> Tensor:
        return torch.from_numpy(array).float().to(device)

    return Targets(
        tensor(known), tensor(there), tensor(state), tensor(axis), tensor(pivot),
        tensor(inverse[..., :3, :3]), tensor(inverse[..., :3, 3]),
        torch.from_numpy(grid).to(device), torch.stack(votes).to(device), tensor(rest), R,
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
    R, K = split.band.resolution, len(rows)
    some = np.linspace(0, K - 1, min(K, VOTING_POSES)).astype(int)
    rows, inverse = rows[some], inverse[some]
    bits = np.unpackbits(split.voxels[torch.from_numpy(rows)].cpu().numpy(), axis=1)
    material = [voxel_centres(torch.from_numpy(np.flatnonzero(b)), R) for b in bits]
    T = torch.from_numpy(inverse).float()
    forward = torch.from_numpy(invert_rigid(inverse)).float()
    halves = [_halves(joint.states[some]) for joint in found.joints]
    fixed = torch.stack([_agreed(T[:, 0], material, half, R) for half in halves]).amin(0)
    votes = [fixed]
    for part, half in enumerate(halves, 1):
        own = _agreed(T[:, part], material, half, R)
        (cells,) = torch.where(own > LEAST_VOTES * own.max())
        posed = _moved(forward[:, part], voxel_centres(cells, R).expand(len(rows), -1, 3))
        cell, inside = _cells(posed, R)
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


def _agreed(T: Tensor, material: list[Tensor], halves: tuple[Tensor, Tensor], R: int) -> Tensor:
    """(R^3,) the share of the poses that have material in a cell, brought there by the motions
    (K, 4, 4); of the half of the poses that has less, and smoothed over three cells along each
    axis, for thin parts miss the centres of many."""
    shares = []
    for half in halves:
        total = torch.zeros(R**3)
        for k in torch.where(half)[0].tolist():
            cell, inside = _cells(_moved(T[k : k + 1], material[k][None]), R)
            total[cell[inside].unique()] += 1.0
        shares.append(total / half.sum())
    least = torch.stack(shares).amin(0).view(1, 1, R, R, R)
    return avg_pool3d(least, 3, stride=1, padding=1).flatten()


def _moved(T: Tensor, points: Tensor) -> Tensor:
    return torch.einsum("kij,knj->kni", T[:, :3, :3], points) + T[:, None, :3, 3]


def _cells(points: Tensor, R: int) -> tuple[Tensor, Tensor]:
    """The flat cells of points (..., 3) in a grid of R^3, and whether they lie in the cube at all;
    others are given to its first or last cells."""
    at = ((points + 0.5) * R).floor().long()
    inside = ((at >= 0) & (at < R)).all(-1)
    at = at.clamp(0, R - 1)
    return (at[..., 0] * R + at[..., 1]) * R + at[..., 2], inside


def likely(found: Found, model: ModelSettings) -> Found:
    """What was found, without the objects that are unlike the others or the candidates: with a
    kind of joint that few objects have, or a joint that leans too far from every candidate."""
    objects = [each for each in found if each]
    kinds = [{joint.kind for joint in each.joints} for each in objects]
    few = {k for k in JointKind if sum(k in own for own in kinds) < FEW_OBJECTS * len(objects)}

    def is_likely(each: Discovery) -> bool:
        along = [np.abs(_directions(j.kind, model) @ j.axis).max() for j in each.joints]
        return min(along) > LEAN and not few & {joint.kind for joint in each.joints}

    return [each if each and is_likely(each) else None for each in found]


def _directions(kind: JointKind, model: ModelSettings) -> Floats:
    """(candidates, 3) where those of a kind point."""
    return np.array(model.revolute if kind == JointKind.REVOLUTE else model.prismatic)


def assigned(found: Discovery, model: ModelSettings) -> list[tuple[int, float] | None]:
    """The candidate that each joint of an object goes to, and 1 or -1, the sense of its axis there.

    Candidates point as joints do, if there are such. Those that point alike are handed out as one
    reads, from the top or from the left, so that they mean the same in objects with as many parts.
    A joint for which no candidate of its kind is left gets None.
    """
    taken: list[tuple[int, float] | None] = [None] * len(found.joints)
    for kind, first in ((JointKind.REVOLUTE, 0), (JointKind.PRISMATIC, len(model.revolute))):
        directions = _directions(kind, model)
        own = [j for j, joint in enumerate(found.joints) if joint.kind == kind][: len(directions)]
        if own:
            own = [own[i] for i in _as_read(np.array([found.joints[j].pivot for j in own]))]
            along = np.array([found.joints[j].axis for j in own]) @ directions.T
            cost = (4.0 * (1.0 - np.abs(along)) + _FLIPPED * (along < 0)).round(1)
            options = permutations(range(len(directions)), len(own))
            best = min(options, key=lambda slots: sum(cost[i, s] for i, s in enumerate(slots)))
            for i, (j, slot) in enumerate(zip(own, best, strict=True)):
                taken[j] = first + slot, 1.0 if along[i, slot] >= 0 else -1.0
    return taken


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
    square = (pose.pivot[:, 1:] - aim.pivot).square().sum(2)
    return {
        "aim_parts": weigh.parts * parts_entropy(part_logits, owner, aim.known, weigh.occupied),
        "aim_state": weigh.state * states,
        "aim_direction": weigh.direction * lean,
        "aim_pivot": weigh.pivot * (square * there).sum(1).mean(),
    }


def parts_entropy(part_logits: Tensor, owner: Tensor, known: Tensor, occupied: float) -> Tensor:
    """The binary cross-entropy of each part's field, summed over parts, a mean over points.

    Args:
        part_logits: (B, P, n).
        owner: (B, n) which part each point belongs to, -1 for none.
        known: (B,) 0 for samples of which that is not known.
        occupied: how much more a part's own points weigh than others: else the field of a part that
            is thin is below 0 everywhere. The same for all parts, so that fields can be compared.
    """
    own = torch.arange(part_logits.shape[1], device=owner.device)[:, None] == owner[:, None]
    entropy = binary_cross_entropy_with_logits(
        part_logits,
        own.to(part_logits.dtype),
        pos_weight=part_logits.new_full((1,), occupied),
        reduction="none",
    )
    return POINTS_OF_THE_PAPER * (entropy.sum(1).mean(1) * known).mean()
