"""The process that reads inputs of one target; `__main__` starts it, and watches."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from tests.fuzz.engine import Findings, Progress, by_atheris, by_chance, instrumented

if TYPE_CHECKING:
    from tests.fuzz.sandbox import Sandbox
    from tests.fuzz.targets import Target


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("target")
    parser.add_argument("engine")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--runs", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    asked = parser.parse_args()
    with instrumented(asked.engine):
        from tests.fuzz.sandbox import sandbox
        from tests.fuzz.targets import TARGETS

        target = TARGETS[asked.target]
        with sandbox() as room:
            for data in target.seeds():  # what is imported only now is seen, too
                room.run(target, data)
            _read(asked, target, room)


def _read(asked: argparse.Namespace, target: "Target", room: "Sandbox") -> None:
    progress, findings = Progress(asked.folder / "progress"), Findings(asked.folder)

    def read(data: bytes) -> None:
        progress.begin(data)
        escape = room.run(target, data)
        if escape is not None:
            findings.add(escape.key, escape.sentence, data)

    go = by_atheris if asked.engine == "atheris" else by_chance
    go(target, read, seed=asked.seed, runs=asked.runs, seconds=asked.seconds)


if __name__ == "__main__":
    main()
