"""What figures ask of PPD: its part fields, and shapes and poses between those of two clouds."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from articugen.core.records import Floats, JointKind
from articugen.evaluation.figures.draw import Between, Drawable, Opening
from articugen.evaluation.reconstruction import Reconstruction
from articugen.learning.fields import probability
from articugen.learning.ppd.network import PPD, Prediction
from articugen.learning.ppd.reconstruct import logits_at, reconstruction_of
from articugen.learning.ppd.settings import ModelSettings

TITLES = {
    "rec": "$L_{rec}$",
    "rec_common": "$L_{rec}$, category-common",
    "vol": "$L_{vol}$",
    "vq": "$L_{vq}$",
    "dev": "$L_{dev}$",
    "loc": "$L_{loc}$",
    "var_state": "$L_{var}$, joint states",
    "var_pivot": "$L_{var}$, pivots",
    "adv_g": "$L_{adv_g}$",
    "adv_d": "$L_{adv_d}$",
    "gradient_penalty": "gradient penalty",
    "held-out rec": "held-out cross-entropy",
    "held-out iou": "held-out IoU",
}
"""Of the curves."""


def drawable(
    model: PPD,
    predict: Callable[[Floats], Prediction],
    settings: ModelSettings,
    resolution: int,
    *,
    points: int | None,
    residual_direction: bool,
) -> Drawable:
    """Return a trained model as the figures take it; meshes on a grid of `resolution`^3.

    Args:
        predict: what it makes of one cloud (n, 3).
        points: so many points of a cloud are examined; None means all.
    """
    revolute, prismatic = len(settings.revolute), len(settings.prismatic)
    kinds = [JointKind.FIXED, *[JointKind.REVOLUTE] * revolute, *[JointKind.PRISMATIC] * prismatic]

    def drawn(prediction: Prediction) -> Reconstruction:
        return reconstruction_of(model, prediction, resolution)

    def part_fields(cloud: Floats, where: Floats) -> Floats:
        return probability(logits_at(model, predict(cloud), torch.from_numpy(where)))

    def interpolate(openings: Sequence[Opening], steps: int) -> Between:
        first, shapes, states = between(
            model,
            [[cloud[:points] for cloud in opening] for opening in openings],
            steps,
            residual_direction,
        )
        return Between(first, [drawn(p) for p in shapes], [drawn(p) for p in states])

    return Drawable(
        reconstruct=lambda cloud: drawn(predict(cloud)),
        part_fields=part_fields,
        interpolate=interpolate,
        parts=[f"part {i}, {kind!s}" for i, kind in enumerate(kinds)],
        titles=TITLES,
    )


@torch.no_grad()
def between(
    model: PPD, openings: Sequence[Sequence[Floats]], steps: int, residual_direction: bool
) -> tuple[int, list[Prediction], list[Prediction]]:
    """From the two objects whose shape codes differ most, the index of the one; predictions between
    their shapes, in its pose, and between its own joint states.

    The latent of the shape goes straight from one cloud's to the other's, and the states likewise.

    Args:
        openings: of each object a cloud (n, 3) closed, half open and wide open.
    """
    device = next(model.parameters()).device

    def encoded(cloud: Floats) -> Tensor:
        return model.encoder(torch.as_tensor(cloud, dtype=torch.float32, device=device)[None])

    def decoded(latent: Tensor) -> Prediction:
        return model.decode(latent, residual_direction=residual_direction)

    latents = [encoded(half) for _, half, _ in openings]
    codes = torch.cat([decoded(latent).shape.detail.flatten(1) for latent in latents])
    first, other = divmod(int(torch.cdist(codes, codes).argmax()), len(codes))
    held = decoded(latents[first])
    low, high = (decoded(encoded(openings[first][at])).pose.state for at in (0, -1))
    shares = torch.linspace(0.0, 1.0, steps).tolist()

    def at_shape(share: float) -> Prediction:
        latent = torch.lerp(latents[first], latents[other], share)
        return replace(held, shape=decoded(latent).shape)

    def at_state(share: float) -> Prediction:
        return replace(held, pose=replace(held.pose, state=torch.lerp(low, high, share)))

    return first, [at_shape(share) for share in shares], [at_state(share) for share in shares]
