"""Copy the newest reports into the documentation: python -m tests.benchmarks.publish [folder]

What stands between `<!-- name -->` and `<!-- end of name -->` is replaced by the folder's report,
its headings one level down: both reports in docs/performance.md, the short table in README.md, for
each that is there; pictures go to docs/images. Figures of code that no commit has are refused:
nobody could measure them again.
"""

import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {
    "docs/performance.md": {"benchmark": "report.md", "accuracy": "accuracy.md"},
    "README.md": {"benchmark": "readme.md"},
}
PICTURES = ("scaling.png", "methods.png")

CHANGED = re.compile(r"commit (\S+-dirty|\S+\+changes|unknown)")
"""How a report tells of code that was changed since its commit, or of none."""


def main(folder: Path = Path("benchmarks_out"), root: Path = ROOT) -> None:
    """
    Raises:
        SystemExit: a report is of code that no commit has; nothing is written.
    """
    names = {name for reports in PAGES.values() for name in reports.values()}
    for report in sorted(folder / name for name in names):
        if report.is_file() and (changed := CHANGED.search(report.read_text())):
            raise SystemExit(f"{report}: measured at {changed[0]}; commit first, and measure again")
    images = root / "docs" / "images"
    for name, reports in PAGES.items():
        page = root / name
        text = page.read_text()
        for mark, report in reports.items():
            if (folder / report).is_file():
                text = replaced(text, mark, (folder / report).read_text())
        page.write_text(text.replace("](methods.png)", f"]({_from(page, images)}/methods.png)"))
    for picture in PICTURES:
        if (folder / picture).is_file():
            shutil.copyfile(folder / picture, images / picture)


def _from(page: Path, folder: Path) -> str:
    return folder.relative_to(page.parent).as_posix()


def replaced(text: str, name: str, report: str) -> str:
    """`text` with the report, less its own first heading, between the marks of that name."""
    body = re.sub(r"^## .*\n+", "", report, count=1).strip()
    first, last = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, rest = text.split(first)
    return f"{before}{first}\n\n{body}\n\n{last}{rest.split(last)[1]}"


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
