"""Read files that mean harm, until something escapes: python -m tests.fuzz --seconds 60.

Each target is read in a process of its own, which may crash or hang: that is an escape as well.
With atheris installed (pip install atheris) inputs are led by what they reach.
"""

import argparse
import importlib.util
import os
import platform
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from articugen.store.provenance import this_commit, this_machine
from tests.fuzz.engine import Findings, Progress, has_atheris
from tests.fuzz.targets import TARGETS, Target

_HANGS = 60.0
"""Seconds without an end of the input that is read."""
_NEVER = 10**12


@dataclass(frozen=True)
class Row:
    """What became of one target."""

    name: str
    executions: int
    seconds: float
    escapes: list[dict[str, str]]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), metavar="NAME",
                        help=f"one of {', '.join(TARGETS)}; several times for several")  # fmt: skip
    parser.add_argument("--seconds", type=float, help="for each target; 20 if no --runs are given")
    parser.add_argument("--runs", type=int, help="inputs of each target")
    parser.add_argument("--seed", type=int, default=random.randrange(10**6),
                        help="the same inputs again; drawn anew where none is given")  # fmt: skip
    parser.add_argument("--engine", choices=("atheris", "chance"),
                        default="atheris" if has_atheris() else "chance")  # fmt: skip
    parser.add_argument("--keep", type=Path, default=Path("build/fuzz"),
                        help="where inputs that escaped are put (%(default)s)")  # fmt: skip
    asked = parser.parse_args()
    seconds = asked.seconds or (_NEVER if asked.runs else 20.0)
    rows = []
    for name in asked.target or TARGETS:
        target = TARGETS[name]
        if target.extra and importlib.util.find_spec(target.extra) is None:
            print(f"{name}: left out, {target.extra} is not installed", file=sys.stderr)
            continue
        row = fuzzed(target, asked.engine, asked.keep, asked.seed, asked.runs or _NEVER, seconds)
        rows.append(row)
        print(f"{name}: {row.executions:,}, {len(row.escapes)} escapes", file=sys.stderr)
    print(table(rows, f"{asked.engine}, --seed {asked.seed}"))
    for row in rows:
        for said in row.escapes:
            file = asked.keep / row.name / said["file"]
            print(f"\n{said['key']}\n  {said['sentence'][:300]}\n  {file}")
    return 1 if any(row.escapes for row in rows) else 0


def fuzzed(target: Target, engine: str, keep: Path, seed: int, runs: int, seconds: float) -> Row:
    """Read inputs of one target; a process that ended early is started again."""
    folder = keep / target.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    progress, findings = Progress(folder / "progress"), Findings(folder)
    began, starts = time.monotonic(), 0
    while progress.executions < runs and (left := seconds - time.monotonic() + began) > 0:
        starts += 1
        more = {"seed": seed + 1000 * starts, "runs": runs - progress.executions, "seconds": left}
        options = [f"--{name}={value}" for name, value in more.items()]
        command = [sys.executable, "-m", "tests.fuzz.child", target.name, engine, *options]
        with (folder / "log").open("ab") as log, _in_memory() as work:
            process = subprocess.Popen(
                [*command, f"--folder={folder.absolute()}"],
                stdout=log,
                stderr=log,
                env=os.environ | {"TMPDIR": work},
                start_new_session=True,
            )
            ended = _watched(process, progress)
        if ended is None:
            break
        findings.add(f"{target.name}: {ended}", ended, progress.data)
        if starts > 20:
            break
    took = time.monotonic() - began
    return Row(target.name, progress.executions, took, findings.known())


def _in_memory() -> "tempfile.TemporaryDirectory[str]":
    """A folder for what the process writes, which it may leave behind."""
    memory = Path("/dev/shm")
    where = memory if os.access(memory, os.W_OK) else None
    return tempfile.TemporaryDirectory(prefix="articugen-fuzz-", dir=where)


def _watched(process: "subprocess.Popen[bytes]", progress: Progress) -> str | None:
    """How the process ended, None where it was done."""
    at, since = progress.executions, time.monotonic()
    while process.poll() is None:
        time.sleep(0.2)
        if progress.executions != at:
            at, since = progress.executions, time.monotonic()
        elif at and time.monotonic() - since > _HANGS:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return "hangs"
    return None if process.returncode == 0 else f"ends the process ({process.returncode})"


def table(rows: list[Row], engine: str) -> str:
    """In Markdown, with what it was measured on."""
    on = (this_machine()["processor"], f"Python {platform.python_version()}", engine)
    lines = [
        ", ".join([f"{date.today()}", f"commit {this_commit()}", *map(str, on)]),
        "",
        "| target | executions | a second | escapes | seconds |",
        "|---|---:|---:|---:|---:|",
    ]
    total = Row("all", sum(r.executions for r in rows), sum(r.seconds for r in rows), [])
    escapes = sum(len(r.escapes) for r in rows)
    for row, count in [*((r, len(r.escapes)) for r in rows), (total, escapes)]:
        rate = row.executions / max(row.seconds, 1e-9)
        lines.append(
            f"| {row.name} | {row.executions:,} | {rate:,.0f} | {count} | {row.seconds:.0f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
