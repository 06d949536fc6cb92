"""What was tried, how often, and what came of it."""

from dataclasses import dataclass, field


@dataclass
class Tally:
    """A row of the table.

    Attributes:
        fault: what was done to which command.
        tried: times.
        survived: times after which the same command, called again, came to its end.
        equal: times after which what it left was what an undisturbed run leaves.
        wrong: what was not as promised, a sentence each.
    """

    fault: str
    tried: int = 0
    survived: int = 0
    equal: int = 0
    wrong: list[str] = field(default_factory=list)

    @property
    def holds(self) -> bool:
        return not self.wrong and self.tried == self.survived == self.equal

    def note(self, *, survived: bool, equal: bool, wrong: str = "") -> None:
        self.tried += 1
        self.survived += survived
        self.equal += equal
        if wrong:
            self.wrong.append(wrong)


HEAD = "| fault | tried | survived | hash equal |\n|---|---:|---:|---:|"


def line(row: Tally) -> str:
    """A row of the table, as Markdown."""
    return f"| {row.fault} | {row.tried} | {row.survived} | {row.equal} |"
