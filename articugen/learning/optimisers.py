"""Adam and SOAP: what becomes of a network's gradients.

SOAP knows that weights are matrices: a linear layer has one, (out, in), a grouped layer one
for each of its groups, (G, out, in). Small products cost calls rather than arithmetic, so matrices
of one shape are stacked and stepped together, whatever layers they are of. All other parameters
(biases, codes, great matrices) get Adam's step.

Nothing here waits for a GPU but SOAP's first step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

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


class Adam:
    """Adam (Kingma and Ba 2015) as torch has it.

    Its function, not its class: that one sorts all parameters again at every step, and with it
    torch's compiler is imported, which takes a second.
    """

    def __init__(self, named: Named, betas: Betas = BETAS) -> None:
        self.named, self.betas = named, betas
        # One call for all parameters; the other devices have no such kernel.
        self.fused = {p.device.type for p in named.values()} <= {"cpu", "cuda"}
        self.mean, self.square = ({n: p.new_zeros(p.shape) for n, p in named.items()} for _ in "12")
        self.steps = {
            n: torch.zeros((), device=p.device if self.fused else "cpu") for n, p in named.items()
        }

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Make a step of the learning rate `rate` along the parameters' gradients; where a
        parameter has none it stays."""
        there = {name: p.grad for name, p in self.named.items() if p.grad is not None}

        def of_them(kept: Mapping[str, Tensor]) -> list[Tensor]:
            return [kept[name] for name in there]

        adam(
            of_them(self.named),
            list(there.values()),
            of_them(self.mean),
            of_them(self.square),
            [],
            of_them(self.steps),
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
        """Return all that `load` needs to go on exactly, by the names of the parameters."""
        return {"step": self.steps, "exp_avg": self.mean, "exp_avg_sq": self.square}

    def load(self, state: dict[str, Any]) -> None:
        _fill(self.state(), state)


class Soap:
    """SOAP (Vyas et al. 2024, "SOAP: Improving and Stabilizing Shampoo using Adam", Algorithm 3).

    Adam's step in the eigenbases of the two Gram matrices of each weight, the running means of
    G G^T and G^T G of its gradients G. The bases are renewed by a step of power iteration and QR
    (Algorithm 4); the first ones are exact, and as in the authors' code the first gradient serves
    for them alone. A side of 1, or of more than `GREATEST_SIDE`, keeps its own axes. The mean of
    the gradients is kept in the bases and turned along when they change: the same as the paper's,
    which turns it at every step.

    Attributes:
        stacks: weights whose matrices are of one shape, by name.
        shapes: (k, m, n) of each stack's matrices, all together.
        mean, square: what Adam keeps of them, in one vector, stack by stack.
        sides: the left and the right side of each stack, None where one has no basis.
    """

    BETAS: Betas = (0.95, 0.95)
    RENEW_EVERY = 10

    def __init__(self, named: Named) -> None:
        by_shape: dict[tuple[int, int], Named] = {}
        for name, p in named.items():
            is_weight = name.rpartition(".")[2] == "weight" and p.ndim > 1
            if is_weight and any(map(_has_basis, p.shape[-2:])):
                by_shape.setdefault((p.shape[-2], p.shape[-1]), {})[name] = p
        self.stacks = list(by_shape.values())
        self.weights = {name: p for stack in self.stacks for name, p in stack.items()}
        self.rest = Adam({n: p for n, p in named.items() if n not in self.weights}, self.BETAS)
        self.shapes = [
            (sum(p.numel() for p in stack.values()) // (m * n), m, n)
            for (m, n), stack in by_shape.items()
        ]
        self.steps = torch.tensor(0, device="cpu")
        self.empty = next(iter(named.values())).new_empty(0)
        size = sum(p.numel() for p in self.weights.values())
        self.mean, self.square = self.empty.new_zeros(size), self.empty.new_zeros(size)
        self.sides = [
            [_Side.new(k, n, self.mean) if _has_basis(n) else None for n in sides]
            for k, *sides in self.shapes
        ]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        self.rest.step(rate)
        steps = int(self.steps)
        gradient = self._joined(
            torch.zeros_like(w) if w.grad is None else w.grad for w in self.weights.values()
        )
        if steps:
            self._descend(gradient, rate, steps)
        for G, (left, right) in zip(self._split(gradient), self.sides, strict=True):
            if left:
                left.follow(G, self.BETAS[1])
            if right:
                right.follow(G.mT, self.BETAS[1])
        if steps % self.RENEW_EVERY == 0:
            mean = self._turned(self.mean, back=True)
            for side in (side for both in self.sides for side in both if side):
                side.renew() if steps else side.find()
            self.mean = self._turned(mean)
        self.steps += 1

    def _descend(self, gradient: Tensor, rate: float, steps: int) -> None:
        """Adam's step in the bases."""
        turned, (keep, keep_square) = self._turned(gradient), self.BETAS
        self.mean.lerp_(turned, 1.0 - keep)
        self.square.mul_(keep_square).addcmul_(turned, turned, value=1.0 - keep_square)
        root = math.sqrt(1.0 - keep_square**steps)
        direction = self.mean / self.square.sqrt().add_(EPSILON * root)
        factor = root / (1.0 - keep**steps)
        weights = self.weights.values()
        pieces = self._turned(direction, back=True).split([w.numel() for w in weights])
        for weight, piece in zip(weights, pieces, strict=True):
            weight.add_(piece.view(weight.shape), alpha=-(factor * rate))

    def _joined(self, pieces: Iterable[Tensor]) -> Tensor:
        """Return a new flat vector."""
        return torch.cat([self.empty, *(piece.flatten() for piece in pieces)])

    def _split(self, flat: Tensor) -> list[Tensor]:
        """Views (k, m, n) of the stacks in a flat vector."""
        pieces = flat.split([math.prod(shape) for shape in self.shapes])
        return [piece.view(shape) for piece, shape in zip(pieces, self.shapes, strict=True)]

    def _turned(self, flat: Tensor, back: bool = False) -> Tensor:
        """Q_L^T X Q_R of every matrix X, or `back`, Q_L X Q_R^T."""
        pieces = []
        for matrices, (left, right) in zip(self._split(flat), self.sides, strict=True):
            x = matrices
            if left:
                x = torch.bmm(left.basis if back else left.basis.mT, x)
            if right:
                x = torch.bmm(x, right.basis.mT if back else right.basis)
            pieces.append(x)
        return self._joined(pieces)

    def state(self) -> dict[str, Any]:
        """Return its state as it lies in memory, sides by the number of their stack; Adam's by
        names."""
        sides = {
            f"{i}.{which}": side
            for i, both in enumerate(self.sides)
            for which, side in zip(("left", "right"), both, strict=True)
            if side
        }
        return {
            "step": self.steps,
            "mean": self.mean,
            "square": self.square,
            "gram": {name: side.gram for name, side in sides.items()},
            "basis": {name: side.basis for name, side in sides.items()},
            "rest": self.rest.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        _fill(self.state(), state)


def optimiser_of(name: str, network: nn.Module, betas: Betas = BETAS) -> Adam | Soap:
    """Return the one that recipes call `name`, at its beginning; `betas` are Adam's."""
    named = dict(network.named_parameters())
    return Soap(named) if name == "soap" else Adam(named, betas)


def _has_basis(side: int) -> bool:
    return 1 < side <= GREATEST_SIDE


@dataclass(frozen=True)
class _Side:
    """The sides of one stack, of one length.

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

    def follow(self, G: Tensor, keep: float) -> None:
        """Let the Gram matrices follow gradients (count, n, any)."""
        self.gram.baddbmm_(G, G.mT, beta=keep, alpha=1.0 - keep)

    def find(self) -> None:
        """Compute the bases, the greatest eigenvalue first."""
        known = self.gram.nan_to_num(0.0, 0.0, 0.0)  # a GPU learns later of what is not finite
        self.basis.copy_(torch.linalg.eigh(known).eigenvectors.flip(-1))

    def renew(self) -> None:
        """Bring the bases nearer by one step."""
        self.basis.copy_(torch.linalg.qr(torch.bmm(self.gram, self.basis)).Q)


def _fill(into: dict[str, Any], state: dict[str, Any]) -> None:
    """Give the tensors in nested dicts the values of another's."""
    for key, value in into.items():
        if isinstance(value, dict):
            _fill(value, state[key])
        else:
            value.copy_(state[key])
