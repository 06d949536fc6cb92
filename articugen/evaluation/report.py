"""What evaluations look like: tables in Markdown, aligned to be read in a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from articugen.core.arrays import grouped
from articugen.evaluation import paper
from articugen.evaluation.metrics import line_through
from articugen.evaluation.results import EvaluatedRun, Evaluation, JointState, RunEvaluation

OTHER_DATA = """\
The paper's rows were measured on other data: a yardstick, not the same test. Failed
instances are counted as failed. Floor: one part for everything, which scores 1 / K^2 where there
are K true parts; nothing moves. ± is the standard deviation over seeds; - was not measured.
T2: the paper's Table 2."""

MARKS = {"": "", "groups": " (g)", "labels": " (s)"}
KNOWN = {
    "groups": "(g): training is given which instances show one object.",
    "labels": "(s): supervised, training is given the true parts.",
}

MATCHED = """\
Parts matched in every instance by the points they share, not by votes; lengths x 100 of the unit
frame; what has no part does not move, and its joint is 90° and the cube's diagonal off."""


class Metric(NamedTuple):
    """A measure: the paper's table, what a narrow column and a table of its own are called, our
    name, factor and decimals, and the paper's numbers."""

    table: str
    header: str
    title: str
    name: str
    factor: float
    decimals: int
    theirs: paper.Numbers = {}  # noqa: RUF012 - never changed


LABELS = (
    Metric("2", "label IoU", "label IoU, %", "label_iou", 100.0, 2, paper.LABEL_IOU),
    Metric("2", "finer", "label IoU, %, finer meshes", "finer_label_iou", 100.0, 2,
           paper.LABEL_IOU),
    Metric("8", "all", "label IoU, %, all poses vote", "label_iou_all_poses", 100.0, 2,
           paper.LABEL_IOU_ALL_POSES),
    Metric("8", "less T2", "all poses less canonical ones", "difference", 100.0, 2,
           paper.DIFFERENCE),
    Metric("9", "parts", "assigned parts", "assigned_parts", 1.0, 2, paper.ASSIGNED_PARTS),
    Metric("9", "kinds", "part type accuracy, %", "type_accuracy", 1.0, 2, paper.TYPE_ACCURACY),
)  # fmt: skip
SHAPES = (
    Metric("3", "EPE", "EPE x 100, by joints", "epe_joint_all", 100.0, 3, paper.EPE),
    Metric("3", "by transforms", "EPE x 100, by transforms", "epe_transform_all", 100.0, 3,
           paper.EPE),
    Metric("4", "F-score", "F-score", "f_score", 1.0, 2, paper.F_SCORE),
    Metric("4", "finer", "F-score, finer meshes", "finer_f_score", 1.0, 2, paper.F_SCORE),
    Metric("4", "Chamfer-L1", "Chamfer-L1 x 100", "chamfer_l1", 100.0, 3, paper.CHAMFER_L1),
    Metric("4", "finer", "Chamfer-L1 x 100, finer meshes", "finer_chamfer_l1", 100.0, 3,
           paper.CHAMFER_L1),
)  # fmt: skip
POSES = (
    Metric("", "part IoU", "", "matched_part_iou", 100.0, 1),
    Metric("", "turn °", "", "matched_rotation_degrees_all", 1.0, 2),
    Metric("", "moving", "", "matched_rotation_degrees_moving", 1.0, 2),
    Metric("", "shift", "", "matched_translation_all", 100.0, 2),
    Metric("", "moving", "", "matched_translation_moving", 100.0, 2),
    Metric("", "axis °", "", "matched_direction_degrees", 1.0, 2),
    Metric("", "pivot", "", "matched_pivot_distance", 100.0, 2),
    Metric("", "state °", "", "matched_state_degrees", 1.0, 2),
    Metric("", "state", "", "matched_state_length", 100.0, 2),
    Metric("", "E", "", "matched_motion", 100.0, 2),
)
"""`matched` says what they are."""

MEAN = "mean"
"""Of the paper's categories, where there are all."""
THERE = ""
"""The mean of the categories that there are."""

_DETAILS = (
    ("EPE x 100, joint-aware, all voted parts", "epe_joint_all", 100.0),
    ("EPE x 100, joint-aware, dominant part", "epe_joint_dominant", 100.0),
    ("EPE x 100, transform only, all voted parts", "epe_transform_all", 100.0),
    ("EPE x 100, transform only, dominant part", "epe_transform_dominant", 100.0),
    ("EPE x 100 if nothing moved", "epe_nothing_moves", 100.0),
    ("reconstruction IoU on the meshes' grid, %", "reconstruction_iou", 100.0),
    ("label IoU of the true labels of that grid's voxels, %", "voxels_label_iou", 100.0),
    ("instances without any surface, %", "no_surface", 100.0),
    ("joints too still for motions to show a direction, %", "direction_not_judged", 1.0),
)


_OF_OBJECTS = (*LABELS[:2], POSES[0], SHAPES[0], *POSES[-2:], SHAPES[2])
"""Columns of the table of objects."""


@dataclass(frozen=True)
class Line:
    """The runs of one recipe: a row of the tables."""

    title: str
    runs: tuple[RunEvaluation, ...]

    @property
    def run(self) -> EvaluatedRun:
        """First of the runs."""
        return self.runs[0].run

    def values(self, metric: Metric, category: str) -> list[float]:
        """Return a measure of each seed; of a mean of categories one value."""
        if category in (MEAN, THERE):
            names = dict.fromkeys(r.run.category for r in self.runs)
            some = [self.values(metric, c) for c in (paper.CATEGORIES if category else names)]
            if len(some) == 1 or not all(some):
                return some[0] if len(some) == 1 else []
            return [float(np.mean([np.mean(seeds) for seeds in some]))]
        numbers = [_measured(r, metric.name) for r in self.runs if r.run.category == category]
        return [metric.factor * number for number in numbers if number is not None]

    def rows(self, columns: Sequence[Column]) -> Iterator[list[str]]:
        """Yield the row of means, and one of their spread over several seeds."""
        cells = [(m, self.values(m, category)) for _, m, category in columns]
        yield [self.title, *(f"{np.mean(v):.{m.decimals}f}" if v else "-" for m, v in cells)]
        if (most := max(len(v) for _, v in cells)) > 1:
            spread = [f"{np.std(v, ddof=1):.{m.decimals}f}" if len(v) > 1 else "" for m, v in cells]
            yield [f"  ± of {most} seeds", *spread]


Column = tuple[str, Metric, str]
"""A header, and what is below it: a measure of a category."""


def markdown(result: RunEvaluation) -> str:
    """Return one evaluation: who was evaluated, the paper's tables, all else that was measured."""
    run = result.run
    others = "test objects" if run.on is None else f"objects of {run.on}"
    poses = "canonical poses" + (", and by all" if run.label_poses == "both" else "")
    about = (
        f"{run.category}: {result.objects} {others}, {result.instances} instances. "
        f"Recipe {run.recipe} ({run.variant}), seed {run.seed}, {run.iterations} "
        f"iterations; meshes on {run.resolution}^3"
        f"{f', finer ones on {run.finer}^3' if run.finer else ''}, labels by {poses}, "
        f"{'all' if run.states is None else f'at most {run.states}'} random states an object."
    )
    lines = [about]
    if (left := result.left_out) is not None:
        lines.append(
            f"Measured as the authors' release does; left out for want of a surface: label IoU of "
            f"{left.instances_label_iou} instances, EPE of {left.instances_epe} instances and "
            f"{left.parts_epe} true parts."
        )
    return "\n".join([*lines, "", tables([result]).rstrip(), *_details(result)])


def tables(results: Sequence[RunEvaluation], refused: Mapping[str, str] | None = None) -> str:
    """Return the paper's Tables 2 to 6, 8 and 9, ours beside the paper's, a row for each recipe.

    Args:
        results: evaluations of any methods, categories and seeds; of several with the same recipe,
            category and seed the last one counts. Where there is one category alone, tables have
            measures for columns, else categories.
        refused: by the recipe's name, why others could not be trained.
    """
    lines = _lines(results)
    whole = [line for line in lines if line.run.input == "complete"] or lines
    categories = [c for c in paper.CATEGORIES if c in {r.run.category for r in results}]
    categories = list(dict.fromkeys([*categories, *sorted(r.run.category for r in results)]))
    text = [OTHER_DATA, *(KNOWN[k] for k in KNOWN if any(x.run.knows == k for x in lines))]
    text += ["", *_overview(lines)]
    if len(categories) == 1:
        for what, metrics in (("labels", LABELS), ("shapes", SHAPES)):
            columns = [(f"T{m.table} {m.header}", m, categories[0]) for m in metrics]
            text += _by_method(f"{categories[0]}, {what}", columns, whole)
    else:
        for m in (*LABELS, *SHAPES):
            columns = [(category, m, category) for category in (*categories, MEAN)]
            text += _by_method(f"table {m.table}: {m.title}", columns, whole)
    of_ppd = [line for line in whole if line.run.method == paper.METHOD]
    over = categories[0] if len(categories) == 1 else "means"
    columns = [(m.title, m, THERE) for m in (LABELS[0], SHAPES[0])]
    if len(of_ppd) > 1:
        printed = {name: (f"paper, mean: {name}", c) for name, c in paper.ABLATION.items()}
        title = f"{over}, table 5: ablation"
        text += _table(title, columns, of_ppd, printed, lambda line: line.run.variant)
    if any(line.run.input == "depth" for line in lines):
        printed = {name: (f"paper, mean: {name}", c) for name, c in paper.INPUTS.items()}
        columns = [(m.title, m, THERE) for m in (SHAPES[2], LABELS[0], SHAPES[0])]
        some = [line for line in lines if line.run.method in (paper.METHOD, "ppd_depth")]
        text += _table(f"{over}, table 6: input", columns, some, printed, lambda x: x.run.input)
    for category in categories:
        columns = [(m.header, m, category) for m in POSES]
        text += _table(f"{category}, as SCAPO and OP-Align", columns, whole, {}, lambda _: "")
    if any("SCAPO" in line for line in text):
        text += ["", MATCHED]
    if any("*" in line for line in text):
        text += ["", "\\* one part stands for the whole shape."]
    text += [f"\nNot trained: {name}: {sentence}" for name, sentence in (refused or {}).items()]
    return "\n".join(text) + "\n"


def _measured(result: RunEvaluation, name: str) -> float | None:
    means = result.means
    if name == "difference" and "label_iou_all_poses" in means:
        return means["label_iou_all_poses"] - means["label_iou"]
    return means.get(name)


def _lines(results: Sequence[RunEvaluation]) -> list[Line]:
    """Return a line for each recipe, in the paper's order of methods; titles differ."""
    groups: dict[tuple, dict[tuple, RunEvaluation]] = {}
    for result in results:
        run = result.run
        key = (run.method, run.recipe, run.variant, run.recipe_sha256, run.input, run.budget)
        groups.setdefault(key, {})[run.category, run.seed] = result
    kept = [tuple(group.values()) for group in groups.values()]
    firsts = [runs[0].run for runs in kept]
    titles = [f"{r.recipe}{MARKS[r.knows]}{', depth' * (r.input == 'depth')}" for r in firsts]
    lines = []
    for title, run, runs in zip(titles, firsts, kept, strict=True):
        more = ""
        if titles.count(title) > 1:  # other settings than the recipe's, or another budget
            more = f" #{run.recipe_sha256[:4]}" + (f", {run.budget:g} s" if run.budget else "")
        lines.append(Line(title + more, runs))
    order = ["one_part", *paper.METHODS]
    return sorted(lines, key=lambda x: order.index(x.run.method) if x.run.method in order else 99)


def _row_of(line: Line) -> str:
    """Return the paper's method that a line stands beside; "" for none."""
    is_small = (line.run.method, len(line.runs[0].labels)) == ("bsp", 8)
    name = "bsp8" if is_small else line.run.method.removesuffix("_depth")
    return name if name in paper.METHODS else ""


def _overview(lines: Sequence[Line]) -> list[str]:
    """Return what was trained: how large it is, and for how long."""
    rows = [["recipe", "parts", "parameters", "iterations", "minutes", "seeds"]]
    for name in (*paper.METHODS, ""):
        some = [line for line in lines if _row_of(line) == name]
        if some and name:
            about = paper.METHODS[name]
            numbers = [f"{n:,.0f}" if n else "-" for n in (about.parts, about.parameters)]
            rows.append([f"paper: {about.title}", *numbers, "-", "-", "-"])
        for line in some:
            runs = [r.run for r in line.runs]
            took = [r.seconds / 60.0 for r in runs if r.seconds is not None]
            rows.append([
                line.title, _range([len(r.labels) for r in line.runs]),
                _range([r.parameters for r in runs if r.parameters is not None]),
                _range([r.iterations for r in runs]), _range(took, ".1f"),
                f"{len({r.seed for r in runs})}",
            ])  # fmt: skip
    return _aligned(rows)


def _range(numbers: Sequence[float], form: str = ",") -> str:
    ends = [f"{end:{form}}" for end in (min(numbers), max(numbers))] if numbers else ["-"]
    return " to ".join(dict.fromkeys(ends))


def _by_method(title: str, columns: Sequence[Column], lines: Sequence[Line]) -> list[str]:
    """Return a table of the paper's methods and ours, below the floor."""
    printed = {"floor": ("floor", [_floor(m, category, lines) for _, m, category in columns])}
    order = (*paper.CATEGORIES, MEAN)
    for name, about in paper.METHODS.items():
        cells = [
            m.theirs[name][order.index(c)] if name in m.theirs and c in order else ""
            for _, m, c in columns
        ]
        parts = f", {about.parts} parts" if about.parts else ""
        printed[name] = (f"paper: {about.title}{parts}", cells)
    return _table(title, columns, lines, printed, _row_of)


def _floor(metric: Metric, category: str, lines: Sequence[Line]) -> str:
    """Return what one part for everything scores, or an error where nothing moves."""
    runs = [r for line in lines for r in line.runs if r.run.category == category]
    if metric.name.startswith("epe_"):
        still = [v for r in runs if (v := r.means.get("epe_nothing_moves")) is not None]
        return f"{metric.factor * np.mean(still):.{metric.decimals}f}" if still else ""
    if runs and "label_iou" in metric.name:
        return f"{100.0 / len(runs[0].votes[0]) ** 2:.2f}"
    return ""


def _table(
    title: str,
    columns: Sequence[Column],
    lines: Sequence[Line],
    printed: Mapping[str, tuple[str, Sequence[str]]],
    key: Callable[[Line], str],
) -> list[str]:
    """Return a table, without what nobody measured.

    Args:
        printed: rows of others, the title and the cells; ours with the same key stand below.
    """
    there = [i for i, (_, m, c) in enumerate(columns) if any(x.values(m, c) for x in lines)]
    if not there:
        return []
    rows = [[title, *(columns[i][0] for i in there)]]
    for name in dict.fromkeys([*printed, *map(key, lines)]):
        if name in printed and any(cells := [printed[name][1][i] for i in there]):
            rows.append([printed[name][0], *(cell or "-" for cell in cells)])
        for line in lines:
            if key(line) == name:
                rows += line.rows([columns[i] for i in there])
    return ["", *_aligned(rows)]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return Markdown whose columns are as wide as their widest cell; numbers end alike."""
    width = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"| {' | '.join([row[0].ljust(width[0]), *map(str.rjust, row[1:], width[1:])])} |"
        for row in rows
    ]
    rule = "|".join(["-" * (width[0] + 2), *("-" * (w + 1) + ":" for w in width[1:])])
    return [lines[0], f"|{rule}|", *lines[1:]]


def _details(result: Evaluation) -> list[str]:
    lines = ["", "| also measured | |", "|---|---:|"]
    for title, name, factor in _DETAILS:
        if name in result.means:
            lines.append(f"| {title} | {factor * result.means[name]:.3f} |")
    lines += _joint_lines(result.joint_states)
    limits = {name: value for name, value in result.means.items() if "_below_" in name}
    if limits:
        lines += ["", "| joints | error below | right, % |", "|---|---:|---:|"]
    for name, value in limits.items():
        what, _, limit = name.partition("_below_")
        kind, _, quantity = what.partition("_")
        angle = quantity == "direction" or (kind, quantity) == ("revolute", "state")
        unit = "°" if angle else " of the unit frame"
        lines.append(f"| {kind} {quantity} | {limit}{unit} | {value:.1f} |")
    return [*lines, *_objects(result), ""]


def _objects(result: Evaluation) -> list[str]:
    """Return a row an object, means over its instances, the worst labels first."""
    columns = [m for m in _OF_OBJECTS if any(m.name in row.values for row in result.measures)]
    table = []
    for name, values in grouped((row.object, row.values) for row in result.measures).items():
        known = [(m, [row[m.name] for row in values if m.name in row]) for m in columns]
        means = [(m, m.factor * np.mean(v) if v else np.nan) for m, v in known]
        cells = [name.replace("|", "\\|"), f"{len(values)}"]
        cells += [f"{mean:.{m.decimals}f}" for m, mean in means]
        table.append(([mean for _, mean in means[:1]], cells))
    table.sort(key=lambda row: np.nan_to_num(row[0], nan=-1.0).tolist())
    head = ["object", "instances", *(m.header for m in columns)]
    return ["", *_aligned([head, *(cells for _, cells in table)])] if table else []


def _joint_lines(states: Sequence[JointState]) -> list[str]:
    """Return the line through predicted over true states of each joint's dominant part."""
    if not states:
        return []
    lines = ["", "| predicted over true joint state | slope | residual | of its kind in |"]
    lines += ["|---|---:|---:|---:|"]
    groups = grouped(((s.joint, s.kind), (s.true, s.predicted)) for s in states)
    for (joint, kind), pairs in sorted(groups.items()):
        known = [pair for pair in pairs if pair[1] is not None]
        line = line_through(*np.array(known, np.float64).reshape(-1, 2).T)
        unit = "rad" if kind == "revolute" else "of the unit frame"
        fit = f"{line[0]:.3f} | {line[1]:.3f} {unit}" if line else "  |  "
        lines.append(f"| joint {joint}, {kind} | {fit} | {len(known)} of {len(pairs)} |")
    return lines
