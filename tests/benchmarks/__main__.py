"""The benchmark: ours beside what one would use instead, on the same meshes in one run.

python -m tests.benchmarks [--quick] [--objects 2] [--states 3] [--runs 3] [--out benchmarks_out]

Prints tables and saves report.json, report.md, glance.md, methods.png and scaling.png in the folder
--out. Bundled objects are written to a temporary folder. With ARTICUGEN_REAL_MODELS, a real model
of each category there is measured too.
"""

import json
import os
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Console

from articugen.instance import preparing
from tests.benchmarks import cases, glance, measure, memory, ours, scaling, tables
from tests.benchmarks.about import about
from tests.benchmarks.cases import Model
from tests.benchmarks.options import Options, dense, parse
from tests.benchmarks.peers import Peer, peers
from tests.benchmarks.rows import Results, Row


def main() -> None:
    options = parse()
    console = Console()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="articugen-bench-") as folder:
        report = _measured(options, Path(folder), console)
    report["about"]["minutes"] = (time.perf_counter() - started) / 60.0
    options.out.mkdir(parents=True, exist_ok=True)
    missing_picture = scaling.draw(report["scaling"], options.out / "scaling.png")
    glance.draw(report, options.out / "methods.png")
    (options.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    (options.out / "report.md").write_text(tables.markdown(report))
    (options.out / "glance.md").write_text(glance.markdown(report))
    wide = Console(width=max(console.width, 200))
    for table in tables.all_tables(report):
        table.print(wide)
    console.print(missing_picture or f"drawn: {options.out}/methods.png, scaling.png", markup=False)
    console.print(f"saved: {options.out}/report.json, report.md, glance.md")


def _measured(options: Options, folder: Path, console: Console) -> Row:
    results, started = Results(), time.perf_counter()
    all_peers = peers(dense(options.quick)) if options.peers else ()
    present = [peer for peer in all_peers if not _absent(peer, options.quick)]
    models = [
        cases.bundled(category, index, messy=messy)
        for category in options.categories
        for index in range(options.objects)
        for messy in (False, True)
    ]
    with console.status("") as status:

        def say(text: str) -> None:
            if console.is_terminal:
                status.update(text)
            else:
                console.print(f"{time.perf_counter() - started:6.1f} s  {text}")

        measure.shapes(present, models[0], results, say)
        measure.objects(models, present, options.extent, results, say, folder)
        measure.real_models(
            _real_models(options.categories), present, options.extent, results, say, folder
        )
        end_to_end = _end_to_end(*options.end_to_end, folder, say)
        laptop = next(model for model in models if model.ref.category == "laptop")
        curves = scaling.curves(laptop, quick=options.quick, say=say)
        peaks = _memory(models[0], all_peers, options, folder, say)
    rate = [(int(n), end_to_end["instances"] / s) for n, s in end_to_end["seconds"].items()]
    curves = {"workers": rate} | curves
    return {
        "about": about(options.quick, [peer.versions for peer in all_peers]),
        "methods": [{"name": "ours", "absent": ""}]
        + [{"name": peer.name, "absent": _absent(peer, options.quick)} for peer in all_peers],
        "categories": list(options.categories),
        "labels": options.extent.labels,
        "end_to_end": end_to_end,
        "scaling": curves,
        "memory": peaks,
    } | asdict(results)


def _absent(peer: Peer, quick: bool) -> str:
    """Why a peer is left out, or nothing."""
    if peer.missing:
        return f"not installed: {', '.join(peer.missing)}"
    return "left out of a quick run" if quick and peer.slow else ""


def _real_models(categories: tuple[str, ...]) -> list[Model]:
    """The first of each of these categories that there is."""
    root = os.environ.get("ARTICUGEN_REAL_MODELS")
    if not root:
        return []
    folders = [(Path(root) / "partnet_mobility" / name, name) for name in categories]
    return [cases.real(sorted(f.iterdir())[0], name) for f, name in folders if f.is_dir()]


def _end_to_end(category: str, objects: int, states: int, folder: Path, say: measure.Say) -> Row:
    seconds = {}
    for index in range(objects):  # written once, for whatever number of workers
        cases.bundled(category, index, messy=False)
    for jobs in scaling.worker_counts():
        say(f"end to end: {category}, {objects} x {states}, {jobs} workers")
        seconds[jobs] = ours.end_to_end(folder, category, objects=objects, states=states, jobs=jobs)
    return {"category": category, "instances": objects * (states + 1), "seconds": seconds}


def _memory(
    model: Model, all_peers: tuple[Peer, ...], options: Options, folder: Path, say: measure.Say
) -> Row:
    """Peak megabytes of each method on the first object."""
    prepared = preparing.prepare(model.obj, model.recipe, 0)
    made = cases.case(model, prepared, 1, 10_000)
    path = folder / "mesh.npz"
    np.savez(path, vertices=made.mesh.vertices, faces=made.mesh.faces, asked=made.asked)
    say("memory: nothing but the libraries that all share")
    peaks: Row = {"nothing": memory.measure("peer", "none", path, int(options.quick))}
    say("memory: ours")
    peaks["ours"] = memory.measure("ours", model.ref.category, 0, options.extent.states)
    for number, peer in enumerate(all_peers):
        if not _absent(peer, options.quick):
            say(f"memory: {peer.name}")
            peaks[peer.name] = memory.measure("peer", number, path, int(options.quick))
    return peaks


if __name__ == "__main__":
    main()
