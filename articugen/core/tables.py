"""How tables, sizes and times are written in the terminal."""

from rich import box
from rich.table import Table

DIM = "bright_black"


def quiet_table(*headers: str) -> Table:
    """Return a table with one rule under its headers; > in front of one means a column of numbers.

    On a narrow terminal, texts behind the first column wrap; names and numbers do not.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style=DIM)
    for place, header in enumerate(headers):
        right = header.startswith(">")
        table.add_column(
            header.removeprefix(">"),
            justify="right" if right else "left",
            no_wrap=right or place == 0,
            overflow="fold",
        )
    return table


def facts() -> Table:
    """Return a table of names and values, without headers or rules."""
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(style=DIM, no_wrap=True)
    table.add_column(overflow="fold")
    return table


def size(count: float) -> str:
    """Bytes for people: 1.9 GB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.0f} {unit}" if count >= 9.95 or unit == "B" else f"{count:.1f} {unit}"
        count /= 1000.0
    return f"{count:.1f} TB"


def counted(number: int, noun: str) -> str:
    """1 object, 2,000 objects."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def duration(seconds: float) -> str:
    """Seconds for people: 23 min 40 s."""
    whole = round(seconds)
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
