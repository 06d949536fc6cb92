"""Training recipes: everything that decides a run, read from recipes/ppd_*.yaml.

A recipe may say `extends: <name>`; unknown keys are refused with the nearest valid name. What a key
takes from the paper and what from the authors' release is listed in docs/ppd.md.
"""

import hashlib
import math
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, model_validator

from articugen.learning.evaluation.paper import COMPLETE
from articugen.recipe_files import Section as _Section
from articugen.recipe_files import find, resolved, validated

Direction = tuple[float, float, float]


class ModelSettings(_Section):
    """The parts and how they move.

    Attributes:
        revolute, prismatic: the initial unit direction e_i of each such part; part 0 is fixed.
        common_shape, common_pose: the category-common decoders; off for the paper's ablation
            ("w/o CS", "w/o CP").
        codes: N_qt, candidates of the pose quantiser.
        codes_learn: whether codes also learn from what is decoded from them, or from L_vq alone.
        coordinate_bound: weights of the layer that sees coordinates start in U(-bound, bound).
        part_frame: where a revolute part's shape lives: `world`, B = T(q) R(s, u); or
            `joint`, which turns it with the direction as well, B = T(q) C(r) Rz(s).
        latent_start: how the encoder's weights start: `release`, as torch's layers do, which leaves
            latents of different objects the same to a thousandth; or `he`, by He et al. 2015, and
            the layer that reads z^s 20 times larger, so that shapes differ from the start.
    """

    revolute: tuple[Direction, ...] = ((0, 0, 1), (0, 0, -1), (0, 1, 0))
    prismatic: tuple[Direction, ...] = ((1, 0, 0),) * 4
    common_shape: bool = True
    common_pose: bool = True
    codes: int = Field(default=4, ge=1)
    codes_learn: bool = True
    coordinate_bound: float = Field(default=math.sqrt(2.0), gt=0.0)
    part_frame: Literal["world", "joint"] = "world"
    latent_start: Literal["release", "he"] = "release"

    @model_validator(mode="after")
    def _directions_are_unit(self) -> "ModelSettings":
        for direction in (*self.revolute, *self.prismatic):
            if abs(math.hypot(*direction) - 1.0) > 1e-6:
                raise ValueError(f"direction {direction} is not of unit length")
        if not self.revolute or not self.prismatic:
            raise ValueError("there must be a revolute and a prismatic part")
        return self

    @property
    def joints(self) -> int:
        return len(self.revolute) + len(self.prismatic)

    @property
    def parts(self) -> int:
        return 1 + self.joints


class LossSettings(_Section):
    """Weights (lambda in the paper) and forms; a weight of 0 switches a term off.

    Attributes:
        vol_logit: what L_vol measures: `instance` F^{s,z} (Eq. 3), or its `product` with O^c.
        vq_form: `norm`, ||z - sg(c)|| (Eq. 4), or `mean_square`, gradient to both.
        dev_form, loc_form, var_form: `paper`, Eq. 5 to 7 as printed, or `release`.
        var_width: v in Eq. 7.
        most_revolute, most_prismatic: h_i, random joint states are U(0, h_i).
    """

    rec: float = Field(default=0.01, ge=0)
    rec_common: float = Field(default=0.001, ge=0)
    vol: float = Field(default=1000.0, ge=0)
    vq: float = Field(default=1.0, ge=0)
    dev: float = Field(default=0.1, ge=0)
    loc: float = Field(default=100.0, ge=0)
    var_state: float = Field(default=0.1, ge=0)
    var_pivot: float = Field(default=0.01, ge=0)
    adv_g: float = Field(default=0.65, ge=0)
    adv_d: float = Field(default=0.35, ge=0)
    gradient_penalty: float = Field(default=1.0, ge=0)
    vol_logit: Literal["instance", "product"] = "instance"
    vq_form: Literal["norm", "mean_square"] = "norm"
    dev_form: Literal["paper", "release"] = "paper"
    loc_form: Literal["paper", "release"] = "paper"
    var_form: Literal["paper", "release"] = "paper"
    var_width: float = Field(default=0.01, gt=0)
    most_revolute: float = Field(default=math.pi / 2, gt=0)
    most_prismatic: float = Field(default=0.4, gt=0)


class Stage(_Section):
    """A stretch of training; Adam starts afresh in each.

    Attributes:
        resolution: of the grid of indicator values.
        iterations: how many.
        residual_direction: r = r^c + r^z (the paper's second stage), else r = r^c.
    """

    resolution: int = Field(ge=1, le=256)
    iterations: int = Field(ge=0)
    residual_direction: bool = False


class DataSettings(_Section):
    """What one sample of a batch is made of.

    Attributes:
        surface_points: the encoder's input.
        grid_points, uniform_points, near_points: points with an indicator value: of the stage's
            grid, anywhere in the cube, near the surface.
        occupancy: what is 1 there: `visible`, what no view sees free (the paper's); or `material`,
            the parts' own solids without the space that they enclose, the same in every pose.
        validation_objects: how many objects of the training split are held out; at most a quarter.
    """

    surface_points: int = Field(default=4096, ge=1)
    grid_points: int = Field(default=4096, ge=0)
    uniform_points: int = Field(default=0, ge=0)
    near_points: int = Field(default=0, ge=0)
    occupancy: Literal["visible", "material"] = "visible"
    validation_objects: int = Field(default=4, ge=0)

    @model_validator(mode="after")
    def _has_points_in_the_volume(self) -> "DataSettings":
        if self.grid_points + self.uniform_points == 0:
            raise ValueError("grid_points or uniform_points must be more than 0: L_vol needs them")
        return self


class Schedule(_Section):
    """How long and how fast.

    Attributes:
        learning_rate: of both Adams.
        final_learning_rate: where a cosine leads to by the end; null keeps it constant.
        validate_every, save_every, log_every: iterations.
    """

    batch: int = Field(default=18, ge=2)
    learning_rate: float = Field(default=1e-4, gt=0)
    final_learning_rate: float | None = Field(default=None, gt=0)
    stages: tuple[Stage, ...] = (
        Stage(resolution=16, iterations=99_000),
        Stage(resolution=32, iterations=49_000, residual_direction=True),
    )
    validate_every: int = Field(default=1000, ge=1)
    save_every: int = Field(default=1000, ge=1)
    log_every: int = Field(default=10, ge=1)

    @property
    def iterations(self) -> int:
        return sum(stage.iterations for stage in self.stages)

    def at(self, iteration: int) -> tuple[int, Stage]:
        """The index of the stage that iteration (from 0) belongs to, and the stage."""
        first = 0
        for index, stage in enumerate(self.stages):
            first += stage.iterations
            if iteration < first:
                return index, stage
        return len(self.stages) - 1, self.stages[-1]


class Seeds(_Section):
    """How many seeds race, since one alone may find no parts at all.

    Attributes:
        count: how many start; 1 is no race.
        halve_at: after each of these iterations the worse half of the seeds still running is
            dropped, by the loss on the objects held out; of those that finish the best wins.
    """

    count: int = Field(default=1, ge=1, le=64)
    halve_at: tuple[int, ...] = ()


class DepthSettings(_Section):
    """The third stage: an encoder for what one depth camera sees.

    Attributes:
        iterations, batch: how many, of how many clouds each.
        learning_rate: of Adam; a cosine leads to a hundredth of it by the end.
    """

    iterations: int = Field(default=50_000, ge=1)
    batch: int = Field(default=32, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)


class TrainRecipe(_Section):
    """One training recipe, resolved. See the sections for the meaning of each key."""

    name: str
    model: ModelSettings = ModelSettings()
    losses: LossSettings = LossSettings()
    data: DataSettings = DataSettings()
    schedule: Schedule = Schedule()
    depth: DepthSettings = DepthSettings()
    seeds: Seeds = Seeds()

    @model_validator(mode="after")
    def _seeds_are_compared(self) -> "TrainRecipe":
        validate_every = self.schedule.validate_every
        if self.seeds.count > 1 and not self.data.validation_objects:
            raise ValueError("several seeds need data.validation_objects to choose by")
        for before, at in pairwise((0, *self.seeds.halve_at, self.schedule.iterations)):
            if self.seeds.count > 1 and not (before < at and before % validate_every == 0):
                raise ValueError(
                    "seeds.halve_at must be ascending, before the last iteration, and multiples of "
                    f"schedule.validate_every ({validate_every})"
                )
        return self

    def with_seeds(self, count: int) -> "TrainRecipe":
        """This recipe with another number of seeds.

        Raises:
            InvalidRecipe: they cannot be compared.
        """
        seeds = {**self.seeds.model_dump(), "count": count}
        return parse_train_recipe(self.model_dump() | {"seeds": seeds}, "--seeds")

    def same_but_seeds(self, other: "TrainRecipe") -> bool:
        """Whether the other decides the same runs, however many of them race."""
        return self.sha256() == other.model_copy(update={"seeds": self.seeds}).sha256()

    def text(self) -> str:
        """The resolved recipe as YAML, every key spelt out."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)

    def sha256(self) -> str:
        """The digest of what decides a run: all but the name."""
        return hashlib.sha256(self.model_dump_json(exclude={"name"}).encode()).hexdigest()


def load_train_recipe(name: str | Path) -> TrainRecipe:
    """The training recipe `name`: a name under recipes/, or a path.

    Raises:
        InvalidRecipe: no such recipe, bad YAML, an unknown key or a bad value.
    """
    path = find(str(name), learner=True)
    data = resolved(path, lambda base: find(base, learner=True))
    return parse_train_recipe({"name": path.stem} | data, str(path))


def parse_train_recipe(data: dict[str, Any], where: str) -> TrainRecipe:
    """A recipe from plain data; `where` is named in errors.

    Raises:
        InvalidRecipe: an unknown key or a bad value.
    """
    return validated(TrainRecipe, data, where)


def variant(recipe: TrainRecipe) -> str:
    """What Table 5 calls a model trained by this recipe; "w/o A, B" where it has no such row."""
    losses, model = recipe.losses, recipe.model
    off = [
        name
        for name, is_on in (
            ("L_vol", losses.vol),
            ("L_dev", losses.dev),
            ("L_loc", losses.loc),
            ("L_var", losses.var_state or losses.var_pivot),
            ("L_adv_g", losses.adv_g),
            ("CS", model.common_shape),
            ("CP", model.common_pose),
        )
        if not is_on
    ]
    return f"w/o {', '.join(off)}" if off else COMPLETE
