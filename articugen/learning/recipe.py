"""Training recipes: everything that decides a run, whatever the method, read from YAML.

A recipe may say `extends: <name>`; unknown keys are refused with the nearest valid name. A method
adds sections of its own (`learning/ppd/settings.py`); `method` says whose recipe it is.
"""

import hashlib
import math
from itertools import accumulate, pairwise
from typing import Any, ClassVar, Literal, TypeVar

import yaml
from pydantic import Field, model_validator

from articugen.core.yaml_files import Section, validated

Recipe = TypeVar("Recipe", bound="TrainRecipe")


class DataSettings(Section):
    """Content of one sample of a batch.

    Attributes:
        surface_points: the encoder's input.
        grid_points, uniform_points, near_points: points with an indicator value: of the stage's
            grid, anywhere in the cube, near the surface.
        band_points: centres of voxels within three of this pose's material and of free space, along
            each axis; half of them occupied.
        varying_points: centres of voxels whose label differs between the poses of this object; half
            of them occupied in this pose. More than the paper uses: that poses are of one object.
            Voxels of both are of the data's finest grid up to 64^3.
        occupancy: what is 1 there: `material`, the parts' own solids without the space that they
            enclose, the same in every pose; or `visible`, what no view sees free (the paper's).
        validation_objects: how many training objects are held out; at most a quarter, or one.
    """

    surface_points: int = Field(default=4096, ge=1)
    grid_points: int = Field(default=4096, ge=0)
    uniform_points: int = Field(default=0, ge=0)
    near_points: int = Field(default=0, ge=0)
    band_points: int = Field(default=0, ge=0)
    varying_points: int = Field(default=0, ge=0)
    occupancy: Literal["visible", "material"] = "material"
    validation_objects: int = Field(default=4, ge=0)


class Stage(Section):
    """A stretch of training.

    Attributes:
        resolution: of the grid of indicator values.
        iterations: how many.
    """

    resolution: int = Field(ge=1, le=256)
    iterations: int = Field(ge=0)


class Schedule(Section):
    """Length and rate of training.

    Attributes:
        optimiser: `adam`, the paper's; or `soap` (Vyas et al. 2024), see
            learning/optimisers.py.
        learning_rate: of the optimiser; SOAP wants about three times Adam's.
        final_learning_rate: where a cosine leads to by the end; null keeps it constant.
        validate_every, save_every, log_every: iterations.
    """

    COUNTED: ClassVar[tuple[str, ...]] = ()
    """More keys that count iterations or samples: a budget scales them too."""

    batch: int = Field(default=18, ge=2)
    optimiser: Literal["adam", "soap"] = "adam"
    learning_rate: float = Field(default=1e-4, gt=0)
    final_learning_rate: float | None = Field(default=None, gt=0)
    stages: tuple[Stage, ...]
    validate_every: int = Field(default=1000, ge=1)
    save_every: int = Field(default=1000, ge=1)
    log_every: int = Field(default=10, ge=1)

    @property
    def iterations(self) -> int:
        return sum(stage.iterations for stage in self.stages)

    def index_at(self, iteration: int) -> int:
        """Return the index of the stage that an iteration (from 0) belongs to."""
        ends = accumulate(stage.iterations for stage in self.stages[:-1])
        return sum(iteration >= end for end in ends)

    def rate_at(self, iteration: int) -> float:
        """Return the learning rate of an iteration."""
        if self.final_learning_rate is None:
            return self.learning_rate
        share = 0.5 * (1.0 + math.cos(math.pi * iteration / max(self.iterations - 1, 1)))
        return self.final_learning_rate + share * (self.learning_rate - self.final_learning_rate)


class Seeds(Section):
    """Number of seeds that race, since one alone may find no parts at all.

    Attributes:
        count: how many start; 1 is no race.
        halve_at: after each of these iterations the worse half of the seeds still running is
            dropped, by the loss on the objects held out; of those that finish the best wins.
        chosen_by: which number of the learner's validation is that loss; its first if not given.
    """

    count: int = Field(default=1, ge=1, le=64)
    halve_at: tuple[int, ...] = ()
    chosen_by: str = ""


class Budget(Section):
    """Time that a schedule was scaled to, see `learning.budget`.

    Attributes:
        seconds: of CPU time, or of the clock on a GPU, that training may take.
        start: how many of them pass before the first iteration.
        recipe_sha256: of the recipe that was scaled.
    """

    seconds: float = Field(gt=0)
    start: float = Field(ge=0)
    recipe_sha256: str


class TrainRecipe(Section):
    """One training recipe, resolved: what every method has. See the sections for each key.

    Attributes:
        method: a name of `learning.method.METHODS`, or of an entry point.
        budget: None of a recipe that was not scaled.
    """

    COUNTED: ClassVar[tuple[str, ...]] = ()
    """Keys of a method's own that are numbers of iterations."""

    MEASURED: ClassVar[tuple[str, ...]] = ()  # what `seeds.chosen_by` may be

    name: str
    method: str
    data: DataSettings = DataSettings()
    schedule: Schedule
    seeds: Seeds = Seeds()
    budget: Budget | None = None

    @property
    def variant(self) -> str:
        """Row of a table of ablations that it belongs in."""
        return self.method

    @model_validator(mode="after")
    def _seeds_are_compared(self: Recipe) -> Recipe:
        validate_every = self.schedule.validate_every
        if self.seeds.count > 1 and not self.data.validation_objects:
            raise ValueError("several seeds need data.validation_objects to choose by")
        if not self.schedule.stages:
            raise ValueError("schedule.stages: has none; give it one")
        if self.seeds.chosen_by not in ("", *self.MEASURED):
            choice = " or ".join(self.MEASURED) or "left out"
            raise ValueError(f"seeds.chosen_by must be {choice} in recipes of {self.method}")
        for before, at in pairwise((0, *self.seeds.halve_at, self.schedule.iterations)):
            if self.seeds.count > 1 and not (before < at and before % validate_every == 0):
                raise ValueError(
                    "seeds.halve_at must be ascending, before the last iteration, and multiples of "
                    f"schedule.validate_every ({validate_every})"
                )
        return self

    def scaled(self: Recipe, share: float, checks: int, **more: Any) -> Recipe:
        """Return this recipe with each stage `share` times as long, and one seed.

        Args:
            checks: how often it is validated and saved.
            more: other values of sections.
        """

        def times(count: int) -> int:
            return max(int(share * count), 1) if count else 0

        data = self.plain()
        stages = [s | {"iterations": times(s["iterations"])} for s in data["schedule"]["stages"]]
        every = -(-sum(s["iterations"] for s in stages) // checks)
        often = {"stages": stages, "validate_every": every, "save_every": every}
        often |= {key: times(data["schedule"][key]) for key in self.schedule.COUNTED}
        data |= {"schedule": data["schedule"] | often, "seeds": {}}
        data |= {key: times(data[key]) for key in self.COUNTED}
        return validated(type(self), data | more, self.name)

    def text(self) -> str:
        """Return the resolved recipe as YAML, every key spelt out."""
        return yaml.safe_dump(self.plain(), sort_keys=False)

    def plain(self) -> dict[str, Any]:
        """Return the resolved recipe as plain data."""
        return self.model_dump(mode="json")

    def sha256(self) -> str:
        """Return the digest of what decides a run: all but the name."""
        left_out = {"name"} if self.budget else {"name", "budget"}
        return hashlib.sha256(self.model_dump_json(exclude=left_out).encode()).hexdigest()
