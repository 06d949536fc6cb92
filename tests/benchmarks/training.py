"""How fast PPD trains, where the time goes, and how much memory it takes.

python -m tests.benchmarks.training [--recipes ppd_paper ppd_quick] [--devices cpu cuda]
    [--iterations 10] [--threads 1] [--out benchmarks_out]

Each row is the real training loop in a process of its own, on a small data set of boxes: batches,
and so the cost, are those of any other. Two runs give a row: one that is only watched from outside,
for the rate and the memory, and one whose functions are timed, for the shares (on a CPU, CPU time,
which a busy machine does not spoil). Prints a table and saves training.json and training.md in the
folder --out.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from articugen.learning import loop
from articugen.learning.blocks import Descent
from articugen.learning.data.split import PackedSplit
from articugen.learning.method import load_recipe
from articugen.learning.ppd import objective
from articugen.learning.ppd.local import LocalLearning
from articugen.learning.ppd.network import PPD
from articugen.learning.recipe import TrainRecipe
from articugen.store.provenance import this_commit, this_machine

sys.path.insert(0, str(Path(__file__).parent.parent))
from instances import SMALL
from ppd_data import write_boxes

STAGES = ("data", "forward", "losses", "backward", "optimiser", "discriminator", "local", "other")
WARM_UP = 2
"""Iterations that count for nothing."""

ENOUGH = {"surface_points": 4096, "uniform_points": 4096, "near_points": 4096}
Row = dict[str, Any]


def main() -> None:
    asked = _asked()
    if asked.child:
        print(json.dumps(_measured(*asked.child, asked.iterations, asked.threads)))  # noqa: T201
        return
    rows = []
    with tempfile.TemporaryDirectory(prefix="articugen-bench-train-") as folder:
        recipe = SMALL.model_copy(update={"sampling": SMALL.sampling.model_copy(update=ENOUGH)})
        write_boxes(Path(folder), train=6, test=0, states=3, recipe=recipe)
        for device in asked.devices:
            for name in asked.recipes:
                print(f"{name} on {device} ...", file=sys.stderr)  # noqa: T201
                rows.append(_in_a_process(name, device, folder, asked))
    report = {"about": _about(asked), "rows": rows}
    asked.out.mkdir(parents=True, exist_ok=True)
    (asked.out / "training.json").write_text(json.dumps(report, indent=1) + "\n")
    (asked.out / "training.md").write_text(markdown(report))
    print(markdown(report))  # noqa: T201
    print(f"saved: {asked.out}/training.json, training.md")  # noqa: T201


def _asked() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.training")
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    recipes = ["ppd_paper", "ppd_release", "ppd_quick"]
    parser.add_argument("--recipes", nargs="+", default=recipes)
    parser.add_argument("--devices", nargs="+", default=devices)
    parser.add_argument("--iterations", type=int, default=10, help="timed, after two others")
    parser.add_argument("--threads", type=int, default=1, help="of a CPU")
    parser.add_argument("--out", type=Path, default=Path("benchmarks_out"))
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    return parser.parse_args()


def _in_a_process(name: str, device: str, folder: str, asked: argparse.Namespace) -> Row:
    done = subprocess.run(
        [
            sys.executable, "-m", "tests.benchmarks.training", "--child", name, device, folder,
            "--iterations", str(asked.iterations), "--threads", str(asked.threads),
        ],
        check=True, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    return json.loads(done.stdout)


def _measured(name: str, device: str, folder: str, iterations: int, threads: int) -> Row:
    torch.set_num_threads(threads)
    recipe = load_recipe(name)
    stage = recipe.schedule.stages[0].model_copy(update={"iterations": WARM_UP + iterations})
    plan = recipe.schedule.model_copy(update={"stages": (stage,)})
    data = recipe.data.model_copy(update={"validation_objects": 0})
    recipe = recipe.model_copy(update={"schedule": plan, "data": data})
    wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
    wall, cpu = _clocked(recipe, device, folder, wait)
    peak = (
        torch.cuda.max_memory_allocated()
        if device.startswith("cuda")
        else 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    )
    clock = time.perf_counter if device.startswith("cuda") else time.process_time
    with _timed(wait, clock) as spent:
        _clocked(recipe, device, folder, wait, at_start=spent.clear)
    whole = sum(spent.values())
    return {
        "recipe": name,
        "device": torch.cuda.get_device_name() if device.startswith("cuda") else "CPU",
        "iterations_per_second": iterations / wall,
        "cpu_seconds_per_iteration": cpu / iterations,
        "peak_bytes": peak,
        "share": {stage: spent.get(stage, 0.0) / whole for stage in STAGES},
    }


def _clocked(
    recipe: TrainRecipe,
    device: str,
    folder: str,
    wait: Callable[[], None],
    at_start: Callable[[], None] = lambda: None,
) -> tuple[float, float]:
    """Seconds, and CPU seconds of this process, of all iterations but the first ones."""
    begun: list[float] = []

    def on_progress(progress: loop.Progress) -> None:
        if progress.iteration == WARM_UP:
            wait()
            at_start()
            begun.extend((time.perf_counter(), time.process_time()))

    with tempfile.TemporaryDirectory() as runs:
        what = loop.Training(recipe, "box", Path(folder), Path(runs), device=device)
        loop.train(what, on_progress=on_progress)
        wait()
        return time.perf_counter() - begun[0], time.process_time() - begun[1]


@contextmanager
def _timed(wait: Callable[[], None], clock: Callable[[], float]) -> Iterator[dict[str, float]]:
    """Seconds of each stage without those it calls; what the discriminator and the local field
    call is theirs."""
    spent: dict[str, float] = {}
    running, since = ["other"], [clock()]

    def turn() -> None:
        wait()
        now = clock()
        spent[running[-1]] = spent.get(running[-1], 0.0) + now - since[0]
        since[0] = now

    def within(stage: Callable[..., str], function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            turn()
            inner = running[-1] if running[-1] in ("discriminator", "local") else stage(*args)
            running.append(inner)
            try:
                return function(*args, **kwargs)
            finally:
                turn()
                running.pop()

        return timed

    def of(name: str) -> Callable[..., str]:
        return lambda *_: name

    def of_descent(descent: Descent, *_: Any) -> str:
        return "optimiser" if isinstance(descent.network, PPD) else "discriminator"

    places: list[tuple[Any, str, Callable[..., str]]] = [
        (PackedSplit, "batch", of("data")),
        (PPD, "forward", of("forward")),
        (PPD, "fields", of("forward")),
        (PPD, "still", of("forward")),
        (objective, "generator_terms", of("losses")),
        (objective, "random_pose", of("discriminator")),
        (objective, "discriminator_terms", of("discriminator")),
        (Descent, "step", of_descent),
        (LocalLearning, "learn", of("local")),
        (torch.Tensor, "backward", of("backward")),
    ]
    with ExitStack() as patches:
        for place, name, stage in places:
            patches.enter_context(patch.object(place, name, within(stage, getattr(place, name))))
        yield spent
        turn()


def markdown(report: Row) -> str:
    """The table, as docs/ppd.md takes it."""
    about = report["about"]
    lines = [
        f"{about['machine']}, {about['threads']} thread, torch {about['torch']}, commit "
        f"{about['commit']}; load before: {about['load']:.1f}.",
        "",
        f"| recipe | device | iterations/s | CPU s/iteration | peak | {' | '.join(STAGES)} |",
        "|---" * (5 + len(STAGES)) + "|",
    ]
    for row in report["rows"]:
        shares = " | ".join(f"{100 * row['share'][stage]:.0f} %" for stage in STAGES)
        lines.append(
            f"| {row['recipe']} | {row['device']} | {row['iterations_per_second']:.3g} "
            f"| {row['cpu_seconds_per_iteration']:.3g} | {row['peak_bytes'] / 2**30:.2f} GiB "
            f"| {shares} |"
        )
    return "\n".join(lines) + "\n"


def _about(asked: argparse.Namespace) -> Row:
    return {
        "machine": f"{this_machine()['processor']}, {os.cpu_count()} cores",
        "threads": asked.threads,
        "torch": torch.__version__,
        "commit": (this_commit() or "unknown")[:12],
        "load": os.getloadavg()[0],
        "iterations": asked.iterations,
    }


if __name__ == "__main__":
    main()
