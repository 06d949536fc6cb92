"""What evaluations look like: Markdown tables beside the paper's."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from articugen.errors import InvalidCheckpoint
from articugen.learning.evaluation import paper
from articugen.store.files import UnfitFile, read_regular

Result = dict[str, Any]

OTHER_DATA = (
    "The paper's numbers were measured on other data: a yardstick, not the same test. Failed "
    "instances are counted as failed."
)

MEANS = "In tables 5 and 6 EPE is joint-aware; the paper's columns are means of its categories."

_LABELS = {"canonical": ("2", paper.LABEL_IOU), "all": ("8", paper.LABEL_IOU_ALL_POSES)}
"""By whose poses vote: the paper's table, and its numbers."""

_METRICS = (
    ("EPE x 100, joint-aware", 3, "3", "epe_joint_all", 100.0, paper.EPE),
    ("EPE x 100, transform only", 3, "3", "epe_transform_all", 100.0, paper.EPE),
    ("F-score", 2, "4", "f_score", 1.0, paper.F_SCORE),
    ("Chamfer-L1 x 100", 3, "4", "chamfer_l1", 100.0, paper.CHAMFER_L1),
    ("assigned parts", 2, "9", "assigned_parts", 1.0, paper.ASSIGNED_PARTS),
    ("part type accuracy, %", 2, "9", "type_accuracy", 1.0, paper.TYPE_ACCURACY),
)
"""Title, decimals, the paper's table, our name and factor, the paper's numbers."""

_HEADERS = ("PPD, paper", "BAE", "BSP-Net", "NSD", "NPCS (supervised)")

_DETAILS = (
    ("EPE x 100, joint-aware, all voted parts", "epe_joint_all", 100.0),
    ("EPE x 100, joint-aware, dominant part", "epe_joint_dominant", 100.0),
    ("EPE x 100, transform only, all voted parts", "epe_transform_all", 100.0),
    ("EPE x 100, transform only, dominant part", "epe_transform_dominant", 100.0),
    ("EPE x 100 if nothing moved", "epe_nothing_moves", 100.0),
    ("reconstruction IoU on the meshes' grid, %", "reconstruction_iou", 100.0),
    ("instances without any surface, %", "no_surface", 100.0),
)


MOST_BYTES = 1 << 28
"""That an evaluation may have."""


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class _Run(_Part):
    category: str
    recipe: str
    variant: str
    label_poses: Literal["canonical", "all"]


class _Measured(_Part):
    means: dict[str, float]


class _Evaluation(_Measured):
    """What `tables` needs of evaluation.json."""

    run: _Run
    depth_input: _Measured | None = None


def read_result(run: Path) -> Result:
    """Of the evaluation of a run's folder what `tables` needs.

    Raises:
        InvalidCheckpoint: there is none, or it is damaged.
    """
    path = run / "evaluation" / "evaluation.json"
    cure = f"make it with: articugen evaluate {run}"
    try:
        result = _Evaluation.model_validate_json(read_regular(path, MOST_BYTES))
    except UnfitFile as error:
        raise InvalidCheckpoint(f"{path}: {error.strerror}; move it away and {cure}") from None
    except OSError:
        raise InvalidCheckpoint(f"{path}: there is no such evaluation; {cure}") from None
    except ValidationError as error:
        first = error.errors()[0]
        what = ": ".join([".".join(map(str, first["loc"])), first["msg"]]).removeprefix(": ")
        raise InvalidCheckpoint(f"{path}: not an evaluation ({what}); {cure}") from None
    return result.model_dump(exclude_unset=True)


def markdown(result: Result) -> str:
    """One evaluation: who was evaluated, the paper's tables, all else that was measured."""
    run = result["run"]
    about = (
        f"{run['category']}: {result['objects']} test objects, {result['instances']} instances. "
        f"Recipe {run['recipe']} ({run['variant']}), seed {run['seed']}, {run['iterations']} "
        f"iterations; meshes on {run['resolution']}^3, labels by {run['label_poses']} poses."
    )
    return "\n".join([about, *_left_out(result), "", tables([result]).rstrip(), *_details(result)])


def tables(results: Sequence[Result]) -> str:
    """The paper's Tables 2 to 6 and 9, a row for each metric and category that was evaluated.

    Args:
        results: evaluations of any categories and variants. Tables 2 to 4 and 9 take the complete
            model where there is one; Tables 5 and 6 the mean over categories.
    """
    return "\n".join(
        [OTHER_DATA, *_by_category(results), *_ablation(results), *_inputs(results)]
    ) + "\n"  # fmt: skip


def _by_category(results: Sequence[Result]) -> list[str]:
    best = sorted(results, key=lambda r: r["run"]["variant"] == paper.COMPLETE)
    chosen = {r["run"]["category"]: r for r in best}
    shown = [c for c in paper.CATEGORIES if c in chosen]
    shown += [c for c in chosen if c not in shown]
    lines = ["", "| table | metric | category | here | " + " | ".join(_HEADERS) + " |"]
    lines += ["|---" * 3 + "|---:" * (1 + len(_HEADERS)) + "|"]
    poses = next(iter(chosen.values()))["run"]["label_poses"]
    table, theirs = _LABELS[poses]
    metrics = (("label IoU, %", 2, table, "label_iou", 100.0, theirs), *_METRICS)
    for title, decimals, table, name, factor, theirs in metrics:
        known = {c: factor * chosen[c]["means"][name] for c in shown if name in chosen[c]["means"]}
        if not known:
            continue
        ours = dict(known)
        if set(paper.CATEGORIES) <= set(known):
            ours["mean"] = float(np.mean([known[c] for c in paper.CATEGORIES]))
        for category, value in ours.items():
            printed = [_printed(theirs, method, category) for method in paper.METHODS]
            cells = [table, title, category, f"**{value:.{decimals}f}**", *printed]
            lines.append(f"| {' | '.join(cells)} |")
    return [*lines, "", "\\* one part stands for the whole shape."]


def _printed(rows: dict[str, paper.Row], method: str, category: str) -> str:
    columns = (*paper.CATEGORIES, "mean")
    return rows[method][columns.index(category)] if method in rows and category in columns else ""


def _ablation(results: Sequence[Result]) -> list[str]:
    variants = [r["run"]["variant"] for r in results]
    lines = [
        "",
        "| table 5: ablation | label IoU, % | paper | EPE x 100 | paper |",
        "|---|---:|---:|---:|---:|",
    ]
    for name in dict.fromkeys([*paper.ABLATION, *variants]):
        mine = [r for r in results if r["run"]["variant"] == name]
        iou, epe = _mean(mine, "label_iou", 100.0, 2), _mean(mine, "epe_joint_all", 100.0, 3)
        theirs = paper.ABLATION.get(name, ("", ""))
        lines.append(f"| {name}{_of(mine)} | {iou} | {theirs[0]} | {epe} | {theirs[1]} |")
    return lines


def _inputs(results: Sequence[Result]) -> list[str]:
    lines = [
        "",
        "| table 6: input | F-score | paper | label IoU, % | paper | EPE x 100 | paper |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    measured = [r for r in results if r["run"]["variant"] == paper.COMPLETE] or list(results)
    for name, theirs in paper.INPUTS.items():
        mine = [r | r["depth_input"] for r in measured if "depth_input" in r]
        mine = mine if name == "depth" else measured
        cells = [
            _mean(mine, "f_score", 1.0, 2), theirs[0], _mean(mine, "label_iou", 100.0, 2),
            theirs[1], _mean(mine, "epe_joint_all", 100.0, 3), theirs[2],
        ]  # fmt: skip
        lines.append(f"| {name}{_of(mine)} | {' | '.join(cells)} |")
    return [*lines, "", MEANS]


def _mean(results: Sequence[Result], name: str, factor: float, decimals: int) -> str:
    values = [r["means"][name] for r in results if name in r["means"]]
    return f"**{factor * np.mean(values):.{decimals}f}**" if values else ""


def _of(results: Sequence[Result]) -> str:
    told = sorted({f"{r['run']['category']} by {r['run']['recipe']}" for r in results})
    return f" (here: {', '.join(told)})" if told else ""


def _details(result: Result) -> list[str]:
    means = result["means"]
    lines = ["", "| also measured | |", "|---|---:|"]
    for title, name, factor in _DETAILS:
        if name in means:
            lines.append(f"| {title} | {factor * means[name]:.3f} |")
    lines += _joint_lines(result.get("joint_lines", []))
    limits = {name: value for name, value in means.items() if "_below_" in name}
    if limits:
        lines += ["", "| joints | error below | right, % |", "|---|---:|---:|"]
    for name, value in limits.items():
        what, _, limit = name.partition("_below_")
        kind, _, quantity = what.partition("_")
        angle = quantity == "direction" or (kind, quantity) == ("revolute", "state")
        unit = "°" if angle else " of the unit frame"
        lines.append(f"| {kind} {quantity} | {limit}{unit} | {value:.1f} |")
    return [*lines, ""]


def _joint_lines(joints: Sequence[dict[str, Any]]) -> list[str]:
    """The line through predicted over true states of each joint's dominant part."""
    if not joints:
        return []
    lines = ["", "| predicted over true joint state | slope | residual | of its kind in |"]
    lines += ["|---|---:|---:|---:|"]
    for joint in joints:
        unit = "rad" if joint["kind"] == "revolute" else "of the unit frame"
        fit = [" ", " "]
        if joint["slope"] is not None:
            fit = [f"{joint['slope']:.3f}", f"{joint['residual']:.3f} {unit}"]
        found = f"{joint['predicted']} of {joint['states']}"
        lines.append(f"| joint {joint['joint']}, {joint['kind']} | {' | '.join(fit)} | {found} |")
    return lines


def _left_out(result: Result) -> list[str]:
    """What the release's protocol does not count."""
    if "left_out" not in result:
        return []
    left = result["left_out"]
    return [
        f"Measured as the authors' release does; left out for want of a surface: label IoU of "
        f"{left['instances_label_iou']} instances, EPE of {left['instances_epe']} instances and "
        f"{left['parts_epe']} true parts."
    ]
