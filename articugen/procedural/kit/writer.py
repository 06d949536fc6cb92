"""A `Model` as files: `model.urdf`, OBJ meshes, `semantics.txt` and the exact `solids.json`.

The same model gives the same bytes.

`solids.json` holds the truth, in the frame of each link of the URDF beside it:

    {"object_id": "laptop_0003", "category": "laptop", "messy": false,
     "links": {"<link name>": {
         "cells":  [{"box": [[x, y, z], [x, y, z]], "half_spaces": [[nx, ny, nz, d], ...]}, ...],
         "sheets": [{"triangles": [[[x, y, z], [x, y, z], [x, y, z]], ...], "thickness": t,
                     "backed": false}, ...]}}}

A point x is inside a cell if n . x <= d for all its half-spaces; it is inside a sheet if its foot
lies in one of the triangles, no further away than thickness / 2. A link is the union of both. A
sheet that is `backed` lies on something and is drawn as its outer face; any other is drawn as its
middle, which has no thickness at all: `thickness` is then that of the panel it stands for.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.files import make_folder, within, writing
from articugen.core.geometry import apply, invert_rigid, rotation_from_rpy, transform
from articugen.core.portable import turned
from articugen.meshes.model_text import Joint, Visual, obj_text, urdf_text
from articugen.procedural.kit import rough
from articugen.procedural.kit.model import ROOT_NAME, Model, ModelLink

URDF_NAME = "model.urdf"
TRUTH_NAME = "solids.json"

_YUP_RPY = (1.5707963267948966, 0.0, -1.5707963267948966)
"""Turns meshes with y up, as PartNet-Mobility publishes them, to z up."""


def model_files(model: Model, *, object_id: str, messy: int = 0) -> dict[str, bytes]:
    """Return the files of `model`, by name: `model.urdf`, OBJ meshes and `semantics.txt`.

    Args:
        messy: the same object as real data come, see `rough`: 1 as badly, 2 as roughly; y-up
            meshes turned by a fixed joint, the body as the last link.
    """
    contents: dict[str, str] = {}
    visuals: dict[str, list[str]] = {}
    for link, T_link_object in _posed(model, object_id, messy):
        if messy:  # The meshes stay in the object's frame: each visual's origin moves them.
            T = transform(_turn(messy).T)
            pieces = rough.meshes(link, object_id, messy)
            meshes = {f"{name}.obj": obj_text([(apply(T, v), f)]) for name, (v, f) in pieces}
        else:
            pieces = [(s.moved(T_link_object).vertices, s.faces) for s in link.solids]
            meshes = {f"{link.name}.obj": obj_text(pieces)}
        visuals[link.name] = list(meshes)
        contents |= meshes
    contents[URDF_NAME] = _urdf(model, object_id, visuals, _turn(messy), messy)
    # PartNet-Mobility's table: link, how it moves, what it is
    moves = {"fixed": "fixed", "revolute": "hinge", "prismatic": "slider"}
    kind = {joint.child: moves[joint.kind] for joint in model.joints}
    contents["semantics.txt"] = "".join(
        f"{link.name} {kind.get(link.name, 'heavy')} {link.semantic}\n" for link in model.links
    )
    return {name: text.encode() for name, text in contents.items()}


def write_model(
    model: Model, folder: Path, *, object_id: str, category: str, messy: int = 0
) -> None:
    """Write the files of `model` and its truth into a folder.

    Args:
        messy: as in `model_files`.

    Raises:
        MachineFault: the folder cannot be written to.
    """
    contents = model_files(model, object_id=object_id, messy=messy)
    contents[TRUTH_NAME] = truth_file(model, object_id=object_id, category=category, messy=messy)
    with writing(folder):
        make_folder(folder)
        for name, data in contents.items():
            within(folder, name).write_bytes(data)


def truth_file(model: Model, *, object_id: str, category: str, messy: int = 0) -> bytes:
    """Return what `solids.json` holds."""
    truth = {link.name: _link_truth(link, T) for link, T in _posed(model, object_id, messy)}
    header = {"object_id": object_id, "category": category, "messy": messy > 0, "links": truth}
    return f"{json.dumps(header, separators=(',', ':'))}\n".encode()


def _turn(messy: int) -> Floats:
    """Return the rotation (3, 3) from the object's frame to that of its root link."""
    return rotation_from_rpy(_YUP_RPY).round() if messy else np.eye(3)


def _posed(model: Model, object_id: str, messy: int) -> Iterator[tuple[ModelLink, Floats]]:
    """Yield the links, whose solids have the sheets that are written, and T_link_object."""
    if messy == rough.ROUGH:
        model = rough.decorated(model, object_id)
    pivot = {joint.child: np.asarray(joint.origin, np.float64) for joint in model.joints}
    limit = rough.SHEET_LIMIT * float(np.max(model.bounds[1] - model.bounds[0]))
    for link in model.links:
        solids = tuple(
            s if not s.sheet or (messy and s.sheet.thickness <= limit) else replace(s, sheet=None)
            for s in link.solids
        )
        at = pivot.get(link.name, np.zeros(3))
        yield replace(link, solids=solids), invert_rigid(transform(_turn(messy), at))


def _link_truth(link: ModelLink, T_link_object: Floats) -> dict[str, list]:
    cells, slabs = [], []
    for solid in link.solids:
        here = solid.moved(T_link_object)
        if here.sheet is not None:
            thickness = round(here.sheet.thickness, 12)
            triangles = _rounded(here.sheet.triangles)
            backed = here.sheet.seen != 0
            slabs.append({"triangles": triangles, "thickness": thickness, "backed": backed})
            continue
        for planes, box in zip(here.half_spaces, here.cell_bounds, strict=True):
            cells.append({"box": _rounded(box), "half_spaces": _rounded(planes)})
    return {"cells": cells, "sheets": slabs}


def _rounded(array: Floats) -> list:
    return (array.round(12) + 0.0).tolist()


def _urdf(model: Model, object_id: str, files: dict[str, list[str]], R: Floats, messy: int) -> str:
    body = model.links[0].name
    pivot = {body: np.zeros(3)}
    joints = []
    if messy:
        joints.append(Joint("stand", "fixed", ROOT_NAME, body, np.zeros(3), _YUP_RPY))
    for j in model.joints:
        pivot[j.child] = np.asarray(j.origin, np.float64)
        shift = turned(R.T, pivot[j.child] - pivot[j.parent])
        axis = None if j.kind == "fixed" else turned(R.T, j.axis)
        ends = (j.lower, j.upper)
        joints.append(Joint(j.name, j.kind, j.parent, j.child, shift, (0, 0, 0), axis, *ends))
    links = {
        name: [Visual(file, -turned(R.T, pivot[name]) if messy else np.zeros(3)) for file in text]
        for name, text in files.items()
    }
    if messy:  # As PartNet-Mobility has it: an empty base first, the body last.
        links = {ROOT_NAME: [], **links}
        links[body] = links.pop(body)
    return urdf_text(object_id, links, joints)
