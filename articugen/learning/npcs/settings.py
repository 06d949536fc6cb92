"""Recipes of NPCS. Defaults are the published network and training."""

from typing import Literal

from pydantic import Field

from articugen.core.yaml_files import Section
from articugen.learning.recipe import Schedule, TrainRecipe


class Level(Section):
    """A set abstraction of PointNet++.

    Attributes:
        centres: points that stand for their neighbourhoods.
        radius: of a neighbourhood, in the unit frame.
        neighbours: points of a neighbourhood at most.
    """

    centres: int = Field(ge=1)
    radius: float = Field(gt=0)
    neighbours: int = Field(ge=1)


class ModelSettings(Section):
    """The network.

    Attributes:
        parts: how many an object may have, the fixed one included.
        levels: the two set abstractions before the last, which takes all.
    """

    parts: int = Field(default=4, ge=2, le=64)
    levels: tuple[Level, Level] = (
        Level(centres=512, radius=0.2, neighbours=64),
        Level(centres=128, radius=0.4, neighbours=64),
    )


class NPCSSchedule(Schedule):
    """Schedule whose rate falls by steps, as does the momentum of batch norms.

    Attributes:
        fall: factor of the rate at each step.
        fall_after: samples between two steps.
    """

    COUNTED = ("fall_after",)

    fall: float = Field(default=0.7, gt=0, le=1)
    fall_after: int = Field(default=200_000, ge=1)

    def steps_at(self, iteration: int) -> int:
        """Return how often the rate has fallen."""
        return iteration * self.batch // self.fall_after

    def rate_at(self, iteration: int) -> float:
        return super().rate_at(iteration) * self.fall ** self.steps_at(iteration)


class NPCSRecipe(TrainRecipe):
    """A recipe of NPCS."""

    method: Literal["npcs"] = "npcs"  # pyright: ignore[reportIncompatibleVariableOverride]
    model: ModelSettings = ModelSettings()
    schedule: NPCSSchedule  # pyright: ignore[reportIncompatibleVariableOverride]
