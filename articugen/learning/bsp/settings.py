"""Recipes of BSP-Net. Defaults are the published network and training."""

from typing import Literal

from pydantic import Field

from articugen.core.yaml_files import Section
from articugen.learning.recipe import Schedule, Stage, TrainRecipe


class ModelSettings(Section):
    """The network.

    Attributes:
        voxels: along an edge of the grid that the encoder sees.
        code: numbers that the encoder makes of a shape.
        widths: of the linear layers between the code and the planes.
        planes: predicted for a shape; two to four times as many as shapes come to use.
        convexes: how many parts there can be.
    """

    voxels: Literal[16, 32, 64] = 64
    code: int = Field(default=256, ge=1)
    widths: tuple[int, int, int] = (512, 1024, 2048)
    planes: int = Field(default=4096, ge=4)
    convexes: int = Field(default=256, ge=1, le=1024)


class BSPStage(Stage):
    """A stretch of training.

    Attributes:
        loss: `continuous`, where planes and convexes are summed with weights; `hard`, where a plane
            bounds a convex or does not; `soft`, where such weights are led to 0 and 1. `_overlap`
            also keeps convexes from lying in each other. The authors' phases 0, 1, 3, 2 and 4.
    """

    loss: Literal["continuous", "hard", "hard_overlap", "soft", "soft_overlap"] = "continuous"


class BSPSchedule(Schedule):
    """Schedule whose stages have losses of their own."""

    stages: tuple[BSPStage, ...]  # pyright: ignore[reportIncompatibleVariableOverride]


class BSPRecipe(TrainRecipe):
    """A recipe of BSP-Net.

    Attributes:
        fourfold: number of first iterations in which the indicator value inside is 4; PPD's authors
            needed 20,000 on eyeglasses, which are so thin that all was left empty.
        restart_after: iterations of a continuous stage in which no point lies between inside and
            outside; nothing can be learned then, and other first weights are drawn.
    """

    COUNTED = ("fourfold", "restart_after")

    method: Literal["bsp"] = "bsp"  # pyright: ignore[reportIncompatibleVariableOverride]
    model: ModelSettings = ModelSettings()
    fourfold: int = Field(default=0, ge=0)
    restart_after: int = Field(default=2000, ge=1)
    schedule: BSPSchedule  # pyright: ignore[reportIncompatibleVariableOverride]
