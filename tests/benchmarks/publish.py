"""Copy the newest reports into the documentation: python -m tests.benchmarks.publish [folder]

The lines between `<!-- name -->` and `<!-- end of name -->` of docs/performance.md are replaced by
the report of that name, if the folder has one; pictures go to docs/images. Figures of code that no
commit has are refused: nobody could measure them again.
"""

import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = Path("docs") / "performance.md"
REPORTS = {"glance": "glance.md"}
PICTURES = ("scaling.png", "methods.png")

CHANGED = re.compile(r"commit (\S+-dirty|\S+\+changes|unknown)")
"""How a report tells of code that was changed since its commit, or of none."""


def main(folder: Path = Path("benchmarks_out"), root: Path = ROOT) -> None:
    """
    Raises:
        SystemExit: a report is of code that no commit has; nothing is written.
    """
    for report in sorted(folder / name for name in REPORTS.values()):
        if report.is_file() and (changed := CHANGED.search(report.read_text())):
            raise SystemExit(f"{report}: measured at {changed[0]}; commit first, and measure again")
    page, images = root / PAGE, root / PAGE.parent / "images"
    text = page.read_text()
    for mark, report in REPORTS.items():
        if (folder / report).is_file():
            text = replaced(text, mark, (folder / report).read_text())
    page.write_text(text)
    for picture in PICTURES:
        if (folder / picture).is_file():
            shutil.copyfile(folder / picture, images / picture)


def replaced(text: str, name: str, report: str) -> str:
    """Put the report between the marks of that name."""
    body = report.strip()
    first, last = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, rest = text.split(first)
    return f"{before}{first}\n\n{body}\n\n{last}{rest.split(last)[1]}"


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
