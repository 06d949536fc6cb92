"""PPD's recipes, recipes/ppd_*.yaml: what they have besides those of any method.

What a key takes from the paper and what from the authors' release is listed in docs/ppd.md.
"""

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from articugen.core.errors import InvalidCheckpoint
from articugen.core.records import Floats, JointKind
from articugen.core.yaml_files import Section
from articugen.evaluation.paper import COMPLETE
from articugen.learning.recipe import Schedule, Stage, TrainRecipe

Direction = tuple[float, float, float]

NEIGHBOURS = 12
"""Points of a cloud that a local field examines around each place, at each scale."""


class ModelSettings(Section):
    """The parts and how they move.

    Attributes:
        revolute, prismatic: the initial unit direction e_i of each such part; part 0 is fixed.
        common_shape, common_pose: the category-common decoders; off for the paper's ablation
            ("w/o CS", "w/o CP").
        codes: N_qt, candidates of the pose quantiser.
        form: `paper` or `release`, see `codes_learn`, `coordinate_bound` and `part_frame`.
        part_boxes: whether each part's shape lives in a box of its own, whose middle and size are
            predicted from z^s: drawers of other sizes in other places then look alike. The paper
            has no such boxes; there z^s says all by six numbers a part. They lie along the unit
            frame's axes.
        latent_start: how the encoder's weights start: `release`, as torch's layers do, which leaves
            latents of different objects the same to a thousandth; or `he`, by He et al. 2015, and
            the layer that reads z^s 20 times larger, so that shapes differ from the start.
        encoder: `points`, the paper's PointNet; or `both`, that and one which sees how full the
            cells of a grid are, and so which ones lie side by side.
        local_points: number of query points of two samples of a batch at which a field learns where
            matter is from the points of the cloud around, and from their normals, which it learns
            to predict, apart from all else (`ppd.local`); parts then decide whose it is. 0 is no
            such field; the paper has none.
        states: `pose`, joint states are those of the pose decoder; `points`, these corrected by
            where the points of the parts lie (`ppd.states`), which is learned from a warm start.
    """

    revolute: tuple[Direction, ...] = ((0, 0, 1), (0, 0, -1), (0, 1, 0))
    prismatic: tuple[Direction, ...] = ((1, 0, 0),) * 4
    common_shape: bool = True
    common_pose: bool = True
    codes: int = Field(default=4, ge=1)
    form: Literal["paper", "release"] = "paper"
    part_boxes: bool = False
    latent_start: Literal["release", "he"] = "release"
    encoder: Literal["points", "both"] = "points"
    local_points: int = Field(default=0, ge=0)
    states: Literal["pose", "points"] = "pose"

    @model_validator(mode="after")
    def _fits_together(self) -> "ModelSettings":
        for direction in (*self.revolute, *self.prismatic):
            if abs(math.hypot(*direction) - 1.0) > 1e-6:
                raise ValueError(f"direction {direction} is not of unit length")
        if not self.revolute or not self.prismatic:
            raise ValueError("there must be a revolute and a prismatic part")
        return self

    @property
    def codes_learn(self) -> bool:
        """True where codes also learn from what is decoded from them, not from L_vq alone."""
        return self.form == "paper"

    @property
    def coordinate_bound(self) -> float:
        """Bound of the first weights of the layer that sees coordinates, U(-bound, bound)."""
        return math.sqrt(2.0) if self.form == "paper" else 1.0 / 3.0

    @property
    def part_frame(self) -> Literal["world", "joint"]:
        """The frame of a revolute part's shape: `world`, B = T(q) R(s, u); or the release's
        `joint`, which turns it with the direction as well, B = T(q) C(r) Rz(s)."""
        return "joint" if self.form == "release" and not self.part_boxes else "world"

    @property
    def joints(self) -> int:
        return len(self.revolute) + len(self.prismatic)

    @property
    def parts(self) -> int:
        return 1 + self.joints


def directions_of(model: ModelSettings) -> dict[JointKind, Floats]:
    """Return (n, 3) where the candidates of each kind point."""
    return {
        JointKind.REVOLUTE: np.array(model.revolute, np.float64),
        JointKind.PRISMATIC: np.array(model.prismatic, np.float64),
    }


class LossSettings(Section):
    """Weights (lambda in the paper) and their form; a weight of 0 switches a term off.

    Attributes:
        form: `paper`, Eq. 3 to 7 as printed; `release`, what that computes instead; or `mixed`, the
            release's but for L_dev, which is the paper's.
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
    form: Literal["paper", "release", "mixed"] = "paper"
    var_width: float = Field(default=0.01, gt=0)
    most_revolute: float = Field(default=math.pi / 2, gt=0)
    most_prismatic: float = Field(default=0.4, gt=0)


class WarmStart(Section):
    """Targets for the first iterations, see `warm_start`; what the paper does not have.

    They come from what changes between the poses of an object.

    Attributes:
        share: of the iterations, the first ones, that are aimed; 0 is no warm start.
        groups: which instances show one object: `found` in their clouds, whose fixed part lies in
            one place (`discovery.groups`), or `given` by the data set, which the paper does not
            use. `data.varying_points` go by it as well.
        parts: weight of each part's field against whose the occupied points are.
        occupied: how much more a part's own points weigh there than all others.
        labels: weight of whose field is the greatest at the points that the encoder is given.
        state, direction, pivot, box: weights of how far these are off: amounts, 1 - cos, the square
            of the distance between the pivots, and the parts' boxes (`box_misfit`).
        still: weight of how far the amounts of candidates that only other objects have are from
            those of a closed joint.
    """

    share: float = Field(default=0.0, ge=0, le=1)
    groups: Literal["found", "given"] = "found"
    parts: float = Field(default=0.01, ge=0)
    occupied: float = Field(default=4.0, gt=0)
    labels: float = Field(default=0.02, ge=0)
    state: float = Field(default=20.0, ge=0)
    still: float = Field(default=2.0, ge=0)
    direction: float = Field(default=20.0, ge=0)
    pivot: float = Field(default=200.0, ge=0)
    box: float = Field(default=20.0, ge=0)


class VarySettings(Section):
    """Variations of training objects, drawn in each batch; see `variation`. The paper does not.

    Attributes:
        stretch: the logarithm of how much longer or shorter along an axis at most; the longest edge
            stays, and so do right angles of what turns.
        shrink: the share that an object is smaller at most.
        mirror: whether every other sample has left and right swapped; none has where joints lean to
            one side (`targets.is_one_sided`).
        shift: whether it is anywhere in the cube, instead of in the middle.
    """

    stretch: float = Field(default=0.0, ge=0, le=1)
    shrink: float = Field(default=0.0, ge=0, le=0.9)
    mirror: bool = False
    shift: bool = False

    def __bool__(self) -> bool:
        return any((self.stretch, self.shrink, self.mirror, self.shift))


class PPDStage(Stage):
    """A stretch of training; the optimiser starts again in each.

    Attributes:
        residual_direction: r = r^c + r^z (the paper's second stage), else r = r^c.
    """

    residual_direction: bool = False


class PPDSchedule(Schedule):
    stages: tuple[PPDStage, ...] = (  # pyright: ignore[reportIncompatibleVariableOverride]
        PPDStage(resolution=16, iterations=99_000),
        PPDStage(resolution=32, iterations=49_000, residual_direction=True),
    )


class PPDRecipe(TrainRecipe):
    """A recipe of PPD, resolved. The defaults are the text of the paper. Seeds can be chosen by how
    well held-out objects are reconstructed, or how well motions carry one pose onto the others."""

    MEASURED = ("rec", "moved")
    method: Literal["ppd"] = "ppd"  # pyright: ignore[reportIncompatibleVariableOverride]
    model: ModelSettings = ModelSettings()
    losses: LossSettings = LossSettings()
    warm_start: WarmStart = WarmStart()
    vary: VarySettings = VarySettings()
    schedule: PPDSchedule = PPDSchedule()  # pyright: ignore[reportIncompatibleVariableOverride]

    @model_validator(mode="after")
    def _fits_together(self) -> "PPDRecipe":
        if self.data.grid_points + self.data.uniform_points == 0:
            raise ValueError(
                "data.grid_points or uniform_points must be more than 0: L_vol needs them"
            )
        if self.model.local_points and self.data.surface_points < NEIGHBOURS:
            raise ValueError(
                f"model.local_points: 0, or data.surface_points of {NEIGHBOURS} or more"
            )
        if self.model.states == "points" and not (self.model.part_boxes and self.warm_start.share):
            raise ValueError(
                "model.states: points needs model.part_boxes and a warm start, which finds how far "
                "parts have moved; set pose instead"
            )
        if self.vary and not self.warm_start.share:
            raise ValueError(
                "vary needs a warm start, which finds what turns about which axis: set "
                "warm_start.share, or leave vary out"
            )
        return self

    @property
    def variant(self) -> str:
        """Name in Table 5 of a model trained by it; "w/o A, B" where it has no such row."""
        losses, model = self.losses, self.model
        parts = {
            "L_vol": losses.vol,
            "L_dev": losses.dev,
            "L_loc": losses.loc,
            "L_var": losses.var_state or losses.var_pivot,
            "L_adv_g": losses.adv_g,
            "CS": model.common_shape,
            "CP": model.common_pose,
        }
        off = [name for name, is_on in parts.items() if not is_on]
        return f"w/o {', '.join(off)}" if off else COMPLETE


class DepthRecipe(TrainRecipe):
    """A recipe of PPD's third stage, an encoder for what one depth camera sees.

    Attributes:
        teacher: the folder of the run whose first two stages are done.
        taught: the teacher's recipe, which is read from its folder where it is not given; `data`
            are the teacher's as well.
    """

    method: Literal["ppd_depth"] = "ppd_depth"  # pyright: ignore[reportIncompatibleVariableOverride]
    teacher: str = ""
    taught: PPDRecipe | None = None

    @model_validator(mode="before")
    @classmethod
    def _knows_its_teacher(cls, keys: Any) -> Any:
        teacher = keys.get("teacher") if isinstance(keys, dict) else None
        if not (isinstance(teacher, str) and teacher) or keys.get("taught") is not None:
            return keys
        from articugen.learning.run_folder import RunFolder  # noqa: PLC0415 - imports torch

        try:
            taught = RunFolder(Path(teacher)).recipe()
        except InvalidCheckpoint as error:
            raise ValueError(str(error)) from None
        if not isinstance(taught, PPDRecipe):
            raise ValueError(f"{teacher} is of method {taught.method}; name a run of PPD")
        return keys | {"taught": taught, "data": taught.data}

    @property
    def variant(self) -> str:
        return self.taught.variant if self.taught else self.method
