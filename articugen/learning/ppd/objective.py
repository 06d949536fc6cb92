"""What is minimised: the terms of the generator's and the discriminator's loss for one batch.

Terms are weighted and named; a recipe's weight of 0 leaves a term out and costs nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from articugen.learning.cpu.batches import gather_points
from articugen.learning.data.batch import Batch
from articugen.learning.method import Terms
from articugen.learning.ppd import losses
from articugen.learning.ppd.discriminator import Discriminator
from articugen.learning.ppd.network import PPD, Prediction
from articugen.learning.ppd.settings import LossSettings
from articugen.learning.ppd.shape import PartLogits, ShapeCode

Unasked = dict[str, Callable[[], Tensor]]
"""Terms without their weights, computed where one has a weight."""


@dataclass(frozen=True)
class RandomPose:
    """The batch's shapes at random joint states, what the discriminator judges.

    Attributes:
        state: (B, J) s~ in U(0, h).
        occupancy: (B, m) sigmoid of the composed field at the batch's points, without a graph.
        mix: (B,) where between fake and real the gradient penalty looks.
    """

    state: Tensor
    occupancy: Tensor
    mix: Tensor


def random_pose(
    model: PPD,
    prediction: Prediction,
    batch: Batch,
    weigh: LossSettings,
    rng: torch.Generator | None,
) -> RandomPose:
    """Draw joint states and evaluate the shapes there."""
    B, J = prediction.pose.state.shape
    kind = {"dtype": batch.points.dtype, "device": batch.points.device}
    most = torch.full((J,), weigh.most_prismatic, **kind)
    most[: len(model.settings.revolute)] = weigh.most_revolute
    state = most * torch.rand(B, J, generator=rng, **kind)
    mix = torch.rand(B, generator=rng, **kind)
    with torch.no_grad():
        occupancy = _composed(model, prediction, state, batch.points)
    return RandomPose(state, occupancy, mix)


def _composed(model: PPD, prediction: Prediction, state: Tensor, points: Tensor) -> Tensor:
    """Return (B, n) the sigmoid of the LogSumExp over the parts, posed at `state`."""
    fields = model.fields(prediction.shape, model.motion(prediction.pose, state), points)
    return fields.product.logsumexp(1).sigmoid()


def discriminator_terms(
    discriminator: Discriminator, batch: Batch, posed: RandomPose, weigh: LossSettings
) -> Terms:
    """L_adv_d (Eq. 8)."""
    fake = torch.cat([batch.points, posed.occupancy[..., None]], 2)
    real = torch.cat([batch.points, batch.occupied[..., None].to(fake.dtype)], 2)
    score = partial(discriminator, weights=discriminator.weights())
    penalty = losses.gradient_penalty(score, fake, real, posed.mix)
    return {
        "adv_d": weigh.adv_d * (score(fake).mean() - score(real).mean()),
        "gradient_penalty": weigh.gradient_penalty * penalty,
    }


def generator_terms(
    model: PPD,
    prediction: Prediction,
    batch: Batch,
    weigh: LossSettings,
    discriminator: Discriminator | None = None,
    posed: RandomPose | None = None,
    aim: Callable[[Prediction, Tensor], Terms] | None = None,
) -> Terms:
    """Return all terms that the model itself minimises; L_adv_g where there are random poses, and
    what a warm start asks of it and the fields (B, P, n) where there is an `aim`."""
    fields = model.fields(prediction.shape, model.motion(prediction.pose), batch.points)
    there = {
        "rec": lambda: losses.reconstruction(fields.product, batch.occupied),
        "rec_common": lambda: losses.reconstruction(fields.common, batch.occupied),
        **FORMS[weigh.form](model, prediction, fields, batch, weigh.var_width),
    }
    if not model.settings.common_shape:
        del there["rec_common"]
    if not model.settings.common_pose:
        del there["dev"]
    weights = {name: getattr(weigh, name) for name in there}
    terms = {name: weights[name] * term() for name, term in there.items() if weights[name]}
    if aim:
        terms |= aim(prediction, fields.product)
    if weigh.adv_g and discriminator is not None and posed is not None:
        terms["adv_g"] = weigh.adv_g * _adversarial(model, discriminator, prediction, batch, posed)
    return terms


def paper_terms(
    model: PPD, predicted: Prediction, fields: PartLogits, batch: Batch, width: float
) -> Unasked:
    """Return L_vol, L_vq, L_dev, L_loc and L_var, as Eq. 3 to 7 are printed."""
    pose, turning = predicted.pose, slice(1, 1 + len(model.settings.revolute))
    joints = model.settings.joints

    def location() -> Tensor:
        inside = fields.product.detach()[:, turning] > 0
        return losses.location(pose.pivot[:, turning], batch.points, batch.occupied, inside)

    def deviation() -> Tensor:
        total = losses.deviation(pose.pivot_residual[:, turning])
        if pose.euler_residual is not None:
            total = total + losses.deviation(pose.euler_residual[:, 1:])
        return total

    vq = {"vq": lambda: losses.quantization(*pose.quantizer)} if model.settings.common_pose else {}
    return {
        "vol": lambda: _volume(model, predicted.shape, fields, batch, "instance"),
        **vq,
        "dev": deviation,
        "loc": location,
        "var_state": lambda: losses.state_variation(pose.state),
        "var_pivot": lambda: losses.pivot_variation(pose.pivot[:, turning], joints, width),
    }


def release_terms(
    model: PPD, predicted: Prediction, fields: PartLogits, batch: Batch, width: float
) -> Unasked:
    """Return the same as the authors' release computes them, which has a quantiser of the shape's
    template, with one code, as well."""
    pose, R, has_common = predicted.pose, len(model.settings.revolute), model.settings.common_pose
    turning = slice(1, 1 + R)

    def location() -> Tensor:
        pivots, product = pose.pivot[:, turning], fields.product.detach()
        chain = losses.release_chain(pivots, batch.points, product)
        both = [pivots, *[pose.pivot_common[:, turning]] * has_common]
        near = losses.release_location(torch.stack(both), batch.points, batch.occupied, product)
        return near.sum() + chain

    def quantization() -> Tensor:
        both = [*[pose.quantizer] * has_common, predicted.shape.quantizer]
        return torch.stack([losses.release_quantization(*some) for some in both]).sum()

    def deviation() -> Tensor:
        total = losses.release_deviation(pose.pivot, pose.pivot_common)
        if pose.euler_residual is not None:
            total = total + losses.release_deviation(pose.euler, pose.euler_common)
        return total

    return {
        "vol": lambda: _volume(model, predicted.shape, fields, batch, "product"),
        "vq": quantization,
        "dev": deviation,
        "loc": location,
        "var_state": lambda: losses.release_state_variation(pose.state, R),
        "var_pivot": lambda: losses.release_pivot_variation(pose.pivot[:, turning], width),
    }


FORMS: dict[str, Callable[..., Unasked]] = {
    "paper": paper_terms,
    "mixed": lambda *some: release_terms(*some) | {"dev": paper_terms(*some)["dev"]},
    "release": release_terms,
}
"""By the recipe's name; mixed is the release's, but for L_dev, which is the paper's."""


def _volume(model: PPD, shape: ShapeCode, fields: PartLogits, batch: Batch, of: str) -> Tensor:
    """Return L_vol over the points that are spread evenly."""
    still = model.still(shape, batch.points[:, : batch.spread])
    return losses.volume(getattr(fields, of)[..., : batch.spread], getattr(still, of))


def _adversarial(
    model: PPD,
    discriminator: Discriminator,
    prediction: Prediction,
    batch: Batch,
    posed: RandomPose,
) -> Tensor:
    """L_adv_g (Eq. 9); only the points that decide the score are evaluated with a graph."""
    weights = discriminator.weights()
    cloud = torch.cat([batch.points, posed.occupancy[..., None]], 2)
    decisive = gather_points(batch.points, discriminator.decisive(cloud, weights))
    occupancy = _composed(model, prediction, posed.state, decisive)
    return -discriminator.score(torch.cat([decisive, occupancy[..., None]], 2), weights).mean()
