"""Rows to tables, on the terminal and as Markdown."""

from collections.abc import Callable

from tests.benchmarks.about import head
from tests.benchmarks.cells import NOTHING, Table, iou, mean, middle, number, of, sheet_and_growth
from tests.benchmarks.rows import Row, median_by_case
from tests.benchmarks.scores import TRUTHS

STAGES = ("pose+render", "occupancy", "surface", "partial", "other", "write", "prepare")


def comparison(report: Row) -> Table:
    """All methods on the same meshes; ratios over the meshes that both did."""
    table_rows = []
    for method in report["methods"]:
        name = method["name"]
        if method["absent"]:
            table_rows.append((name, method["absent"], *[NOTHING] * (len(_COLUMNS) - 2)))
            continue
        scores = [s for s in of(report["scores"], name) if s["case"] in report["shared"]]
        runs = {row["run"] for row in of(report["timings"], name) if not row["real"]}
        cost = costs(report, name)
        table_rows.append(
            (
                name,
                *(number(value, ".3g") for value in cost),
                *(iou(scores, truth, messy) for messy in (False, True) for truth in TRUTHS),
                number(report["memory"].get(name), ".0f"),
                f"{len({s['case'] for s in scores})} x {len(runs)}",
            )
        )
    columns = tuple(text.format(labels=f"{report['labels']:,}") for text in _COLUMNS)
    shared = report["memory"].get("nothing")
    note = _COMPARISON + (f" Those that all share take {shared:.0f} MB." if shared else "")
    return Table("Methods side by side, on the same meshes", columns, table_rows, note)


_COLUMNS = (
    "method", "s a mesh", "core s", "x ours", "x ours, core s", "{labels} labels: s", "core s",
    "x ours, core s", "clean: material U / N", "visible space U / N", "messy: material U / N",
    "visible space U / N", "peak MB", "meshes x runs",
)  # fmt: skip

_COMPARISON = (
    "Medians over the runs, means over the meshes; each ratio over the meshes that the method did. "
    "Ours: everything for an instance, on one core, with what is done once an object shared out "
    "among its instances. Peers: from the posed mesh to the labels of the same number of points, "
    "nothing else, on all cores. Then the same for that many query points, half of them near the "
    "surface, and no grids. IoU of all with two truths: material, the solids alone, and visible "
    "space, the solids with what no view sees. Ours answers each by its labels, a peer both with "
    "the one inside that it knows. U: uniform points, N: near the surface (sigma 0.01). Peak: on "
    "the first object, in a process of its own, libraries included."
)


def costs(report: Row, method: str) -> list[float | None]:
    """Of a mesh: s, core s, both as multiples of ours; of many labels: s, core s, its multiple."""
    shared = report["shared"]
    found: list[float | None] = []
    for name in ("timings", "many"):
        measured = [row for row in report[name] if row["case"] in shared]
        own, base = of(measured, method), of(measured, "ours")
        means, ratios = [], []
        for column in ("seconds", "cpu"):
            mine, theirs = median_by_case(own, column), median_by_case(base, column)
            means.append(mean(mine.values()))
            both = [case for case in mine if case in theirs]
            of_ours = sum(theirs[case] for case in both)
            ratios.append(sum(mine[case] for case in both) / of_ours if of_ours else None)
        found += means + (ratios if name == "timings" else ratios[1:])
    return found


def shapes(report: Row) -> Table:
    """How thick sheets come out, and how far a closed solid swells."""
    rows = [(shape["method"], *sheet_and_growth(shape)) for shape in report["shapes"]]
    note = (
        "Sheet: thickness of a sheet without any (least to most by direction; ours means 1.5). "
        "Swelling: of a closed cylinder, a side. Voxels of 1/256."
    )
    return Table("Sheets and swelling", ("method", "sheet, voxels", "swelling, voxels"), rows, note)


def stages(report: Row) -> Table:
    """Where an instance's time goes."""
    rows = []
    for method in report["methods"]:
        timings = [t for t in of(report["timings"], method["name"]) if not t["real"]]
        if not timings or "prepare" not in timings[0]:
            continue
        for category in report["categories"]:
            own = [t for t in timings if t["category"] == category]
            ms = [mean(median_by_case(own, s).values()) for s in (*STAGES, "seconds")]
            rows.append(
                (
                    method["name"],
                    category,
                    str(len({t["case"] for t in own})),
                    *(number(1e3 * m if m is not None else None, ".1f") for m in ms),
                    number(mean(median_by_case(own, "once").values()), ".2f"),
                )
            )
    columns = ("setting", "category", "instances", *STAGES, "sum", "once an object, s")
    note = (
        "Milliseconds an instance on one core; `prepare` is what is done once an object, shared "
        "out among its instances. Clean and messy objects; random joint states."
    )
    return Table("Ours by stage", columns, rows, note)


def end_to_end(report: Row) -> Table:
    run = report["end_to_end"]
    rates = [(int(n), run["instances"] / s) for n, s in run["seconds"].items()]
    rows = [
        (run["category"], str(run["instances"]), str(n), f"{rate:.1f}", f"{rate / rates[0][1]:.2f}")
        for n, rate in rates
    ]
    columns = ("category", "instances", "workers", "instances / s", "gain")
    note = "`articugen generate` as a process, from the command line to the finished data set."
    return Table("End to end", columns, rows, note)


def real(report: Row) -> Table:
    timings = [row for row in report["timings"] if row["real"]]
    cases = [case for case in report["triangles"] if any(row["case"] == case for row in timings)]
    category = {row["case"]: row["category"] for row in timings}
    table_rows = []
    for method in report["methods"]:
        seconds = median_by_case(of(timings, method["name"]))
        if not seconds:
            continue
        cells = []
        for case in cases:
            scores = [s for s in of(report["scores"], method["name"]) if s["case"] == case]
            cells += [number(seconds.get(case), ".3g"), middle(scores)]
        table_rows.append((method["name"], *cells))
    heads = []
    for case in cases:
        triangles = report["triangles"][case]
        heads += [f"{category[case]} {case}, {triangles:,} triangles: s a mesh", "IoU with ours"]
    note = (
        "There is no truth: IoU, the mean of uniform and near points, says how far a method agrees "
        "with ours, with its material / with its visible space. Slow peers left out."
    )
    return Table("Real models", ("method", *heads), table_rows, note)


def failures(report: Row) -> Table:
    rows = [(f["method"], f["case"], f["error"]) for f in report["failures"]]
    return Table("Failures", ("method", "on", "error"), rows)


def all_tables(report: Row) -> list[Table]:
    tables: list[Callable[[Row], Table]] = [comparison, shapes, stages, end_to_end, real, failures]
    made = [table(report) for table in tables]
    return [table for table in made if table.rows]


def markdown(report: Row) -> str:
    tables = [table.markdown() for table in all_tables(report)]
    tables.insert(1, "![Error against core seconds, a dot a method](methods.png)\n")
    return "\n".join(["## Benchmark", "", head(report["about"]), *tables])
