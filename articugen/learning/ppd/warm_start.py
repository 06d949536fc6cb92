"""A start that the paper does not have: joints and parts from what changes between an object's poses.

`articugen.discovery` finds them in the surface points of training objects, without labels; but it
must know which instances belong to one object, which the paper does not use. For the first
iterations they are targets: which candidate carries what, its axis, pivot and state, and whose each
occupied point is. Afterwards the losses of the paper alone go on from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from articugen.discovery import Discovery, discover
from articugen.geometry import invert_rigid
from articugen.learning import processes
from articugen.learning.dataset import PackedSplit, unpacked
from articugen.learning.method import Terms
from articugen.learning.ppd.losses import POINTS_OF_THE_PAPER
from articugen.learning.ppd.model import Pose, amount_of
from articugen.learning.ppd.settings import ModelSettings, WarmStart
from articugen.records import Floats, JointKind

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
        there: (I, J) 1 where the object has a joint for the candidate, else 0.
        state: (I, J) of that joint.
        axis, pivot: (I, J, 3) of that joint, in the unit frame.
        rotation, offset: (I, P, 3, 3), (I, P, 3) from the instance to its object's first one.
        grid: (I, P) which of `squares` belongs to a part; the first is that of parts without any.
        squares: (V, C^3) squared distances from the cells to a part's points in that first one.
    """

    there: Tensor
    state: Tensor
    axis: Tensor
    pivot: Tensor
    rotation: Tensor
    offset: Tensor
    grid: Tensor
    squares: Tensor

    def of(self, rows: Tensor) -> Targets:
        """Those of some instances."""
        each = (self.there, self.state, self.axis, self.pivot, self.rotation, self.offset)
        return Targets(*(x[rows] for x in each), self.grid[rows], self.squares)

    def owner(self, points: Tensor, occupied: Tensor) -> Tensor:
        """(B, n) the part that each occupied point belongs to, that of the nearest points; -1 for
        points in free space.

        Args:
            points: (B, n, 3) in the instances that these targets are of.
        """
        first = torch.einsum("bpij,bnj->bpni", self.rotation, points) + self.offset[:, :, None]
        at = ((first + 0.5) * CELLS).long().clamp(0, CELLS - 1)
        cell = (at[..., 0] * CELLS + at[..., 1]) * CELLS + at[..., 2]
        found = self.squares.flatten()[self.grid[..., None] * CELLS**3 + cell]
        return torch.where(occupied, found.argmin(1), -1)


def discovered(
    training: PackedSplit, beside: Path
) -> tuple[list[Discovery], list[NDArray[np.intp]]]:
    """What is found in each object, and its instances; kept in a file `beside` the run, since
    several seeds ask for it.

    Raises:
        CorruptShard: an object has one pose alone, or nothing in it moves.
    """
    names = list(dict.fromkeys(training.object_id.tolist()))
    rows = [training.poses_of(name) for name in names]
    surface = training.surface.cpu()
    found = []
    for mine in rows:
        found.append(discover([unpacked(surface[row]).numpy().astype(np.float64) for row in mine]))
    return found, rows


def targets(
    found: Sequence[Discovery],
    rows: Sequence[NDArray[np.intp]],
    model: ModelSettings,
    device: torch.device,
) -> Targets:
    """The targets of a split.

    Args:
        found: what was found in each object, its poses in the order of `rows`.
        rows: the instances of each object.
    """
    I, J = sum(map(len, rows)), model.joints
    there, state = np.zeros((I, J)), np.zeros((I, J))
    axis, pivot = np.zeros((I, J, 3)), np.zeros((I, J, 3))
    inverse = np.tile(np.eye(4), (I, J + 1, 1, 1))
    grid = np.zeros((I, J + 1), np.int64)
    squares = [torch.full((CELLS**3,), torch.inf, dtype=torch.float16)]
    for each, mine, taken in zip(found, rows, assigned(found, model), strict=True):
        for part in range(len(each.joints) + 1):
            candidate = taken[part - 1] if part else (-1, 1.0)
            if candidate is None:
                continue
            slot, sense = candidate
            grid[mine, slot + 1] = len(squares)
            squares.append(squared_distances(each.points[each.part == part]))
            if part:
                joint = each.joints[part - 1]
                there[mine, slot], axis[mine, slot] = 1.0, sense * joint.axis
                state[mine, slot], pivot[mine, slot] = sense * joint.states, joint.pivot
                motion = np.stack([each.motion(k)[part] for k in range(len(mine))])
                inverse[mine, slot + 1] = invert_rigid(motion)
    least = np.where(there > 0, state, np.inf).min(0)
    rest = np.where(np.arange(J) < len(model.revolute), REST_TURN, REST_SLIDE)
    state = np.where(there > 0, state + rest - least, rest)

    def tensor(array: Floats) -> Tensor:
        return torch.from_numpy(array).float().to(device)

    return Targets(
        tensor(there), tensor(state), tensor(axis), tensor(pivot),
        tensor(inverse[..., :3, :3]), tensor(inverse[..., :3, 3]),
        torch.from_numpy(grid).to(device), torch.stack(squares).to(device),
    )  # fmt: skip


def squared_distances(points: Floats) -> Tensor:
    """(CELLS^3,) from each cell's centre to the nearest cell that holds one of `points` (n, 3).

    Exact, an axis at a time (Felzenszwalb and Huttenlocher 2012, without their envelopes).
    """
    at = torch.from_numpy(((points + 0.5) * CELLS).astype(np.int64).clip(0, CELLS - 1))
    square = torch.full((CELLS, CELLS, CELLS), torch.inf)
    square[tuple(at.T)] = 0.0
    along = torch.arange(CELLS) / CELLS
    between = (along[:, None] - along).square()[:, :, None]
    for _ in range(3):
        square = (square.flatten(1)[None] + between).amin(1).view(CELLS, CELLS, CELLS)
        square = square.permute(1, 2, 0)
    return square.flatten().half()


def assigned(
    found: Sequence[Discovery], model: ModelSettings
) -> list[list[tuple[int, float] | None]]:
    """Which candidate each joint of each object goes to, and 1 or -1, the sense of its axis there.

    A candidate's joints point where it points, and their parts lie in the same place of every
    object as far as that can be. Objects with the most joints say first where those places are;
    then every object chooses by them, and they become the means of what was chosen, until nothing
    changes. A joint for which no candidate of its kind is left gets None.
    """
    taken: list[list[tuple[int, float] | None]] = [[None] * len(each.joints) for each in found]
    R = len(model.revolute)
    for kind, slots in (
        (JointKind.REVOLUTE, range(R)),
        (JointKind.PRISMATIC, range(R, model.joints)),
    ):
        directions = np.array([*model.revolute, *model.prismatic])[list(slots)]
        own = [[j for j, joint in enumerate(each.joints) if joint.kind == kind] for each in found]
        places = np.full((len(slots), 3), np.nan)
        for _ in range(10):
            before = [list(each) for each in taken]
            seen: list[list[Floats]] = [[] for _ in slots]
            for o in sorted(range(len(found)), key=lambda o: (-len(own[o]), o)):
                joints = own[o][: len(slots)]
                parts = [_middle(found[o], j) for j in joints]
                axes = [found[o].joints[j].axis for j in joints]
                chosen, senses = _best(axes, parts, directions, places)
                for j, slot, sense, part in zip(joints, chosen, senses, parts, strict=True):
                    taken[o][j] = (slots[slot], sense)
                    seen[slot].append(part)
                    if np.isnan(places[slot]).any():
                        places[slot] = part
            places = np.array([np.mean(s, 0) if s else np.full(3, np.nan) for s in seen])
            if taken == before:
                break
    return taken


def _middle(found: Discovery, joint: int) -> Floats:
    return found.points[found.part == joint + 1].mean(0)


def _best(
    axes: list[Floats], parts: list[Floats], directions: Floats, places: Floats
) -> tuple[tuple[int, ...], list[float]]:
    """The candidates of an object's joints at the least cost, each another one, and the senses.

    A candidate without a place yet (NaN) is as good as one that is a unit length away.
    """
    along = np.array([directions @ axis for axis in axes]).reshape(len(axes), len(directions))
    far = np.linalg.norm(np.array(parts).reshape(len(axes), 1, 3) - places, axis=2)
    cost = 4.0 * (1.0 - np.abs(along)) + _FLIPPED * (along < 0) + np.nan_to_num(far, nan=1.0)
    options = permutations(range(len(directions)), len(axes))
    best = min(options, key=lambda slots: sum(cost[j, s] for j, s in enumerate(slots)))
    return best, [1.0 if along[j, s] >= 0 else -1.0 for j, s in enumerate(best)]


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
        "aim_parts": weigh.parts * parts_entropy(part_logits, owner, weigh.rarity),
        "aim_state": weigh.state * states,
        "aim_direction": weigh.direction * lean,
        "aim_pivot": weigh.pivot * (square * there[:, :revolute]).sum(1).mean(),
    }


def parts_entropy(part_logits: Tensor, owner: Tensor, rarity: float) -> Tensor:
    """The binary cross-entropy of each part's field, summed over parts, a mean over points.

    Where a part owns few of the batch's points these weigh more, (others / own)^rarity, at most 100
    times: else the field of a part that is nearly nowhere is empty.

    Args:
        part_logits: (B, P, n).
        owner: (B, n) which part each point belongs to, -1 for none.
    """
    own = torch.arange(part_logits.shape[1], device=owner.device)[:, None] == owner[:, None]
    share = processes.gathered(own.float().mean((0, 2))[None]).mean(0).clamp(min=1e-6)
    weight = (1.0 / share - 1.0).pow(rarity).clamp(1.0, 100.0)[:, None]
    entropy = binary_cross_entropy_with_logits(
        part_logits, own.to(part_logits.dtype), pos_weight=weight, reduction="none"
    )
    return POINTS_OF_THE_PAPER * entropy.sum(1).mean()
