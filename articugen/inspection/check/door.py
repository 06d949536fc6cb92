"""Whole folders of models checked: `ag.check`, `articugen check`."""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from articugen.core.errors import ArticugenError, InvalidSource, machine_fault, printable
from articugen.core.processes import Limit, each
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
        path: a mesh, URDF, MJCF or USD file, or a folder of models; where it has none, of meshes.
        jobs: worker processes; 0 does it in this one, without limits on memory and time.
        pictures: draw each, for a report.
        on_model: called with each that is checked, and how many there are.

    Raises:
        InvalidSource: there is nothing to check.
    """
    tasks = tasks_in(Path(path))
    checks: dict[int, Checked] = {}
    for ended in each(partial(_checked, pictures=pictures), tasks, workers=jobs, limit=LIMIT):
        problem = f"its worker {ended.lost}"
        if ended.over:
            problem = f"it takes more than {getattr(LIMIT, ended.over):g} {ended.over}"
        checks[ended.number] = ended.value or _blank(tasks[ended.number], problem)
        on_model(checks[ended.number], len(tasks))
    return Checks(tuple(checks[number] for number in range(len(tasks))))


def tasks_in(path: Path) -> list[ObjectRef | Path]:
    """Return the models at a path, or the mesh files; InvalidSource where there is neither."""
    if path.suffix.lower() in read.SUFFIXES and not path.is_dir():
        return [path]
    try:
        return list(models(path))
    except InvalidSource:
        meshes = [p for p in path.rglob("*") if p.suffix.lower() in read.SUFFIXES and p.is_file()]
        if not meshes:
            raise
        return [*sorted(meshes)]


def _blank(task: ObjectRef | Path, problem: str) -> Checked:
    if isinstance(task, Path):
        return Checked(printable(task.name), printable(str(task)), problem)
    return Checked(printable(task.object_id), printable(str(task.location)), problem)


def _checked(task: ObjectRef | Path, *, pictures: bool) -> Checked:
    """Check one; whatever it does to us is its problem."""
    blank = _blank(task, "")
    try:
        if isinstance(task, Path):  # a mesh is a model of one part
            link = Link(task.stem, read.read_mesh(task))
            obj = ArticulatedObject(task.stem, "", (link,), (), np.eye(4), "")
        else:
            obj = readers.load(task)
        checked = check_model(obj, blank.name, blank.path)
        return replace(checked, picture=picture(obj) if pictures else "")
    except ArticugenError as error:
        problem = printable(str(error)).removeprefix(f"{blank.path}: ")
    except MemoryError:
        raise
    except Exception as error:
        if fault := machine_fault(error):
            raise fault from error
        problem = printable(f"cannot be checked ({type(error).__name__}: {error})")[:300]
    return replace(blank, problem=problem)
