"""Recipes of BAE-Net.

Defaults are the published one-shot network and training; its author advises `model.widths` of
3072, 384 and 12 branches, and `from_zero`, for learning without labels (recipe `bae`).
"""

from typing import Literal

from pydantic import Field

from articugen.core.yaml_files import Section
from articugen.learning.recipe import Schedule, TrainRecipe


class ModelSettings(Section):
    """The network.

    Attributes:
        voxels: along an edge of the grid that the encoder sees.
        code: numbers that the encoder makes of a shape.
        widths: of the decoder's first two layers; there are exactly three, or parts merge.
        branches: how many parts there can be.
        from_zero: outputs lie in (-1, 1) and start at 0, instead of in (0, 1) at 0.5.
        level: of the output, where surfaces are drawn.
    """

    voxels: Literal[16, 32, 64] = 64
    code: int = Field(default=128, ge=1)
    widths: tuple[int, int] = (1024, 256)
    branches: int = Field(default=8, ge=1, le=64)
    from_zero: bool = False
    level: float = Field(default=0.4, gt=0, lt=1)


class LossSettings(Section):
    """Weights besides that of the reconstruction, 1.

    Attributes:
        l1: of the sum of the last layer's absolute weights.
    """

    l1: float = Field(default=1e-6, ge=0)


class BAESchedule(Schedule):
    """Schedule whose batch may be one shape, as it is for the authors."""

    batch: int = Field(default=1, ge=1)


class BAERecipe(TrainRecipe):
    """A recipe of BAE-Net."""

    method: Literal["bae"] = "bae"  # pyright: ignore[reportIncompatibleVariableOverride]
    model: ModelSettings = ModelSettings()
    losses: LossSettings = LossSettings()
    schedule: BAESchedule  # pyright: ignore[reportIncompatibleVariableOverride]
