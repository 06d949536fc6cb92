"""How OP-Align learns: from distances between a cloud and the shape that it is aligned with."""

import numpy as np
import torch
from torch import Tensor

from articugen.core.geometry import invert_rigid
from articugen.core.records import Floats, JointKind
from articugen.evaluation.reconstruction import PartJoints, Reconstruction, labelled_points
from articugen.learning.blocks import NetworkLearner
from articugen.learning.cpu.batches import gather_points
from articugen.learning.data.batch import Batch, BatchSpec
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.method import Terms
from articugen.learning.opalign.network import Joints, OPAlignNet, Posed, alignment, between
from articugen.learning.opalign.settings import OPAlignRecipe

HERE, BACK = 30.0, 120.0  # how fast distances saturate, from the cloud and to it
WHOLE = 0.5  # the first weight of the whole shape, against that of the parts


class OPAlignLearner(NetworkLearner):
    settings: OPAlignRecipe  # pyright: ignore[reportIncompatibleVariableOverride]
    network: OPAlignNet

    def __init__(self, settings: OPAlignRecipe, seed: int, device: torch.device) -> None:
        model, n = settings.model, settings.data.surface_points
        self.inputs = BatchSpec.of(settings.data, joints=(model.revolute, model.prismatic))
        super().__init__(settings, lambda: OPAlignNet(model, n), seed, device)
        self.turns = model.revolute > 0

    def loss(self, batch: Batch) -> Terms:
        whole = WHOLE * self.settings.schedule.share_at(self.iteration)
        return terms_of(*self.network(batch.cloud), whole=whole, turns=self.turns)

    @torch.no_grad()
    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """Return the loss of the parts alone, and of the whole shape."""
        clouds = unpacked(held_out.surface[held_out.evenly(), : self.inputs.surface_points])
        self.network.eval()
        posed = self.network(clouds)
        parts, whole = (terms_of(*posed, whole=w, turns=self.turns) for w in (0.0, 1.0))
        self.network.train()
        return {"parts": float(parts["parts"]), "whole": float(whole["whole"])}

    @torch.no_grad()
    def reconstruct(self, cloud: Floats, *, resolution: int) -> Reconstruction:
        """Return the points that the network sees with their parts, joints, and the inverse of
        each part's alignment. Of parts on a joint both move; part 0 has the first joint."""
        points = cloud[np.arange(self.inputs.surface_points) % len(cloud)]
        few = torch.as_tensor(points, dtype=torch.float32)[None].to(self.device)
        self.network.eval()
        there, canonical, _ = self.network(few)
        self.network.train()
        T = np.tile(np.eye(4), (there.label.shape[2], 1, 1))
        R, offset = (sides(x) for x in alignment(there.joints, canonical.joints, turns=self.turns))
        T[:, :3, :3], T[:, :3, 3] = (x[0].double().cpu().numpy() for x in (R, offset))
        of_part = [max(i - 1, 0) for i in range(len(T))]
        kind = JointKind.REVOLUTE if self.turns else JointKind.PRISMATIC
        pivot, direction, _ = (x[0].double().cpu().numpy() for x in there.joints)
        joints = PartJoints(
            np.full(len(T), int(kind)),
            sides(there.joints.state)[0].double().cpu().numpy(),
            pivot[of_part],
            direction[of_part],
        )
        part = there.label[0].argmax(1).cpu().numpy()
        return labelled_points(points, part, len(T), T_part=invert_rigid(T), joints=joints)


def sides(of_joints: Tensor) -> Tensor:
    """Return (B, P, ...) of (B, J, 2, ...): part 0 is the first joint's first side, the others are
    the second side of each joint."""
    return torch.cat([of_joints[:, :1, 0], of_joints[:, :, 1]], 1)


def terms_of(there: Posed, canonical: Posed, offset: Tensor, *, whole: float, turns: bool) -> Terms:
    """Return the terms to minimise.

    Args:
        there, canonical, offset: as `OPAlignNet` returns them.
        whole: the weight of the whole shape; the parts have the rest.
        turns: whether joints are revolute.
    """
    shape, joints = canonical.points, canonical.joints
    R, shift = alignment(there.joints, joints, turns=turns)
    moved = (R @ there.points.mT[:, None, None]).mT + shift[..., None, :]
    of_parts = sides(moved)
    if moved.shape[1] > 1:  # both joints move part 0
        of_parts = torch.cat([moved[:, :, 0].mean(1, keepdim=True), of_parts[:, 1:]], 1)
    here, back = zip(*(saturated(part, shape) for part in of_parts.unbind(1)), strict=True)
    by_label = (torch.stack(here, 2) * there.label).sum(2).mean()
    by_label = by_label + (torch.stack(back, 2) * canonical.label).sum(2).mean()
    terms = {
        "whole": 10.0 * whole * sum(x.mean() for x in saturated(there.points, shape)),
        "parts": 10.0 * (1.0 - whole) * by_label,
        "spread": 200.0 * spread(shape),
        "offset": 10.0 * (1.0 - (-60.0 * offset.square().sum(2)).exp()).mean(),
        "centre": shape.mean(1).square().sum(1).mean(),
        "joint": 10.0 * calm(joints),
        "pivot": 0.1 * (astray(joints.pivot, shape) + astray(there.joints.pivot, there.points)),
        "label": 10.0 * balance(there.label, canonical.label),
    }
    if moved.shape[1] > 1:
        apart = (moved[:, 0, 0] - moved[:, 1, 0]).square().sum(2).mean()
        first, second = between(there.joints.direction, joints.direction).unbind(1)
        terms["common"] = 10.0 * apart + (first - second).square().mean()
    return terms


def saturated(cloud: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    """Return 1 - exp(-k d^2) of the distances d from a cloud's points to the nearest of a shape
    (B, n), and of those back (B, m), which weigh less as they saturate sooner."""
    here, back = (nearest(*pair, 1)[..., 0].square() for pair in ((cloud, shape), (shape, cloud)))
    return 1.0 - (-HERE * here).exp(), HERE / BACK * (1.0 - (-BACK * back).exp())


def nearest(points: Tensor, others: Tensor, count: int) -> Tensor:
    """Return (B, n, count), how far the nearest of others (B, m, 3) are from points (B, n, 3)."""
    with torch.no_grad():
        at = torch.cdist(points, others).topk(count, largest=False).indices
    return (points[:, :, None] - gather_points(others, at)).norm(dim=3)


def spread(shape: Tensor) -> Tensor:
    """Return how unevenly points (B, n, 3) are spread: the variance over points of the distance to
    the i-th nearest other one, as a mean over the first 64 of these."""
    count = min(64, shape.shape[1] - 1)
    return nearest(shape, shape, count + 1)[..., 1:].var(1).mean()


def calm(joints: Joints) -> Tensor:
    """Return the mean square of states, and that of how directions differ within a batch."""
    differ = joints.direction - joints.direction.mean(0)
    return joints.state.square().mean() + differ.square().sum(2).mean()


def astray(pivot: Tensor, points: Tensor) -> Tensor:
    """Return how far pivots (B, J, 3) are from the nearest eight points (B, n, 3) of a shape."""
    far = nearest(pivot, points.detach(), min(8, points.shape[1])).mean(2)
    return (1.0 - (-HERE * far.square()).exp()).mean()


def balance(there: Tensor, canonical: Tensor) -> Tensor:
    """Return what labels (B, n, P) lack: a part's mean share of a tenth in the canonical shape, and
    a hundredth of probability anywhere."""
    least = sum((0.01 - label.amin(2)).relu().mean() for label in (there, canonical))
    return (0.1 - canonical.mean(1)).relu().mean() + least
