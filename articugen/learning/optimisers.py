"""Adam and SOAP: what becomes of a network's gradients.

SOAP knows that weights are matrices: a linear layer has one, (out, in), a grouped layer one
for each of its groups, (G, out, in). Small products cost calls rather than arithmetic, so matrices
of one shape are stacked and stepped together, whatever layers they are of. All other parameters
(biases, codes, great matrices) get Adam's step.

Nothing here waits for a GPU but SOAP's first step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

Betas = tuple[float, float]

BETAS: Betas = (0.9, 0.999)

GREATEST_SIDE = 64
"""A longer side gets no basis from SOAP."""

EPSILON = 1e-8

Named = dict[str, nn.Parameter]
"""Parameters by their names in the network."""


class Optimiser(Protocol):
    """Steps of one network."""

    def step(self, rate: float) -> None:
        """One step of the learning rate `rate` along the parameters' gradients; where a parameter
        has none it stays."""
        ...

    def state(self) -> dict[str, Any]:
        """All that `load` needs to go on exactly; its keys, shapes and types never change."""
        ...

    def load(self, state: dict[str, Any]) -> None:
        """Go on from another one's `state`."""
        ...


def optimiser_of(name: str, network: nn.Module, betas: Betas = BETAS) -> Optimiser:
    """Return the one that recipes call `name`, at its beginning; `betas` are Adam's."""
    named = dict(network.named_parameters())
    return Soap(named) if name == "soap" else Adam(named, betas)


class Adam:
    """Adam (Kingma and Ba 2015) as torch has it.

    Its function, not its class: that one sorts all parameters again at every step, and with it
    torch's compiler is imported, which takes a second.
    """

    def __init__(self, named: Named, betas: Betas = BETAS) -> None:
        self.named, self.betas = named, betas
        # One call for all parameters; the other devices have no such kernel.
        self.fused = {p.device.type for p in named.values()} <= {"cpu", "cuda"}
        self.kept: dict[str, _Moments] = {}

    def _moments(self, name: str) -> _Moments:
        """Made when they are first asked for, of the type that the parameter has by then."""
        if name not in self.kept:
            p = self.named[name]
            steps = torch.zeros((), device=p.device if self.fused else "cpu")
            self.kept[name] = _Moments(p.new_zeros(p.shape), p.new_zeros(p.shape), steps)
        return self.kept[name]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        there = [(p, p.grad, self._moments(n)) for n, p in self.named.items() if p.grad is not None]
        adam(
            [p for p, _, _ in there],
            [gradient for _, gradient, _ in there],
            [kept.mean for _, _, kept in there],
            [kept.square for _, _, kept in there],
            [],
            [kept.steps for _, _, kept in there],
            fused=self.fused or None,
            amsgrad=False,
            beta1=self.betas[0],
            beta2=self.betas[1],
            lr=rate,
            weight_decay=0.0,
            eps=EPSILON,
            maximize=False,
        )

    def state(self) -> dict[str, Any]:
        """By the names of the parameters."""
        kept = {name: self._moments(name) for name in self.named}
        return {
            "step": {name: moments.steps.cpu() for name, moments in kept.items()},
            "exp_avg": {name: moments.mean for name, moments in kept.items()},
            "exp_avg_sq": {name: moments.square for name, moments in kept.items()},
        }

    def load(self, state: dict[str, Any]) -> None:
        for name in self.named:
            kept = self._moments(name)
            kept.steps.copy_(state["step"][name])
            kept.mean.copy_(state["exp_avg"][name])
            kept.square.copy_(state["exp_avg_sq"][name])


class _Moments(NamedTuple):
    """What Adam keeps of one parameter: running means of its gradient and of the square, and how
    many steps it has made, ()."""

    mean: Tensor
    square: Tensor
    steps: Tensor


class Soap:
    """SOAP (Vyas et al. 2024, "SOAP: Improving and Stabilizing Shampoo using Adam", Algorithm 3).

    Adam's step in the eigenbases of the two Gram matrices of each weight, the running means of
    G G^T and G^T G of its gradients G. The bases are renewed by a step of power iteration and QR
    (Algorithm 4); the first ones are exact, and as in the authors' code the first gradient serves
    for them alone. A side of 1, or of more than `GREATEST_SIDE`, keeps its own axes. The mean of
    the gradients is kept in the bases and turned along when they change: the same as the paper's,
    which turns it at every step.
    """

    BETAS: Betas = (0.95, 0.95)
    RENEW_EVERY = 10

    def __init__(self, named: Named) -> None:
        self.flat, others = _sorted_out(named, lambda m, n: _has_basis(m) or _has_basis(n))
        self.rest = Adam(others, self.BETAS)
        self.steps = 0
        self.mean, self.square = self.flat.zeros(), self.flat.zeros()
        counts: dict[int, int] = {}
        for stack in self.flat.stacks:
            for n in filter(_has_basis, stack.shape[1:]):
                counts[n] = counts.get(n, 0) + stack.shape[0]
        self.sides = {n: _Side.new(count, n, self.mean) for n, count in counts.items()}
        taken = dict.fromkeys(counts, 0)

        def take(count: int, n: int) -> _Side | None:
            if not _has_basis(n):
                return None
            taken[n] += count
            return self.sides[n].of(slice(taken[n] - count, taken[n]))

        self.bases = [(take(k, m), take(k, n)) for k, m, n in (s.shape for s in self.flat.stacks)]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        self.rest.step(rate)
        gradient = self.flat.gradient()
        if self.steps:
            self._descend(gradient, rate)
        for G, (left, right) in zip(self.flat.split(gradient), self.bases, strict=True):
            if left:
                left.follow(G, self.BETAS[1])
            if right:
                right.follow(G.mT, self.BETAS[1])
        if self.steps == 0:
            for side in self.sides.values():
                side.find()
        elif self.steps % self.RENEW_EVERY == 0:
            mean = self._turned(self.mean, back=True)
            for side in self.sides.values():
                side.renew()
            self.mean = self._turned(mean)
        self.steps += 1

    def _descend(self, gradient: Tensor, rate: float) -> None:
        """Adam's step in the bases."""
        turned, (keep, keep_square) = self._turned(gradient), self.BETAS
        self.mean.lerp_(turned, 1.0 - keep)
        self.square.mul_(keep_square).addcmul_(turned, turned, value=1.0 - keep_square)
        root = math.sqrt(1.0 - keep_square**self.steps)
        direction = self.mean / self.square.sqrt().add_(EPSILON * root)
        factor = root / (1.0 - keep**self.steps)
        self.flat.descend(self._turned(direction, back=True), factor * rate)

    def _turned(self, flat: Tensor, back: bool = False) -> Tensor:
        """Q_L^T X Q_R of every matrix X, or `back`, Q_L X Q_R^T."""
        pieces = []
        for matrices, (left, right) in zip(self.flat.split(flat), self.bases, strict=True):
            x = matrices
            if left:
                x = torch.bmm(left.basis if back else left.basis.mT, x)
            if right:
                x = torch.bmm(x, right.basis.mT if back else right.basis)
            pieces.append(x)
        return self.flat.joined(pieces)

    def state(self) -> dict[str, Any]:
        """By the names of the parameters; `left` and `right` are the sides of out and of in."""
        grams: dict[str, Tensor] = {}
        bases: dict[str, Tensor] = {}
        for stack, sides in zip(self.flat.stacks, self.bases, strict=True):
            for which, side in zip(("left", "right"), sides, strict=True):
                if side:
                    names = [f"{name}.{which}" for name in stack.counts]
                    counts = list(stack.counts.values())
                    grams |= zip(names, side.gram.split(counts), strict=True)
                    bases |= zip(names, side.basis.split(counts), strict=True)
        return {
            "step": torch.tensor(self.steps),
            "mean": self.flat.named(self.mean),
            "square": self.flat.named(self.square),
            "gram": grams,
            "basis": bases,
            "rest": self.rest.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        self.steps = int(state["step"])
        _fill(self.state(), state, but=("rest",))
        self.rest.load(state["rest"])


def _has_basis(side: int) -> bool:
    return 1 < side <= GREATEST_SIDE


@dataclass(frozen=True)
class _Side:
    """Some sides of one length.

    Attributes:
        gram, basis: (count, n, n) Gram matrices and their eigenbases; an eigenvector is a column.
    """

    gram: Tensor
    basis: Tensor

    @staticmethod
    def new(count: int, n: int, like: Tensor) -> _Side:
        """Nothing is known yet."""
        basis = like.new_empty(count, n, n)
        return _Side(like.new_zeros(count, n, n), basis.copy_(torch.eye(n, device="cpu")))

    def of(self, some: slice) -> _Side:
        """Views of some."""
        return _Side(self.gram[some], self.basis[some])

    def follow(self, G: Tensor, keep: float) -> None:
        """Let the Gram matrices follow gradients (count, n, any)."""
        self.gram.baddbmm_(G, G.mT, beta=keep, alpha=1.0 - keep)

    def find(self) -> None:
        """The bases, the greatest eigenvalue first."""
        known = self.gram.nan_to_num(0.0, 0.0, 0.0)  # a GPU learns later of what is not finite
        self.basis.copy_(torch.linalg.eigh(known).eigenvectors.flip(-1))

    def renew(self) -> None:
        """Bring the bases nearer by one step."""
        self.basis.copy_(torch.linalg.qr(torch.bmm(self.gram, self.basis)).Q)


@dataclass(frozen=True)
class _Stack:
    """Matrices of one shape.

    Attributes:
        counts: how many are of each parameter.
        shape: (k, m, n) of all together.
    """

    counts: dict[str, int]
    shape: tuple[int, int, int]


class _Flat:
    """Weights of a network in one flat vector, stack by stack.

    Attributes:
        weights: in that order.
    """

    def __init__(self, named: Named, like: Tensor) -> None:
        by_shape: dict[tuple[int, int], Named] = {}
        for name, weight in named.items():
            m, n = weight.shape[-2:]
            by_shape.setdefault((m, n), {})[name] = weight
        self.stacks: list[_Stack] = []
        for (m, n), own in by_shape.items():
            counts = {name: weight.numel() // (m * n) for name, weight in own.items()}
            self.stacks.append(_Stack(counts, (sum(counts.values()), m, n)))
        self.weights = {n: w for own in by_shape.values() for n, w in own.items()}
        self._empty = like.new_empty(0)
        self._sizes = [weight.numel() for weight in self.weights.values()]

    def zeros(self) -> Tensor:
        """Return a number for each."""
        return self._empty.new_zeros(sum(self._sizes))

    def gradient(self) -> Tensor:
        """That of all weights, 0 for those that have none."""
        each = self.weights.values()
        return self.joined([torch.zeros_like(w) if w.grad is None else w.grad for w in each])

    def joined(self, pieces: list[Tensor]) -> Tensor:
        """Return a new flat vector."""
        return torch.cat([self._empty, *(piece.flatten() for piece in pieces)])

    def split(self, flat: Tensor) -> list[Tensor]:
        """Views (k, m, n) of the stacks in a flat vector."""
        shapes = [stack.shape for stack in self.stacks]
        pieces = flat.split([math.prod(shape) for shape in shapes])
        return [piece.view(shape) for piece, shape in zip(pieces, shapes, strict=True)]

    def named(self, flat: Tensor) -> dict[str, Tensor]:
        """Views of the weights' own in a flat vector."""
        pieces = zip(self.weights.items(), flat.split(self._sizes), strict=True)
        return {name: piece.view(weight.shape) for (name, weight), piece in pieces}

    def descend(self, direction: Tensor, rate: float) -> None:
        """Move the weights against a direction."""
        for weight, piece in zip(
            self.weights.values(), self.named(direction).values(), strict=True
        ):
            weight.add_(piece, alpha=-rate)


def _sorted_out(named: Named, wanted: Callable[[int, int], bool]) -> tuple[_Flat, Named]:
    """Return the weights whose sides are `wanted`, and all the rest."""

    def is_wanted(name: str, parameter: nn.Parameter) -> bool:
        is_weight = name.rpartition(".")[2] == "weight" and parameter.ndim > 1
        return is_weight and wanted(*parameter.shape[-2:])

    chosen = {name: p for name, p in named.items() if is_wanted(name, p)}
    rest = {name: p for name, p in named.items() if name not in chosen}
    return _Flat(chosen, next(iter(named.values()))), rest


def _fill(into: dict[str, Any], state: dict[str, Any], but: tuple[str, ...] = ()) -> None:
    """Give the tensors in nested dicts the values of another's."""
    for key, value in into.items():
        if isinstance(value, dict):
            if key not in but:
                _fill(value, state[key])
        else:
            value.copy_(state[key])
