"""python -m tests.chaos [--quick] [--every] [--kills 50] [--seed 0] [--only generate,stories]

Prints the table (fault, times tried, survived, hash equal), and what did not hold; status 1 then.
A corruption is survived where `verify` finds and names it, and equal where `--repair` mends it.
--every takes every write of a stretch into one file, not the first, the middle and the last alone.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console

from tests.chaos import corruptions, determinism
from tests.chaos.commands import commands
from tests.chaos.disk import failing_disk
from tests.chaos.failures import FAULTS, Failures
from tests.chaos.kills import Kills, Strike, moments
from tests.chaos.machine import told
from tests.chaos.tally import HEAD, Tally, line

Told = Callable[[str], None]

COMMANDS = ("generate", "export", "train", "fetch")
PARTS = (*COMMANDS, "stories", "corruptions", "determinism")


def main() -> None:
    options = _options()
    console = Console(stderr=True)
    rows: list[Tally] = []
    with (
        tempfile.TemporaryDirectory(prefix="articugen-chaos-") as folder,
        console.status("") as bar,
    ):
        say(HEAD)
        for name in options.only:
            bar.update(name)
            for row in _rows(Path(folder), name, options, bar.update):
                say(line(row))
                rows.append(row)
    for row in rows:
        for sentence in row.wrong:
            say(f"{row.fault}: {sentence}")
    sys.exit(0 if all(row.holds for row in rows) else 1)


def say(text: str) -> None:
    """At once: the whole takes an hour."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.chaos")
    parser.add_argument("--quick", action="store_true", help="a few of each")
    parser.add_argument("--every", action="store_true", help="every write, not the telling ones")
    parser.add_argument("--kills", type=int, default=50, help="of each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", default=",".join(PARTS), help="parts of the table, with commas")
    options = parser.parse_args()
    options.only = options.only.split(",")
    if unknown := [name for name in options.only if name not in PARTS]:
        parser.error(f"{unknown[0]}: choose of {', '.join(PARTS)}")
    if options.quick:
        options.kills = 4
    return options


def _rows(folder: Path, name: str, options: argparse.Namespace, told: Told) -> Iterator[Tally]:
    """A part of the table, row by row."""
    if name == "stories":
        yield _any_order(folder, options)
    elif name == "corruptions":
        for kind, tried, found, mended in corruptions.rows(options.quick):
            yield Tally(f"corrupted: {kind}", tried, found, mended)
    elif name == "determinism":
        for way, made, same in determinism.rows(options.quick):
            yield Tally(f"made otherwise: {way}", made, made, same)
    else:
        yield from _failing(folder, name, options, told)
        yield from _killed(folder, name, options, told)


def _failing(folder: Path, name: str, options: argparse.Namespace, told: Told) -> Iterator[Tally]:
    work = folder / "work"
    command = commands(folder / "inputs", work, jobs=0)[name]
    with failing_disk(folder) as disk:
        failures = Failures(command, disk, work)
        points = failures.every() if options.every else failures.telling()
        chosen = points[:: max(len(points) // 5, 1)] if options.quick else points
        for mode in FAULTS:
            yield failures.tried(mode, chosen, told)


def _killed(folder: Path, name: str, options: argparse.Namespace, told: Told) -> Iterator[Tally]:
    """With two workers, where the command has any: the strikes take turns."""
    command = commands(folder / "inputs-killed", folder / "work", jobs=2, objects=6)[name]
    kills = Kills.of(command, folder / "work")
    strikes = [s for s in Strike if s != Strike.WORKER or name == "generate"]
    drawn = moments(options.seed, options.kills)
    for i, strike in enumerate(strikes):
        yield kills.tried(strike, drawn[i :: len(strikes)], told)


def _any_order(folder: Path, options: argparse.Namespace) -> Tally:
    """Runs, kills, faults, corruptions and verifications in any order: see `machine`."""
    row = Tally("`generate`: stories of all these, in any order")
    with failing_disk(folder) as disk:
        stories = 5 if options.quick else 40
        try:
            told(folder, disk, stories=stories, steps=8, seed=options.seed)
        except AssertionError as error:
            row.note(survived=False, equal=False, wrong=str(error))
        else:
            row.tried = row.survived = row.equal = stories
    return row


if __name__ == "__main__":
    main()
