"""Plots of plain numbers: training curves, joint accuracy, slices of part fields."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.errors import ArticugenError, MissingExtra
from articugen.core.records import Floats
from articugen.evaluation.results import Evaluation, JointError, JointLine, JointState

try:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter
except ImportError:
    raise MissingExtra("matplotlib", "ppd") from None

INK, GREY, BLUE = "#333333", "#8a8a8a", "#4477aa"

DEGREES = np.linspace(0.0, 30.0, 121)
LENGTHS = np.linspace(0.0, 0.2, 121)


def curves(
    metrics: Sequence[dict[str, Any]], path: Path, titles: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Every loss term and what was measured on held-out objects, against the iteration.

    Args:
        metrics: the records of a run's metrics.jsonl.
        titles: of some curves, instead of their names.
    """
    panels, borders = curve_panels(metrics)
    columns = min((5, 4), key=lambda columns: -len(panels) % columns)
    axes = _grid(max(len(panels), 1), columns, width=2.6, height=2.0)
    end = max((r["iteration"] for r in metrics), default=1)
    for axis, (title, iterations, values, is_loss) in zip(axes, panels, strict=False):
        _curve(axis, np.array(iterations), np.array(values), is_loss)
        _title(axis, titles.get(title, title), INK if is_loss else BLUE)
        axis.set_xlim(0, 1.02 * end)
        for stage, border in enumerate(borders):
            axis.axvline(border, color=GREY, linewidth=0.8, linestyle=(0, (3, 3)))
            if axis is axes[0]:
                axis.text(border, 1.0, f"stage {stage + 2} ", color=GREY, fontsize=7.5, ha="right",
                          va="top", transform=axis.get_xaxis_transform())  # fmt: skip
    for axis in axes[-columns:]:
        axis.set_xlabel("iteration")
    _save(axes, path)


def curve_panels(
    metrics: Sequence[dict[str, Any]],
) -> tuple[list[tuple[str, list[int], list[float], bool]], list[int]]:
    """Return (name, iterations, values, whether it is a loss) of each curve; where stages end."""
    panels: list[tuple[str, list[int], list[float], bool]] = []
    for key, before in (("terms", ""), ("validation", "held-out ")):
        records = [record for record in metrics if key in record]
        for name in dict.fromkeys(str(name) for record in records for name in record[key]):
            mine = [record for record in records if name in record[key]]
            values = [record[key][name] for record in mine]
            panels.append((before + name, [r["iteration"] for r in mine], values, not before))
    learned = [record for record in metrics if "terms" in record]
    return panels, [a["iteration"] for a, b in pairwise(learned) if a["stage"] != b["stage"]]


def _curve(axis: Axes, iterations: NDArray[np.int64], values: Floats, is_loss: bool) -> None:
    colour = INK if is_loss else BLUE
    if is_loss and len(values) > 40:
        axis.plot(iterations, values, color=colour, alpha=0.25, linewidth=0.6)
        axis.plot(iterations, running_mean(values, len(values) // 60), color=colour, linewidth=1.4)
    else:
        axis.plot(iterations, values, color=colour, linewidth=1.4, marker="o", markersize=2.5)
    positive = values[values > 0]
    if is_loss and len(positive) > 0.9 * len(values) and np.ptp(np.log10(positive)) > 0.7:
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(NullFormatter())


def running_mean(values: Floats, width: int) -> Floats:
    """Return the mean of up to `width` values on either side, fewer near the ends: (n,)."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    reach = np.minimum(np.minimum(at, len(values) - 1 - at), width)
    return (total[at + reach + 1] - total[at - reach]) / (2 * reach + 1)


def accuracy(errors: Sequence[float | None], thresholds: Floats) -> Floats:
    """Percent of errors below each threshold; None has failed at all of them."""
    known = np.sort(np.array([e for e in errors if e is not None], np.float64))
    return 100.0 * np.searchsorted(known, thresholds, side="left") / max(len(errors), 1)


def joints(result: Evaluation, colours: Sequence[str], path: Path) -> None:
    """Predicted against true joint states, and the share of joints right within a threshold.

    Args:
        result: with joint states.
        colours: of part 0, 1, ...; joint j has that of part j + 1.
    """
    kinds = [
        kind
        for kind in ("revolute", "prismatic")
        if any(state.kind == kind for state in result.joint_states)
    ]
    axes = _grid(4 * len(kinds), 4, width=3.0, height=2.75)
    for row, kind in enumerate(kinds):
        scatter, *panels = axes[4 * row : 4 * row + 4]
        angle = kind == "revolute"
        states = [s for s in result.joint_states if s.kind == kind]
        lines = [line for line in result.joint_lines if line.kind == kind]
        _states(scatter, states, lines, colours, angle)
        errors = [e for e in result.joint_errors if e.kind == kind]
        wanted = ("state", "direction", "axis") if angle else ("state", "direction")
        for axis, what in zip(panels, wanted, strict=False):
            _accuracy(axis, errors, what, what == "direction" or (angle and what == "state"))
            _title(axis, f"{kind}: {_NAMES[what]}")
        for axis in panels[len(wanted) :]:
            axis.set_visible(False)
    _save(axes, path)


_NAMES = {"state": "joint state", "direction": "direction", "axis": "distance of axes"}


def _states(
    axis: Axes,
    states: Sequence[JointState],
    lines: Sequence[JointLine],
    colours: Sequence[str],
    angle: bool,
) -> None:
    unit, symbol = (np.degrees(1.0), "°") if angle else (1.0, "")
    texts = []
    for line in lines:
        mine = [s for s in states if s.joint == line.joint]
        known = [(s.true, s.predicted) for s in mine if s.predicted is not None]
        true, predicted = unit * np.array(known, np.float64).reshape(-1, 2).T
        colour = colours[(line.joint + 1) % len(colours)]
        axis.scatter(true, predicted, s=9, color=colour, alpha=0.5, linewidths=0)
        if line.slope is None or line.offset is None or line.residual is None:
            texts.append((f"joint {line.joint}: none predicted" if not known else "", colour))
            continue
        slope, offset, residual = line.slope, unit * line.offset, unit * line.residual
        ends = np.array([true.min(), true.max()])
        axis.plot(ends, slope * ends + offset, color=colour, linewidth=1.2)
        digits = 1 if angle else 3
        texts.append((f"slope {slope:.2f}, residual {residual:.{digits}f}{symbol}", colour))
    axis.set_ylim(*_with_room_above(axis.get_ylim(), len(texts)))
    for place, (text, colour) in enumerate(texts):
        axis.text(0.03, 0.96 - 0.085 * place, text, color=colour, transform=axis.transAxes,
                  va="top", fontsize=8)  # fmt: skip
    _title(axis, f"{'revolute' if angle else 'prismatic'}: states")
    axis.set_xlabel(f"true{', degrees' if angle else ', unit frame'}")
    axis.set_ylabel(f"predicted{', degrees' if angle else ', unit frame'}")


def _with_room_above(limits: tuple[float, float], lines: int) -> tuple[float, float]:
    low, high = limits
    return low, high + 0.1 * lines * (high - low)


def _accuracy(axis: Axes, joints: Sequence[JointError], what: str, angle: bool) -> None:
    thresholds = DEGREES if angle else LENGTHS
    unit = np.degrees(1.0) if angle else 1.0
    errors = [None if e is None else unit * e for e in (getattr(j, what) for j in joints)]
    failed = 100.0 * sum(e is None for e in errors) / max(len(errors), 1)
    axis.plot(thresholds, accuracy(errors, thresholds), color=BLUE, linewidth=1.6)
    if failed:
        axis.axhspan(100.0 - failed, 100.0, color=GREY, alpha=0.15, linewidth=0)
        axis.text(thresholds[-1], 99.0, "no such part ", color=GREY, ha="right", va="top",
                  fontsize=8)  # fmt: skip
    axis.set_xlim(0.0, thresholds[-1])
    axis.set_ylim(0.0, 102.0)
    axis.set_xlabel("threshold" + (", degrees" if angle else ", unit frame"))
    axis.set_ylabel("joints right, %")


def slices(
    fields: Floats,
    colours: Sequence[str],
    titles: Sequence[str],
    cut: tuple[Floats, NDArray[np.int64], Sequence[str]],
    axis_names: tuple[str, str],
    path: Path,
) -> None:
    """The occupancy of the whole and of each part on a plane through the unit cube.

    Args:
        fields: (P, R, R) probabilities, indexed by the two axes of the plane.
        colours, titles: of each part.
        cut: true surface points near the plane (n, 2), their parts (n,), colours of those.
        axis_names: of the plane's first and second axis.
    """
    pictures = slice_pictures(fields, colours)
    axes = _one_and_many(len(fields), 1.7)
    at = (np.arange(fields.shape[1]) + 0.5) / fields.shape[1] - 0.5
    points, part, true_colours = cut
    for panel, (axis, title) in enumerate(zip(axes, ["union", *titles], strict=True)):
        axis.imshow(
            pictures[panel].transpose(1, 0, 2), origin="lower", extent=(-0.5, 0.5, -0.5, 0.5),
            interpolation="bilinear",
        )  # fmt: skip
        field = fields.max(0) if panel == 0 else fields[panel - 1]
        if field.min() < 0.5 < field.max():
            axis.contour(at, at, field.T, levels=[0.5], colors=INK, linewidths=0.7)
        if panel == 0:
            drawn = [true_colours[k % len(true_colours)] for k in part]
            axis.scatter(*points.T, s=5.0, c=drawn, edgecolors=INK, linewidths=0.25)
        _title(axis, title)
        axis.set_xticks([])
        axis.set_yticks([])
        for spine in axis.spines.values():
            spine.set_color("#cccccc")
    axes[0].set_xlabel(axis_names[0])
    axes[0].set_ylabel(axis_names[1], rotation=0)
    _save(axes, path)


def slice_pictures(fields: Floats, colours: Sequence[str]) -> Floats:
    """(P + 1, R, R, 3) in [0, 1]: the union, each pixel in the colour of the greatest part; then
    each part in its own; from white where the probability is 0 to the full colour where it is 1.

    Args:
        fields: (P, R, R) probabilities.
        colours: #rrggbb of each part.
    """
    rgb = np.array([[int(c[i : i + 2], 16) / 255.0 for i in (1, 3, 5)] for c in colours])
    each = 1.0 - fields[..., None] * (1.0 - rgb[:, None, None])
    union = np.take_along_axis(each, fields.argmax(0)[None, ..., None], 0)
    return np.concatenate([union, each])


def _grid(panels: int, columns: int, *, width: float, height: float) -> list[Axes]:
    """`panels` axes in rows of `columns`, of so many inches each."""
    rows = -(-panels // columns)
    figure = Figure(figsize=(columns * width, rows * height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]
    for axis in axes:
        axis.tick_params(labelsize=7.5, colors=INK, length=2.5)
        axis.xaxis.label.set_fontsize(8.5)
        axis.yaxis.label.set_fontsize(8.5)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
        for side in ("bottom", "left"):
            axis.spines[side].set_color(GREY)
    return axes


def _one_and_many(count: int, size: float) -> list[Axes]:
    """Return a large panel, and `count` small ones of `size` inches in two rows beside it."""
    columns = (count + 1) // 2
    figure = Figure(figsize=((2 + columns) * size, 2.15 * size), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2 + columns)
    small = [grid[i // columns, 2 + i % columns] for i in range(count)]
    return [figure.add_subplot(place) for place in (grid[:, :2], *small)]


def _title(axis: Axes, text: str, colour: str = INK) -> None:
    axis.set_title(text, fontsize=9.5, color=colour)


def _save(axes: Sequence[Axes], path: Path) -> None:
    figure = axes[0].get_figure(root=True)
    assert figure is not None
    try:
        figure.savefig(path, format="png")
    except OSError as error:
        raise ArticugenError(f"{path}: cannot be written: {error.strerror}") from None
