"""The tables of docs/format.md, from the schema; `python -m tests.format_tables` prints them."""

from articugen.core import schema
from articugen.core.schema import SYMBOLS


def markdown() -> str:
    """Return the tables of docs/format.md."""
    rows = [
        f"| `{f.name}`{'?' if f.optional else ''} | `{f.dtype}`{' gzip' if f.compressed else ''} "
        f"| {f.written_shape} | {f.unit} | {f.frame} | {f.meaning} |"
        for f in schema.FIELDS
    ]
    checked = f"| `{schema.CHECKED_ATTRIBUTES}` | bytes | All the others as JSON; see below. |"
    letters = [f"| {letter} | {meaning} |" for letter, (meaning, _) in SYMBOLS.items()]
    attributes = [
        f"| `{n}` | {kind.__name__} | {what} |" for n, (kind, what) in schema.ATTRIBUTES.items()
    ]
    return "\n".join(
        [
            "| data set | dtype | shape | unit | frame | meaning |",
            "|---|---|---|---|---|---|",
            *rows,
            "",
            "| letter | number of |",
            "|---|---|",
            *letters,
            "",
            "| attribute of the file | type | meaning |",
            "|---|---|---|",
            *attributes,
            checked,
            "",
        ]
    )


if __name__ == "__main__":
    print(markdown())  # noqa: T201 - it is what the script is for
