"""Recipes of Neural Star Domain. Defaults are the published network and training."""

from typing import Literal

from pydantic import Field

from articugen.core.yaml_files import Section
from articugen.learning.recipe import TrainRecipe


class ModelSettings(Section):
    """The network.

    Attributes:
        code: numbers that the encoder makes of a shape.
        stars: how many parts there are.
        width: of the hidden layers of a radius.
        directions: in which each star's surface is drawn in a step, others for each shape.
    """

    code: int = Field(default=256, ge=1)
    stars: int = Field(default=10, ge=1, le=256)
    width: int = Field(default=64, ge=1)
    directions: int = Field(default=400, ge=1)


class LossSettings(Section):
    """Weights.

    Attributes:
        occupancy: of the cross-entropy at query points.
        surface: of the distances between drawn surfaces and the cloud, both ways.
        overlap: of what more than one star covers.
    """

    occupancy: float = Field(default=1.0, ge=0)
    surface: float = Field(default=10.0, ge=0)
    overlap: float = Field(default=10.0, ge=0)


class NSDRecipe(TrainRecipe):
    """A recipe of Neural Star Domain."""

    method: Literal["nsd"] = "nsd"  # pyright: ignore[reportIncompatibleVariableOverride]
    model: ModelSettings = ModelSettings()
    losses: LossSettings = LossSettings()
