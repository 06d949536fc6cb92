"""What the commands of learning do, as functions that a notebook can call as well."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from articugen.core.errors import ArticugenError, InvalidCheckpoint, MissingExtra

try:
    import safetensors  # noqa: F401 - what checkpoints are written with
    import scipy  # noqa: F401 - what parts are matched with
    import torch
except ImportError as error:
    name = error.name if error.name in ("safetensors", "scipy") else "torch"
    raise MissingExtra(name, "ppd") from None

from articugen.core.files import write_atomically
from articugen.core.processes import default_jobs
from articugen.core.records import Floats, JointKind, dequantize
from articugen.core.schema import Instance
from articugen.core.yaml_files import with_settings
from articugen.evaluation.evaluate import Reconstruct, check_splits
from articugen.evaluation.evaluate import evaluate as evaluate_as_paper
from articugen.evaluation.reconstruction import Reconstruction
from articugen.evaluation.report import markdown
from articugen.evaluation.report import tables as written
from articugen.evaluation.results import FILE, EvaluatedRun, RunEvaluation, read_evaluation
from articugen.evaluation.tally import Protocol
from articugen.learning import loop
from articugen.learning.data.fitness import lying_otherwise, training_objects
from articugen.learning.data.windows import Endless
from articugen.learning.loop import Notify
from articugen.learning.method import Learner, OfThread, Yardstick, find_method, load_recipe
from articugen.learning.predict import (
    cloud_of_shard,
    cut,
    draw_cut,
    seen_by_a_camera,
    write_cut,
    write_rig,
)
from articugen.learning.race import race
from articugen.learning.recipe import TrainRecipe
from articugen.learning.run_folder import LATEST, RunFolder, newest, read_checkpoint
from articugen.learning.tensors import one_thread
from articugen.meshes.points import Cloud, cloud_of_file
from articugen.store.manifest import Manifest

FolderLike = str | os.PathLike[str]
RecipeLike = str | Path | Mapping[str, Any] | TrainRecipe

STATES = 8
"""Random states of a test object that are evaluated, unless said otherwise: label IoU differs
more between objects than between states (docs/ppd.md), so more take longer and add little."""

FEW_OBJECTS = 20
"""Fewer than the smallest category's 24."""

_PAPER = Yardstick(
    32, lambda learner, cloud, resolution: learner.reconstruct(cloud, resolution=resolution),
    evaluate_as_paper, finer=64,
)  # fmt: skip
"""The paper names the first grid for F-score and Chamfer-L1; for labels none, the authors' code has
the second."""


def train(
    data: FolderLike | Sequence[FolderLike] | Endless,
    recipe: RecipeLike | None = None,
    *,
    method: str | None = None,
    changes: Sequence[str] = (),
    category: str | None = None,
    runs: FolderLike = "runs",
    seed: int = 0,
    seeds: int | None = None,
    jobs: int = 0,
    resume: FolderLike | None = None,
    device: str = "cpu",
    threads: int = 0,
    on_progress: Notify = lambda _: None,
) -> RunFolder:
    """Train on a data set, or on several, or go on with a run.

    Args:
        data: the folder of a data set, or a sequence of those of several that are learned from
            together: real objects beside bundled ones, say. All are of one category and made with
            the same numbers of points and grids; no object is in two. Or an `ag.stream(...)`.
        recipe: a name under recipes/, a YAML file, a mapping of keys that may say `extends`, or a
            recipe; None is the method's own, and where a run is resumed, that run's.
        method: whose recipe it must be; None is whosever it is.
        changes: other values than the recipe's, each `section.key=value`.
        category: what the data set must hold; None is whatever it holds.
        runs: the run's folder is <runs>/<category>/<number>.
        seed: of weights and batches, the first of several.
        seeds: how many race; None is what the recipe says.
        jobs: seeds that are trained at a time; 0 is one a CPU core. On a stream it is one.
        resume: the folder of a run to go on with instead; its recipe and seed hold.
        device: cpu, cuda or cuda:1.
        threads: of the CPU; 0 leaves it to torch.
        on_progress: called after each iteration.

    Returns:
        The run's folder.

    Raises:
        InvalidRecipe, CorruptShard, UnfitData, InvalidCheckpoint, TrainingDiverged, ArticugenError:
            as each says.
    """
    prepare(device, threads)
    if resume is None:
        settings = with_settings(load_recipe(recipe, method=method), changes)
    else:
        resume = Path(resume)
        settings, seed = RunFolder(resume).recipe(), RunFolder(resume).about()["seed"]
        wanted = with_settings(load_recipe(recipe or settings, method=method), changes)
        if wanted.sha256() != settings.model_copy(update={"seeds": wanted.seeds}).sha256():
            raise InvalidCheckpoint(
                f"{resume}: was started with another recipe; leave out --recipe and --set, or "
                "start a new run"
            )
        seeds = None
    if seeds is not None:
        settings = with_settings(settings, [f"seeds.count={seeds}"])
    source = data.for_training() if isinstance(data, Endless) else _folders(data)
    category = category or (
        source.category if isinstance(source, Endless) else Manifest.read(source[0]).category
    )
    what = loop.Training(
        settings, category, source, Path(runs) / category, seed, resume=resume, device=device
    )
    # of one object none is held out, by which seeds could be judged; a race's seed goes on alone
    is_single = not isinstance(source, Endless) and sum(training_objects(source)) == 1
    if settings.seeds.count == 1 or is_single or (resume and resume.parent.name == loop.SEEDS):
        return loop.train(what, on_progress=on_progress)
    is_alone = device != "cpu" or isinstance(source, Endless)
    at_once = 1 if is_alone else jobs or os.cpu_count() or 1
    return race(what, jobs=min(at_once, settings.seeds.count), on_progress=on_progress)


@one_thread()
def evaluate(
    run: FolderLike,
    data: FolderLike,
    *,
    protocol: str = "paper",
    resolution: int | None = None,
    label_poses: str = "canonical",
    states: int | None = STATES,
    jobs: int = 0,
    on: FolderLike | None = None,
    on_object: Callable[[str], None] = lambda _: None,
) -> RunEvaluation:
    """Evaluate a run's last checkpoint on the test objects, and write <run>/evaluation/.

    Args:
        run: a run's folder, or that of a category's runs, whose newest is meant.
        data: the folder of a data set of the same category.
        protocol: `paper`, or one of the method's own.
        resolution: of the meshes' grid; None is the protocol's. The paper's measures labels on a
            finer one as well.
        label_poses: whose poses vote for labels, `canonical`, or `all` for another label IoU too.
        states: random states an object; None is all, as in the paper.
        jobs: objects at a time, a thread each; 0 is as many as there are cores. What is measured
            stays the same.
        on: the folder of another data set, all objects of which are tested instead: none of them
            was trained on.
        on_object: called with the name of each object that was evaluated.

    Returns:
        What was measured; of clouds that one camera sees, where the run learned from those.

    Raises:
        InvalidCheckpoint: the run cannot be read.
        UnfitData: a data set has no such object, or is of another category.
        ArticugenError: there is no such protocol, or `on` is called as another data set was.
    """
    if label_poses not in ("canonical", "all"):
        raise ArticugenError(f"--label-poses {label_poses}: canonical or all")
    folder, out = newest(run), evaluation_folder(run, protocol, on)
    point = read_checkpoint(folder / LATEST)
    yardsticks = {"paper": _PAPER, **find_method(point.recipe.method).yardsticks()}
    if protocol not in yardsticks:
        choice = " or ".join(yardsticks)
        raise ArticugenError(f"--protocol {protocol}: {point.recipe.method} has {choice} alone")
    by = yardsticks[protocol]
    finer, resolution = None if resolution else by.finer, resolution or by.resolution
    measure = partial(
        by.evaluate, Path(data),
        protocol=Protocol(label_poses=label_poses, states=states,
                          occupancy=point.recipe.data.occupancy),
        category=point.category, on=None if on is None else Path(on),
        jobs=jobs or default_jobs(), on_object=on_object,
    )  # fmt: skip

    learner, budget = point.learner(), point.recipe.budget
    of_thread = OfThread(learner)

    def at(grid: int) -> Reconstruct:
        def reconstruct(instance: Instance) -> Reconstruction:
            learner = of_thread.learner
            return by.reconstruct(learner, _given(learner, instance), grid)

        return reconstruct

    measured = measure(at(resolution), **({"finer": at(finer)} if finer else {}))
    evaluated = EvaluatedRun(
        **point.about(), input="depth" if learner.inputs.partial else "complete", protocol=protocol,
        label_poses="both" if label_poses == "all" else "canonical", states=states,
        knows=learner.inputs.knows, parameters=learner.parameters, resolution=resolution,
        finer=finer, seconds=RunFolder(folder).seconds() + (budget.start if budget else 0.0),
        on=None if on is None else str(on),
    )  # fmt: skip
    result = RunEvaluation(run=evaluated, **dict(measured))
    out.mkdir(exist_ok=True)
    result.write(out)
    write_atomically(out / "evaluation.md", markdown(result).encode())
    return result


def evaluation_folder(
    run: FolderLike, protocol: str = "paper", on: FolderLike | None = None
) -> Path:
    """Return where `evaluate` writes to; ArticugenError where that is of another data set."""
    parts = ["evaluation", *([] if protocol == "paper" else [protocol])]
    parts += [] if on is None else ["on", os.path.basename(os.path.abspath(on))]
    folder = newest(run) / "-".join(parts)
    if on is not None and os.path.exists(on) and (folder / FILE).is_file():
        before = read_evaluation(folder.parent, folder.name).run.on or on
        if os.path.exists(before) and not os.path.samefile(before, on):
            raise ArticugenError(f"{folder}: is of {before}; move it away, or rename {on}")
    return folder


def draw(run: FolderLike, data: FolderLike, result: RunEvaluation) -> list[Path]:
    """Draw an evaluation's figures into its folder, and return their paths.

    Args:
        run, data: as `evaluate` took them.
        result: what it has returned.
    """
    from articugen.evaluation import figures  # noqa: PLC0415

    on = Path(result.run.on) if result.run.on else None
    folder = evaluation_folder(run, result.run.protocol, on)
    learner = read_checkpoint(newest(run) / LATEST).learner()
    paths = [folder / "reconstructions.png"]
    reconstruct = _drawn_by(learner, result)
    figures.draw_reconstructions(paths[0], Path(data), reconstruct, result, on=on)
    if hasattr(learner, "between"):  # what tells shapes and poses apart
        paths.append(folder / "interpolations.png")
        between = _drawn_by(learner, result, "between")
        figures.draw_interpolations(paths[1], Path(data), between, result, on=on)
    return paths


def _given(learner: Learner, instance: Instance) -> Floats:
    """Return the points (n, 3) of an instance that a learner is given."""
    if learner.inputs.partial:
        return seen_by_a_camera(instance)
    return dequantize(instance.surface_points)


def _drawn_by(learner: Any, result: RunEvaluation, of: str = "reconstruct") -> Callable[..., Any]:
    """Return a learner's `reconstruct` or `between`, of instances, by meshes that are finer than
    those that were evaluated."""
    make = partial(getattr(learner, of), resolution=min(4 * result.run.resolution, 128))
    return lambda *some, **more: make(*(_given(learner, one) for one in some), **more)


def tables(runs: Sequence[FolderLike]) -> str:
    """Return the paper's tables over all evaluated runs in these folders."""
    return written([read_evaluation(run) for run in evaluated(runs)])


def evaluated(folders: Sequence[FolderLike]) -> list[Path]:
    """Return the folders of the evaluated runs in these folders; the newest of each comes last.

    Raises:
        InvalidCheckpoint: a folder holds none.
    """
    runs: list[Path] = []
    for folder in map(Path, folders):
        there = [path.parents[1] for path in folder.rglob("evaluation/evaluation.json")]
        runs += sorted(there, key=lambda run: [(len(part), part) for part in run.parts])
        if not there:
            read_evaluation(newest(folder))  # which says what is missing
    return runs


def draw_examples(
    runs: Sequence[FolderLike], path: FolderLike, data: FolderLike | None = None
) -> Path:
    """Draw a test object of each category in three states, and what each evaluated run makes of it.

    Args:
        runs: as `tables` takes them.
        path: of the picture, a PNG.
        data: a data set, or a folder with one named after each category; None is what each run was
            trained on.

    Raises:
        InvalidCheckpoint: a run cannot be read, or was not evaluated.
        UnfitData: a data set has no test object, or is of another category.
        ArticugenError: the picture cannot be written.
    """
    from articugen.evaluation import figures  # noqa: PLC0415

    examples = []
    for folder in evaluated(runs):
        result, point = read_evaluation(folder), read_checkpoint(folder / LATEST)
        folder_of_data = Path(data or RunFolder(folder).about()["data"]["folder"])
        if data and (folder_of_data / point.category).is_dir():
            folder_of_data /= point.category
        check_splits(folder_of_data, point.category)
        about = (point.category, point.recipe.name, folder_of_data)
        examples.append(figures.Example(*about, _drawn_by(point.learner(), result), result))
    figures.draw_examples(Path(path), examples)
    return Path(path)


@dataclass(frozen=True)
class Predicted:
    """Outcome of `predict`.

    Attributes:
        cloud: what was given.
        found: what the model makes of it.
        path: of the URDF of what is reconstructed.
        cut: of the GLB of what was given, cut into parts; of its URDF too, if that was a mesh; of
            the picture.
    """

    cloud: Cloud
    found: Reconstruction
    path: Path
    cut: tuple[Path, ...]

    def lines(self) -> list[str]:
        """Return a line for each part that has a surface; kind and state of its joint, in the
        cloud's own unit."""
        joints, lines = self.found.joints, []
        for i in sorted(set(self.found.part.tolist())):
            if joints is None:
                lines.append(f"part {i}")
                continue
            kind = str(JointKind(joints.kind[i]))
            unit = self.cloud.frame.scale if kind == "prismatic" else 1.0
            lines.append(f"part {i}: {kind}, state {joints.state[i] * unit:.3f}")
        return lines


def predict(
    run: FolderLike,
    cloud: FolderLike,
    *,
    row: int = 0,
    camera: int = 0,
    fit: bool = False,
    out: FolderLike = "rig",
    resolution: int = 128,
    on_progress: Callable[[str], None] = lambda _: None,
) -> Predicted:
    """Segment and rig a shape: what is reconstructed, and what was given, cut into the parts, as
    meshes on the predicted joints.

    Args:
        run: a run's folder, or that of a category's runs, whose newest is meant.
        cloud: a shard, or a file of points.
        row: which instance of a shard.
        camera: which of a shard's depth cameras, where the run learned from what one sees; a file's
            points are taken for what some camera sees then.
        fit: bring the file's box into the unit frame first.
        out: the folder for meshes, URDF and GLB.
        resolution: of the meshes' grid.
        on_progress: called with what is being done, of a large mesh with counts.

    Raises:
        InvalidCheckpoint: the run cannot be read.
        InvalidSource, CorruptShard: the cloud cannot be made sense of.
        ArticugenError: the model sees no surface.
    """
    folder, cloud = newest(run), Path(cloud)
    point = read_checkpoint(folder / LATEST)
    learner = point.learner()
    if cloud.suffix == ".h5":
        eye = camera if learner.inputs.partial else None
        shape = cloud_of_shard(cloud, row, category=point.category, camera=eye)
    else:
        shape = cloud_of_file(cloud, fit=fit)
    predicted = learner.reconstruct(shape.points, resolution=resolution)
    path = write_rig(predicted, Path(out), frame=shape.frame)
    pieces = cut(shape, predicted, on_progress)
    on_progress("writing and drawing ...")
    files = write_cut(pieces, Path(out), shape.frame)
    files.append(draw_cut(pieces, predicted, Path(out) / "input.png"))
    return Predicted(shape, predicted, path, tuple(files))


def hints(data: FolderLike | Sequence[FolderLike] = ()) -> list[str]:
    """Return advice before a training on a data set, on several, or on a stream."""
    folders, advice = _folders(data) if data else (), []
    counts = training_objects(folders)
    if folders and sum(counts) < FEW_OBJECTS:
        advice.append(
            f"{folders[0]}: {sum(counts)} training objects show that all works, but teach little "
            "that carries over to others; for that make the full data set, without RECIPE=quick or "
            "OBJECTS="
        )
    for folder, count in zip(folders, counts, strict=True):
        if others := lying_otherwise(folder):
            advice.append(
                f"{folder}: the joints of {len(others)} of the {count} training objects lie along "
                f"other axes than most ({', '.join(others[:3])}{', ...' if others[3:] else ''}); a "
                "category is learnt in a frame that its objects share, so turn those that lie "
                "turned by mistake"
            )
    return advice


def _folders(data: FolderLike | Sequence[FolderLike]) -> tuple[Path, ...]:
    """Return the folder of one data set, or those of several, as the loop takes them; or raise."""
    folders = (data,) if isinstance(data, str | os.PathLike) else tuple(data)
    if not folders:
        raise ArticugenError("no data set to train on; give its folder")
    return tuple(map(Path, folders))


def prepare(device: str = "cpu", threads: int = 0) -> None:
    """Raise ArticugenError where the device is not there."""
    if threads:
        torch.set_num_threads(threads)
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        raise ArticugenError(
            f"--device {device}: torch sees no such device; use --device cpu"
        ) from None
