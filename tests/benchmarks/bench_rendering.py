"""How long a depth map takes, by backend and image size: python -m tests.benchmarks.bench_rendering

Runs of the backends take turns, so that a busy machine slows all of them alike; the table gives
the median of the runs. A run is one call: it includes what a backend sets up for each mesh, shared
by the frames of the call. The first run of each, which compiles and loads drivers, is not counted.
"""

import argparse
import os
import platform
import statistics
import time
from importlib.metadata import version

import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table

from articugen.core.backends import BACKENDS
from articugen.core.errors import MissingDriver, MissingExtra
from articugen.core.geometry import bounds
from articugen.core.recipe import ViewSettings
from articugen.core.records import LabelledMesh, Views
from articugen.rendering import render
from articugen.rendering.views import fusion_views

SIZES = (128, 256, 640)


def subdivided_box(times: int) -> LabelledMesh:
    """A closed box of 12 * 4^times triangles."""
    mesh = trimesh.creation.box((0.5, 0.6, 0.7))
    for _ in range(times):
        mesh = mesh.subdivide()
    return LabelledMesh(mesh.vertices, mesh.faces, np.zeros(len(mesh.faces), np.uint8))


def present_backends(mesh: LabelledMesh, views: Views, console: Console) -> list[str]:
    """The backends that run here, warmed up; the others are named with the reason."""
    present = []
    for backend in BACKENDS:
        try:
            render(mesh, views, backend=backend)
            present.append(backend)
        except (MissingExtra, MissingDriver) as missing:
            console.print(f"[bold]{backend}[/] is left out: {missing}")
    return present


def ms_per_frame(mesh: LabelledMesh, views: Views, backends: list[str], runs: int) -> list[float]:
    """The median over `runs` interleaved runs of each backend; a run draws all `views`."""
    seconds: dict[str, list[float]] = {backend: [] for backend in backends}
    for counted in [False] + [True] * runs:
        for backend in backends:
            start = time.perf_counter()
            render(mesh, views, backend=backend)
            if counted:
                seconds[backend].append(time.perf_counter() - start)
    return [1e3 * statistics.median(seconds[backend]) / len(views) for backend in backends]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=20, help="frames a run, 4 or more")
    parser.add_argument("--runs", type=int, default=5, help="runs of each backend and size")
    parser.add_argument("--projection", choices=("orthographic", "pinhole"), default="orthographic")
    arguments = parser.parse_args()
    console = Console()
    mesh = subdivided_box(times=5)
    box = bounds(mesh.vertices)

    def views_at(size: int) -> Views:
        settings = ViewSettings(
            count=arguments.views, resolution=size, projection=arguments.projection
        )
        return fusion_views(settings, box)

    backends = present_backends(mesh, views_at(SIZES[0]), console)
    table = Table(*("backend", *(f"{size}x{size}" for size in SIZES)))
    columns = [ms_per_frame(mesh, views_at(size), backends, arguments.runs) for size in SIZES]
    for backend, row in zip(backends, zip(*columns, strict=True), strict=True):
        table.add_row(backend, *(f"{ms:.2f}" for ms in row))
    table.title = f"ms a frame, {len(mesh.faces)} triangles, {arguments.projection}"
    table.caption = (
        f"median of {arguments.runs} interleaved runs of {arguments.views} frames; "
        f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, "
        f"numpy {version('numpy')}, numba {version('numba')}"
    )
    console.print(table)


if __name__ == "__main__":
    main()
