"""Steps down the sum of some terms, none of them with a number that is not finite."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from articugen.core.errors import TrainingDiverged
from articugen.learning.method import Terms
from articugen.learning.optimisers import optimiser_of


class Descent:
    """The steps of one network.

    On a CPU a step that would spoil the weights is refused and the term to blame is named. To ask a
    GPU is to wait for it, so there it is noted on the device which terms were not finite first, and
    `check` asks where something is logged or kept anyway.

    Args:
        optimiser: as recipes call it.
        patient: note instead of asking; what a GPU gets if not given.
        rate: the recipe's key of the learning rate, which errors name.
    """

    def __init__(
        self,
        network: nn.Module,
        optimiser: str = "adam",
        patient: bool | None = None,
        rate: str = "schedule.learning_rate",
    ) -> None:
        self.network, self.rate = network, rate
        device = next(network.parameters()).device.type
        self.optimiser = optimiser_of(optimiser, network)
        self._parameters = list(network.parameters())  # found once: to walk a network takes long
        self.patient = device != "cpu" if patient is None else patient
        self._names: tuple[str, ...] = ()
        self._noted: Tensor | None = None

    def step(self, terms: Terms, again: Callable[[], Terms], iteration: int, rate: float) -> None:
        """One step of the learning rate `rate`.

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
            f"iteration {iteration + 1}: {what} is not a finite number; lower {self.rate} or that "
            "term's weight, and resume from the last checkpoint"
        )

    def state(self) -> dict[str, Tensor]:
        """Where the optimiser stands."""
        return self.optimiser.state()

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from another one's `state`."""
        self.optimiser.load(state)


def _blame(network: nn.Module, terms: Terms) -> str:
    """The terms that are not finite, or else those whose gradient is not."""
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
