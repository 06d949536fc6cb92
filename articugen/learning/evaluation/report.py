"""What evaluations look like: Markdown tables beside the paper's."""

from collections.abc import Mapping, Sequence

import numpy as np

from articugen.learning.evaluation import paper
from articugen.learning.evaluation.results import Evaluation, JointLine, RunEvaluation

OTHER_DATA = (
    "The paper's numbers were measured on other data: a yardstick, not the same test. Failed "
    "instances are counted as failed."
)

MEANS = "In tables 5 and 6 EPE is joint-aware; the paper's columns are means of its categories."

MATCHED = (
    "Parts matched in every instance by the points they share, not by votes; lengths of the unit "
    "frame; what has no part does not move, and its joint is 90° and the cube's diagonal off."
)

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

_MATCHED = (
    ("part IoU, %", 1, "matched_part_iou", 100.0),
    ("rotation, °", 2, "matched_rotation_degrees_all", 1.0),
    ("of moving parts", 2, "matched_rotation_degrees_moving", 1.0),
    ("translation x 100", 2, "matched_translation_all", 100.0),
    ("of moving parts", 2, "matched_translation_moving", 100.0),
    ("joint direction, °", 2, "matched_direction_degrees", 1.0),
    ("pivot x 100", 2, "matched_pivot_distance", 100.0),
    ("state, °", 2, "matched_state_degrees", 1.0),
    ("state x 100", 2, "matched_state_length", 100.0),
)
"""Title, decimals, our name and factor; `matched` says what they are."""

_HEADERS = ("PPD, paper", "BAE", "BSP-Net", "NSD", "NPCS (supervised)")

_DETAILS = (
    ("EPE x 100, joint-aware, all voted parts", "epe_joint_all", 100.0),
    ("EPE x 100, joint-aware, dominant part", "epe_joint_dominant", 100.0),
    ("EPE x 100, transform only, all voted parts", "epe_transform_all", 100.0),
    ("EPE x 100, transform only, dominant part", "epe_transform_dominant", 100.0),
    ("EPE x 100 if nothing moved", "epe_nothing_moves", 100.0),
    ("reconstruction IoU on the meshes' grid, %", "reconstruction_iou", 100.0),
    ("label IoU of the true labels of that grid's voxels, %", "voxels_label_iou", 100.0),
    ("instances without any surface, %", "no_surface", 100.0),
)


def markdown(result: RunEvaluation) -> str:
    """Return one evaluation: who was evaluated, the paper's tables, all else that was measured."""
    run = result.run
    others = "test objects" if run.on is None else f"objects of {run.on}, none trained on"
    about = (
        f"{run.category}: {result.objects} {others}, {result.instances} instances. "
        f"Recipe {run.recipe} ({run.variant}), seed {run.seed}, {run.iterations} "
        f"iterations; meshes on {run.resolution}^3, labels by {run.label_poses} poses, "
        f"{'all' if run.states is None else f'at most {run.states}'} random states an object."
    )
    return "\n".join([about, *_left_out(result), "", tables([result]).rstrip(), *_details(result)])


def tables(results: Sequence[RunEvaluation]) -> str:
    """The paper's Tables 2 to 6 and 9, a row for each metric and category that was evaluated.

    Args:
        results: evaluations of any methods, categories and variants. Tables 2 to 4 and 9 take the
            complete model where there is one, and what sees depth only where nothing else was
            evaluated; Tables 5 and 6, of PPD alone, the mean over categories.
    """
    by_depth = [r for r in results if r.run.input == "depth"]
    whole = [r for r in results if r.run.input == "complete"] or by_depth
    lines, of_ppd = _by_category(whole), [r for r in whole if r.run.method == paper.METHOD]
    if of_ppd:
        lines += _ablation(of_ppd)
    if of_ppd or by_depth:
        lines += _inputs([*of_ppd, *by_depth])
    lines += _as_pose_estimators(whole)
    return "\n".join([OTHER_DATA, *lines]) + "\n"


def _by_category(results: Sequence[RunEvaluation]) -> list[str]:
    chosen = _complete(results)
    methods = list(dict.fromkeys(r.run.method for r in results))
    here = [f"here: {method}" for method in methods] if len(methods) > 1 else ["here"]
    lines = ["", f"| {' | '.join(['table', 'metric', 'category', *here, *_HEADERS])} |"]
    lines += ["|---" * 3 + "|---:" * (len(here) + len(_HEADERS)) + "|"]
    categories = dict.fromkeys([*paper.CATEGORIES, *(r.run.category for r in results), "mean"])
    table, theirs = _LABELS[results[0].run.label_poses]
    names = {"label_iou": "label IoU, %"}
    if finer := next((r.run.finer for r in results if r.run.finer), None):
        names["finer_label_iou"] = f"label IoU, %, meshes on {finer}^3"
    labels = ((title, 2, table, name, 100.0, theirs) for name, title in names.items())
    metrics = (*labels, *_METRICS)
    for title, decimals, table, name, factor, theirs in metrics:
        measured = {key: r.means[name] for key, r in chosen.items() if name in r.means}
        ours = _with_means({key: factor * value for key, value in measured.items()})
        for category in categories:
            values = [ours.get((method, category)) for method in methods]
            if any(value is not None for value in values):
                cells = ["" if v is None else f"**{v:.{decimals}f}**" for v in values]
                cells += [_printed(theirs, method, category) for method in paper.METHODS]
                lines.append(f"| {' | '.join([table, title, category, *cells])} |")
    return [*lines, "", "\\* one part stands for the whole shape."]


def _complete(results: Sequence[RunEvaluation]) -> dict[tuple[str, str], RunEvaluation]:
    """By method and category, the complete model where there is one."""
    best = sorted(results, key=lambda r: r.run.variant == paper.COMPLETE)
    return {(r.run.method, r.run.category): r for r in best}


def _as_pose_estimators(results: Sequence[RunEvaluation]) -> list[str]:
    """A row for each method and category; blank where the method knows no motions or joints."""
    chosen = {key: r for key, r in _complete(results).items() if "matched_part_iou" in r.means}
    if not chosen:
        return []
    titles = ["as SCAPO and OP-Align measure", *(title for title, *_ in _MATCHED)]
    lines = ["", f"| {' | '.join(titles)} |", "|---" + "|---:" * len(_MATCHED) + "|"]
    for (method, category), result in sorted(chosen.items()):
        means = result.means
        cells = [
            f"**{factor * means[name]:.{decimals}f}**" if name in means else ""
            for _, decimals, name, factor in _MATCHED
        ]
        lines.append(f"| {' | '.join([f'{category}, {method}', *cells])} |")
    return [*lines, "", MATCHED]


def _with_means(values: dict[tuple[str, str], float]) -> dict[tuple[str, str], float]:
    """The same by method and category, and "mean" for methods with all the paper's categories."""
    means = {}
    for method in {method for method, _ in values}:
        each = [values[method, c] for c in paper.CATEGORIES if (method, c) in values]
        if len(each) == len(paper.CATEGORIES):
            means[method, "mean"] = float(np.mean(each))
    return values | means


def _printed(rows: Mapping[str, paper.Row], method: str, category: str) -> str:
    columns = (*paper.CATEGORIES, "mean")
    return rows[method][columns.index(category)] if method in rows and category in columns else ""


def _ablation(results: Sequence[RunEvaluation]) -> list[str]:
    variants = [r.run.variant for r in results]
    lines = [
        "",
        "| table 5: ablation | label IoU, % | paper | EPE x 100 | paper |",
        "|---|---:|---:|---:|---:|",
    ]
    for name in dict.fromkeys([*paper.ABLATION, *variants]):
        mine = [r for r in results if r.run.variant == name]
        iou, epe = _mean(mine, "label_iou", 100.0, 2), _mean(mine, "epe_joint_all", 100.0, 3)
        theirs = paper.ABLATION.get(name, ("", ""))
        lines.append(f"| {name}{_of(mine)} | {iou} | {theirs[0]} | {epe} | {theirs[1]} |")
    return lines


def _inputs(results: Sequence[RunEvaluation]) -> list[str]:
    lines = [
        "",
        "| table 6: input | F-score | paper | label IoU, % | paper | EPE x 100 | paper |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, theirs in paper.INPUTS.items():
        of_input = [r for r in results if r.run.input == name]
        measured = [r for r in of_input if r.run.variant == paper.COMPLETE] or of_input
        cells = [
            _mean(measured, "f_score", 1.0, 2), theirs[0],
            _mean(measured, "label_iou", 100.0, 2), theirs[1],
            _mean(measured, "epe_joint_all", 100.0, 3), theirs[2],
        ]  # fmt: skip
        lines.append(f"| {name}{_of(measured)} | {' | '.join(cells)} |")
    return [*lines, "", MEANS]


def _mean(results: Sequence[Evaluation], name: str, factor: float, decimals: int) -> str:
    values = [r.means[name] for r in results if name in r.means]
    return f"**{factor * np.mean(values):.{decimals}f}**" if values else ""


def _of(results: Sequence[RunEvaluation]) -> str:
    names = sorted({f"{r.run.category} by {r.run.recipe}" for r in results})
    return f" (here: {', '.join(names)})" if names else ""


def _details(result: Evaluation) -> list[str]:
    lines = ["", "| also measured | |", "|---|---:|"]
    for title, name, factor in _DETAILS:
        if name in result.means:
            lines.append(f"| {title} | {factor * result.means[name]:.3f} |")
    lines += _joint_lines(result.joint_lines)
    limits = {name: value for name, value in result.means.items() if "_below_" in name}
    if limits:
        lines += ["", "| joints | error below | right, % |", "|---|---:|---:|"]
    for name, value in limits.items():
        what, _, limit = name.partition("_below_")
        kind, _, quantity = what.partition("_")
        angle = quantity == "direction" or (kind, quantity) == ("revolute", "state")
        unit = "°" if angle else " of the unit frame"
        lines.append(f"| {kind} {quantity} | {limit}{unit} | {value:.1f} |")
    return [*lines, ""]


def _joint_lines(joints: Sequence[JointLine]) -> list[str]:
    """Return the line through predicted over true states of each joint's dominant part."""
    if not joints:
        return []
    lines = ["", "| predicted over true joint state | slope | residual | of its kind in |"]
    lines += ["|---|---:|---:|---:|"]
    for joint in joints:
        unit = "rad" if joint.kind == "revolute" else "of the unit frame"
        fit = "  |  "
        if joint.slope is not None:
            fit = f"{joint.slope:.3f} | {joint.residual:.3f} {unit}"
        found = f"{joint.predicted} of {joint.states}"
        lines.append(f"| joint {joint.joint}, {joint.kind} | {fit} | {found} |")
    return lines


def _left_out(result: Evaluation) -> list[str]:
    """What the release's protocol does not count."""
    if result.left_out is None:
        return []
    left = result.left_out
    return [
        f"Measured as the authors' release does; left out for want of a surface: label IoU of "
        f"{left.instances_label_iou} instances, EPE of {left.instances_epe} instances and "
        f"{left.parts_epe} true parts."
    ]
