"""What a run carries from one iteration to the next: two networks, and where their Adams stand."""

from functools import partial

import torch

from articugen.learning.dataset import Batch
from articugen.learning.ppd import objective
from articugen.learning.ppd.descent import Descent
from articugen.learning.ppd.discriminator import Discriminator
from articugen.learning.ppd.model import PPD
from articugen.learning.ppd.objective import Terms
from articugen.learning.ppd.settings import TrainRecipe


class Learner:
    """The model and the discriminator, new or to be loaded into.

    Args:
        weights_seed: decides the weights, whatever the device.
    """

    def __init__(self, recipe: TrainRecipe, weights_seed: int, device: torch.device) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(weights_seed)
            self.model, self.critic = PPD(recipe.model), Discriminator()
        self.model.to(device)
        self.critic.to(device)
        self.weigh = recipe.losses
        self.begin_stage()

    def begin_stage(self) -> None:
        """New Adams, as the release has in each stage."""
        self.descent, self.critic_descent = Descent(self.model), Descent(self.critic)

    def learn(
        self,
        batch: Batch,
        rng: torch.Generator | None,
        *,
        iteration: int,
        rate: float,
        residual_direction: bool,
    ) -> Terms:
        """One step of the discriminator and one of the model; every term, weighted.

        Args:
            rng: of the batch's device, for joint states and mixtures.
            iteration: named in errors.
            rate: the learning rate.
            residual_direction: whether r^z counts.

        Raises:
            TrainingDiverged: a term or gradient is not finite.
        """
        predict = partial(self.model, batch.cloud, residual_direction=residual_direction)
        predicted = predict()
        posed, critic_terms = None, {}
        if self.weigh.adv_g:
            posed = objective.random_pose(self.model, predicted, batch, self.weigh, rng)
            judge = partial(objective.discriminator_terms, self.critic, batch, posed, self.weigh)
            critic_terms = judge()
            self.critic_descent.step(critic_terms, judge, iteration, rate)
        minimize = partial(
            objective.generator_terms,
            self.model,
            batch=batch,
            weigh=self.weigh,
            critic=self.critic,
            posed=posed,
        )
        terms = minimize(predicted)
        self.descent.step(terms, lambda: minimize(predict()), iteration, rate)
        return terms | critic_terms

    def check(self) -> None:
        """Raise TrainingDiverged for what a GPU has only noted so far."""
        self.critic_descent.check()
        self.descent.check()
