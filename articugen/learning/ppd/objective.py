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
    pose, form = prediction.pose, FORMS[weigh.form](model, weigh)
    terms: Terms = {}
    if weigh.rec:
        terms["rec"] = weigh.rec * losses.reconstruction(fields.product, batch.occupied)
    if weigh.rec_common and model.settings.common_shape:
        common = losses.reconstruction(fields.common, batch.occupied)
        terms["rec_common"] = weigh.rec_common * common
    if weigh.vol:
        terms["vol"] = weigh.vol * form.volume(prediction.shape, fields, batch)
    if weigh.vq:
        terms["vq"] = weigh.vq * form.quantization(prediction)
    if weigh.dev and model.settings.common_pose:
        terms["dev"] = weigh.dev * form.deviation(pose)
    if weigh.loc:
        terms["loc"] = weigh.loc * form.location(pose, fields.product.detach(), batch)
    if weigh.var_state:
        terms["var_state"] = weigh.var_state * form.state_variation(pose)
    if weigh.var_pivot:
        terms["var_pivot"] = weigh.var_pivot * form.pivot_variation(pose)
    if aim:
        terms |= aim(prediction, fields.product)
    if weigh.adv_g and discriminator is not None and posed is not None:
        terms["adv_g"] = weigh.adv_g * _adversarial(model, discriminator, prediction, batch, posed)
    return terms


class Paper:
    """Losses L_vol, L_vq, L_dev, L_loc and L_var, as Eq. 3 to 7 are printed."""

    def __init__(self, model: PPD, weigh: LossSettings) -> None:
        self.model, self.weigh, self.settings = model, weigh, model.settings
        self.revolute = slice(1, 1 + len(model.settings.revolute))

    def volume(self, shape: ShapeCode, fields: PartLogits, batch: Batch) -> Tensor:
        """Return L_vol over the points that are spread evenly."""
        still = self.model.still(shape, batch.points[:, : batch.spread])
        moved, unmoved = (
            losses.relu_volume(self._logit(of)[..., : batch.spread]) for of in (fields, still)
        )
        return losses.volume(moved, unmoved)

    def _logit(self, of: PartLogits) -> Tensor:
        return of.instance

    def quantization(self, prediction: Prediction) -> Tensor:
        """Return L_vq of the pose's quantiser."""
        total = prediction.pose.state.new_zeros(())
        if self.settings.common_pose:
            total = total + losses.quantization(*prediction.pose.quantizer)
        return total

    def deviation(self, pose: Pose) -> Tensor:
        total = losses.deviation(pose.pivot_residual[:, self.revolute])
        if pose.euler_residual is not None:
            total = total + losses.deviation(pose.euler_residual[:, 1:])
        return total

    def location(self, pose: Pose, product: Tensor, batch: Batch) -> Tensor:
        inside = product[:, self.revolute] > 0
        return losses.location(pose.pivot[:, self.revolute], batch.points, batch.occupied, inside)

    def state_variation(self, pose: Pose) -> Tensor:
        return losses.state_variation(pose.state)

    def pivot_variation(self, pose: Pose) -> Tensor:
        pivots, width = pose.pivot[:, self.revolute], self.weigh.var_width
        return losses.pivot_variation(pivots, self.settings.joints, width)


class Mixed(Paper):
    """Losses in the release's forms, but L_dev, which is the paper's."""

    def _logit(self, of: PartLogits) -> Tensor:
        return of.product

    def quantization(self, prediction: Prediction) -> Tensor:
        """Return L_vq of the pose's quantiser, and of the shape template's, which has one code."""
        total = prediction.pose.state.new_zeros(())
        if self.settings.common_pose:
            total = total + losses.release_quantization(*prediction.pose.quantizer)
        return total + losses.release_quantization(*prediction.shape.quantizer)

    def location(self, pose: Pose, product: Tensor, batch: Batch) -> Tensor:
        pivots = pose.pivot[:, self.revolute]
        squares = losses.release_chain_squares(pivots, batch.points, product)
        chain = losses.release_chain(*squares)
        both = [pivots]
        if self.settings.common_pose:
            both.append(pose.pivot_common[:, self.revolute])
        near = losses.release_location(torch.stack(both), batch.points, batch.occupied, product)
        return near.sum() + chain

    def state_variation(self, pose: Pose) -> Tensor:
        return losses.release_state_variation(pose.state, len(self.settings.revolute))

    def pivot_variation(self, pose: Pose) -> Tensor:
        return losses.release_pivot_variation(pose.pivot[:, self.revolute], self.weigh.var_width)


class Release(Mixed):
    """Losses as the authors' release computes them."""

    def deviation(self, pose: Pose) -> Tensor:
        total = losses.release_deviation(pose.pivot, pose.pivot_common)
        if pose.euler_residual is not None:
            total = total + losses.release_deviation(pose.euler, pose.euler_common)
        return total


FORMS = {"paper": Paper, "mixed": Mixed, "release": Release}


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
