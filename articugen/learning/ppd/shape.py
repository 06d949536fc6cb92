"""The shape decoders; with the PointNet 214,928 parameters, the paper's 2.149 x 10^5."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from articugen.learning.cpu.batches import one_by_one, takes_kernels
from articugen.learning.ppd.cpu.fused import sine_parts
from articugen.learning.ppd.kinematics import InverseMotion
from articugen.learning.ppd.settings import ModelSettings
from articugen.learning.tensors import changed

POSE, SHAPE, TEMPLATE, COMMON = 128, 256, 64, 64
"""The latent is z^p, z^s, the template's and z^{p,c}, in this order."""

LATENT = POSE + SHAPE + TEMPLATE + COMMON

WIDTH = 205
"""Channels of all parts together; a part has WIDTH // P."""

WITHIN = (12, 6)
"""Channels of a part's layers within."""

_FREQUENCY = 30.0

PLAIN_SIZE = 0.25
"""Half the edge of the box of a part that is seen as it is; others are as if they were as large."""


class Quantizer(nn.Module):
    """The nearest of a few learned codes (VQ-VAE's qt; Eq. 4), with straight-through gradient.

    Args:
        learn: whether the code gets that gradient too: Eq. 4 itself gives it none.
    """

    def __init__(self, codes: int, width: int, learn: bool) -> None:
        super().__init__()
        self.learn = learn
        self.codes = nn.Parameter(torch.rand(codes, width))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return (quantised, code), both of the value of the nearest code (B, width)."""
        distance = torch.cdist(x.detach(), self.codes.detach())
        code = self.codes[distance.argmin(1)]
        passed = code if self.learn else code.detach()
        return passed + (x - x.detach()), code


@dataclass(frozen=True)
class ShapeCode:
    """Codes of a sample that the shape decoders take.

    Attributes:
        template: (B, P, C) the same for all samples, but for the gradient.
        detail: (B, P, m) of the instance.
        quantizer: (before, code), both (B, P C), for L_vq.
        box: where each part lies in its rest frame, None where parts have no boxes.
    """

    template: Tensor
    detail: Tensor
    quantizer: tuple[Tensor, Tensor]
    box: "PartBox | None" = None

    def of(self, parts: Tensor) -> "ShapeCode":
        """Return the code of some parts."""
        some = changed(self, Tensor, lambda of_all: of_all[:, parts])
        return replace(some, quantizer=self.quantizer)

    def towards(self, other: "ShapeCode", share: float) -> "ShapeCode":
        """Return the code of a shape between this one (0) and another (1)."""
        template = torch.lerp(self.template, other.template, share)
        detail, box = torch.lerp(self.detail, other.detail, share), None
        if self.box and other.box:
            middle = torch.lerp(self.box.middle, other.box.middle, share)
            box = PartBox(middle, torch.lerp(self.box.size, other.box.size, share))
        return ShapeCode(template, detail, self.quantizer, box)


@dataclass(frozen=True)
class PartBox:
    """A box for each part, in its rest frame, along the axes of the unit frame.

    Attributes:
        middle: (B, P, 3).
        size: (B, P, 3) half of its edges.
    """

    middle: Tensor
    size: Tensor


@dataclass(frozen=True)
class PartLogits:
    """Fields of every part before the sigmoid, (B, P, n) each.

    Attributes:
        common: F^{s,c}.
        instance: F^{s,z}.
        product: F^{s,z} sigmoid(F^{s,c}), what Eq. 1 takes the sigmoid of.
    """

    common: Tensor
    instance: Tensor
    product: Tensor


class ShapeDecoder(nn.Module):
    """F^{s,c} and F^{s,z} of all parts at once.

    Layers are grouped: part i has weights of its own, kept as (P, out, in), and points run along
    the last axis, (B, P, channels, n), so that a layer is one batched product.
    """

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.parts = P = settings.parts
        self.common_shape = settings.common_shape
        self.box_in = _box_head(P) if settings.part_boxes else None
        c, (h, m) = WIDTH // P, WITHIN
        self.template_in = nn.Linear(TEMPLATE, P * c)
        self.template_codes = Quantizer(1, P * c, settings.codes_learn)
        self.template_0, self.template_1 = Grouped(P, c, c, "latent"), Grouped(P, c, c)
        self.coordinate = Grouped(P, 3, c, bound=settings.coordinate_bound)
        self.trunk_0, self.trunk_1 = Grouped(P, c, h), Grouped(P, h, m)
        self.detail_in = nn.Linear(SHAPE, P * m)
        self.detail = Grouped(1, P * m, P * m)
        # Groups 0 to P - 1 are the heads of F^{s,c}, the others those of F^{s,z}.
        self.head_0, self.head_1 = Grouped(2 * P, m, h), Grouped(2 * P, h, c)
        self.head_2 = Grouped(2 * P, c, 1)
        scale = 0.2 if settings.latent_start == "he" else 0.01
        nn.init.normal_(self.detail_in.weight, std=scale * math.sqrt(2.0 / SHAPE))
        nn.init.uniform_(self.detail_in.bias, -1.0 / SHAPE, 1.0 / SHAPE)

    def code(self, z_shape: Tensor, z_template: Tensor) -> ShapeCode:
        """From z^s (B, 256) and the template's latent (B, 64)."""
        B, P = len(z_shape), self.parts
        before = self.template_in(nn.functional.leaky_relu(z_template, 0.2))
        quantized, code = self.template_codes(before)
        template = self.template_1.sine(self.template_0(quantized.view(B, P, -1, 1)))
        detail = self.detail.sine(self.detail_in(z_shape).view(B, 1, -1, 1)).view(B, P, -1)
        return ShapeCode(template[..., 0], detail, (before, code), self._box(z_shape))

    def _box(self, z_shape: Tensor) -> PartBox | None:
        if self.box_in is None:
            return None
        middle, size = self.box_in(z_shape).view(len(z_shape), self.parts, 6).split(3, 2)
        return PartBox(middle, PLAIN_SIZE * size.clamp(-3.0, 1.0).exp())

    def forward(self, code: ShapeCode, motion: InverseMotion, points: Tensor) -> PartLogits:
        """Return the fields of all parts at points (B, n, 3), each part moved by its own motion."""
        # The motion is part of the first layer: W (A x + t) + b = (W A) x + (W t + b).
        W, b = self.coordinate.times(_FREQUENCY)
        at = motion.offset
        if code.box:
            W, at = W * (PLAIN_SIZE / code.box.size)[:, :, None], at - code.box.middle
        moved, shift = W @ motion.rotation, (W @ at[..., None])[..., 0] + b
        inputs = points, moved, shift, code.template, code.detail
        if takes_kernels(points):
            both = sine_parts(*inputs, *self._weights())
        else:
            both = one_by_one(self._heads, *inputs)
        common, instance = both.chunk(2, 1)
        product = instance * common.sigmoid() if self.common_shape else instance
        return PartLogits(common, instance, product)

    def _weights(self) -> list[Tensor]:
        """Weights and biases of all layers but the first, with the factors of their sines."""
        layers = self.trunk_0, self.trunk_1, self.head_0, self.head_1
        scaled = [*(layer.times(_FREQUENCY) for layer in layers), self.head_2.times(1.0)]
        return [tensor for pair in scaled for tensor in pair]

    def _heads(
        self, points: Tensor, moved: Tensor, shift: Tensor, template: Tensor, detail: Tensor
    ) -> Tensor:
        """Return (B, 2 P, n): F^{s,c} of all parts, then F^{s,z}."""
        x = torch.baddbmm(shift.flatten(1)[..., None], moved.flatten(1, 2), points.mT).sin()
        x = x.view(*template.shape, -1) + template[..., None]
        x = self.trunk_1.sine(self.trunk_0.sine(x))
        x = torch.cat([x, x + detail[..., None]], 1)
        return self.head_2(self.head_1.sine(self.head_0.sine(x)))[:, :, 0]


def _box_head(parts: int) -> nn.Sequential:
    """From z^s to the middles and sizes of all parts' boxes, which are PLAIN at first.

    Two layers in between: where one part ends and the next begins is no linear function of what
    the encoder pools.
    """
    last = nn.Linear(SHAPE, 6 * parts)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(
        nn.Linear(SHAPE, SHAPE), nn.LeakyReLU(0.2), nn.Linear(SHAPE, SHAPE), nn.LeakyReLU(0.2), last
    )


class Grouped(nn.Module):
    """A linear layer for each of G groups: (B, G, in, n) to (B, G, out, n).

    Args:
        rule: "sine" starts weights as SIREN does (Sitzmann et al. 2020), U(+-sqrt(6 / in) / 30);
            "latent" by Kaiming's normal / 100, biases U(+-1 / in); "linear" as torch's layers.
        bound: U(+-bound) for the weights instead.
    """

    def __init__(
        self,
        groups: int,
        n_in: int,
        n_out: int,
        rule: Literal["sine", "latent", "linear"] = "sine",
        bound: float | None = None,
        bias: bool = True,
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(groups, n_out, n_in))
        self.bias = nn.Parameter(torch.empty(groups, n_out)) if bias else None
        plain = 1.0 / math.sqrt(n_in)  # of torch's layers
        if rule == "latent":
            nn.init.normal_(self.weight, std=math.sqrt(2.0 / n_in) / 100.0)
        else:
            bound = bound or (plain if rule == "linear" else math.sqrt(6.0 / n_in) / _FREQUENCY)
            nn.init.uniform_(self.weight, -bound, bound)
        if self.bias is not None:
            spread = 1.0 / n_in if rule == "latent" else plain
            nn.init.uniform_(self.bias, -spread, spread)

    def forward(self, x: Tensor) -> Tensor:
        return self._affine(x, 1.0)

    def sine(self, x: Tensor) -> Tensor:
        """sin(30 (W x + b)); the factor goes into the small weights, not over the activations."""
        return self._affine(x, _FREQUENCY).sin()

    def flat(self, x: Tensor) -> Tensor:
        """Return one vector a group, side by side: (B, G in) to (B, G out)."""
        G, _, n_in = self.weight.shape
        out = torch.einsum("goi,bgi->bgo", self.weight, x.view(len(x), G, n_in))
        return (out if self.bias is None else out + self.bias).flatten(1)

    def times(self, factor: float) -> tuple[Tensor, Tensor]:
        """Weight and bias, multiplied; of a layer that has a bias."""
        assert self.bias is not None
        return factor * self.weight, factor * self.bias

    def _affine(self, x: Tensor, factor: float) -> Tensor:
        B, G, n_in, n = x.shape
        W, b = self.times(factor)
        W = W.expand(B, -1, -1, -1).reshape(B * G, -1, n_in)
        b = b.expand(B, -1, -1).reshape(B * G, -1, 1)
        return torch.baddbmm(b, W, x.reshape(B * G, n_in, n)).view(B, G, -1, n)
