"""Where each method stands, at a glance: a short table, and a picture."""

from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.cells import Table, agreement, iou, number, of, sheet_and_growth
from tests.benchmarks.rows import Row
from tests.benchmarks.scaling import BLUE, GREY, drawn
from tests.benchmarks.tables import costs

LEAST = 1e-5
"""What the picture calls no error: of 100,000 points a mesh one may be wrong."""


def markdown(report: Row) -> str:
    """Write the short table, with the run that all of it is from."""
    about = report["about"]
    labels = f"{report['labels']:,} labels"
    columns = (
        "method", "core s a mesh", labels, "material U / N, clean", "messy",
        "visible space U / N, clean", "messy", "sheet",
    )  # fmt: skip
    table_rows = []
    for shape in report["shapes"]:
        name = shape["method"]
        scores = [s for s in of(report["scores"], name) if s["case"] in report["shared"]]
        _, core, _, _, _, core_many, _ = costs(report, name)
        cells = (iou(scores, t, m) for t in ("material", "visible") for m in (False, True))
        table_rows.append(
            (
                name,
                *(number(value, ".3g") for value in (core, core_many)),
                *cells,
                sheet_and_growth(shape)[0].split(" ")[0],
            )
        )
    table = Table("", columns, table_rows).markdown().split("\n", 2)[2]
    lines = [
        "Beside what one would use instead, on the same meshes in one run: "
        f"`{about['command']}` at commit {about['commit']}, {about['date']}, {about['machine']}; "
        "versions are in `report.md`.",
        "",
        table.strip(),
        "",
        "Core seconds: ours for everything of an instance, the others' for as many labels and "
        "nothing else; then with that many query points and no grids. IoU at uniform points / near "
        "the surface, with the solids alone and with those and the space that no view sees. "
        "Sheet: the thickness of one without any, in voxels of 1/256; ours means 1.5.",
        "",
    ]
    return "\n".join(lines)


def draw(report: Row, path: Path) -> str | None:
    """Error against core seconds, both logarithmic, clean and messy meshes; None where drawn."""

    def on(axes: Any) -> None:
        for axis, messy in zip(axes, (False, True), strict=True):
            _panel(axis, report, messy)
        axes[0].set_ylabel("1 - IoU with the solids alone")

    return drawn(path, (13, 5.0), 2, on)


def _panel(axis: Any, report: Row, messy: bool) -> None:
    dots = []
    for method in report["methods"]:
        scores = [
            s for s in of(report["scores"], method["name"])
            if s["messy"] == messy and s["case"] in report["shared"]
        ]  # fmt: skip
        core = costs(report, method["name"])[1]
        if scores and core:
            error = max(1.0 - agreement(scores, "material"), LEAST)
            dots.append((core, error, method["name"]))
    for core, error, name in dots:
        own = name.startswith("ours")
        axis.plot(core, error, "o", color=BLUE if own else GREY, markersize=9 if own else 6)
    axis.set(xscale="log", yscale="log", xlabel="core seconds a mesh")
    axis.set_ylim(LEAST / 2.0, 2.0)
    axis.set_yticks(
        [10.0**k for k in range(-5, 1)], ["0.00001 or less", "0.0001", "0.001", "0.01", "0.1", "1"]
    )
    axis.grid(alpha=0.25)
    axis.xaxis.set_major_formatter("{x:g}")
    axis.set_title(f"{'messy' if messy else 'clean'} meshes", loc="left")
    _name(axis, dots)


def _name(axis: Any, dots: list[tuple[float, float, str]]) -> None:
    """Names beside the panel, in the order of the dots, none on another."""
    dots = sorted(dots, key=lambda dot: dot[1])
    low, high = np.log(axis.get_ylim())
    gap = 0.042 * (high - low)
    at = np.log([error for _, error, _ in dots])
    for k in range(1, len(at)):
        at[k] = max(at[k], at[k - 1] + gap)
    at[-1] = min(at[-1], high)
    for k in reversed(range(len(at) - 1)):
        at[k] = min(at[k], at[k + 1] - gap)
    for (core, error, name), height in zip(dots, np.exp(at), strict=True):
        own = name.startswith("ours")
        line = {"arrowstyle": "-", "color": BLUE if own else GREY, "linewidth": 0.5}
        axis.annotate(
            name, (core, error), (1.04, height), textcoords=("axes fraction", "data"),
            va="center", fontsize=7.5, color=BLUE if own else "#444444",
            weight="bold" if own else "normal", annotation_clip=False,
            arrowprops=line | {"relpos": (0.0, 0.5)},
        )  # fmt: skip
