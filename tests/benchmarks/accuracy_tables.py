"""The rows of accuracy.py to tables."""

from tests.benchmarks.about import head
from tests.benchmarks.cells import Table
from tests.benchmarks.exactness import MATERIAL, Row, total


def occupancy(report: Row) -> Table:
    """Make the first table: IoU by category, clean and messy."""
    rows = report["objects"]
    categories = list(dict.fromkeys(row["category"] for row in rows))
    figures = {
        (c, messy): total(r for r in rows if (r["category"], r["messy"]) == (c, messy))
        for c in categories
        for messy in (False, True)
    }
    tubes = report["shapes"][0]["tubes"]
    lines = []
    for messy in (False, True):
        kind = "messy" if messy else "clean"
        for figure, name in _FIGURES.items():
            cells = [_cell(figure, figures[c, messy][figure]) for c in categories]
            alone = f"{tubes[figure]:.4f}" if figure in tubes and not messy else "–"
            lines.append((f"{kind}: {name}", *cells, alone))
    first = next(iter(figures.values()))
    note = (
        f"{first['instances']} instances a category in random joint states, judged by what they "
        "store. IoU with the exact solids; what no view sees by exact rays counts as inside, in "
        "the truth as well. With material: labels of parts with the solids alone, what is enclosed "
        "left out; a cavity sealed inside one part counts as its material. "
        "Near: sigma 0.01 of the unit frame. Worst: the worst instance. Labels: "
        "of points in one part's solids. Surface points with their part's exact solid 1e-4 behind "
        "them; messy sheets are as thick as the recipe makes them. On the zero level: at most half "
        "a voxel of 1/256 from a change of the field's sign. Tubes: a frame of radius 0.01."
    )
    columns = ("", *(c.replace("_", " ") for c in categories), "tubes")
    return Table("Exactness by category", columns, lines, note)


_FIGURES = {
    "uniform": "IoU, uniform",
    "near": "IoU, near",
    "worst uniform": "worst, uniform",
    "worst near": "worst, near",
    "material uniform": "IoU with material, uniform",
    "material near": "IoU with material, near",
    "material grid": "IoU with material, grid of 64",
    "worst material uniform": "worst, material, uniform",
    "labels": "labels that agree",
    "own part": "surface points on their part",
    "level": "surface points on the zero level",
}


def _cell(figure: str, value: float) -> str:
    if figure in ("labels", "own part", "level"):
        return f"{100.0 * value:.3f} %"
    return f"{value:.4f}"


def shapes(report: Row) -> Table:
    measured = report["shapes"][0]
    thick, grown = measured["sheets"], measured["growth"]
    lines = [
        (
            f"a sheet of no thickness, {len(thick)} directions: thickness",
            f"{min(thick):.2f} to {max(thick):.2f}",
            "1 to 2",
        )
    ]
    lines += [(f"{name}: growth a side", f"{by:+.3f}", "0.25") for name, by in grown.items()]
    for row in measured["uniformity"]:
        test = f"{row['chi-square']:.0f} of {row['freedom']} degrees, p = {row['p']:.2f}"
        lines.append((f"{row['shape']}: surface points uniform, chi-square", test, "p > 0.01"))
        lines.append(
            (
                f"{row['shape']}: surface points within half a voxel of the zero level",
                f"{100.0 * row['on level']:.3f} %",
                "100 %",
            )
        )
    note = (
        "Lengths in voxels of 1/256. Chi-square: two samples, ours and one drawn evenly over what "
        "is visible by exact rays, in cells of 1/6 apart for the side the surface looks to."
    )
    return Table("Shapes", ("shape", "measured", "goal"), lines, note)


def reachable(report: Row) -> Table:
    lines = []
    rows = report["reachable"]
    for category in dict.fromkeys(row["category"] for row in rows):
        own = [row for row in rows if row["category"] == category]
        cells = []
        for kind in ("uniform", "near"):
            both, either = (sum(row[kind][k] for row in own) for k in (0, 1))
            worst = min(row[kind][0] / row[kind][1] for row in own)
            cells += [f"{both / either:.4f}", f"{worst:.4f}"]
        undecided = sum(row["undecided"] for row in own) / sum(row["asked"] for row in own)
        ratio = sum(row["reachable"] for row in own) / sum(row["seen"] for row in own)
        most = max(row["reachable"] / row["seen"] for row in own)
        lines.append(
            (category.replace("_", " "), str(len(own)), *cells, f"{100.0 * undecided:.2f} %",
             f"{ratio:.2f}", f"{most:.2f}")
        )  # fmt: skip
    columns = (
        "rule reachable", "instances", "IoU, uniform", "worst", "IoU, near", "worst", "undecided",
        "time over seen", "most",
    )  # fmt: skip
    note = (
        "Against what a ball of the opening's width reaches from outside, on a grid of exact "
        "occupancy. Undecided, and left out: points that a ball of half the width comes near and "
        "one of the whole width does not; the rule says nothing of openings in between. Time: CPU, "
        "of an instance."
    )
    return Table("The rule `reachable`, random states", columns, lines, note)


def rigid(report: Row) -> Table:
    lines = []
    rows = report["rigid"]
    for category in dict.fromkeys(row["category"] for row in rows):
        own = [row for row in rows if row["category"] == category]
        cells = []
        for kind in MATERIAL:
            both, either = (sum(row[kind][k] for row in own) for k in (0, 1))
            cells.append(f"{both / either:.4f}")
        faster = sum(row["seen"] for row in own) / sum(row["rigid"] for row in own)
        least = min(row["seen"] / row["rigid"] for row in own)
        lines.append(
            (category.replace("_", " "), str(len(own)), *cells, f"{faster:.2f}", f"{least:.2f}")
        )
    columns = (
        "rule rigid", "instances", "IoU, uniform", "IoU, near", "IoU, grid of 64",
        "time of seen over its own", "least",
    )  # fmt: skip
    note = "With the exact solids, as above. Time: CPU, of a whole instance by the full recipe."
    return Table("The rule `rigid`, random states", columns, lines, note)


def all_tables(report: Row) -> list[Table]:
    return [occupancy(report), shapes(report), reachable(report), rigid(report)]


def markdown(report: Row) -> str:
    tables = [table.markdown() for table in all_tables(report)]
    return "\n".join(["## Accuracy", "", head(report["about"]), *tables])
