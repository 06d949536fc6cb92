"""PPD's losses, each a pure function named by its equation; all give a scalar without its weight.

B samples, P parts, R revolute parts, n points. Where a function has a twin `release_...`, the twin
is what the authors' release computes instead. Expectations over a sample's points are means over
points; everything is a mean over the batch unless said otherwise.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss

POINTS_OF_THE_PAPER = 4096
"""Points over which the paper's losses are sums; means are multiplied by it."""


def reconstruction(part_logits: Tensor, occupied: Tensor) -> Tensor:
    """Eq. 2, one of its terms: BCE of the composed field against the indicator values.

    The composition is the LogSumExp over the parts instead of their maximum.

    Args:
        part_logits: (B, P, n), of O_i or of O_i^c.
        occupied: (B, n) of 0 and 1.
    """
    whole = part_logits.logsumexp(1)
    return POINTS_OF_THE_PAPER * binary_cross_entropy_with_logits(whole, occupied.to(whole.dtype))


def volume(moved: Tensor, still: Tensor) -> Tensor:
    """Eq. 3: the square of the difference of two E_x[relu(max_i F_i(x))], over the batch and points
    (B, P, n) spread evenly."""
    return (moved.amax(1).relu().mean() - still.amax(1).relu().mean()).square()


def quantization(before: Tensor, code: Tensor) -> Tensor:
    """Eq. 4: ||z - sg(c)||; `before` and `code` (B, C)."""
    return (before - code.detach()).norm(dim=1).mean()


def release_quantization(before: Tensor, code: Tensor) -> Tensor:
    """Return the mean square of code - z, with gradient to both."""
    return mse_loss(code, before)


def deviation(residual: Tensor) -> Tensor:
    """Eq. 5, one of its terms: the mean length of q^z (revolute parts) or r^z (moving ones).

    Args:
        residual: (B, parts, 3) of those parts alone.
    """
    return residual.norm(dim=2).mean()


def release_deviation(final: Tensor, common: Tensor) -> Tensor:
    """Return the mean square of final - common over all P parts; both (B, P, 3)."""
    return mse_loss(final, common)


def nearest_distance(pivots: Tensor, points: Tensor, chosen: Tensor) -> Tensor:
    """min over the chosen points of ||q - x||, (..., B, R); 0 where none is chosen.

    Args:
        pivots: (..., B, R, 3).
        points: (B, n, 3).
        chosen: (..., B, R, n) bool.
    """
    with torch.no_grad():
        distance = torch.cdist(pivots, points).masked_fill(~chosen, torch.inf)
        nearest = distance.argmin(-1)
    sample = torch.arange(len(points), device=points.device)[:, None]
    return (pivots - points[sample, nearest]).norm(dim=-1) * chosen.any(-1)


def location(pivots: Tensor, points: Tensor, occupied: Tensor, inside: Tensor) -> Tensor:
    """Eq. 6: a pivot lies at the object, at its own part, and at another revolute part.

    Args:
        pivots: (B, R, 3) q_i.
        points: (B, n, 3), where the fields are known.
        occupied: (B, n) bool, S_gt.
        inside: (B, R, n) bool, O_i(B_i^{-1} x) > 0.5 of the revolute parts. S_i is where part i is,
            S_ij where any other revolute part is; an empty one counts 0.
    """
    anywhere = occupied[:, None].expand_as(inside)
    others = (inside.sum(1, keepdim=True) - inside.to(torch.int64)) > 0
    chosen = torch.stack([anywhere, inside, others])
    to_any, to_own, to_other = nearest_distance(pivots, points, chosen)
    return (to_any + 0.5 * (to_own + to_other)).mean()


def release_location(pivots: Tensor, points: Tensor, occupied: Tensor, fields: Tensor) -> Tensor:
    """Return the mean squared distance from a pivot to where its part and the fixed part meet,
    (...).

    Args:
        pivots: (..., B, R, 3), the final ones and the raw q^c for instance.
        points: (B, n, 3).
        occupied: (B, n) bool. Of these, points count where the fields of part i and of part 0 are
            both above 0; where there are none, all of them do.
        fields: (B, P, n) part logits.
    """
    R = pivots.shape[-2]
    meeting = occupied[:, None] & (fields[:, :1] > 0) & (fields[:, 1 : 1 + R] > 0)
    anywhere = occupied[:, None].expand_as(meeting)
    chosen = torch.where(meeting.any(2, keepdim=True), meeting, anywhere)
    return nearest_distance(pivots, points, chosen).square().mean((-2, -1))


def release_chain(pivots: Tensor, points: Tensor, fields: Tensor) -> Tensor:
    """Half the sum of the mean squared distances to the points that part i owns, and to those any
    other part owns: where its field is the greatest of all and above 0.

    A part's term is the mean over the samples in which there are points, the whole the mean over
    parts.
    """
    R = pivots.shape[1]
    greatest, owner = fields.max(1)
    solid = (greatest > 0)[:, None]
    of_part = owner[:, None] == torch.arange(1, 1 + R, device=owner.device)[:, None]
    both = torch.stack([solid & of_part, solid & ~of_part])
    squares = nearest_distance(pivots, points, both).square()
    there = both.any(-1).to(pivots.dtype)
    return 0.5 * (squares.sum(1) / there.sum(1).clamp(min=1.0)).mean(1).sum()


def state_variation(state: Tensor) -> Tensor:
    """Eq. 7, first term: the mean over moving parts of 1 / std over the batch; `state` (B, J)."""
    return (1.0 / _std(state)).mean()


def pivot_variation(pivots: Tensor, joints: int, width: float) -> Tensor:
    """Eq. 7, second term: sum_{i, j != i} exp(-||q_i - q_j|| / v) / N^p over revolute parts.

    Args:
        pivots: (B, R, 3).
        joints: N^p, revolute and prismatic parts.
        width: v.
    """
    i, j = torch.triu_indices(pivots.shape[1], pivots.shape[1], 1, device=pivots.device)
    distance = (pivots[:, i] - pivots[:, j]).norm(dim=2)
    return 2.0 * torch.exp(-distance / width).sum(1).mean() / joints


def release_state_variation(state: Tensor, revolute: int) -> Tensor:
    """Half the greatest 1 / std of the revolute parts plus half that of the prismatic ones."""
    inverse = 1.0 / _std(state)
    return 0.5 * (inverse[:revolute].max() + inverse[revolute:].max())


def release_pivot_variation(pivots: Tensor, width: float) -> Tensor:
    """Sum over the whole batch and pairs i <= j of exp(-||q_i - q_j||^2 / (2 v)) / R."""
    i, j = torch.triu_indices(pivots.shape[1], pivots.shape[1], 0, device=pivots.device)
    square = (pivots[:, i] - pivots[:, j]).square().sum(2)
    return torch.exp(-square / (2.0 * width)).sum() / pivots.shape[1]


def _std(state: Tensor) -> Tensor:
    """Over the batch, unbiased; the release's 1e-7 keeps its inverse finite."""
    return (state.var(0) + 1e-7).sqrt()


def gradient_penalty(
    score: Callable[[Tensor], Tensor], fake: Tensor, real: Tensor, mix: Tensor
) -> Tensor:
    """Eq. 8, second term: E[(||grad D|| - 1)^2] between fake and real (Gulrajani et al. 2017).

    Args:
        score: D, from (B, n, 4) to (B,).
        fake, real: (B, n, 4).
        mix: (B,) in [0, 1], the share of `real`.
    """
    between = torch.lerp(fake, real, mix[:, None, None]).detach().requires_grad_()
    (slope,) = torch.autograd.grad(score(between).sum(), between, create_graph=True)
    return (slope.flatten(1).norm(dim=1) - 1.0).square().mean()
