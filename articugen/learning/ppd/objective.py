"""What is minimised: the terms of the generator's and the discriminator's loss for one batch.

Terms are weighted and named; a recipe's weight of 0 leaves a term out and costs nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from articugen.learning.cpu.batches import gather_points
from articugen.learning.data.batch import Batch
from articugen.learning.method import Terms
from articugen.learning.ppd import losses
from articugen.learning.ppd.discriminator import Discriminator
from articugen.learning.ppd.network import PPD, Pose, Prediction
from articugen.learning.ppd.settings import LossSettings
from articugen.learning.ppd.shape import PartLogits, ShapeCode


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
    weights = discriminator.weights()

    def score(clouds: Tensor) -> Tensor:
        return discriminator.score(
            gather_points(clouds, discriminator.decisive(clouds, weights)), weights
        )

    penalty = losses.gradient_penalty(score, fake, real, posed.mix)
    return {
        "adv_d": weigh.adv_d * losses.discriminator_score(score(fake), score(real)),
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
    """Everything the model itself minimises; L_adv_g where there are random poses, and what a warm
    start asks of it and the fields (B, P, n) where there is an `aim`."""
    fields = model.fields(prediction.shape, model.motion(prediction.pose), batch.points)
    terms: Terms = {}
    if weigh.rec:
        terms["rec"] = weigh.rec * losses.reconstruction(fields.product, batch.occupied)
    if weigh.rec_common and model.settings.common_shape:
        common = losses.reconstruction(fields.common, batch.occupied)
        terms["rec_common"] = weigh.rec_common * common
    if weigh.vol:
        terms["vol"] = weigh.vol * _volume(model, prediction.shape, fields, batch, weigh)
    if weigh.vq:
        terms["vq"] = weigh.vq * _quantization(model, prediction, weigh)
    if weigh.dev and model.settings.common_pose:
        terms["dev"] = weigh.dev * _deviation(model, prediction.pose, weigh)
    if weigh.loc:
        terms["loc"] = weigh.loc * _location(model, prediction.pose, fields, batch, weigh)
    terms |= _variation(model, prediction.pose, weigh)
    if aim:
        terms |= aim(prediction, fields.product)
    if weigh.adv_g and discriminator is not None and posed is not None:
        terms["adv_g"] = weigh.adv_g * _adversarial(model, discriminator, prediction, batch, posed)
    return terms


def _volume(
    model: PPD, shape: ShapeCode, fields: PartLogits, batch: Batch, weigh: LossSettings
) -> Tensor:
    """L_vol over the points that are spread evenly."""

    def positive(of: PartLogits) -> Tensor:
        logit = of.product if weigh.vol_logit == "product" else of.instance
        return losses.relu_volume(logit[..., : batch.spread])

    still = model.still(shape, batch.points[:, : batch.spread])
    return losses.volume(positive(fields), positive(still))


def _quantization(model: PPD, prediction: Prediction, weigh: LossSettings) -> Tensor:
    """L_vq of the pose's quantiser, and of the shape template's, which has one code."""
    form = losses.quantization if weigh.vq_form == "norm" else losses.release_quantization
    quantizers = []
    if model.settings.common_pose:
        quantizers.append(prediction.pose.quantizer)
    if weigh.vq_form == "mean_square":
        quantizers.append(prediction.shape.quantizer)
    total = prediction.pose.state.new_zeros(())
    for before, code in quantizers:
        total = total + form(before, code)
    return total


def _deviation(model: PPD, pose: Pose, weigh: LossSettings) -> Tensor:
    if weigh.dev_form == "paper":
        revolute = slice(1, 1 + len(model.settings.revolute))
        total = losses.deviation(pose.pivot_residual[:, revolute])
        if pose.euler_residual is not None:
            total = total + losses.deviation(pose.euler_residual[:, 1:])
        return total
    total = losses.release_deviation(pose.pivot, pose.pivot_common)
    if pose.euler_residual is not None:
        total = total + losses.release_deviation(pose.euler, pose.euler_common)
    return total


def _location(
    model: PPD, pose: Pose, fields: PartLogits, batch: Batch, weigh: LossSettings
) -> Tensor:
    revolute = slice(1, 1 + len(model.settings.revolute))
    pivots, product = pose.pivot[:, revolute], fields.product.detach()
    if weigh.loc_form == "paper":
        return losses.location(pivots, batch.points, batch.occupied, product[:, revolute] > 0)
    squares = losses.release_chain_squares(pivots, batch.points, product)
    chain = losses.release_chain(*squares)
    asked = [pivots, pose.pivot_common[:, revolute]] if model.settings.common_pose else [pivots]
    near = losses.release_location(torch.stack(asked), batch.points, batch.occupied, product)
    return near.sum() + chain


def _variation(model: PPD, pose: Pose, weigh: LossSettings) -> Terms:
    revolute = len(model.settings.revolute)
    pivots, terms = pose.pivot[:, 1 : 1 + revolute], {}
    state = pose.state
    if weigh.var_state:
        if weigh.var_form == "paper":
            variation = losses.state_variation(state)
        else:
            variation = losses.release_state_variation(state, revolute)
        terms["var_state"] = weigh.var_state * variation
    if weigh.var_pivot:
        if weigh.var_form == "paper":
            variation = losses.pivot_variation(pivots, model.settings.joints, weigh.var_width)
        else:
            variation = losses.release_pivot_variation(pivots, weigh.var_width)
        terms["var_pivot"] = weigh.var_pivot * variation
    return terms


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
    return losses.generator_score(
        discriminator.score(torch.cat([decisive, occupancy[..., None]], 2), weights)
    )
