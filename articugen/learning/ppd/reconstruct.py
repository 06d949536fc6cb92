"""What a trained model says of one cloud: part surfaces, joints, and how parts moved."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from articugen.geometry import invert_rigid
from articugen.learning.dataset import voxel_centres
from articugen.learning.evaluation.reconstruction import (
    FIXED,
    PRISMATIC,
    REVOLUTE,
    PartJoints,
    Reconstruction,
)
from articugen.learning.ppd.model import PPD, Prediction
from articugen.marching_cubes import zero_level
from articugen.records import Floats

Meshes = Callable[[Floats], tuple[list[Floats], Floats]]
"""From the parts' logits (P, R, R, R) to the triangles of each part, and those of the whole."""

_NO_TRIANGLES = np.zeros((0, 3, 3))
_BLOCK = 1 << 15
_DENSE = 64


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
        parts=J + 1,
        T_part=invert_rigid(T_inverse),
        joints=PartJoints(
            kind=np.array([FIXED] + [REVOLUTE] * R + [PRISMATIC] * (J - R)),
            state=np.append(0.0, pose.state[0].double().cpu().numpy()),
            pivot=pose.pivot[0].double().cpu().numpy(),
            direction=np.concatenate([[[0, 0, 1.0]], pose.direction[0].double().cpu().numpy()]),
        ),
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
    own = [zero_level(field).triangles for field in _own_fields(logits)]
    return own, zero_level(logits.max(0)).triangles


def _own_fields(logits: Floats) -> Floats:
    """(P, R, R, R): above 0 where a part's field is, and exceeds every other part's."""
    first, second = torch.from_numpy(logits).topk(2, dim=0).values.numpy()
    greatest_other = np.where(logits == first, second, first)
    return np.minimum(logits, logits - greatest_other)
