"""A start that the paper does not have: joints and parts from what changes between poses.

For the first iterations what is known of the instances (`targets`) is aimed at: which candidate
carries what, its axis, pivot and state, and whose each occupied point is. Afterwards the losses of
the paper alone go on from there.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, softplus

from articugen.learning.method import Terms
from articugen.learning.ppd.losses import POINTS_OF_THE_PAPER
from articugen.learning.ppd.network import Prediction, amount_of
from articugen.learning.ppd.settings import WarmStart
from articugen.learning.ppd.shape import PartBox
from articugen.learning.ppd.warm.targets import Targets

LEAST_SIZE = 0.03
"""Half of the least edge that a part's box is asked to have."""


def aim_terms(
    predicted: Prediction,
    part_logits: Tensor,
    owner: Tensor,
    aim: Targets,
    weigh: WarmStart,
    revolute: int,
) -> Terms:
    """Return how far a prediction is from its targets.

    Amounts are compared instead of states, since near the ends of a tanh nothing would be learned.
    Of a candidate that only other objects have it is asked to stand still: else it would be said to
    move with the one that this object has in its place.

    Args:
        part_logits: (B, P, n) of the composed fields.
        owner: (B, n) from `Targets.owner`.
        revolute: how many of the candidates turn.
    """
    pose, there = predicted.pose, aim.there
    amount = amount_of(aim.state, revolute)
    off = (pose.amount - amount).square()
    lean = ((1.0 - (pose.direction * aim.axis).sum(2)) * there).sum(1).mean()
    square = (pose.pivot[:, 1:] - aim.pivot).square().sum(2)[:, :revolute]
    terms = {
        "aim_parts": weigh.parts * parts_entropy(part_logits, owner, aim.known, weigh.occupied),
        "aim_state": weigh.state * (off * there).sum(1).mean(),
        "aim_still": weigh.still * (off * aim.still).sum(1).mean(),
        "aim_direction": weigh.direction * lean,
        "aim_pivot": weigh.pivot * (square * there[:, :revolute]).sum(1).mean(),
    }
    if box := predicted.shape.box:
        terms["aim_box"] = weigh.box * box_misfit(box, aim, revolute)
    return terms


def box_misfit(box: PartBox, aim: Targets, revolute: int) -> Tensor:
    """Return how far the boxes' middles are off, in sizes of the boxes, and the logarithms of the
    sizes: sums of squares over axes and parts, a mean over samples. A part that turns is seen from
    its pivot."""
    middle, size = aim.middle.clone(), aim.size.clamp(min=LEAST_SIZE)
    middle[:, 1 : 1 + revolute] -= aim.pivot[:, :revolute]
    shift, growth = (box.middle - middle) / size, (box.size / size).log()
    return ((shift.square() + growth.square()).sum(2) * aim.owns).sum(1).mean()


def labels_entropy(part_logits: Tensor, owner: Tensor, known: Tensor) -> Tensor:
    """Return the cross-entropy of whose field is the greatest, a mean over points: where parts lie
    beside each other, `parts_entropy` is content with fields that are right on either side of 0.

    It lowers the fields of the others alone: at the surface the part's own should be 0.

    Args:
        part_logits: (B, P, n) at points of the surface.
        owner: (B, n) which part each belongs to.
        known: as for `parts_entropy`.
    """
    of_part = owner[:, None] == torch.arange(part_logits.shape[1], device=owner.device)[:, None]
    greatest = part_logits.detach().masked_fill(~of_part, -torch.inf).amax(1)
    others = part_logits.masked_fill(of_part, -torch.inf).logsumexp(1)
    return POINTS_OF_THE_PAPER * (softplus(others - greatest).mean(1) * known).mean()


def parts_entropy(part_logits: Tensor, owner: Tensor, known: Tensor, occupied: float) -> Tensor:
    """Return the binary cross-entropy of each part's field, summed over parts, a mean over points.

    Args:
        part_logits: (B, P, n).
        owner: (B, n) which part each point belongs to, -1 for none.
        known: (B,) 0 for samples of which that is not known.
        occupied: how much more a part's own points weigh than others: else the field of a part that
            is thin is below 0 everywhere. The same for all parts, so that fields can be compared.
    """
    of_part = torch.arange(part_logits.shape[1], device=owner.device)[:, None] == owner[:, None]
    entropy = binary_cross_entropy_with_logits(
        part_logits,
        of_part.to(part_logits.dtype),
        pos_weight=part_logits.new_full((1,), occupied),
        reduction="none",
    )
    return POINTS_OF_THE_PAPER * (entropy.sum(1).mean(1) * known).mean()
