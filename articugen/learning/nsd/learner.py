"""How Neural Star Domain learns: from occupancy, surfaces and what stars have in common."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from articugen.core.records import Floats
from articugen.evaluation.reconstruction import Reconstruction
from articugen.learning.data.batch import Batch
from articugen.learning.fields import FieldLearner, fields_on_grid, reconstruction_of_surfaces
from articugen.learning.method import Terms
from articugen.learning.nsd.network import SCALE, NSDNet, directions_of, indicator
from articugen.learning.nsd.settings import NSDRecipe

SHARED = 1.2  # what `indicator` may be without a loss for the overlap
HIDDEN = 0.1  # of the sum of fields above 0 at a point: more, and it lies inside other stars
MESH = 20  # longitudes and latitudes of a mesh


class NSDLearner(FieldLearner):
    settings: NSDRecipe  # pyright: ignore[reportIncompatibleVariableOverride]
    network: NSDNet

    def __init__(self, settings: NSDRecipe, seed: int, device: torch.device) -> None:
        super().__init__(settings, lambda: NSDNet(settings.model), seed, device)
        self.inputs = replace(self.inputs, chances=2 * settings.model.directions)

    def loss(self, batch: Batch) -> Terms:
        net, weight = self.network, self.settings.losses
        code = net.encode(batch.cloud)
        inside = indicator(net.stars(code, SCALE * batch.points))
        true = batch.occupied.to(inside.dtype)
        drawn = net.surfaces(code, directions_of(batch.chance.unflatten(1, (-1, 2)))).flatten(1, 2)
        return {
            "occupancy": weight.occupancy * binary_cross_entropy_with_logits(inside, true),
            "surface": weight.surface
            * surface_loss(drawn, visible(net, code, drawn), SCALE * batch.cloud),
            "overlap": weight.overlap * (inside - SHARED).relu().mean(),
        }

    @torch.no_grad()
    def reconstruct(self, cloud: Floats, *, resolution: int) -> Reconstruction:
        """Return each star as a mesh, without what is inside others; the whole from a grid."""
        code = self.code_of(cloud)
        at, faces = sphere()
        corners = self.network.surfaces(code, directions_of(at.to(code))[None]).flatten(1, 2)
        outer = visible(self.network, code, corners).view(self.parts, -1).cpu()
        meshes = (corners / SCALE).view(self.parts, -1, 3).double().cpu().numpy()
        surfaces = [
            mesh[faces[there.numpy()[faces].any(1)]]
            for mesh, there in zip(meshes, outer, strict=True)
        ]
        inside = fields_on_grid(self.fields_of(code), resolution).max(0)
        return reconstruction_of_surfaces(surfaces, inside)


@torch.no_grad()
def visible(net: NSDNet, code: Tensor, points: Tensor) -> Tensor:
    """Return (B, n), whether points (B, n, 3) of surfaces lie in no other star."""
    return net.stars(code, points).relu().sum(1) <= HIDDEN


def surface_loss(drawn: Tensor, counts: Tensor, cloud: Tensor) -> Tensor:
    """Return half the sum of both mean distances between drawn points (B, m, 3) and a cloud
    (B, n, 3); the distance of a drawn point that does not count (B, m) is 0, and yet it can be the
    nearest one of the cloud's."""
    there, back = nearest(drawn, cloud), nearest(cloud, drawn)
    return ((there * counts).mean() + back.mean()) / 2.0


def nearest(points: Tensor, others: Tensor) -> Tensor:
    """Return (B, m), how far points (B, m, 3) are from the nearest of others (B, n, 3)."""
    with torch.no_grad():
        at = torch.cdist(points, others).argmin(2, keepdim=True)
    return (points - others.gather(1, at.expand(-1, -1, 3))).norm(dim=2)


def sphere() -> tuple[Tensor, np.ndarray]:
    """Return (n, 2) for `directions_of`, and the triangles (F, 3) of a sphere's mesh."""
    steps = torch.linspace(0.0, 1.0, MESH)
    at = torch.cartesian_prod(steps, steps)
    i, j = np.meshgrid(np.arange(MESH - 1), np.arange(MESH - 1), indexing="ij")
    a = (i * MESH + j).ravel()
    b, c, d = a + MESH, a + MESH + 1, a + 1
    return at, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
