"""Rigid motions of parts in torch: directions from Euler residuals, and B_i^{-1} (Section 3.2).

A batch has B samples, P parts and J = P - 1 joints; joint j moves part j + 1, the revolute ones
first. Everything is in the unit frame, angles in radians.
"""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class InverseMotion:
    """x_part = rotation @ x + offset: where a posed point lies in each part's rest frame.

    Attributes:
        rotation: (B, P, 3, 3).
        offset: (B, P, 3).
    """

    rotation: Tensor
    offset: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Points (B, n, 3) in the frame of every part: (B, P, n, 3)."""
        return torch.einsum("bpij,bnj->bpni", self.rotation, points) + self.offset[:, :, None]

    @staticmethod
    def none(batch: int, parts: int, like: Tensor) -> "InverseMotion":
        """Nothing moves: the points themselves."""
        eye = torch.eye(3, dtype=like.dtype, device=like.device).expand(batch, parts, 3, 3)
        return InverseMotion(eye, torch.zeros_like(eye[..., 0]))


def rotation_from_z(directions: Tensor) -> Tensor:
    """Return rotations M (..., 3, 3) with M e_z = direction, for unit directions (..., 3).

    The shortest one for directions that point up; for others that of their image under the half
    turn about x, turned back: exact everywhere, also at -z.
    """
    half_turn = directions.new_tensor([1.0, -1.0, -1.0])
    down = directions[..., 2:] < 0
    x, y, z = torch.where(down, half_turn * directions, directions).unbind(-1)
    k = 1.0 / (1.0 + z)
    rows = [1.0 - k * x * x, -k * x * y, x, -k * x * y, 1.0 - k * y * y, y, -x, -y, z]
    shortest = torch.stack(rows, -1).unflatten(-1, (3, 3))
    return torch.where(down[..., None], half_turn[:, None] * shortest, shortest)


def about_z(angle: Tensor) -> Tensor:
    """Return (..., 3, 3) rotations by `angle` (...) about z."""
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).unflatten(-1, (3, 3))


def joint_frames(initial: Tensor, euler: Tensor) -> Tensor:
    """C_i = M_i Rx(r_x) Rz(r_z) Ry(r_y), (..., J, 3, 3); its last column is the direction u_i.

    Args:
        initial: (J, 3, 3) the M_i, whose last columns are the initial directions e_i.
        euler: (..., J, 3) the residual r_i; the order of the rotations is the release's.
    """
    (cx, cy, cz), (sx, sy, sz) = euler.cos().unbind(-1), euler.sin().unbind(-1)
    rows = [
        cz * cy, -sz, cz * sy,
        cx * sz * cy + sx * sy, cx * cz, cx * sz * sy - sx * cy,
        sx * sz * cy - cx * sy, sx * cz, sx * sz * sy + cx * cy,
    ]  # fmt: skip
    return initial @ torch.stack(rows, -1).unflatten(-1, (3, 3))


def inverse_motion(
    frames: Tensor, state: Tensor, pivot: Tensor, revolute: int, part_frame: str
) -> InverseMotion:
    """B_i^{-1} of every part: fixed I; revolute T(q) R(s, u); prismatic T(s u).

    Args:
        frames: (B, J, 3, 3) from `joint_frames`.
        state: (B, J).
        pivot: (B, R, 3) of the revolute joints.
        revolute: R, how many joints are.
        part_frame: "world" as in the paper, "joint" for T(q) C Rz(s).
    """
    C = frames[:, :revolute]
    turned = C @ about_z(state[:, :revolute])
    R = turned if part_frame == "joint" else turned @ C.mT
    inverse = R.mT
    slide = state[:, revolute:, None] * frames[:, revolute:, :, 2]
    eye = torch.eye(3, dtype=state.dtype, device=state.device).expand(len(state), 1, 3, 3)
    zero = torch.zeros_like(slide[:, :1])
    return InverseMotion(
        torch.cat([eye, inverse, eye.expand(-1, slide.shape[1], 3, 3)], 1),
        torch.cat([zero, -(inverse @ pivot[..., None])[..., 0], -slide], 1),
    )
