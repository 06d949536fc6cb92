"""What a trained model says of one cloud: part surfaces, joints, and how parts moved."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from articugen.geometry import invert_rigid, rotation_about, transform
from articugen.learning.dataset import voxel_centres
from articugen.learning.evaluation.surfaces import Floats, surface
from articugen.learning.ppd.model import PPD, Prediction
from articugen.records import Instance, dequantize

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2

Meshes = Callable[[Floats], tuple[list[Floats], Floats]]
"""From the parts' logits (P, R, R, R) to the triangles of each part, and those of the whole."""

_NO_TRIANGLES = np.zeros((0, 3, 3))
_BLOCK = 1 << 15
_DENSE = 64


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Parts and joints of one posed shape; P parts, the unit frame, radians.

    Attributes:
        triangles, part: (F, 3, 3) the surfaces of all parts, (F,) whose each is.
        whole: (G, 3, 3) the surface of the whole.
        occupied: (R, R, R) whether a voxel's centre lies in any part; R = 0 where that is unknown.
        kind: (P,) FIXED, REVOLUTE or PRISMATIC.
        state: (P,) joint states, 0 for fixed parts.
        pivot, direction: (P, 3).
        T_part: (P, 4, 4) the transform B_i of each part from its rest frame.
    """

    triangles: Floats
    part: NDArray[np.int64]
    whole: Floats
    occupied: NDArray[np.bool_]
    kind: NDArray[np.int64]
    state: Floats
    pivot: Floats
    direction: Floats
    T_part: Floats

    @property
    def parts(self) -> int:
        return len(self.kind)

    def motion_to(self, posed: "Reconstruction") -> Floats:
        """Transform-only reading of how parts moved: B_i(posed) B_i(here)^-1, (P, 4, 4)."""
        return posed.T_part @ invert_rigid(self.T_part)

    def joint_motion_to(self, posed: "Reconstruction") -> Floats:
        """Joint-aware reading: this shape's axes and the difference of states, (P, 4, 4)."""
        motion = np.tile(np.eye(4), (self.parts, 1, 1))
        change = posed.state - self.state
        for i in np.flatnonzero(self.kind == REVOLUTE):
            R = rotation_about(self.direction[i], change[i])
            motion[i] = transform(R, self.pivot[i] - R @ self.pivot[i])
        for i in np.flatnonzero(self.kind == PRISMATIC):
            motion[i, :3, 3] = change[i] * self.direction[i]
        return motion


def reconstruction_of(
    model: PPD, predicted: Prediction, resolution: int, meshes: Meshes | None = None
) -> Reconstruction:
    """Parts and joints of one predicted shape, its surfaces from a grid of `resolution`^3."""
    settings, pose = model.settings, predicted.pose
    logits = part_logits(model, predicted, resolution)
    surfaces, whole = (meshes or _meshes)(logits)
    R, J = len(settings.revolute), settings.joints
    with torch.no_grad():
        inverse = model.motion(pose)
    T_inverse = np.tile(np.eye(4), (J + 1, 1, 1))
    T_inverse[:, :3, :3] = inverse.rotation[0].double().cpu().numpy()
    T_inverse[:, :3, 3] = inverse.offset[0].double().cpu().numpy()
    return Reconstruction(
        triangles=np.concatenate([_NO_TRIANGLES, *surfaces]),
        part=np.repeat(np.arange(J + 1), [len(s) for s in surfaces]),
        whole=whole,
        occupied=logits.max(0) > 0.0,
        kind=np.array([FIXED] + [REVOLUTE] * R + [PRISMATIC] * (J - R)),
        state=np.append(0.0, pose.state[0].double().cpu().numpy()),
        pivot=pose.pivot[0].double().cpu().numpy(),
        direction=np.concatenate([[[0, 0, 1.0]], pose.direction[0].double().cpu().numpy()]),
        T_part=invert_rigid(T_inverse),
    )


def part_logits(model: PPD, predicted: Prediction, resolution: int) -> Floats:
    """(P, R, R, R): the field of each part at the voxel centres, before the sigmoid.

    Grids of 128^3 and finer are evaluated near surfaces only: what is far keeps its value on the
    grid that is half as fine, which changes no surface that is seen there.
    """
    if resolution < 2 * _DENSE or resolution % 2:
        every = voxel_centres(torch.arange(resolution**3), resolution)
        values = logits_at(model, predicted, every)
        return values.reshape(-1, resolution, resolution, resolution)
    coarse = part_logits(model, predicted, resolution // 2)
    fine = coarse.repeat(2, 1).repeat(2, 2).repeat(2, 3)
    near = _beside_surfaces(coarse).repeat(2, 0).repeat(2, 1).repeat(2, 2)
    cells = torch.from_numpy(np.flatnonzero(near))
    fine[:, near] = logits_at(model, predicted, voxel_centres(cells, resolution))
    return fine


@torch.no_grad()
def logits_at(model: PPD, predicted: Prediction, points: Tensor) -> Floats:
    """(P, n): the field of each part at points (n, 3), before the sigmoid."""
    inverse = model.motion(predicted.pose)
    field = [
        model.fields(predicted.shape, inverse, block[None].to(inverse.offset)).product[0]
        for block in points.split(_BLOCK)
    ]
    return torch.cat(field, 1).double().cpu().numpy()


def _beside_surfaces(logits: Floats) -> NDArray[np.bool_]:
    """(R, R, R): whether any voxel around, corners included, is of another part, or none."""
    owner = np.pad(np.where(logits.max(0) > 0.0, logits.argmax(0), -1), 1, mode="edge")
    least = most = owner
    for axis in range(3):
        rolled = [np.roll(least, step, axis) for step in (-1, 0, 1)]
        least = np.minimum.reduce(rolled)
        rolled = [np.roll(most, step, axis) for step in (-1, 0, 1)]
        most = np.maximum.reduce(rolled)
    return (least != most)[1:-1, 1:-1, 1:-1]


def _meshes(logits: Floats) -> tuple[list[Floats], Floats]:
    own = [surface(field).corners for field in _own_fields(logits)]
    return own, surface(logits.max(0)).corners


def _own_fields(logits: Floats) -> Floats:
    """(P, R, R, R): above 0 where a part's field is, and exceeds every other part's."""
    first, second = torch.from_numpy(logits).topk(2, dim=0).values.numpy()
    greatest_other = np.where(logits == first, second, first)
    return np.minimum(logits, logits - greatest_other)


def truth(instance: Instance, resolution: int = 32) -> Reconstruction:
    """The ground truth in the place of a prediction; its surfaces are the stored points.

    Args:
        resolution: of the stored grid that tells what is occupied, if there is such a grid.
    """
    grid = instance.occupancy.get(resolution, np.zeros((0, 0, 0), np.uint8))
    points = dequantize(instance.surface_points)
    J = len(instance.joint_kind)
    triangles = np.repeat(points[:, None], 3, axis=1)
    return Reconstruction(
        triangles=triangles,
        part=instance.surface_part.astype(np.int64),
        whole=triangles,
        occupied=grid > 0,
        kind=np.append(FIXED, instance.joint_kind).astype(np.int64),
        state=np.append(0.0, instance.joint_state),
        pivot=np.concatenate([np.zeros((1, 3)), instance.joint_pivot]),
        direction=np.concatenate([[[0, 0, 1.0]], instance.joint_axis]).reshape(J + 1, 3),
        T_part=instance.part_motion,
    )
