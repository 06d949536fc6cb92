"""PPD: from a point cloud to part fields, joint directions, pivots and states (Sections 3.1, 3.2).

Widths and layers are the release's, whose count of encoder and shape decoders is the paper's
214,928. Part 0 is fixed; joint j moves part j + 1; revolute joints come before prismatic ones.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from articugen.learning.blocks import BothEncoders, GridEncoder, PointNet
from articugen.learning.ppd.kinematics import (
    InverseMotion,
    inverse_motion,
    joint_frames,
    rotation_from_z,
)
from articugen.learning.ppd.settings import ModelSettings
from articugen.learning.ppd.shape import (
    COMMON,
    LATENT,
    POSE,
    SHAPE,
    TEMPLATE,
    WIDTH,
    Grouped,
    PartLogits,
    Quantizer,
    ShapeCode,
    ShapeDecoder,
)

REST_TURN, REST_SLIDE = 0.3, 0.05
"""What the state of a closed joint is, radians or lengths, in models with part boxes."""


@dataclass(frozen=True)
class Pose:
    """Joint parameters; B samples, P parts, J joints. The unit frame, radians.

    Attributes:
        amount: (B, J) a_i, from which the states follow: any number.
        state: (B, J) s_i: revolute in (0, pi), prismatic in (0, 1).
        pivot: (B, P, 3) q_i = tanh(q^c_i + q^z_i) / 2; only those of revolute parts are used.
        pivot_common, pivot_residual: (B, P, 3) q^c_i and q^z_i, before the tanh.
        euler: (B, P, 3) r_i = r^c_i (+ r^z_i).
        euler_common, euler_residual: (B, P, 3); the residual is None in the first stage.
        frames: (B, J, 3, 3) C_i; the last column is the direction u_i.
        quantizer: (before, code), for L_vq.
    """

    amount: Tensor
    state: Tensor
    pivot: Tensor
    pivot_common: Tensor
    pivot_residual: Tensor
    euler: Tensor
    euler_common: Tensor
    euler_residual: Tensor | None
    frames: Tensor
    quantizer: tuple[Tensor, Tensor]

    @property
    def direction(self) -> Tensor:
        """(B, J, 3) the unit directions u_i."""
        return self.frames[..., 2]


@dataclass(frozen=True)
class Prediction:
    """Output of the model for a batch of clouds."""

    shape: ShapeCode
    pose: Pose


class PPD(nn.Module):
    """The whole generator: encoder, shape decoders, pose decoders."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder = encoder_of(settings)
        self.shape = ShapeDecoder(settings)
        self.pose = PoseDecoder(settings)

    def forward(self, cloud: Tensor, *, residual_direction: bool = True) -> Prediction:
        """Return the prediction for clouds (B, n, 3).

        Args:
            residual_direction: whether r^z counts; false in the paper's first stage.
        """
        latent = self.encoder(cloud)
        z_pose, z_shape, z_template, z_common = latent.split([POSE, SHAPE, TEMPLATE, COMMON], 1)
        return Prediction(
            self.shape.code(z_shape, z_template),
            self.pose(z_pose, z_common, residual_direction=residual_direction),
        )

    def motion(self, pose: Pose, state: Tensor | None = None) -> InverseMotion:
        """B_i^{-1} at the predicted joint states, or at `state` (B, J)."""
        R = len(self.settings.revolute)
        state = self.since_rest(pose.state if state is None else state)
        return inverse_motion(
            pose.frames, state, pose.pivot[:, 1 : 1 + R], R, self.settings.part_frame
        )

    def since_rest(self, state: Tensor) -> Tensor:
        """Return how far states (B, J) are from those in which parts are at rest."""
        if not self.settings.part_boxes:
            return state
        return state - rest_states(state, len(self.settings.revolute))

    def fields(self, shape: ShapeCode, motion: InverseMotion, points: Tensor) -> PartLogits:
        """Return the fields of all parts at points (B, n, 3)."""
        return self.shape(shape, motion, points)

    def still(self, shape: ShapeCode, points: Tensor) -> PartLogits:
        """Return the fields at points that no part's pose has moved (the second term of Eq. 3)."""
        return self.shape(
            shape, InverseMotion.none(len(points), self.settings.parts, points), points
        )


def encoder_of(settings: ModelSettings) -> nn.Module:
    """Return the encoder that a recipe asks for: clouds (B, n, 3) to latents (B, 512)."""
    points = PointNet(LATENT, settings.latent_start)
    return BothEncoders(points, GridEncoder(LATENT)) if settings.encoder == "both" else points


class PoseDecoder(nn.Module):
    """F^{p,z}, F^{p,c}_q and F^{p,c}_r.

    F^{p,c}_r is one learned Euler vector a part: the release's net of that name computes just
    this, since it normalises each vector over a single element, which leaves zeros.
    """

    initial: Tensor

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.parts, self.revolute = settings.parts, len(settings.revolute)
        self.common_pose = settings.common_pose
        known = [*settings.revolute, *settings.prismatic]
        directions = torch.tensor(known, dtype=torch.float32, device="cpu")
        self.register_buffer("initial", rotation_from_z(directions), persistent=False)
        self.backbone = nn.Linear(POSE, WIDTH)
        self.residual = _Residual(1, WIDTH, WIDTH, norm_groups=1)
        self.revolute_state = nn.Linear(WIDTH, self.revolute)
        self.prismatic_state = nn.Linear(WIDTH, settings.joints - self.revolute)
        self.pivot = nn.Linear(WIDTH, 3 * self.parts)
        self.direction = nn.Linear(WIDTH, 3 * self.parts)
        nn.init.zeros_(self.direction.weight)
        nn.init.zeros_(self.direction.bias)
        self.common_pivot = _CommonPivot(settings)
        self.common_euler = nn.Parameter(torch.zeros(self.parts, 3))

    def forward(self, z_pose: Tensor, z_common: Tensor, *, residual_direction: bool) -> Pose:
        B, P = len(z_pose), self.parts
        hidden = leaky_relu(self.residual(self.backbone(z_pose)), 0.2)
        amount = torch.cat([self.revolute_state(hidden), self.prismatic_state(hidden)], 1)
        pivot_residual = self.pivot(hidden).view(B, P, 3)
        pivot_common, quantizer = self.common_pivot(z_common)
        euler_common = self.common_euler.expand(B, P, 3)
        if not self.common_pose:
            pivot_common, euler_common = 0.0 * pivot_common, 0.0 * euler_common
        euler_residual = self.direction(hidden).view(B, P, 3) if residual_direction else None
        euler = euler_common if euler_residual is None else euler_common + euler_residual
        return Pose(
            amount=amount,
            state=widest(amount, self.revolute) * (0.5 * (torch.tanh(2.0 * amount) + 1.0)),
            pivot=0.5 * torch.tanh(pivot_common + pivot_residual),
            pivot_common=pivot_common,
            pivot_residual=pivot_residual,
            euler=euler,
            euler_common=euler_common,
            euler_residual=euler_residual,
            frames=joint_frames(self.initial, euler[:, 1:]),
            quantizer=quantizer,
        )


def rest_states(states: Tensor, revolute: int) -> Tensor:
    """Return (J,) the states at which parts with boxes lie along the axes of the unit frame: so far
    from the ends, which a tanh never reaches, that an object can be closed."""
    rest = torch.full_like(states[0], REST_SLIDE)
    rest[:revolute] = REST_TURN
    return rest


def amount_of(state: Tensor, revolute: int) -> Tensor:
    """Return amounts a (B, J) of states inside their ranges, of which the first are revolute."""
    return 0.5 * torch.atanh(2.0 * state / widest(state, revolute) - 1.0)


def widest(states: Tensor, revolute: int) -> Tensor:
    """Return (J,) how far states can go: pi, or 1 where a joint slides."""
    most = torch.ones_like(states[0])
    most[:revolute] = math.pi
    return most


class _CommonPivot(nn.Module):
    """F^{p,c}_q: q^c of every part from the quantised z^{p,c}; one group a part."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.parts = parts = settings.parts
        c = WIDTH // parts
        self.norm_in = nn.GroupNorm(1, COMMON)
        self.linear_in = nn.Linear(COMMON, parts * c)
        self.quantizer = Quantizer(settings.codes, parts * c, settings.codes_learn)
        self.blocks = nn.Sequential(
            _Residual(parts, c, 12, norm_groups=parts), _Residual(parts, 12, 6, norm_groups=parts)
        )
        self.norm_out = nn.GroupNorm(parts, parts * 6)
        self.linear_out = Grouped(parts, 6, 3, "linear")

    def forward(self, z_common: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        before = self.linear_in(leaky_relu(self.norm_in(z_common), 0.2))
        quantized, code = self.quantizer(before)
        hidden = leaky_relu(self.norm_out(self.blocks(quantized)), 0.2)
        return self.linear_out.flat(hidden).view(len(z_common), self.parts, 3), (before, code)


class _Residual(nn.Module):
    """x + W1 relu(norm(W0 relu(norm(x)))), grouped; W1 starts at 0.

    The hidden width is the input's; where widths differ, the shortcut is linear without bias.
    """

    def __init__(self, groups: int, n_in: int, n_out: int, norm_groups: int) -> None:
        super().__init__()
        self.norm_0 = nn.GroupNorm(norm_groups, groups * n_in)
        self.linear_0 = Grouped(groups, n_in, n_in, "linear")
        self.norm_1 = nn.GroupNorm(norm_groups, groups * n_in)
        self.linear_1 = Grouped(groups, n_in, n_out, "linear")
        nn.init.zeros_(self.linear_1.weight)
        self.shortcut = None
        if n_in != n_out:
            self.shortcut = Grouped(groups, n_in, n_out, "linear", bias=False)

    def forward(self, x: Tensor) -> Tensor:
        hidden = self.linear_0.flat(self.norm_0(x).relu())
        short = x if self.shortcut is None else self.shortcut.flat(x)
        return short + self.linear_1.flat(self.norm_1(hidden).relu())
