"""How PPD learns: the model and the discriminator, each with where its optimiser stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from articugen.core.records import Floats
from articugen.core.tables import counted
from articugen.evaluation.reconstruction import Reconstruction
from articugen.learning.blocks import Beside, Descent
from articugen.learning.data.batch import Batch, BatchSpec
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.fields import VALIDATION_GRID, Meshes, held_out_fit
from articugen.learning.method import Learner, Terms
from articugen.learning.ppd import objective
from articugen.learning.ppd.discriminator import Discriminator
from articugen.learning.ppd.local import LocalLearning, Outline
from articugen.learning.ppd.network import PPD, Prediction
from articugen.learning.ppd.reconstruct import reconstruction_of
from articugen.learning.ppd.settings import PPDRecipe, directions_of
from articugen.learning.ppd.states import StateLearning
from articugen.learning.ppd.warm import terms as warm_start
from articugen.learning.ppd.warm.found import discovered
from articugen.learning.ppd.warm.targets import Targets, is_one_sided, likely, targets
from articugen.learning.ppd.warm.variation import CHANCES, Variation
from articugen.learning.tensors import made

MOVED_POSES, MOVED_POINTS = 6, 2048

LABELLED = 512
"""Points of a cloud, about, at which it is asked whose field is the greatest."""


class Predictor(Learner):
    """Learner that predicts as a PPD model does.

    Attributes:
        points: how many points of a cloud are examined; None means all.
        residual_direction: whether r^z counts.
        local: what says where matter is, if the recipe has it; None leaves that to the parts.
        reading: what corrects the states, likewise.
    """

    model: PPD
    points: int | None
    residual_direction: bool
    local: LocalLearning | None = None
    reading: StateLearning | None = None

    @property
    def parameters(self) -> int:
        """Number of values that describe shapes, as the paper counts; those of poses are left
        out."""
        of_shapes = [self.model.encoder, self.model.shape]
        of_shapes += [self.local.field] if self.local else []
        return sum(p.numel() for module in of_shapes for p in module.parameters())

    def predict(self, cloud: Floats) -> Prediction:
        """Predict from one cloud (n, 3), as a batch of one."""
        with torch.no_grad():
            clouds = self._examined(cloud)[None]
            return self.model(clouds, residual_direction=self.residual_direction)

    def reconstruct(
        self, cloud: Floats, *, resolution: int, meshes: Meshes | None = None
    ) -> Reconstruction:
        """Part i's surface encloses where its field is above 0 and the greatest of all, unless
        `meshes` says otherwise; what is inside of any a local field decides, if there is one."""
        whole = Outline(self.local.field, self._examined(cloud)).on_grid if self.local else None
        predicted, states = self.predict(cloud), None
        if self.reading:
            few = self._examined(cloud)[None]
            states = self.reading.reader.settled(self.model, predicted, few)
        return reconstruction_of(
            self.model, predicted, resolution, meshes, whole=whole, states=states
        )

    def _examined(self, cloud: Floats) -> Tensor:
        """Return what is examined of a cloud (n, 3)."""
        device = next(self.model.parameters()).device
        return torch.as_tensor(cloud[: self.points], dtype=torch.float32, device=device)

    def between(
        self, one: Floats, other: Floats, steps: int, *, resolution: int
    ) -> tuple[list[Reconstruction], list[Reconstruction]]:
        """Return, from one cloud (n, 3) to another in `steps` steps, shapes in the pose of the one,
        and states of its own shape (the paper's figure of interpolations)."""
        first, last = self.predict(one), self.predict(other)
        shapes, states = [], []
        for share in np.linspace(0.0, 1.0, steps).tolist():
            state = torch.lerp(first.pose.state, last.pose.state, share)
            shapes.append(replace(first, shape=first.shape.towards(last.shape, share)))
            states.append(replace(first, pose=replace(first.pose, state=state)))
        drawn = partial(reconstruction_of, self.model, resolution=resolution)
        return list(map(drawn, shapes)), list(map(drawn, states))

    def fit(self, clouds: Tensor, held_out: PackedSplit) -> dict[str, float]:
        """Return `rec` and `iou` of `held_out_fit`, from clouds (I, n, 3) as they are stored."""

        def fields(cloud: Tensor, points: Tensor) -> Tensor:
            predicted = self.model(cloud, residual_direction=self.residual_direction)
            motion = self.model.motion(predicted.pose)
            return self.model.fields(predicted.shape, motion, points).product[0]

        fit = held_out_fit(fields, clouds, held_out)
        return {"rec": fit["rec"], "iou": fit["iou"]}


class PPDLearner(Predictor):
    """The first two stages.

    Args:
        seed: decides the weights, whatever the device.
    """

    def __init__(self, settings: PPDRecipe, seed: int, device: torch.device) -> None:
        self.settings: PPDRecipe = settings  # pyright: ignore[reportIncompatibleVariableOverride]
        self.inputs = BatchSpec.of(
            settings.data,
            grids=(VALIDATION_GRID,) if settings.data.validation_objects else (),
            joints=(len(settings.model.revolute), len(settings.model.prismatic)),
            poses=settings.warm_start.share > 0,
            groups=settings.warm_start.groups,
            normals=settings.warm_start.share > 0,
            sides=settings.model.local_points > 0,
            chances=CHANCES if settings.vary else 0,
        )
        with made(seed, device):
            self.model = PPD(settings.model)
            judge = Discriminator().to(device)
            self.judging = Beside("discriminator", judge, settings.schedule.optimiser)
            few = settings.model.local_points
            self.local = LocalLearning(few, device) if few else None
            self.unjudged = ("local", "local_adam") if few else ()
            reads = settings.model.states == "points"
            self.reading = StateLearning(settings.model, device) if reads else None
        self.model.to(device)
        self.mirrors = settings.vary.mirror
        self.points = settings.data.surface_points
        self.at(0)
        self._begin_stage()

    def at(self, iteration: int) -> None:
        """Stand at an iteration: its stage's flags hold."""
        self.iteration = iteration
        plan = self.settings.schedule
        self.residual_direction = plan.stages[plan.index_at(iteration)].residual_direction

    def _begin_stage(self) -> None:
        """Optimisers start again in each stage, as in the release."""
        self.descent = Descent(self.model, self.settings.schedule.optimiser)
        for beside in self._beside():
            beside.begin_stage()

    def _beside(self) -> list[Beside]:
        return [beside for beside in (self.judging, self.local, self.reading) if beside]

    def begin(
        self, training: PackedSplit, beside: Path, notify: Callable[[str], None] = lambda _: None
    ) -> None:
        """Find the joints of the training objects, if there is a warm start."""
        if self.settings.warm_start.share:
            model = self.settings.model
            if self.inputs.groups == "found":
                shown = counted(len(set(training.object_id.tolist())), "object")
                notify(f"{len(training)} training instances show {shown}, by their clouds")
            discoveries, rows = discovered(training, beside, directions_of(model), notify)
            known = sum(one is not None for one in likely(discoveries, model))
            notify(f"joints are known of {known} of {len(discoveries)} training objects")
            self.mirrors = self.settings.vary.mirror and not is_one_sided(discoveries, model)
            if self.settings.vary.mirror and not self.mirrors:
                notify("no object is mirrored: joints lean to one side, in a mirror to another")
            self.targets = targets(training, discoveries, rows, model, mirrored=self.mirrors)

    def varied(self, batch: Batch) -> tuple[Targets, Variation | None]:
        """Return the targets of a batch as its objects are, and what varies them."""
        mirrored = batch.chance[:, 0] < 0.5 if self.mirrors else batch.rows < 0
        aim, vary = self.targets.of(batch.rows, mirrored), self.settings.vary
        return aim, Variation.of(batch.chance, mirrored, aim, vary) if vary else None

    def prepared(
        self, batch: Batch
    ) -> tuple[Batch, Callable[[Prediction, Tensor], Terms] | None, Targets | None]:
        """Return the batch, varied where the recipe says so, what a warm start asks of the
        prediction for it, while there is one, and the targets of the batch that it found."""
        warm, turning = self.settings.warm_start, len(self.settings.model.revolute)
        if not warm.share:
            return batch, None, None
        aim, variation = self.varied(batch)
        owner = aim.owner(batch.points, batch.occupied)
        every = max(batch.cloud.shape[1] // LABELLED, 1)
        some = batch.cloud[:, ::every]
        labels = aim.owner(some, torch.ones_like(some[..., 0], dtype=torch.bool))
        if variation:
            batch, freed = variation.batch(batch)
            owner = owner.masked_fill(freed, -1)
            aim, some = variation.targets(aim, turning), batch.cloud[:, ::every]
        if self.iteration >= warm.share * self.settings.schedule.iterations:
            return batch, None, aim

        def asked(predicted: Prediction, part_logits: Tensor) -> Terms:
            terms = warm_start.aim_terms(predicted, part_logits, owner, aim, warm, turning)
            if warm.labels:
                motion = self.model.motion(predicted.pose)
                fields = self.model.fields(predicted.shape, motion, some).product
                wrong = warm_start.labels_entropy(fields, labels, aim.known)
                terms["aim_labels"] = warm.labels * wrong
            return terms

        return batch, asked, aim

    def learn(self, batch: Batch, rng: torch.Generator | None, *, iteration: int) -> Terms:
        """Return one step of the discriminator and one of the model."""
        plan, weigh = self.settings.schedule, self.settings.losses
        if plan.index_at(iteration) != plan.index_at(self.iteration):
            self._begin_stage()
        self.at(iteration)
        rate = plan.rate_at(iteration)
        batch, more, aim = self.prepared(batch)
        predict = partial(self.model, batch.cloud, residual_direction=self.residual_direction)
        predicted = predict()
        posed, judged, discriminator = None, {}, self.judging.network
        if weigh.adv_g:
            posed = objective.random_pose(self.model, predicted, batch, weigh, rng)
            judge = partial(objective.discriminator_terms, discriminator, batch, posed, weigh)
            judged = self.judging.descent.lower(judge, iteration, rate)
        minimize = partial(
            objective.generator_terms,
            self.model,
            batch=batch,
            weigh=weigh,
            discriminator=discriminator,
            posed=posed,
            aim=more,
        )
        terms = minimize(predicted)
        self.descent.step(terms, lambda: minimize(predict()), iteration, rate)
        if self.local:
            judged |= self.local.learn(batch, iteration, rate)
        if self.reading and aim:
            judged |= self.reading.learn(self.model, predicted, batch.cloud, aim, iteration, rate)
        return terms | judged

    def check(self) -> None:
        for descent in (*(beside.descent for beside in self._beside()), self.descent):
            descent.check()

    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """Return how well held-out objects are reconstructed, and how well their motions are
        known."""
        clouds = held_out.surface[:, : self.points]
        measures = self.fit(clouds, held_out)
        measures |= motion_misfit(self.model, clouds, held_out, self.residual_direction)
        by = self.settings.seeds.chosen_by
        return {by: measures[by], **measures} if by in measures else measures

    def state(self) -> dict[str, Any]:
        state = {
            "iteration": self.iteration,
            "model": self.model.state_dict(),
            "adam": self.descent.optimiser.state(),
        }
        for beside in self._beside():
            state |= beside.state()
        return state

    def load(self, state: dict[str, Any]) -> None:
        self.at(max(state["iteration"], 0))
        self.model.load_state_dict(state["model"])
        self.descent.optimiser.load(state["adam"])
        for beside in self._beside():
            beside.load(state)


@torch.no_grad()
def motion_misfit(
    model: PPD, clouds: Tensor, held_out: PackedSplit, residual_direction: bool
) -> dict[str, float]:
    """Return how well predicted motions carry the first pose of unseen objects onto their other
    poses.

    `moved` is the mean square of the distance between the points of the first pose, each moved with
    the part whose field is the greatest there, and the points of the other pose, both ways; divided
    by what it is if nothing moves. It needs no labels, and sees what the cross-entropy does not: a
    wrong candidate, a wrong sense of turning, a part that hides instead of moving. Nothing where
    all objects have one pose.

    Args:
        clouds: (I, n, 3) as they are stored, what the model sees of each instance.
    """
    moved, still = [], []
    for name in dict.fromkeys(held_out.object_id.tolist()):
        first, *others = held_out.poses_of(name).tolist()
        if not others:
            continue
        chosen = [others[i] for i in np.linspace(0, len(others) - 1, MOVED_POSES).astype(int)]
        rows = torch.tensor([first, *chosen], device=clouds.device)
        predicted = model(unpacked(clouds[rows]), residual_direction=residual_direction)
        motion = model.motion(predicted.pose)
        points = unpacked(held_out.surface[rows, :MOVED_POINTS])
        part = model.fields(predicted.shape, motion, points).product[0].argmax(0)
        at_rest = motion.apply(points)[0, part, torch.arange(len(part), device=part.device)]
        back = at_rest - motion.offset[1:, part]
        there = torch.einsum("kpij,kpi->kpj", motion.rotation[1:, part], back)
        moved.append(_between(there, points[1:]))
        still.append(_between(points[:1].expand_as(there), points[1:]))
    if not moved:
        return {}
    return {"moved": float(torch.stack(moved).mean() / torch.stack(still).mean())}


def _between(some: Tensor, others: Tensor) -> Tensor:
    """Return the mean square of the distance from points (B, n, 3) to the nearest of others, and
    back: samples of one surface are never quite alike, and squares make little of it."""
    far = torch.cdist(some, others)
    return far.amin(2).square().mean() + far.amin(1).square().mean()
