"""Copy the newest reports into docs/performance.md: python -m tests.benchmarks.publish [folder]

What stands between `<!-- name -->` and `<!-- end of name -->` is replaced by the folder's name.md,
its headings one level down, for each report that is there; scaling.png goes to docs/images.
"""

import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
REPORTS = {"benchmark": "report.md", "accuracy": "accuracy.md"}


def main(folder: Path = Path("benchmarks_out")) -> None:
    page = DOCS / "performance.md"
    text = page.read_text()
    for name, report in REPORTS.items():
        if (folder / report).is_file():
            text = replaced(text, name, (folder / report).read_text())
    page.write_text(text)
    if (folder / "scaling.png").is_file():
        shutil.copyfile(folder / "scaling.png", DOCS / "images" / "scaling.png")


def replaced(text: str, name: str, report: str) -> str:
    """`text` with the report, less its own first heading, between the marks of that name."""
    body = re.sub(r"^## .*\n+", "", report, count=1).strip()
    first, last = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, rest = text.split(first)
    return f"{before}{first}\n\n{body}\n\n{last}{rest.split(last)[1]}"


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
