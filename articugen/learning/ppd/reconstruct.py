"""What a trained model says of one cloud: part surfaces, joints, and how parts moved."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.func import functional_call

from articugen.core.geometry import invert_rigid
from articugen.core.records import Floats, JointKind
from articugen.evaluation.reconstruction import PartJoints, Reconstruction
from articugen.learning import fields
from articugen.learning.fields import Meshes, grid_centres, in_blocks
from articugen.learning.ppd.kinematics import InverseMotion
from articugen.learning.ppd.network import PPD, Prediction
from articugen.learning.ppd.shape import PartBox, ShapeCode, ShapeDecoder

ROOM = 1.5
"""Farthest a part is from the middle of its box, in the box's half edges: sines
repeat, and far away, where hardly a point is ever drawn, there would be crumbs."""

_MARGIN = 3.0**0.5 / 32.0
"""So much farther out it need not be evaluated: surfaces on grids of 32^3 and finer lie between
samples that are not so far apart."""

_AT_MOST, _NOWHERE = -1.0, -10.0
"""The field beyond that many half edges at most, and beyond the margin."""

_LOOKED_FOR = 12
"""Places along each edge of the box that a part can be in."""


def reconstruction_of(
    model: PPD,
    predicted: Prediction,
    resolution: int,
    meshes: Meshes | None = None,
    *,
    whole: Callable[[int], Floats] | None = None,
    states: Tensor | None = None,
) -> Reconstruction:
    """Parts and joints of one predicted shape, its surfaces from a grid of `resolution`^3.

    Args:
        meshes, whole: as `fields.reconstruction_of`.
        states: (1, J) of the joints, if those are known better than predicted: motions are by
            them, surfaces as predicted.
    """
    settings, pose, shape = model.settings, predicted.pose, predicted.shape
    R, J = len(settings.revolute), settings.joints
    states = pose.state if states is None else states
    with torch.no_grad():
        inverse, states = model.motion(pose, states), model.since_rest(states)
    T_inverse = np.tile(np.eye(4), (J + 1, 1, 1))
    T_inverse[:, :3, :3] = inverse.rotation[0].double().cpu().numpy()
    T_inverse[:, :3, 3] = inverse.offset[0].double().cpu().numpy()
    return fields.reconstruction_of(
        partial(logits_at, model, predicted),
        J + 1,
        resolution,
        meshes=meshes,
        looked_for=partial(_in_boxes, model, shape, shape.box) if shape.box else None,
        whole=whole,
        T_part=invert_rigid(T_inverse),
        joints=PartJoints(
            kind=np.array(
                [JointKind.FIXED] + [JointKind.REVOLUTE] * R + [JointKind.PRISMATIC] * (J - R)
            ),
            state=np.append(0.0, states[0].double().cpu().numpy()),
            pivot=pose.pivot[0].double().cpu().numpy(),
            direction=np.concatenate([[[0, 0, 1.0]], pose.direction[0].double().cpu().numpy()]),
        ),
    )


@torch.no_grad()
def _in_boxes(model: PPD, code: ShapeCode, box: PartBox) -> Floats:
    """Return (P, n): the field of each part at places all over the box that it can be in, however
    small that is: grids of the cube may miss what is thin."""
    points = 2.0 * ROOM * grid_centres(_LOOKED_FOR).to(box.middle)
    into = InverseMotion(torch.diag_embed(box.size), box.middle)
    return model.fields(code, into, points[None]).product[0].double().cpu().numpy()


@torch.no_grad()
def logits_at(
    model: PPD, predicted: Prediction, points: Tensor, parts: NDArray[np.int64] | None = None
) -> Floats:
    """Return (P, n): the field of each part, or of these `parts`, at points (n, 3), before the
    sigmoid; below 0 far outside of the part's box, where it has one."""
    inverse = model.motion(predicted.pose)
    points = points.to(inverse.offset)
    numbers = torch.arange(model.settings.parts) if parts is None else torch.from_numpy(parts)
    numbers = numbers.to(points.device)
    if not predicted.shape.box:
        field = _field(model.shape, predicted.shape, inverse, points, numbers)
    else:
        field = points.new_full((len(numbers), len(points)), _NOWHERE)
        columns = points.mT.contiguous()
        for values, part in zip(field, numbers.split(1), strict=True):
            beyond = _beyond(predicted.shape.box, inverse, columns, part)
            near = torch.nonzero(beyond < _MARGIN)[:, 0]
            alone = _field(model.shape, predicted.shape, inverse, points[near], part)[0]
            values[near] = torch.where(beyond[near] > 0.0, alone.clamp(max=_AT_MOST), alone)
    return field.double().cpu().numpy()


def _beyond(box: PartBox, inverse: InverseMotion, points: Tensor, part: Tensor) -> Tensor:
    """Return (n,) how far points (3, n) are outside of `ROOM` times the box of a part (1,), along
    that axis of the box along which it is most; negative inside."""
    offset = inverse.offset[0, part] - box.middle[0, part]
    rest = torch.addmm(offset.mT, inverse.rotation[0, part][0], points)
    x, y, z = rest.abs_().sub_(ROOM * box.size[0, part].mT)
    return torch.maximum(torch.maximum(x, y), z)


def _field(
    decoder: ShapeDecoder, code: ShapeCode, inverse: InverseMotion, points: Tensor, parts: Tensor
) -> Tensor:
    """Return (p, n): the field of some parts (p,) at points (n, 3), a few at a time."""
    weights, code = _weights_of(decoder, parts), code.of(parts)
    inverse = InverseMotion(inverse.rotation[:, parts], inverse.offset[:, parts])
    blocks = [
        functional_call(decoder, weights, (code, inverse, some[None])).product[0]
        for some in in_blocks(points, len(parts))
    ]
    return torch.cat(blocks, 1)


def _weights_of(decoder: ShapeDecoder, parts: Tensor) -> dict[str, Tensor]:
    """Return the weights of the layers of some parts."""
    both = torch.cat([parts, decoder.parts + parts])
    groups = {"coordinate": parts, "trunk_0": parts, "trunk_1": parts}
    groups |= {"head_0": both, "head_1": both, "head_2": both}
    known = dict(decoder.named_parameters())
    kinds = "weight", "bias"
    return {f"{n}.{kind}": known[f"{n}.{kind}"][g] for n, g in groups.items() for kind in kinds}
