"""Part fields: their surfaces, how well they fit held-out objects, and learners of nothing else.

A field is above 0 inside of its part and below 0 outside, as a logit is. Part i's surface encloses
where its field is above 0 and the greatest of all, unless a method draws its surfaces otherwise.
"""

from collections.abc import Callable, Sequence
from functools import cache, cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from articugen.core.records import Floats
from articugen.evaluation.metrics import nearest_part
from articugen.evaluation.reconstruction import PartJoints, Reconstruction
from articugen.learning.blocks import NetworkLearner
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import PackedSplit, unpacked, voxel_centres
from articugen.meshes.marching_cubes import zero_level

VALIDATION_GRID = 32

DENSE = 64
"""Grids of less than twice that are evaluated everywhere."""

_NO_TRIANGLES = np.zeros((0, 3, 3))
_BLOCK, _LARGE_BLOCK = 1 << 14, 1 << 21
"""Points at a time, of all parts together: on a CPU what the decoders make of them stays in the
cache, which takes less than half of the time; on a GPU there are enough to keep it busy."""

_ABSENT = -4.0
"""A part whose field is nowhere above that at the places where it is looked for is nowhere at all:
PPD's candidates that no object has are at -7, and what was there came to -0.1 at the least."""

Meshes = Callable[[Floats], tuple[list[Floats], Floats]]
"""From the parts' fields (P, R, R, R) to the triangles of each part, and those of the whole."""


class Fields(Protocol):
    """The fields of one shape."""

    def __call__(self, points: Tensor, parts: NDArray[np.int64] = ..., /) -> Floats:
        """Return (P, n), the field of each part, or of these `parts`, at points (n, 3)."""
        ...


def reconstruction_of(
    fields: Fields,
    parts: int,
    resolution: int,
    *,
    meshes: Meshes | None = None,
    looked_for: Callable[[], Floats] | None = None,
    whole: Callable[[int], Floats] | None = None,
    T_part: Floats | None = None,
    joints: PartJoints | None = None,
) -> Reconstruction:
    """Return the parts of one shape, their surfaces from a grid of `resolution`^3.

    Args:
        parts: how many fields there are.
        meshes: what makes the surfaces; `meshes_of_greatest` if not given.
        looked_for: see `fields_near_surfaces`.
        whole: gives (R, R, R), above 0 inside of the object, if that is known better: fields then
            decide whose each place in there is, see `divided`, and their own surfaces label points.
            The parts' surfaces are drawn on a grid of `DENSE`^3 at least, since thin things fall
            between the samples of a coarser one. The surface of the whole is drawn on the grid that
            was asked for.
        T_part, joints: as `Reconstruction`; None of a method that knows none.
    """
    drawn, meshes = max(resolution, DENSE) if whole else resolution, meshes or meshes_of_greatest
    there, grids = fields_near_surfaces(fields, drawn, looked_for)
    surfaces, outline = meshes(grids)
    labelling = None
    if whole:
        labelling = _of_parts(there, surfaces)
        grids = divided(whole(drawn), grids, surfaces)
        surfaces, outline = meshes(grids)
    inside, finer = grids.max(0), None
    if drawn != resolution and whole:
        inside, finer = whole(resolution), outline
        outline = meshes(inside[None])[1]
    return Reconstruction(
        *_of_parts(there, surfaces),
        whole=outline,
        occupied=inside > 0.0,
        parts=parts,
        T_part=T_part,
        joints=joints,
        finer=finer,
        labelling=labelling,
    )


def _of_parts(
    parts: NDArray[np.int64], surfaces: Sequence[Floats]
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the triangles (F, 3, 3) of the parts' surfaces, and whose each is (F,)."""
    return np.concatenate([_NO_TRIANGLES, *surfaces]), np.repeat(parts, [*map(len, surfaces)])


def reconstruction_of_surfaces(surfaces: Sequence[Floats], inside: Floats) -> Reconstruction:
    """Return parts whose triangles (F, 3, 3) are known; `inside` (R, R, R), above 0 there, is drawn
    as the whole."""
    return Reconstruction(
        *_of_parts(np.arange(len(surfaces)), surfaces),
        whole=zero_level(inside).triangles,
        occupied=inside > 0.0,
        parts=len(surfaces),
    )


def fields_on_grid(fields: Fields, resolution: int) -> Floats:
    """Return (P, R, R, R), the field of each part at the voxel centres."""
    return _on_grid(fields(grid_centres(resolution)))


def _on_grid(values: Floats) -> Floats:
    """Return (P, R, R, R) of (P, R^3)."""
    resolution = round(values.shape[1] ** (1 / 3))
    return values.reshape(-1, resolution, resolution, resolution)


@cache
def grid_centres(resolution: int) -> Tensor:
    """Return (R^3, 3), the centres of a grid's voxels."""
    return voxel_centres(torch.arange(resolution**3), resolution)


def in_blocks(points: Tensor, parts: int) -> tuple[Tensor, ...]:
    """Split points (n, 3) into blocks that are fastest for a number of parts."""
    return points.split((_BLOCK if points.device.type == "cpu" else _LARGE_BLOCK) // parts)


def divided(whole: Floats, grids: Floats, surfaces: Sequence[Floats]) -> Floats:
    """Return fields (P, R, R, R) of which the greatest is `whole` (R, R, R): that of the part whose
    field of `grids` (P, R, R, R) is the greatest there or, outside of all parts, of that whose
    surface (F, 3, 3) of the `surfaces` is the nearest: how far below 0 a field is says little of
    how far away its part is."""
    near = np.flatnonzero((whole > 0.0) | beside_surfaces(whole[None]))
    values = grids.reshape(len(grids), -1)[:, near]
    outside = np.flatnonzero(values.max(0) <= 0.0)
    if any(map(len, surfaces)) and len(outside):
        at = voxel_centres(torch.from_numpy(near[outside]), len(whole)).double().numpy()
        owner = nearest_part(at, *_of_parts(np.arange(len(grids)), surfaces), len(grids))
        values[:, outside] = -1.0 * (np.arange(len(grids))[:, None] != owner)
    shared = np.repeat(whole[None], len(grids), axis=0)
    shared.reshape(len(grids), -1)[:, near] += values - values.max(0, initial=-np.inf)
    return shared


def fields_near_surfaces(
    fields: Fields, resolution: int, looked_for: Callable[[], Floats] | None = None
) -> tuple[NDArray[np.int64], Floats]:
    """Return some parts (k,), and their fields (k, R, R, R) as `fields_on_grid` gives them.

    Parts that are nowhere are left out. Grids of twice `DENSE` and finer are evaluated near
    surfaces only, and of parts alone that are anywhere on the grid that is half as fine: what is
    far keeps its value there, which changes no surface that is seen there.

    Args:
        looked_for: gives (P, n), each part's field where it would be found if it were anywhere.
    """
    if resolution < 2 * DENSE or resolution % 2:
        return _on_the_whole_grid(fields, resolution, looked_for)
    parts, coarse = fields_near_surfaces(fields, resolution // 2, looked_for)
    there = _somewhere_above(0.0, coarse)
    parts, coarse = parts[there], coarse[there]
    beside = doubled(beside_surfaces(coarse)[None])
    return parts, renewed(doubled(coarse), beside, lambda centres: fields(centres, parts))


def renewed(grids: Floats, there: NDArray[np.bool_], values: Callable[[Tensor], Floats]) -> Floats:
    """Return grids (P, R, R, R), changed to `values` (P, n) of the centres (n, 3) of the voxels
    that are `there`."""
    cells = np.flatnonzero(there)
    if len(cells):
        centres = voxel_centres(torch.from_numpy(cells), grids.shape[1])
        grids.reshape(len(grids), -1)[:, cells] = values(centres)
    return grids


def _on_the_whole_grid(
    fields: Fields, resolution: int, looked_for: Callable[[], Floats] | None
) -> tuple[NDArray[np.int64], Floats]:
    """Return parts and their fields, without those that `_ABSENT` says are nowhere."""
    if looked_for:
        sought = looked_for()
    elif resolution >= DENSE:
        sought = fields(grid_centres(resolution // 2))
    else:
        grids = fields_on_grid(fields, resolution)
        return np.arange(len(grids)), grids
    parts = np.flatnonzero(_somewhere_above(_ABSENT, sought))
    return parts, _on_grid(fields(grid_centres(resolution), parts))


def _somewhere_above(level: float, logits: Floats) -> NDArray[np.bool_]:
    """Return (P,), whether fields (P, ...) are above a level anywhere; the first, if none is."""
    there = logits.reshape(len(logits), -1).max(1) > level
    there[0] |= not there.any()
    return there


def doubled(grids: NDArray[Any]) -> NDArray[Any]:
    """Return grids (P, R, R, R) with each voxel as eight."""
    P, R = grids.shape[:2]
    fine = np.empty((P, R, 2, R, 2, R, 2), grids.dtype)
    fine[:] = grids[:, :, None, :, None, :, None]
    return fine.reshape(P, 2 * R, 2 * R, 2 * R)


def beside_surfaces(logits: Floats) -> NDArray[np.bool_]:
    """Return (R, R, R), whether any voxel around, corners included, is of another part or none."""
    owner = np.pad(np.where(logits.max(0) > 0.0, logits.argmax(0), -1), 1, mode="edge")
    least = most = owner
    for axis in range(3):
        least = np.minimum.reduce([np.roll(least, step, axis) for step in (-1, 0, 1)])
        most = np.maximum.reduce([np.roll(most, step, axis) for step in (-1, 0, 1)])
    return (least != most)[1:-1, 1:-1, 1:-1]


def meshes_of_greatest(logits: Floats) -> tuple[list[Floats], Floats]:
    """Draw part i where its field is above 0, and exceeds every other part's."""
    first, second = logits[0].copy(), np.full_like(logits[0], -np.inf)  # the greatest two
    for field in logits[1:]:
        np.maximum(second, np.minimum(first, field), out=second)
        np.maximum(first, field, out=first)
    surfaces = []
    for field in logits:
        if not (field > 0.0).any():
            surfaces.append(_NO_TRIANGLES)
            continue
        lead = np.where(field == first, second, first)
        np.subtract(field, lead, out=lead)
        surfaces.append(zero_level(np.minimum(field, lead, out=lead)).triangles)
    return surfaces, zero_level(first).triangles


@torch.no_grad()
def held_out_fit(
    fields: Callable[[Tensor, Tensor], Tensor], clouds: Tensor, held_out: PackedSplit
) -> dict[str, float]:
    """Measure how unseen objects are reconstructed on their 32^3 grid, by the greatest field.

    `rec` is the mean binary cross-entropy, `iou` the mean over instances of |A and B| / |A or B|,
    `parts` how many parts are the greatest anywhere inside, on average: where that is 1 a method
    has come to one part for everything, which scores 1 / K^2 in label IoU.

    Args:
        fields: from one cloud (1, n, 3) and points (1, m, 3) to (P, m).
        clouds: (I, n, 3) as they are stored, what the model sees of each instance.
    """
    entropy, overlap, owners = [], [], []
    points = grid_centres(VALIDATION_GRID).to(clouds.device)[None]
    for row in held_out.evenly():
        occupied = held_out.grids[VALIDATION_GRID][row] > 0
        logit, owner = fields(unpacked(clouds[row : row + 1]), points).max(0)
        entropy.append(binary_cross_entropy_with_logits(logit, occupied.to(logit.dtype)))
        both, either = (logit > 0) & occupied, (logit > 0) | occupied
        overlap.append(both.sum() / either.sum().clamp(min=1))
        owners.append(len(owner[logit > 0].unique()))
    return {
        "rec": float(torch.stack(entropy).mean()),
        "iou": float(torch.stack(overlap).mean()),
        "parts": float(np.mean(owners)),
    }


class PartFields(nn.Module):
    """Network of part fields, as `FieldLearner` takes it.

    Attributes:
        parts: how many fields there are.
    """

    parts: int

    def encode(self, cloud: Tensor) -> Tensor:
        """Return the codes (B, C) of clouds (B, n, 3)."""
        raise NotImplementedError

    def fields(self, code: Tensor, points: Tensor) -> Tensor:
        """Return the fields (B, P, n) of codes (B, C) at points (B, n, 3)."""
        raise NotImplementedError


class FieldLearner(NetworkLearner):
    """Learner of part fields: a method adds settings, a network of `PartFields` and a loss."""

    @cached_property
    def inputs(self) -> BatchSpec:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Needs of the batches; a method may ask for others."""
        grids = (VALIDATION_GRID,) if self.settings.data.validation_objects else ()
        return BatchSpec.of(self.settings.data, grids=grids)

    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """Return `rec`, `iou` and `parts`, see `held_out_fit`."""

        def fields(cloud: Tensor, points: Tensor) -> Tensor:
            code = self.network.encode(cloud)
            some = [self.network.fields(code, p[None])[0] for p in in_blocks(points[0], self.parts)]
            return torch.cat(some, 1)

        self.network.eval()
        fit = held_out_fit(fields, held_out.surface[:, : self.inputs.surface_points], held_out)
        self.network.train()
        return fit

    @property
    def parts(self) -> int:
        return self.network.parts

    @torch.no_grad()
    def code_of(self, cloud: Floats) -> Tensor:
        """Return the code (1, C) of one cloud (n, 3)."""
        few = torch.as_tensor(cloud[: self.inputs.surface_points], dtype=torch.float32)
        return self.network.encode(few[None].to(self.device))

    def fields_of(self, code: Tensor) -> Fields:
        """Return the fields of one cloud, by its code (1, C)."""

        @torch.no_grad()
        def fields(points: Tensor, parts: NDArray[np.int64] | slice = slice(None)) -> Floats:
            blocks = in_blocks(points.to(code), self.parts)
            some = [self.network.fields(code, block[None])[0][parts] for block in blocks]
            return torch.cat(some, 1).double().cpu().numpy()

        return fields

    def reconstruct(self, cloud: Floats, *, resolution: int) -> Reconstruction:
        """Return parts without motions or joints."""
        return reconstruction_of(self.fields_of(self.code_of(cloud)), self.parts, resolution)
