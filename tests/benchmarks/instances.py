"""What an instance costs one core: python -m tests.benchmarks.instances [FOLDER ...]

Of three bundled objects of each category or, where folders of models are given, of each model in
them: CPU seconds to prepare it and milliseconds of an instance, without and with its share of that,
and with its writing. The least of RUNS, of STATES random states each; then each category's mean.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import mean

from articugen.core.content import MODELS
from tests.benchmarks import cases
from tests.benchmarks.rows import Results
from tests.benchmarks.timing import time_ours

OBJECTS, RUNS, STATES = 3, 3, 4


def main() -> None:
    means: dict[str, list[float]] = {}
    for model in _models(list(map(Path, sys.argv[1:]))):
        once, alone, whole = min(_measured(model, run) for run in range(RUNS))
        means.setdefault(model.ref.category, []).append(whole)
        print(f"{model.name}: {once:.3f} s, then {alone:.0f} ms; {whole:.0f} ms in all", flush=True)  # noqa: T201
    for category, milliseconds in means.items():
        print(f"{category}: {mean(milliseconds):.0f} ms, {len(milliseconds)} objects")  # noqa: T201


def _models(folders: list[Path]) -> Iterator[cases.Model]:
    for folder in folders:
        for model in sorted(path for path in folder.iterdir() if path.is_dir()):
            yield cases.real(model, folder.name.lower())
    for category in () if folders else MODELS:
        yield from (cases.bundled(category, index, messy=False) for index in range(OBJECTS))


def _measured(model: cases.Model, run: int) -> tuple[float, float, float]:
    results = Results()
    with tempfile.TemporaryDirectory() as folder:
        prepared = time_ours(model, range(1, STATES + 1), run, results, Path(folder))
    once = results.timings[0]["once cpu"]
    whole = mean(row["cpu"] for row in results.timings)
    return once, 1e3 * (whole - once / len(prepared.states)), 1e3 * whole


if __name__ == "__main__":
    main()
