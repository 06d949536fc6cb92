"""What a run measured: plain rows (dicts), one for each timing and each score; tables add up."""

import statistics
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from tests.benchmarks.cases import Model

Row = dict[str, Any]


@dataclass
class Results:
    """Rows.

    timings: method, case, category, messy, run, seconds, cpu; ours also a column for each stage.
    many: the same for many labels and no grids.
    scores: method, case, category, messy, and by truth ("material", "visible") the IoU of
        "uniform" and "near" points.
    shapes: method, thickness (voxels: mean, least, most), growth (voxels).
    failures: method, case, error.
    shared: the cases that peers, too, are measured on.
    triangles: of each real case.
    """

    timings: list[Row] = field(default_factory=list)
    many: list[Row] = field(default_factory=list)
    scores: list[Row] = field(default_factory=list)
    shapes: list[Row] = field(default_factory=list)
    failures: list[Row] = field(default_factory=list)
    shared: list[str] = field(default_factory=list)
    triangles: dict[str, int] = field(default_factory=dict)


def about(method: str, model: Model, state: int) -> Row:
    return {
        "method": method,
        "case": f"{model.name} state {state}",
        "category": model.ref.category,
        "messy": model.messy,
        "real": model.real,
    }


def failure(method: str, case: str, error: Exception) -> Row:
    text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return {"method": method, "case": case, "error": text}


def median_by_case(rows: Iterable[Row], column: str = "seconds") -> dict[str, float]:
    """The median over the runs, for each case."""
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row["case"], []).append(row[column])
    return {case: statistics.median(v) for case, v in values.items()}
