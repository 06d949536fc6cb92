"""Many seeds that learn at once on one device: the same iteration, with every weight once a seed.

A GPU is idle while Python says what comes next; said for 64 seeds at a time it is said once. The
learners' weights are stacked along a new first axis, `torch.vmap` goes along it, and what it cannot
follow (the ways of a CPU, which ask for numbers) is not taken. Seeds do not touch each other: each
has batches, terms, gradients and steps of its own, those that it has alone but for rounding.

The adversary is left out: its penalty differentiates within the iteration, and it draws joint
states.
"""

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

from articugen.learning.data.batch import Batch
from articugen.learning.data.split import PackedSplit
from articugen.learning.method import Team, Terms
from articugen.learning.optimisers import Optimiser, optimiser_of
from articugen.learning.ppd import objective
from articugen.learning.ppd.cpu.batches import whole_batches
from articugen.learning.ppd.learner import PPDLearner
from articugen.learning.ppd.model import PPD
from articugen.learning.ppd.settings import PPDRecipe


def can_learn_at_once(recipe: PPDRecipe) -> bool:
    """Whether `Many` learns what a recipe says."""
    return not recipe.losses.adv_g


class Many(Team):
    """Several learners of one recipe that take their steps together.

    The weights and where the optimiser stands are here until `hand_out`.

    Args:
        learners: at the same iteration; one a seed.
    """

    def __init__(self, learners: Sequence[PPDLearner]) -> None:
        self.learners = learners
        self.settings, self.iteration = learners[0].settings, learners[0].iteration
        self.stack = _stacked([learner.model for learner in learners])
        self.objective = _Objective(learners[0])
        like = next(self.stack.parameters())
        self.unsound = torch.zeros(len(learners), dtype=torch.bool, device=like.device)
        self.optimiser = self._new_optimiser()
        own = [learner.descent.state() for learner in learners]
        self.optimiser.load(_joined(own, self.optimiser.state()))

    def _new_optimiser(self) -> Optimiser:
        return optimiser_of(self.settings.schedule.optimiser, self.stack)

    def begin(self, training: PackedSplit, beside: Path) -> None:
        """The first learner looks for all: what it finds does not hang on the seed."""
        self.learners[0].begin(training, beside)

    def learn(self, batch: Batch, *, iteration: int) -> Terms:
        plan = self.settings.schedule
        if plan.index_at(iteration) != plan.index_at(self.iteration):
            self.optimiser = self._new_optimiser()
        self.iteration = iteration
        self.learners[0].at(iteration)
        terms = self._terms(batch)
        noted = torch.stack([value.detach() for value in terms.values()])
        self.unsound |= ~noted.isfinite().all(0)
        self.stack.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        self.optimiser.step(plan.rate_at(iteration))
        return terms

    def _terms(self, batch: Batch) -> Terms:
        """What each seed minimises, (S,) each, of its share of the batch."""
        S = len(self.learners)

        def of_one(weights: Mapping[str, Tensor], *own: Tensor) -> Terms:
            return functional_call(self.objective, dict(weights), (batch.spread, *own))

        weights = {f"model.{name}": value for name, value in self._weights()}
        shares = [
            x.unflatten(0, (S, len(batch.rows) // S))
            for x in (
                batch.rows,
                batch.cloud,
                batch.part,
                batch.points,
                batch.occupied,
                batch.chance,
            )
        ]
        with whole_batches():
            return vmap(of_one)(weights, *shares)

    def diverged(self) -> list[bool]:
        found = self.unsound.clone()
        for _, value in self._weights():
            found |= ~value.detach().flatten(1).isfinite().all(1)
        return found.tolist()

    def _weights(self) -> Iterator[tuple[str, Tensor]]:
        """All weights by name, (S, ...)."""
        own = dict(self.learners[0].model.named_parameters())
        for name, value in self.stack.named_parameters():
            yield name, value.view(-1, *own[name].shape)

    def hand_out(self) -> None:
        adam, weights = self.optimiser.state(), self.stack.state_dict()
        for seed, learner in enumerate(self.learners):
            own = learner.state()
            mine = {"iteration": self.iteration, "model": _share(weights, own["model"], seed)}
            learner.load({**own, **mine, "adam": _share(adam, own["adam"], seed)})


class _Objective(nn.Module):
    """What one learner's model minimises, as a module whose weights can be given from outside."""

    def __init__(self, learner: PPDLearner) -> None:
        super().__init__()
        self.learner, self.model = learner, learner.model

    def forward(
        self,
        spread: int,
        rows: Tensor,
        cloud: Tensor,
        part: Tensor,
        points: Tensor,
        occupied: Tensor,
        chance: Tensor,
    ) -> Terms:
        learner, weigh = self.learner, self.learner.settings.losses
        given = Batch(rows, cloud, part, points, occupied, spread, chance)
        batch, aim = learner.prepared(given)
        predicted = self.model(batch.cloud, residual_direction=learner.residual_direction)
        return objective.generator_terms(self.model, predicted, batch, weigh, aim=aim)


def _stacked(models: Sequence[PPD]) -> PPD:
    """A model by name alone, every parameter of which is that of all `models`.

    Matrices get a first axis more, as groups are; vectors stand one after the other, since
    optimisers would take them for a matrix.
    """
    stack = copy.deepcopy(models[0])
    each = [dict(model.named_parameters()) for model in models]
    for name in each[0]:
        module, _, own = name.rpartition(".")
        join = torch.cat if each[0][name].dim() == 1 else torch.stack
        together = join([parameters[name].detach() for parameters in each])
        setattr(stack.get_submodule(module), own, nn.Parameter(together))
    return stack


def _joined(states: Sequence[Any], like: Any) -> Any:
    """Where the optimiser of the stack stands, from where each seed's does.

    A tensor of the stack's is that of all seeds, one after the other, or one that all share (the
    count of steps).
    """
    first = states[0]
    if isinstance(like, Mapping):
        return {name: _joined([s[name] for s in states], own) for name, own in like.items()}
    if not isinstance(first, Tensor) or like.shape == first.shape:
        return first
    return torch.stack(list(states)).view(like.shape)


def _share(whole: Any, like: Any, seed: int) -> Any:
    """What one seed has of such a state, or of the stack's weights."""
    if isinstance(whole, Mapping):
        return {name: _share(value, like[name], seed) for name, value in whole.items()}
    if not isinstance(whole, Tensor) or whole.shape == like.shape:
        return whole
    return whole.view(-1, *like.shape)[seed]
