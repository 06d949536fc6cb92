"""The commands that must survive everything, on next to nothing, and what they must come to."""

import hashlib
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.ppd_data import write_boxes
from tests.published import model_files, zipped

RECIPE = """
name: tiny
objects: {objects}
articulation: {{states: 3, revolute_degrees: [0, 90]}}
views: {{count: 12, resolution: 48}}
sampling: {{grids: [8], surface_points: 128, uniform_points: 128, near_points: 128,
  partial_views: 1, partial_points: 32, partial_resolution: 32}}
"""

TRAINING = """
extends: ppd_quick
data: {surface_points: 64, uniform_points: 32, near_points: 32, band_points: 0, varying_points: 0,
  validation_objects: 1}
model: {states: pose}
warm_start: {share: 0.0}
vary: {stretch: 0.0, mirror: false}
schedule: {batch: 2, optimiser: adam, stages: [{resolution: 8, iterations: 3}], log_every: 1,
  validate_every: 2, save_every: 1}
seeds: {count: 1}
"""

Result = dict[str, str]
"""What must be the same whatever happened: a digest for each name."""


@dataclass(frozen=True)
class Command:
    """A command of articugen and what it leaves.

    Attributes:
        begin: its arguments.
        result: what it came to.
        again: the arguments that go on with it; as `begin` where None.
    """

    name: str
    begin: tuple[str, ...]
    result: Callable[[], Result]
    again: Callable[[], tuple[str, ...]] | None = None

    def resumed(self) -> tuple[str, ...]:
        return self.again() if self.again else self.begin


def commands(inputs: Path, work: Path, *, jobs: int, objects: int = 2) -> dict[str, Command]:
    """Each by its name; inputs are made once, all that is written lies in `work`."""
    data = inputs / "box"
    if not inputs.exists():
        inputs.mkdir(parents=True)
        write_boxes(data, train=3, test=1, states=2)
        (inputs / "generate.yaml").write_text(RECIPE.format(objects=objects))
        (inputs / "train.yaml").write_text(TRAINING)
        models = {f"{n}/{name}": text for n in range(3) for name, text in model_files().items()}
        (inputs / "models.zip").write_bytes(zipped(models))
    generate = (
        "generate", "-c", "eyeglasses", "-r", str(inputs / "generate.yaml"), "-o", str(work),
        "-j", str(jobs),
    )  # fmt: skip
    train = (
        "train", "-c", "box", "-d", str(data), "-r", str(inputs / "train.yaml"),
        "--runs", str(work), "--threads", "1",
    )  # fmt: skip
    export = ("export", str(data), "--to", "ply", "--out", str(work / "ply"))
    fetch = ("fetch", "partnet-mobility", "--from", str(inputs / "models.zip"), "-o", str(work))
    return {
        "generate": Command("generate", generate, lambda: generated(work / "eyeglasses")),
        "export": Command("export", export, lambda: files(work / "ply")),
        "train": Command("train", train, lambda: trained(work / "box"), lambda: resumed(train)),
        "fetch": Command("fetch", fetch, lambda: files(work, without=".fetch")),
    }


def prepare(work: Path) -> None:
    """What must be there before a command is called."""
    (work / "models" / "procedural").mkdir(parents=True)


def files(folder: Path, without: str = "") -> Result:
    """Every file below a folder, hidden ones too."""
    found = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    return {
        str(name): hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in found.items()
        if without not in name.parts
    }


def generated(folder: Path) -> Result:
    """All but the manifest's timings; its content hash by itself."""
    manifest = json.loads((folder / "manifest.json").read_text())
    found = {name: digest for name, digest in files(folder).items() if name != "manifest.json"}
    return {**found, "content": manifest["content_sha256"]}


def trained(runs: Path) -> Result:
    """The weights, and the curve without its seconds, of the newest run."""
    from articugen.learning.commands import newest  # noqa: PLC0415 - imports torch
    from articugen.learning.run_folder import LATEST, RunFolder, read_checkpoint  # noqa: PLC0415
    from tests.digests import digest  # noqa: PLC0415

    run = RunFolder(newest(runs))
    point = read_checkpoint(run.path / LATEST)
    curve = [{k: v for k, v in line.items() if k != "seconds"} for line in run.metrics()]
    hidden = sorted(path.name for path in run.path.glob(".*"))
    return {
        "weights": digest(point.state),
        "iteration": str(point.iteration),
        "curve": hashlib.sha256(json.dumps(curve).encode()).hexdigest(),
        "hidden": str(hidden),
    }


def resumed(train: tuple[str, ...]) -> tuple[str, ...]:
    """With --resume, where the run got so far as to be one."""
    runs = Path(train[train.index("--runs") + 1]) / train[train.index("-c") + 1]
    begun = sorted(path.parent for path in runs.glob("*/run.json"))
    return (*train, "--resume", str(begun[-1])) if begun else train


PYTHON = (sys.executable, "-m", "articugen")
