"""Recipes of OP-Align. Defaults are the published network and training, but for the encoder."""

from typing import Literal

from pydantic import Field, model_validator

from articugen.core.yaml_files import Section
from articugen.learning.recipe import Schedule, TrainRecipe


class ModelSettings(Section):
    """The network.

    Attributes:
        revolute, prismatic: joints, one or two of one kind; part 0 hangs on all of them.
        width: of the residual blocks.
        reach: of states, which lie within half of it around 0; degrees, of which prismatic joints
            take as many radians as lengths. It is twice the published one, since in a frame that
            is given the base cannot take half of a turn.
    """

    revolute: int = Field(default=1, ge=0, le=2)
    prismatic: int = Field(default=0, ge=0, le=2)
    width: int = Field(default=256, ge=1)
    reach: float = Field(default=180.0, gt=0)

    @model_validator(mode="after")
    def _kind_is_one(self) -> "ModelSettings":
        if bool(self.revolute) == bool(self.prismatic):
            raise ValueError("OP-Align has one or two joints of one kind; set the other kind to 0")
        return self


class OPAlignSchedule(Schedule):
    """Schedule that halves the rate, and the weight of the whole shape, after some iterations
    again and again."""

    COUNTED = ("halve_after",)

    halve_after: int = Field(default=5000, ge=1)

    def share_at(self, iteration: int) -> float:
        """Return what is left of both."""
        return 0.5 ** (iteration // self.halve_after)

    def rate_at(self, iteration: int) -> float:
        return super().rate_at(iteration) * self.share_at(iteration)


class OPAlignRecipe(TrainRecipe):
    """A recipe of OP-Align."""

    method: Literal["opalign"] = "opalign"  # pyright: ignore[reportIncompatibleVariableOverride]
    model: ModelSettings = ModelSettings()
    schedule: OPAlignSchedule  # pyright: ignore[reportIncompatibleVariableOverride]
