"""How BSP-Net learns: a loss for each kind of stage, and other first weights where it is stuck."""

from typing import Any

import torch
from torch import Tensor

from articugen.core.records import Floats
from articugen.evaluation.reconstruction import Reconstruction
from articugen.learning.bsp.network import NEAR, USED, BSPNet, filled, outside
from articugen.learning.bsp.polytopes import cut, reconstruction_of_polytopes
from articugen.learning.bsp.settings import BSPRecipe
from articugen.learning.data.batch import Batch
from articugen.learning.fields import FieldLearner
from articugen.learning.method import Terms
from articugen.learning.tensors import made

BETAS = 0.5, 0.999  # of Adam
INSIDE = 4.0  # the indicator value inside, at first, where a recipe says `fourfold`
LOOK_EVERY = 100  # iterations: a GPU is waited for where it is asked whether learning is stuck


class BSPLearner(FieldLearner):
    """Learner of planes, T and W.

    Attributes:
        stuck: for how many iterations no point was between inside and outside.
        restarts: how often first weights were drawn again.
    """

    settings: BSPRecipe  # pyright: ignore[reportIncompatibleVariableOverride]
    network: BSPNet

    def __init__(self, settings: BSPRecipe, seed: int, device: torch.device) -> None:
        super().__init__(settings, lambda: BSPNet(settings.model), seed, device, betas=BETAS)
        self.seed, self.restarts = seed, 0
        self.stuck = torch.zeros((), dtype=torch.int64, device=device)

    def loss(self, batch: Batch) -> Terms:
        net, plan = self.network, self.settings.schedule
        loss = plan.stages[plan.index_at(self.iteration)].loss
        true = batch.occupied.to(net.T.dtype)
        if loss == "continuous":
            output = filled(outside(net.all_planes(batch.cloud), net.T, batch.points), net.W)
            between = ((output > 0.0) & (output < 1.0)).any()
            self.stuck = torch.where(between, 0, self.stuck + 1)
            inside = INSIDE if self.iteration < self.settings.fourfold else 1.0
            return {"rec": (inside * true - output).square().mean(), **weights_loss(net.T, net.W)}
        if loss.startswith("hard"):
            out = outside(net.encode(batch.cloud), net.bounds(), batch.points)
            terms = {"rec": union_loss(out, true)}
        else:
            out = outside(net.all_planes(batch.cloud), net.T, batch.points)
            terms = {"rec": union_loss(out, true), "t": binary_loss(net.T)}
        if loss.endswith("overlap"):
            terms["overlap"] = overlap_loss(out, true)
        return terms

    def learn(self, batch: Batch, rng: torch.Generator | None, *, iteration: int) -> Terms:
        stage = self.settings.schedule.stages[self.settings.schedule.index_at(iteration)]
        looks = stage.loss == "continuous" and iteration % LOOK_EVERY == 0
        if looks and int(self.stuck) >= self.settings.restart_after:
            self._restart()
        return super().learn(batch, rng, iteration=iteration)

    def _restart(self) -> None:
        """Draw first weights again, others each time, and restart the optimiser."""
        self.restarts += 1
        self.stuck = torch.zeros_like(self.stuck)
        with made((self.seed + self.restarts) % 2**63, self.device):
            fresh = BSPNet(self.settings.model)
        self.network.load_state_dict(fresh.state_dict())
        self._begin_stage()

    def state(self) -> dict[str, Any]:
        return super().state() | {"stuck": self.stuck, "restarts": self.restarts}

    def load(self, state: dict[str, Any]) -> None:
        super().load(state)
        self.stuck.copy_(state["stuck"])
        self.restarts = state["restarts"]

    @torch.no_grad()
    def reconstruct(self, cloud: Floats, *, resolution: int) -> Reconstruction:
        """Return each convex as the polytope that its planes leave of the unit frame's cube."""
        planes = self.code_of(cloud)[0].T.double().cpu().numpy()
        bounds = self.network.bounds().T.bool().cpu().numpy()
        return reconstruction_of_polytopes([cut(planes[some]) for some in bounds], resolution)


def weights_loss(T: Tensor, W: Tensor) -> Terms:
    """Return what leads W to 1, and T into [0, 1]: sums, not means."""
    return {"w": (W - 1.0).abs().sum(), "t": ((T - 1.0).relu() + (-T).relu()).sum()}


def binary_loss(T: Tensor) -> Tensor:
    """Return what leads each entry of T to the nearer side of `USED`, 0 or 1."""
    return torch.where(T < USED, T.abs(), (T - 1.0).abs()).sum()


def union_loss(out: Tensor, true: Tensor) -> Tensor:
    """Return the mean error of the union of convexes, from `outside` (B, n, c) and 0 or 1 (B, n):
    an occupied point should be in some convex, any other at least 1 beyond all."""
    least = out.amin(2)
    return ((1.0 - true) * (1.0 - least.clamp(max=1.0)) + true * least.clamp(min=0.0)).mean()


def overlap_loss(out: Tensor, true: Tensor) -> Tensor:
    """Return a mean that is less where occupied points are in fewer convexes at a time.

    As in the authors' program, which they say is right where the paper's formula is not.
    """
    within = out < NEAR
    shared = within & (within.sum(2, keepdim=True) > 1)
    return -(out * shared * true[..., None]).mean()
