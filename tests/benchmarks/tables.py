"""Rows to tables, on the terminal and as Markdown."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table as RichTable

from tests.benchmarks.about import head
from tests.benchmarks.measure import Row, median_by_case

NOTHING = "–"
STAGES = ("pose+render", "occupancy", "surface", "partial", "other", "write", "prepare")


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


def comparison(report: Row) -> Table:
    """All methods on the same meshes; ratios over the meshes that both did."""
    timings = [row for row in report["timings"] if not row["real"]]
    ours, ours_cpu = (median_by_case(_of(timings, "ours"), k) for k in ("seconds", "cpu"))
    rows = []
    for method in report["methods"]:
        name = method["name"]
        if method["absent"]:
            rows.append((name, method["absent"], *[NOTHING] * 9))
            continue
        own = _of(timings, name)
        wall, cpu = median_by_case(own), median_by_case(own, "cpu")
        shared = report["shared"]
        wall = {case: s for case, s in wall.items() if case in shared}
        scores = [s for s in _of(report["scores"], name) if s["case"] in shared]
        ratio = sum(wall.values()) / sum(ours[case] for case in wall) if wall else None
        cores = (
            sum(cpu[case] for case in wall) / sum(ours_cpu[case] for case in wall) if wall else None
        )
        rows.append(
            (
                name,
                _number(_mean(wall.values()), ".3g"),
                _number(_mean(cpu[case] for case in wall), ".3g"),
                _number(ratio, ".3g"),
                _number(cores, ".3g"),
                _iou(s for s in scores if not s["messy"]),
                _iou(s for s in scores if s["messy"]),
                *_shape(report["shapes"], name),
                _number(report["memory"].get(name), ".0f"),
                f"{len(wall)} x {len({row['run'] for row in own})}",
            )
        )
    columns = (
        "method", "s a mesh", "core s", "x ours", "x ours, core s", "IoU U / N, clean",
        "IoU U / N, messy", "sheet, voxels", "growth, voxels", "peak MB", "meshes x runs",
    )  # fmt: skip
    shared = report["memory"].get("nothing")
    note = _COMPARISON + (f" Those that all share take {shared:.0f} MB." if shared else "")
    return Table("Methods side by side, on the same meshes", columns, rows, note)


_COMPARISON = (
    "Medians over the runs, means over the meshes; each ratio over the meshes that the method did. "
    "Ours: everything for an instance, on one core, with what is done once an object shared out "
    "among its instances. Peers: from the posed mesh to the labels of the same number of points, "
    "nothing else, on all cores. U: uniform points, N: near the surface (sigma 0.01). Ours counts "
    "unseen space as inside, so does its truth; a peer is judged on each mesh by the kinder of two "
    "truths, the solids alone or with what is unseen. Sheet: thickness of a sheet without any "
    "(least to most by direction; ours means 1.5). Growth: of a closed cylinder, a side. Voxels of "
    "1/256. Peak: on the first object, in a process of its own, libraries included."
)


def by_category(report: Row, *, messy: bool) -> Table:
    """IoU of each method by category, on the same meshes."""
    rows = []
    categories = report["categories"]
    for method in report["methods"]:
        scores = [
            s for s in _of(report["scores"], method["name"])
            if s["messy"] == messy and s["case"] in report["shared"]
        ]  # fmt: skip
        if scores:
            cells = [_iou(s for s in scores if s["category"] == c) for c in categories]
            rows.append((method["name"], *cells))
    kind = "messy" if messy else "clean"
    return Table(f"IoU uniform / near by category, {kind} meshes", ("method", *categories), rows)


def stages(report: Row) -> Table:
    """Where an instance's time goes."""
    rows = []
    for method in report["methods"]:
        timings = [t for t in _of(report["timings"], method["name"]) if not t["real"]]
        if not timings or "prepare" not in timings[0]:
            continue
        for category in report["categories"]:
            own = [t for t in timings if t["category"] == category]
            ms = [_mean(median_by_case(own, s).values()) for s in (*STAGES, "seconds")]
            rows.append(
                (
                    method["name"],
                    category,
                    str(len({t["case"] for t in own})),
                    *(_number(1e3 * m if m is not None else None, ".1f") for m in ms),
                    _number(_mean(median_by_case(own, "once").values()), ".2f"),
                )
            )
    columns = ("setting", "category", "instances", *STAGES, "sum", "once an object, s")
    note = (
        "Milliseconds an instance on one core; `prepare` is what is done once an object, shared "
        "out among its instances. Clean and messy objects; random joint states."
    )
    return Table("Ours by stage", columns, rows, note)


def end_to_end(report: Row) -> Table:
    rows = []
    for run in report["end_to_end"]:
        rates = {int(n): run["instances"] / s for n, s in run["seconds"].items()}
        base = rates[min(rates)]
        rates_text = ", ".join(f"{rate:.1f} with {n}" for n, rate in rates.items())
        gains = ", ".join(f"{rate / base:.2f}" for n, rate in rates.items() if n != min(rates))
        rows.append((run["setting"], run["category"], str(run["instances"]), rates_text, gains))
    columns = ("setting", "category", "instances", "instances / s, by workers", "gain")
    note = "`articugen generate` as a process, from the command line to the finished data set."
    return Table("End to end", columns, rows, note)


def real(report: Row) -> Table:
    timings = [row for row in report["timings"] if row["real"]]
    cases = [case for case in report["triangles"] if any(row["case"] == case for row in timings)]
    rows = []
    for method in report["methods"]:
        seconds = median_by_case(_of(timings, method["name"]))
        if not seconds:
            continue
        cells = []
        for case in cases:
            scores = [s for s in _of(report["scores"], method["name"]) if s["case"] == case]
            cells += [_number(seconds.get(case), ".3g"), _iou(scores)]
        rows.append((method["name"], *cells))
    heads = []
    for case in cases:
        triangles = report["triangles"][case]
        heads += [f"{case}, {triangles:,} triangles: s a mesh", "IoU U / N with ours"]
    note = "There is no truth: IoU says how far a method agrees with ours. Slow peers left out."
    return Table("Real models", ("method", *heads), rows, note)


def failures(report: Row) -> Table:
    rows = [(f["method"], f["case"], f["error"]) for f in report["failures"]]
    return Table("Failures", ("method", "on", "error"), rows)


def all_tables(report: Row) -> list[Table]:
    tables: list[Callable[[Row], Table]] = [
        comparison,
        lambda r: by_category(r, messy=False),
        lambda r: by_category(r, messy=True),
        stages,
        end_to_end,
        real,
        failures,
    ]
    made = [table(report) for table in tables]
    return [table for table in made if table.rows]


def markdown(report: Row) -> str:
    tables = [table.markdown() for table in all_tables(report)]
    return "\n".join(["## Benchmark", "", head(report["about"]), *tables])


def _of(rows: Sequence[Row], method: str) -> list[Row]:
    return [row for row in rows if row["method"] == method]


def _mean(values: Iterable[float]) -> float | None:
    listed = list(values)
    return statistics.fmean(listed) if listed else None


def _number(value: float | None, form: str) -> str:
    return NOTHING if value is None else format(value, form)


def _iou(scores: Iterable[Row]) -> str:
    listed = list(scores)
    if not listed:
        return NOTHING
    return " / ".join(f"{statistics.fmean(s[k] for s in listed):.4f}" for k in ("uniform", "near"))


def _shape(shapes: Sequence[Row], method: str) -> tuple[str, str]:
    row = next((row for row in shapes if row["method"] == method), None)
    if row is None:
        return NOTHING, NOTHING
    sheet = NOTHING
    if row["thickness"] is not None:
        mean, least, most = row["thickness"]
        sheet = f"{mean:.2f} ({least:.2f} to {most:.2f})"
    return sheet, _number(row["growth"], "+.2f")
