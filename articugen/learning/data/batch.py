"""What a learner asks for, and what it is given in one step."""

from dataclasses import dataclass, field
from typing import Any, Literal

from torch import Tensor

from articugen.learning.recipe import DataSettings


@dataclass(frozen=True)
class BatchSpec:
    """Needs of a learner; nothing else is read or unpacked.

    Attributes:
        surface_points, grid_points, uniform_points, near_points, band_points, varying_points,
            occupancy: as `DataSettings`.
        grids: resolutions of grids that `Learner.validate` reads, besides those of the stages.
        parts: whether the true parts of surface points are wanted.
        partial: whether clouds are what one depth camera sees, another one each time.
        joints: (revolute, prismatic) joints an object may have at most; None is any number.
        poses: whether several poses of each object are compared; for `varying_points` they are.
        groups: which instances show one object, where that is used: `found` in their clouds, or
            `given` by the data set.
        normals: whether the normals of surface points are wanted, for `Learner.begin`.
        sides: whether they are, of the cloud, for `Batch.normals`.
        motions: whether it is wanted how the true parts have moved, for `Batch.rest` and `joints`.
        chances: how many random numbers the learner asks for each sample.
    """

    surface_points: int
    grid_points: int = 0
    uniform_points: int = 0
    near_points: int = 0
    band_points: int = 0
    varying_points: int = 0
    occupancy: str = "material"
    grids: tuple[int, ...] = ()
    parts: bool = False
    partial: bool = False
    joints: tuple[int, int] | None = None
    poses: bool = False
    groups: Literal["found", "given"] = "given"
    normals: bool = False
    sides: bool = False
    motions: bool = False
    chances: int = 0

    @property
    def finds_objects(self) -> bool:
        """True where poses are compared, and of which objects is to be found out."""
        return self.groups == "found" and (self.poses or self.varying_points > 0)

    @staticmethod
    def of(data: DataSettings, **more: Any) -> "BatchSpec":
        """Return what a recipe's data settings ask for, and `more`."""
        return BatchSpec(**data.model_dump(exclude={"validation_objects"}), **more)

    @property
    def knows(self) -> Literal["", "groups", "labels"]:
        """Knowledge that training gets beside shapes: true parts, or which instances show one
        object."""
        if self.parts or self.motions:
            return "labels"
        compares = self.poses or self.varying_points > 0
        return "groups" if compares and not self.finds_objects else ""


@dataclass(frozen=True)
class Batch:
    """B samples in the unit frame.

    Attributes:
        rows: (B,) which instances of the split they are.
        cloud: (B, n, 3) surface points, or what a depth camera sees.
        part: (B, n) the cloud's true parts where they were asked for, else (B, 0).
        points: (B, m, 3) query points.
        occupied: (B, m) bool, their indicator values.
        spread: how many query points, the first ones, lie evenly in the cube; the others lie near
            the surface, in the band around it, and where the object's poses differ, in this order.
        chance: (B, k) random numbers in [0, 1), for whatever the learner does with the samples.
        rest: (B, n, 3) where the cloud's points lie in the canonical pose, if motions were asked
            for; a cloud that a depth camera sees has no parts, and so none.
        joints: `kind` (B, J), `state` (B, J), `axis` and `pivot` (B, J, 3) likewise, as a shard has
            them; J of the object with most, 0 where another has no such joint.
        normals: (B, n, 3) outward ones at points of a complete cloud, if sides were asked for.
    """

    rows: Tensor
    cloud: Tensor
    part: Tensor
    points: Tensor
    occupied: Tensor
    spread: int
    chance: Tensor
    rest: Tensor | None = None
    joints: dict[str, Tensor] = field(default_factory=dict)
    normals: Tensor | None = None
