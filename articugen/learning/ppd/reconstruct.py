"""What a trained model says of one cloud: part surfaces, joints, and how parts moved."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.func import functional_call

from articugen.core.geometry import invert_rigid
from articugen.core.records import Floats, JointKind
from articugen.learning.data.split import voxel_centres
from articugen.learning.evaluation.reconstruction import PartJoints, Reconstruction
from articugen.learning.ppd.kinematics import InverseMotion
from articugen.learning.ppd.network import PPD, Prediction
from articugen.learning.ppd.shape import PartBox, ShapeCode, ShapeDecoder
from articugen.meshes.marching_cubes import zero_level

Meshes = Callable[[Floats], tuple[list[Floats], Floats]]
"""From the parts' logits (P, R, R, R) to the triangles of each part, and those of the whole."""

_NO_TRIANGLES = np.zeros((0, 3, 3))
_BLOCK, _LARGE_BLOCK = 1 << 14, 1 << 21
"""Points at a time, of all parts together: on a CPU what the decoders make of them stays in the
cache, which takes less than half of the time; on a GPU there are enough to keep it busy."""

_DENSE = 64

ROOM = 1.5
"""A part is not farther from the middle of its box than so many times the box's half edges: sines
repeat, and far away, where hardly a point is ever drawn, there would be crumbs."""

_MARGIN = 3.0**0.5 / 32.0
"""So much farther out it need not be evaluated: surfaces on grids of 32^3 and finer lie between
samples that are not so far apart."""

_AT_MOST, _NOWHERE = -1.0, -10.0
"""The field beyond that many half edges at most, and beyond the margin."""

_ABSENT = -4.0
"""A part whose field is nowhere above that at the places where it is looked for is nowhere at all:
candidates that no object has are at -7, and whatever was there came to -0.1 at the least."""

_LOOKED_FOR = 12
"""So many places along each edge of the box that a part can be in."""


def reconstruction_of(
    model: PPD,
    predicted: Prediction,
    resolution: int,
    meshes: Meshes | None = None,
    *,
    dense: int = _DENSE,
) -> Reconstruction:
    """Parts and joints of one predicted shape, its surfaces from a grid of `resolution`^3.

    Args:
        meshes: what makes the surfaces; part i's encloses where its field is above 0 and the
            greatest of all, unless that is given.
        dense: see `logits_near_surfaces`.
    """
    settings, pose = model.settings, predicted.pose
    parts, logits = logits_near_surfaces(model, predicted, resolution, dense)
    surfaces, whole = (meshes or _meshes)(logits)
    R, J = len(settings.revolute), settings.joints
    with torch.no_grad():
        inverse = model.motion(pose)
    T_inverse = np.tile(np.eye(4), (J + 1, 1, 1))
    T_inverse[:, :3, :3] = inverse.rotation[0].double().cpu().numpy()
    T_inverse[:, :3, 3] = inverse.offset[0].double().cpu().numpy()
    return Reconstruction(
        triangles=np.concatenate([_NO_TRIANGLES, *surfaces]),
        part=np.repeat(parts, [len(s) for s in surfaces]),
        whole=whole,
        occupied=logits.max(0) > 0.0,
        parts=J + 1,
        T_part=invert_rigid(T_inverse),
        joints=PartJoints(
            kind=np.array(
                [JointKind.FIXED] + [JointKind.REVOLUTE] * R + [JointKind.PRISMATIC] * (J - R)
            ),
            state=np.append(0.0, pose.state[0].double().cpu().numpy()),
            pivot=pose.pivot[0].double().cpu().numpy(),
            direction=np.concatenate([[[0, 0, 1.0]], pose.direction[0].double().cpu().numpy()]),
        ),
    )


def part_logits(model: PPD, predicted: Prediction, resolution: int) -> Floats:
    """(P, R, R, R): the field of each part at the voxel centres, before the sigmoid."""
    return _on_grid(logits_at(model, predicted, _all_centres(resolution)))


def _on_grid(values: Floats) -> Floats:
    """(P, R, R, R) of (P, R^3)."""
    resolution = round(values.shape[1] ** (1 / 3))
    return values.reshape(-1, resolution, resolution, resolution)


@cache
def _all_centres(resolution: int) -> Tensor:
    return voxel_centres(torch.arange(resolution**3), resolution)


def logits_near_surfaces(
    model: PPD, predicted: Prediction, resolution: int, dense: int
) -> tuple[NDArray[np.int64], Floats]:
    """((k,), (k, R, R, R)): some parts, and their fields as `part_logits` gives them.

    Parts that are nowhere are left out. Grids of twice `dense` and finer are evaluated near
    surfaces only, and of parts alone that are anywhere on the grid that is half as fine: what is
    far keeps its value there, which changes no surface that is seen there.
    """
    if resolution < 2 * dense or resolution % 2:
        return _on_the_whole_grid(model, predicted, resolution)
    parts, coarse = logits_near_surfaces(model, predicted, resolution // 2, dense)
    there = _somewhere_above(0.0, coarse)
    parts, coarse = parts[there], coarse[there]
    fine, cells = _doubled(coarse), np.flatnonzero(_doubled(_beside_surfaces(coarse)[None]))
    if not len(cells):
        return parts, fine
    centres = voxel_centres(torch.from_numpy(cells), resolution)
    for field, values in zip(fine, logits_at(model, predicted, centres, parts), strict=True):
        field.reshape(-1)[cells] = values
    return parts, fine


def _on_the_whole_grid(
    model: PPD, predicted: Prediction, resolution: int
) -> tuple[NDArray[np.int64], Floats]:
    """Parts and their fields, without those that `_ABSENT` says are nowhere."""
    if predicted.shape.box:
        looked_for = _in_boxes(model, predicted.shape, predicted.shape.box)
    elif resolution >= _DENSE:
        looked_for = logits_at(model, predicted, _all_centres(resolution // 2))
    else:
        logits = part_logits(model, predicted, resolution)
        return np.arange(len(logits)), logits
    parts = np.flatnonzero(_somewhere_above(_ABSENT, looked_for))
    return parts, _on_grid(logits_at(model, predicted, _all_centres(resolution), parts))


@torch.no_grad()
def _in_boxes(model: PPD, code: ShapeCode, box: PartBox) -> Floats:
    """(P, n): the field of each part at places all over the box that it can be in, however small
    that is: grids of the cube may miss what is thin."""
    points = 2.0 * ROOM * _all_centres(_LOOKED_FOR).to(box.middle)
    into = InverseMotion(torch.diag_embed(box.size), box.middle)
    return model.fields(code, into, points[None]).product[0].double().cpu().numpy()


def _somewhere_above(level: float, logits: Floats) -> NDArray[np.bool_]:
    """(P,) whether fields (P, ...) are above a level anywhere; the first, if none is."""
    there = logits.reshape(len(logits), -1).max(1) > level
    there[0] |= not there.any()
    return there


def _doubled(grids: NDArray[Any]) -> NDArray[Any]:
    """Grids (P, R, R, R), each voxel as eight."""
    P, R = grids.shape[:2]
    fine = np.empty((P, R, 2, R, 2, R, 2), grids.dtype)
    fine[:] = grids[:, :, None, :, None, :, None]
    return fine.reshape(P, 2 * R, 2 * R, 2 * R)


@torch.no_grad()
def logits_at(
    model: PPD, predicted: Prediction, points: Tensor, parts: NDArray[np.int64] | None = None
) -> Floats:
    """(P, n): the field of each part, or of these `parts`, at points (n, 3), before the sigmoid;
    below 0 far outside of the part's box, where it has one."""
    inverse = model.motion(predicted.pose)
    points = points.to(inverse.offset)
    each = torch.arange(model.settings.parts) if parts is None else torch.from_numpy(parts)
    each = each.to(points.device)
    if not predicted.shape.box:
        field = _field(model.shape, predicted.shape, inverse, points, each)
    else:
        field = points.new_full((len(each), len(points)), _NOWHERE)
        columns = points.mT.contiguous()
        for values, part in zip(field, each.split(1), strict=True):
            beyond = _beyond(predicted.shape.box, inverse, columns, part)
            near = torch.nonzero(beyond < _MARGIN)[:, 0]
            alone = _field(model.shape, predicted.shape, inverse, points[near], part)[0]
            values[near] = torch.where(beyond[near] > 0.0, alone.clamp(max=_AT_MOST), alone)
    return field.double().cpu().numpy()


def _beyond(box: PartBox, inverse: InverseMotion, points: Tensor, part: Tensor) -> Tensor:
    """(n,) how far points (3, n) are outside of `ROOM` times the box of a part (1,), along that
    axis of the box along which it is most; negative inside."""
    offset = inverse.offset[0, part] - box.middle[0, part]
    rest = torch.addmm(offset.mT, inverse.rotation[0, part][0], points)
    x, y, z = rest.abs_().sub_(ROOM * box.size[0, part].mT)
    return torch.maximum(torch.maximum(x, y), z)


def _field(
    decoder: ShapeDecoder, code: ShapeCode, inverse: InverseMotion, points: Tensor, parts: Tensor
) -> Tensor:
    """(p, n): the field of some parts (p,) at points (n, 3), a few at a time."""
    block = (_BLOCK if points.device.type == "cpu" else _LARGE_BLOCK) // len(parts)
    weights, code = _weights_of(decoder, parts), code.of(parts)
    inverse = InverseMotion(inverse.rotation[:, parts], inverse.offset[:, parts])
    fields = [
        functional_call(decoder, weights, (code, inverse, some[None])).product[0]
        for some in points.split(block)
    ]
    return torch.cat(fields, 1)


def _weights_of(decoder: ShapeDecoder, parts: Tensor) -> dict[str, Tensor]:
    """What the layers of some parts know."""
    both = torch.cat([parts, decoder.parts + parts])
    groups = {"coordinate": parts, "trunk_0": parts, "trunk_1": parts}
    groups |= {"head_0": both, "head_1": both, "head_2": both}
    known = dict(decoder.named_parameters())
    kinds = "weight", "bias"
    return {f"{n}.{kind}": known[f"{n}.{kind}"][g] for n, g in groups.items() for kind in kinds}


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
    """Part i is where its field is above 0, and exceeds every other part's."""
    first, second = logits[0].copy(), np.full_like(logits[0], -np.inf)  # the greatest two
    for field in logits[1:]:
        np.maximum(second, np.minimum(first, field), out=second)
        np.maximum(first, field, out=first)
    own = []
    for field in logits:
        if not (field > 0.0).any():
            own.append(_NO_TRIANGLES)
            continue
        lead = np.where(field == first, second, first)
        np.subtract(field, lead, out=lead)
        own.append(zero_level(np.minimum(field, lead, out=lead)).triangles)
    return own, zero_level(first).triangles
