"""What networks of several methods are made of, and the step that all of them make.

A PointNet, two encoders of the grid that a cloud fills, and steps down the sum of some terms, none
of them with a number that is not finite.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from articugen.core.errors import TrainingDiverged
from articugen.learning.cpu.batches import (
    argmax_of_points,
    distinct,
    gather_points,
    one_by_one,
    spares,
    takes_kernels,
)
from articugen.learning.cpu.kernels import patches
from articugen.learning.data.batch import Batch
from articugen.learning.method import Learner, Terms
from articugen.learning.optimisers import BETAS, Betas, optimiser_of
from articugen.learning.recipe import TrainRecipe
from articugen.learning.tensors import made

_GRID = 64
"""Cells along an edge of the grid that clouds fill."""

_FEW = 512
"""Points of a cloud, about, that are enough for a PointNet beside a grid."""

_USUAL = 2048
"""Points of a cloud whose cells are as full as counted; others are counted in proportion."""


class PointNet(nn.Module):
    """The simple PointNet of Occupancy Networks (Mescheder et al. 2019).

    A maximum passes its gradient to one element only. What is pooled away is evaluated without a
    graph, and what is left is evaluated again with one: value and gradient are exactly those of the
    plain network, for a tenth of the work and memory.

    Args:
        code: the length of the latent.
        start: `release` leaves weights as torch draws them, `he` draws them as He et al. (2015) do.
        blocks: how many pooled blocks, two to four.
    """

    def __init__(
        self, code: int, start: Literal["release", "he"] = "release", blocks: int = 3
    ) -> None:
        super().__init__()
        self.position = nn.Linear(3, 256)
        self.blocks = ("first", "second", "third", "fourth")[:blocks]
        for name in self.blocks:
            self.add_module(name, nn.Linear(256, 128))
        self.latent = nn.Linear(128, code)
        if start == "he":
            for layer in self.children():
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")  # pyright: ignore[reportArgumentType]

    def forward(self, cloud: Tensor) -> Tensor:
        """Return the latent (B, code) of clouds (B, n, 3), whatever the order of their points."""
        most = 128 if spares(cloud) else len(self.blocks) * 128  # of what `_decisive` keeps
        if torch.is_grad_enabled() and cloud.shape[1] > most:
            cloud = gather_points(cloud, self._decisive(cloud))
        return self.latent(self._each(cloud)[-1].amax(1).relu())

    @torch.no_grad()
    def _decisive(self, cloud: Tensor) -> Tensor:
        """Return (B, 128 a block) the indices of the points that hold a maximum in any of them; on
        a CPU less, since many hold several."""
        index = one_by_one(
            lambda c: torch.cat([argmax_of_points(features) for features in self._each(c)], 1),
            cloud,
        )
        return distinct(index) if spares(index) else index

    def _each(self, cloud: Tensor) -> list[Tensor]:
        """Return the features of each point by each block: (B, n, 128).

        From the second block on, half of a point's input is the pooled vector, the same for every
        point: its share of the layer is computed once a cloud.
        """
        first, *others = (self.get_submodule(name) for name in self.blocks)
        blocks = [first(self.position(cloud).relu_())]
        for block in others:
            assert isinstance(block, nn.Linear)
            alone, shared = block.weight.split(128, dim=1)
            common = nn.functional.linear(blocks[-1].amax(1).relu(), shared, block.bias)
            blocks.append(blocks[-1].relu() @ alone.T + common[:, None])
        return blocks


class GridEncoder(nn.Module):
    """Encoder of where a cloud has points and where not, cell by cell: patches of a grid, merged
    three times.

    A PointNet knows of each of its channels the greatest value alone; where one drawer ends and the
    next begins is known by which cells lie beside each other. All layers are linear in patches that
    do not overlap (as in Vision Transformers, Dosovitskiy et al. 2021), since products of matrices
    are what both CPUs and the optimisers here are best at.
    """

    def __init__(self, code: int) -> None:
        super().__init__()
        self.patch = nn.Linear(4**3, 32)
        self.first, self.second = nn.Linear(2**3 * 32, 64), nn.Linear(2**3 * 64, 64)
        self.whole = nn.Linear(4**3 * 64, 256)
        self.latent = nn.Linear(256, code)
        for layer in (self.patch, self.first, self.second, self.whole, self.latent):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)

    def forward(self, cloud: Tensor) -> Tensor:
        """Return the latent (B, code) of clouds (B, n, 3), whatever the order of their points."""
        x = self._few(cloud) if takes_kernels(cloud) else self._all(cloud)
        return self.latent(self.whole(x).relu())

    def _all(self, cloud: Tensor) -> Tensor:
        """Return the features of all patches before the last two layers: (B, 64 64)."""
        x = 2.0 * filled(cloud, _GRID).log1p()[..., None]
        for layer, cells, along in ((self.patch, 64, 4), (self.first, 16, 2), (self.second, 8, 2)):
            x = leaky_relu(layer(_merged(x, cells, along)), 0.1)
        return x.flatten(1)

    def _few(self, cloud: Tensor) -> Tensor:
        """Return the same from the patches that hold something; those that hold nothing are the
        same everywhere."""
        place, features = map(torch.from_numpy, patches(cloud.detach().contiguous().numpy(), 64, 4))
        few = _Few(
            place, 2.0 * (features * (_USUAL / cloud.shape[1])).log1p(), features.new_zeros(4**3)
        )
        few = few.joined(self.patch).merged(16).joined(self.first).merged(8).joined(self.second)
        return few.all(len(cloud) * 4**3).view(len(cloud), -1)


class _Few(NamedTuple):
    """Some of the cells of B grids, by their flat place (M,), with what they hold (M, C), and what
    all others hold (C,)."""

    place: Tensor
    features: Tensor
    others: Tensor

    def joined(self, layer: nn.Module) -> "_Few":
        """After a layer of `GridEncoder`."""
        features, others = (leaky_relu(layer(x), 0.1) for x in (self.features, self.others))
        return _Few(self.place, features, others)

    def merged(self, cells: int) -> "_Few":
        """Merge blocks of two of `cells` along each edge, as `_merged` does; a block is here if one
        of its cells is."""
        x, y, z = self.place // cells**2, self.place // cells % cells, self.place % cells
        block = (x // 2 * (cells // 2) + y // 2) * (cells // 2) + z // 2
        place, at = block.unique(return_inverse=True)
        inside = (x % 2 * 2 + y % 2) * 2 + z % 2
        features = self.others.expand(8 * len(place), -1).index_copy(
            0, 8 * at + inside, self.features
        )
        return _Few(place, features.view(len(place), -1), self.others.repeat(8))

    def all(self, count: int) -> Tensor:
        """Return the contents of each of `count` cells, (count, C)."""
        return self.others.expand(count, -1).index_copy(0, self.place, self.features)


class BothEncoders(nn.Module):
    """The sum of both latents, at first the PointNet's alone."""

    def __init__(self, points: PointNet, grid: GridEncoder) -> None:
        super().__init__()
        self.points, self.grid = points, grid
        nn.init.zeros_(grid.latent.weight)

    def forward(self, cloud: Tensor) -> Tensor:
        """Return the latent (B, code) of clouds (B, n, 3)."""
        return self.points(cloud[:, :: max(cloud.shape[1] // _FEW, 1)]) + self.grid(cloud)


class VoxelEncoder(nn.Module):
    """The encoder of BAE-Net and BSP-Net: the voxels that a cloud fills, halved until 4 are left.

    Each convolution but the last has kernels of 4, stride 2 and twice as many channels as the one
    before, from 32 on; the last takes all 4^3 voxels that are left to a code in (0, 1).

    Args:
        voxels: along an edge, 8 or a larger power of two.
        code: the length of the latent.
        slope: of the leaky ReLUs.
        normalised: whether each channel of each shape is normalised, without learned factors.
    """

    def __init__(self, voxels: int, code: int, *, slope: float, normalised: bool) -> None:
        super().__init__()
        self.voxels = voxels
        channels = [1, *(32 << i for i in range(voxels.bit_length() - 3))]
        layers: list[nn.Module] = []
        for before, after in pairwise(channels):
            layers.append(nn.Conv3d(before, after, 4, stride=2, padding=1))
            layers += [nn.InstanceNorm3d(after, eps=1e-6)] * normalised
            layers.append(nn.LeakyReLU(slope))
        self.layers = nn.Sequential(*layers, nn.Conv3d(channels[-1], code, 4), nn.Sigmoid())
        for layer in self.layers:
            if isinstance(layer, nn.Conv3d):
                nn.init.xavier_uniform_(layer.weight)
                torch.nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]

    def forward(self, cloud: Tensor) -> Tensor:
        """Return the code (B, code) of clouds (B, n, 3), whatever the order of their points."""
        return self.layers(occupied_voxels(cloud, self.voxels)[:, None]).flatten(1)


@torch.no_grad()
def occupied_voxels(cloud: Tensor, voxels: int) -> Tensor:
    """Return (B, R, R, R): 1 where a cell of the unit frame holds a point of clouds (B, n, 3)."""
    x, y, z = ((cloud + 0.5) * voxels).long().clamp(0, voxels - 1).unbind(2)
    grid = cloud.new_zeros(len(cloud), voxels**3)
    return grid.scatter(1, (x * voxels + y) * voxels + z, 1.0).view(-1, *3 * [voxels])


@torch.no_grad()
def filled(cloud: Tensor, cells: int) -> Tensor:
    """Return (B, cells^3) how many of 2,048 points each cell of the unit frame holds; a point
    counts to the eight cells whose centres surround it, by how near they are. Clouds (B, n, 3)."""
    at = ((cloud + 0.5) * cells - 0.5).clamp(0.0, cells - 1.001)
    low = at.floor()
    share = torch.stack([1.0 - (at - low), at - low])
    low = low.long()
    count = cloud.new_zeros(len(cloud), cells**3)
    for i, j, k in torch.cartesian_prod(*3 * [torch.arange(2)]).tolist():
        cell = ((low[..., 0] + i) * cells + low[..., 1] + j) * cells + low[..., 2] + k
        count = count.scatter_add(1, cell, share[i, ..., 0] * share[j, ..., 1] * share[k, ..., 2])
    return count * (_USUAL / cloud.shape[1])


def _merged(x: Tensor, cells: int, along: int) -> Tensor:
    """Return the contents of cells (B, cells^3, C), joined for blocks of `along` cells an edge."""
    blocks = cells // along
    x = x.unflatten(1, 3 * (blocks, along))
    return x.permute(0, 1, 3, 5, 2, 4, 6, 7).flatten(4).flatten(1, 3)


class Descent:
    """The steps of one network.

    On a CPU a step that would spoil the weights is refused and the term to blame is named. To ask a
    GPU is to wait for it, so there it is noted on the device which terms were not finite first, and
    `check` asks where something is logged or kept anyway.

    Args:
        optimiser: as recipes call it.
        betas: of Adam.

    Attributes:
        patient: note instead of asking, as on a GPU.
    """

    def __init__(self, network: nn.Module, optimiser: str = "adam", betas: Betas = BETAS) -> None:
        self.network = network
        self.optimiser = optimiser_of(optimiser, network, betas)
        self._parameters = list(network.parameters())  # found once: to walk a network takes long
        self.patient = self._parameters[0].device.type != "cpu"
        self._names: tuple[str, ...] = ()
        self._noted: Tensor | None = None

    def step(self, terms: Terms, again: Callable[[], Terms], iteration: int, rate: float) -> None:
        """Make one step of the learning rate `rate`.

        Args:
            again: evaluates the same terms once more, to find the one to blame.

        Raises:
            TrainingDiverged: a term or its gradient is not finite; no step is made.
        """
        for parameter in self._parameters:
            parameter.grad = None
        torch.stack(list(terms.values())).sum().backward()
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        size = torch.nn.utils.get_total_norm(gradients)
        values = torch.stack([*(value.detach() for value in terms.values()), size])
        if self.patient:
            self._note(iteration, tuple(terms), values)
        elif not bool(values.isfinite().all()):
            raise self._diverged(iteration, _blame(self.network, again()))
        self.optimiser.step(rate)

    def lower(self, evaluate: Callable[[], Terms], iteration: int, rate: float) -> Terms:
        """Make the step that lowers the terms which `evaluate` gives, and return these."""
        terms = evaluate()
        self.step(terms, evaluate, iteration, rate)
        return terms

    def check(self) -> None:
        """Raise TrainingDiverged where a step since the last check was not finite."""
        if self._noted is None:
            return
        iteration, *bad = self._noted.tolist()
        self._noted = None
        if any(bad):
            named = [name for name, is_bad in zip(self._names, bad, strict=False) if is_bad]
            what = f"the loss {' and '.join(named)}" if named else "the gradient of some term"
            raise self._diverged(int(iteration), what)

    def _note(self, iteration: int, names: tuple[str, ...], values: Tensor) -> None:
        """Keep (iteration, which values are not finite) of the first that has any."""
        if names != self._names:  # a warm start's terms end; where they do a GPU is waited for
            self.check()
        now = torch.cat([values.new_full((1,), iteration), (~values.isfinite()).to(values.dtype)])
        before = self._noted
        self._names = names
        self._noted = now if before is None else torch.where(before[1:].any(), before, now)

    def _diverged(self, iteration: int, what: str) -> TrainingDiverged:
        return TrainingDiverged(
            f"iteration {iteration + 1}: {what} is not a finite number; lower "
            "schedule.learning_rate or that term's weight in a new run"
        )


class Beside:
    """Learning of a network that a model does not learn from.

    Args:
        name: of its weights in a checkpoint.
        optimiser: as recipes call it.
    """

    def __init__(self, name: str, network: nn.Module, optimiser: str = "adam") -> None:
        self.name, self.optimiser = name, optimiser
        self.network: Any = network

    def begin_stage(self) -> None:
        """Make a new optimiser."""
        self.descent = Descent(self.network, self.optimiser)

    def state(self) -> dict[str, Any]:
        adam = self.descent.optimiser.state()
        return {self.name: self.network.state_dict(), f"{self.name}_adam": adam}

    def load(self, state: dict[str, Any]) -> None:
        self.network.load_state_dict(state[self.name])
        self.descent.optimiser.load(state[f"{self.name}_adam"])


def _blame(network: nn.Module, terms: Terms) -> str:
    """Return the terms that are not finite, or else those whose gradient is not."""
    values = [value.detach() for value in terms.values()]
    bad = [name for name, value in zip(terms, values, strict=True) if not bool(value.isfinite())]
    if bad:
        return f"the loss {' and '.join(bad)}"
    parameters = list(network.parameters())
    for name, value in terms.items():
        if value.requires_grad:
            gradients = torch.autograd.grad(value, parameters, retain_graph=True, allow_unused=True)
            if not all(bool(g.isfinite().all()) for g in gradients if g is not None):
                bad.append(name)
    return f"the gradient of {' and '.join(bad or terms)}"


class NetworkLearner(Learner):
    """Learner of one network: a method adds settings, a network, a loss and how it is judged.

    Args:
        network: makes it; `seed` decides its weights, whatever the device.
        betas: of Adam, where the recipe asks for that.
    """

    def __init__(
        self,
        settings: TrainRecipe,
        network: Callable[[], nn.Module],
        seed: int,
        device: torch.device,
        *,
        betas: Betas = BETAS,
    ) -> None:
        self.settings = settings
        with made(seed, device):
            self.network: Any = network()
        self.network.to(device)
        self.device, self.betas, self.iteration = device, betas, 0
        self._begin_stage()

    def loss(self, batch: Batch) -> Terms:
        """Return the terms to minimise for a batch, at `self.iteration`."""
        raise NotImplementedError

    def _begin_stage(self) -> None:
        """Make a new optimiser, as at the start of each stage."""
        optimiser = self.settings.schedule.optimiser
        self.descent = Descent(self.network, optimiser, betas=self.betas)

    def learn(self, batch: Batch, rng: torch.Generator | None, *, iteration: int) -> Terms:
        plan = self.settings.schedule
        if plan.index_at(iteration) != plan.index_at(self.iteration):
            self._begin_stage()
        self.iteration = iteration
        return self.descent.lower(lambda: self.loss(batch), iteration, plan.rate_at(iteration))

    def check(self) -> None:
        self.descent.check()

    def state(self) -> dict[str, Any]:
        return {
            "iteration": self.iteration,
            "network": self.network.state_dict(),
            "optimiser": self.descent.optimiser.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        self.iteration = state["iteration"]
        self.network.load_state_dict(state["network"])
        self.descent.optimiser.load(state["optimiser"])
