"""What an evaluation found, as records that are written to and read from JSON."""

import json
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from articugen.core.errors import InvalidCheckpoint
from articugen.core.files import read_or_refuse, write_atomically
from articugen.core.yaml_files import fault_in

FILE = "evaluation.json"
MOST_BYTES = 1 << 28
"""That an evaluation may have."""

Kind = Literal["revolute", "prismatic"]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)


class _OfJoint(_Record):
    """Values of one joint, counted from 0, of one instance; radians, or lengths in the unit
    frame."""

    object: str
    state_index: int
    joint: int
    kind: Kind


class JointState(_OfJoint):
    """The true state, and that predicted by the part that stands for the joint; None where there is
    no such part, or its joint is of another kind."""

    true: float
    predicted: float | None


class JointError(_OfJoint):
    """Error of a predicted joint since the canonical pose; None where the joint failed.

    `direction` is the angle between the axes, `axis` the distance between those of revolute joints.
    """

    state: float | None
    direction: float | None
    axis: float | None


class Measures(_Record):
    """Measures of one instance: of several joints, the mean over them."""

    object: str
    state_index: int
    values: dict[str, float]


class LeftOut(_Record):
    """Numbers of instances and true parts that the release's protocol does not count."""

    instances_label_iou: int = 0
    instances_epe: int = 0
    parts_epe: int = 0


class Evaluation(_Record):
    """Measures on the test objects of a data set.

    Attributes:
        means: of every metric over all test instances; what a method does not know is not there.
        votes: (P, K) of the training instances, from which `labels` and `dominant` follow.
        labels, dominant: (P,) the true part that each predicted part stands for, -1 for none; the
            latter names each true part once at most.
        objects, instances: how many were evaluated.
        left_out: of the release's protocol alone.
        joint_states, joint_errors: empty for a method without joints.
        measures: of every instance, by the names of `means`; empty in evaluations of before.
    """

    means: dict[str, float]
    votes: tuple[tuple[float, ...], ...]
    labels: tuple[int, ...]
    dominant: tuple[int, ...]
    objects: int
    instances: int
    left_out: LeftOut | None = None
    joint_states: tuple[JointState, ...] = ()
    joint_errors: tuple[JointError, ...] = ()
    measures: tuple[Measures, ...] = ()


class EvaluatedRun(_Record):
    """Run that was evaluated, and how.

    Attributes:
        method: whose run it is; the paper's ablation is of `paper.METHOD` alone.
        knows: `labels` where training is given true parts, `groups` where it is given which
            instances show one object; else nothing.
        recipe_sha256: of the recipe, before it was scaled to a budget; runs of one differ by
            category and seed alone.
        parameters: numbers that were learned.
        seconds, budget: CPU seconds of training, or of the clock on a GPU, and how many there were
            to be.
        input: what it reconstructs from: complete clouds, or what one depth camera sees.
        variant: the row of Table 5 that it belongs to.
        label_poses: whose poses vote for labels: canonical ones, or those and all as well.
        states: random ones of each object; None is all.
        resolution: of the grid of its meshes.
        finer: of the second grid by which labels are measured.
        on: the folder of the data set whose objects were tested, where that is another one than
            the run's.
    """

    method: str = "ppd"
    input: Literal["complete", "depth"] = "complete"
    category: str
    recipe: str
    variant: str
    knows: Literal["", "groups", "labels"] = ""
    recipe_sha256: str = ""
    parameters: int | None = None
    seconds: float | None = None
    budget: float | None = None
    seed: int
    iterations: int
    commit: str | None = None
    protocol: str = "paper"
    label_poses: Literal["canonical", "both"] = "canonical"
    states: int | None = None
    resolution: int
    finer: int | None = None
    on: str | None = None


class RunEvaluation(Evaluation):
    """The evaluation of a run."""

    run: EvaluatedRun

    def write(self, folder: Path) -> None:
        """Write evaluation.json, which `read_evaluation` reads."""
        fields = {k: v for k, v in self.model_dump(mode="json").items() if v is not None}
        text = json.dumps({"run": fields.pop("run"), **fields}, indent=1)
        write_atomically(folder / FILE, f"{text}\n".encode())


def read_evaluation(run: Path, folder: str = "evaluation") -> RunEvaluation:
    """Return the evaluation in this folder, by default that by the paper's protocol, of a run.

    Raises:
        InvalidCheckpoint: there is none, or it is damaged.
    """
    path = run / folder / FILE
    cure = f"make it with: articugen evaluate {run}"
    try:
        text = read_or_refuse(path, MOST_BYTES, InvalidCheckpoint, cure)
        return RunEvaluation.model_validate_json(text)
    except ValidationError as error:
        raise InvalidCheckpoint(f"{path}: not an evaluation ({fault_in(error)}); {cure}") from None
