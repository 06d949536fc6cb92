"""A table on the terminal and as Markdown, and what its cells say."""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table as RichTable

from tests.benchmarks.rows import Row
from tests.benchmarks.scores import TRUTHS

NOTHING = "–"


@dataclass(frozen=True)
class Table:
    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""

    def print(self, console: Console) -> None:
        table = RichTable(title=self.title, caption=self.note, title_justify="left")
        for k, column in enumerate(self.columns):
            table.add_column(column, justify="left" if k == 0 else "right")
        for row in self.rows:
            table.add_row(*row)
        console.print(table)

    def markdown(self) -> str:
        lines = [f"### {self.title}", "", "| " + " | ".join(self.columns) + " |"]
        lines.append("|---|" + "---:|" * (len(self.columns) - 1))
        lines += ["| " + " | ".join(row) + " |" for row in self.rows]
        return "\n".join([*lines, "", *([self.note, ""] if self.note else [])])


def of(rows: Sequence[Row], method: str) -> list[Row]:
    return [row for row in rows if row["method"] == method]


def mean(values: Iterable[float]) -> float | None:
    listed = list(values)
    return statistics.fmean(listed) if listed else None


def number(value: float | None, form: str) -> str:
    return NOTHING if value is None else format(value, form)


def iou(scores: Iterable[Row], truth: str, messy: bool) -> str:
    """Means over the meshes, uniform / near."""
    listed = [s[truth] for s in scores if s["messy"] == messy]
    if not listed:
        return NOTHING
    return " / ".join(f"{statistics.fmean(s[k] for s in listed):.4f}" for k in ("uniform", "near"))


def middle(scores: Sequence[Row]) -> str:
    """Means over meshes and kinds of points, material / visible space."""
    if not scores:
        return NOTHING
    return " / ".join(f"{agreement(scores, truth):.4f}" for truth in TRUTHS)


def agreement(scores: Sequence[Row], truth: str) -> float:
    return statistics.fmean(s[truth][kind] for s in scores for kind in ("uniform", "near"))


def sheet_and_growth(shape: Row) -> tuple[str, str]:
    sheet = NOTHING
    if shape["thickness"] is not None:
        mean, least, most = shape["thickness"]
        sheet = f"{mean:.2f} ({least:.2f} to {most:.2f})"
    return sheet, number(shape["growth"], "+.2f")
