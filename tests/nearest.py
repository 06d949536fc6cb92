"""The smallest method there can be: it remembers clouds, and each point of a new one gets the part
of the nearest point of the most similar cloud. It knows neither solids nor joints."""

from typing import Literal

import numpy as np
import torch

from articugen.evaluation.reconstruction import Reconstruction
from articugen.learning.data.batch import Batch, BatchSpec
from articugen.learning.data.split import PackedSplit, unpacked
from articugen.learning.method import Learner, Method
from articugen.learning.recipe import Schedule, Stage, TrainRecipe


class NearestRecipe(TrainRecipe):
    method: Literal["nearest"] = "nearest"
    schedule: Schedule = Schedule(stages=(Stage(resolution=1, iterations=4),))
    clouds: int = 6
    parts: int = 3


class NearestLearner(Learner):
    def __init__(self, settings: NearestRecipe, device: torch.device) -> None:
        n = settings.data.surface_points
        self.settings = settings
        self.inputs = BatchSpec(surface_points=n, parts=True)
        self.clouds = torch.full((settings.clouds, n, 3), 9.0, device=device)  # far from all
        self.parts = torch.zeros((settings.clouds, n), dtype=torch.uint8, device=device)
        self.seen = 0

    def learn(self, batch: Batch, rng, *, iteration: int) -> dict[str, torch.Tensor]:
        terms = {"distance": self._nearest(batch.cloud)[1].mean()}
        for cloud, part in zip(batch.cloud, batch.part, strict=True):
            self.clouds[self.seen % len(self.clouds)] = cloud
            self.parts[self.seen % len(self.clouds)] = part
            self.seen += 1
        return terms

    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        clouds = unpacked(held_out.surface[:, : self.clouds.shape[1]])
        return {"distance": float(self._nearest(clouds)[1].mean())}

    def _nearest(self, clouds: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B,) which remembered cloud is nearest, and by how much."""
        far = torch.stack([torch.cdist(clouds, c[None]).amin(2).mean(1) for c in self.clouds], 1)
        return far.argmin(1), far.amin(1)

    def state(self) -> dict:
        return {"clouds": self.clouds, "parts": self.parts, "seen": self.seen}

    def load(self, state: dict) -> None:
        self.clouds.copy_(state["clouds"])
        self.parts.copy_(state["parts"])
        self.seen = state["seen"]

    def reconstruct(self, cloud: np.ndarray, *, resolution: int) -> Reconstruction:
        given = torch.as_tensor(cloud, dtype=torch.float32)
        which = self._nearest(given[None])[0][0]
        part = self.parts[which][torch.cdist(given, self.clouds[which]).argmin(1)]
        points = np.repeat(np.asarray(cloud, np.float64)[:, None], 3, axis=1)
        nowhere = np.zeros((0, 0, 0), bool)
        return Reconstruction(
            points, part.numpy().astype(np.int64), points, nowhere, self.settings.parts
        )


class Nearest(Method):
    name = "nearest"
    recipe = "none"
    Settings = NearestRecipe

    def start(self, settings: NearestRecipe, *, seed: int, device: torch.device) -> NearestLearner:
        return NearestLearner(settings, device)


METHOD = Nearest()
