"""Whole folders of models checked: `ag.check`, `articugen check`."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from articugen.core.errors import ArticugenError, InvalidSource, machine_fault, printable
from articugen.core.processes import Crew, Limit
from articugen.core.records import ArticulatedObject, Link
from articugen.inspection.check.model import Checked, Checks, check_model
from articugen.inspection.check.page import picture
from articugen.instance.maker import models
from articugen.meshes import read
from articugen.sources import readers
from articugen.sources.refs import ObjectRef

LIMIT = Limit(seconds=600.0, megabytes=6000.0)  # of one model


def check(
    path: str | os.PathLike[str],
    *,
    jobs: int = 1,
    pictures: bool = False,
    on_model: Callable[[Checked, int], None] = lambda *_: None,
) -> Checks:
    """Check models of others before anything is made of them: meshes, joints, what is solid.

    Args:
        path: a mesh, URDF or USD file, or a folder of models; where it has none, of meshes.
        jobs: worker processes; 0 does it in this one, without limits on memory and time.
        pictures: draw each, for a report.
        on_model: called with each that is checked, and how many there are.

    Raises:
        InvalidSource: there is nothing to check.
    """
    tasks = tasks_in(Path(path))
    checks: dict[int, Checked] = {}
    function = partial(_check_one, pictures=pictures)
    with Crew(function, workers=min(jobs, len(tasks)), limit=LIMIT, name=_name) as crew:
        for ended in crew.each(tasks):
            task = tasks[ended.number]
            over = ended.over and f"takes more than {getattr(LIMIT, ended.over):g} {ended.over}"
            lost = ended.lost and f"its worker {ended.lost}"
            checks[ended.number] = ended.value or _problem(task, over or lost or "")
            on_model(checks[ended.number], len(tasks))
    return Checks(tuple(checks[number] for number in sorted(checks)))


def tasks_in(path: Path) -> Sequence[ObjectRef | Path]:
    """Return the models at a path, or the mesh files; InvalidSource where there is neither."""
    if path.suffix.lower() in read.SUFFIXES and not path.is_dir():
        return [path]
    try:
        return models(path)
    except InvalidSource:
        meshes = [p for p in path.rglob("*") if p.suffix.lower() in read.SUFFIXES and p.is_file()]
        if meshes:
            return sorted(meshes)
        raise


def _name(task: ObjectRef | Path) -> str:
    return str(task) if isinstance(task, Path) else task.object_id


def _problem(task: ObjectRef | Path, problem: str) -> Checked:
    where = task if isinstance(task, Path) else task.location
    return Checked(printable(_name(task)), printable(str(where)), problem)


def _check_one(task: ObjectRef | Path, *, pictures: bool) -> Checked:
    """Check one; whatever it does to us is its problem."""
    blank = _problem(task, "")
    try:
        obj = _of_mesh(task) if isinstance(task, Path) else readers.load(task)
        checked = check_model(obj, blank.name, blank.path)
        return replace(checked, picture=picture(obj) if pictures else "")
    except ArticugenError as error:
        return replace(blank, problem=printable(str(error).removeprefix(f"{blank.path}: ")))
    except MemoryError:
        raise
    except Exception as error:
        if fault := machine_fault(error):
            raise fault from error
        return replace(blank, problem=printable(f"{type(error).__name__}: {error}")[:300])


def _of_mesh(path: Path) -> ArticulatedObject:
    """Return a mesh file as a model of one part."""
    mesh = read.read_mesh(path)
    return ArticulatedObject(path.stem, "", (Link(path.stem, mesh),), (), np.eye(4), "")
