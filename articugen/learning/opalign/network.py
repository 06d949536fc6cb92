"""The layers of OP-Align: the shared shape, and what segments shapes and predicts their joints."""

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from articugen.learning.blocks import PointNet
from articugen.learning.opalign.settings import ModelSettings

CODE = 256


class Joints(NamedTuple):
    """Pivots and directions (B, J, 3), and states (B, J, 2) of both parts that each joint holds."""

    pivot: Tensor
    direction: Tensor
    state: Tensor


class Posed(NamedTuple):
    """A shape: points (B, n, 3), their parts' probabilities (B, n, P), and its joints."""

    points: Tensor
    label: Tensor
    joints: Joints


class OPAlignNet(nn.Module):
    """An encoder, the canonical shape of `points` points, and the segmenter of both shapes."""

    def __init__(self, settings: ModelSettings, points: int) -> None:
        super().__init__()
        self.encoder = PointNet(CODE)
        self.shape = nn.Sequential(*normed(CODE, CODE, CODE, CODE), nn.Linear(CODE, 3 * points))
        self.base = nn.Parameter(nn.init.xavier_uniform_(torch.empty(points, 3)))
        self.segmenter = Segmenter(settings)

    def forward(self, cloud: Tensor) -> tuple[Posed, Posed, Tensor]:
        """Return the cloud (B, n, 3) and the canonical shape, as they are posed, and how far that
        shape's points lie from where they lie for all objects (B, n, 3)."""
        offset = self.shape(self.encoder(cloud)).view(len(cloud), -1, 3)
        both = torch.cat([cloud, self.base + offset])
        label, joints = self.segmenter(both)
        halves = zip(*(values.chunk(2) for values in (both, label, *joints)), strict=True)
        there, canonical = (Posed(points, label, Joints(*rest)) for points, label, *rest in halves)
        return there, canonical, offset


class Segmenter(nn.Module):
    """Part labels and joints of shapes."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        width, self.joints = settings.width, settings.revolute + settings.prismatic
        self.reach = math.radians(settings.reach)
        self.position = nn.Linear(3, 2 * width)
        self.blocks = nn.ModuleList(Block(2 * width, width) for _ in range(5))
        self.norms = nn.ModuleList(nn.BatchNorm1d(width) for _ in range(5))
        self.label = nn.Sequential(
            *normed(width, 128, 32, slope=0.0), nn.Linear(32, self.joints + 1)
        )
        self.joint = nn.Sequential(
            *normed(width, 256, slope=0.0), nn.Linear(256, 128), nn.Linear(128, 8 * self.joints)
        )

    def forward(self, points: Tensor) -> tuple[Tensor, Joints]:
        """Return the labels (B, n, P) and joints of shapes (B, n, 3)."""
        first, *others = zip(self.blocks, self.norms, strict=True)
        features = first[1](first[0](self.position(points)).mT).mT
        for block, norm in others:
            pooled = features.amax(1, keepdim=True).expand_as(features)
            features = norm(block(torch.cat([features, pooled], 2)).mT).mT
        label = self.label(features.flatten(0, 1)).view(*points.shape[:2], -1).softmax(2)
        of_joints = self.joint(features.amax(1)).view(-1, 8, self.joints).mT
        pivot, direction, state = of_joints.split([3, 3, 2], 2)
        direction = direction / direction.norm(dim=2, keepdim=True).clamp(min=1e-9)
        return label, Joints(pivot, direction, self.reach * (state.sigmoid() - 0.5))


class Block(nn.Module):
    """Residual block, whose second layer begins at 0."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(before, after), nn.Linear(after, after)
        self.shortcut = nn.Linear(before, after, bias=False)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        return self.shortcut(x) + self.second(self.first(x.relu()).relu())


def normed(*widths: int, slope: float = 0.01) -> list[nn.Module]:
    """Return linear layers, each with a batch norm and a leaky ReLU."""
    blocks = [
        (nn.Linear(a, b), nn.BatchNorm1d(b), nn.LeakyReLU(slope)) for a, b in pairwise(widths)
    ]
    return [layer for layers in blocks for layer in layers]


def alignment(there: Joints, canonical: Joints, *, turns: bool) -> tuple[Tensor, Tensor]:
    """Return rotations (B, J, 2, 3, 3) and offsets (B, J, 2, 3) that take both parts of each joint
    to where they lie in the canonical shape: x' = E R (x - q) + q_c, where R turns the joint's
    direction into the other, and E about that one, or along it, by the difference of states."""
    change = canonical.state - there.state
    along = canonical.direction[:, :, None]
    R = between(there.direction, canonical.direction)[:, :, None]
    R = turn(along, change) @ R if turns else R.expand(-1, -1, 2, -1, -1)
    offset = canonical.pivot[:, :, None] - (R @ there.pivot[:, :, None, :, None])[..., 0]
    return R, offset if turns else offset + change[..., None] * along


def turn(axis: Tensor, angle: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) about unit axes (..., 3) by angles (...), Rodrigues' formula."""
    K, angle = cross_matrix(axis), angle[..., None, None]
    return torch.eye(3).to(K) + angle.sin() * K + (1.0 - angle.cos()) * K @ K


def between(u: Tensor, v: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) that turn unit vectors (..., 3) into others the short way."""
    K = cross_matrix(torch.linalg.cross(u, v))
    cosine = (u * v).sum(-1)[..., None, None]
    return torch.eye(3).to(K) + K + K @ K / (1.0 + cosine).clamp(min=1e-4)


def cross_matrix(v: Tensor) -> Tensor:
    """Return K (..., 3, 3) with K x = v cross x."""
    basis = torch.eye(3).to(v).expand(*v.shape[:-1], 3, 3)
    return torch.linalg.cross(v[..., None, :].expand_as(basis), basis).mT
