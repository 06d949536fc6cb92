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
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from articugen.core.errors import MachineFault
from articugen.core.files import cannot_write, make_folder, within
from articugen.core.geometry import Array, apply, cross, invert_rigid, rotation_from_rpy, transform
from articugen.core.portable import norm, product, turned
from articugen.meshes.model_text import Joint, Visual, obj_text, urdf_text
from articugen.procedural.kit.model import ROOT_NAME, Model, ModelLink
from articugen.procedural.kit.solids import Solid

URDF_NAME = "model.urdf"
TRUTH_NAME = "solids.json"

_YUP_RPY = (1.5707963267948966, 0.0, -1.5707963267948966)
"""Turns meshes with y up, as PartNet-Mobility publishes them, to z up."""

_SHEET_LIMIT = 0.013
"""Panels thinner than this part of the object's longest side become sheets in messy models."""


def model_files(
    model: Model, *, object_id: str, category: str, messy: bool = False
) -> dict[str, bytes]:
    """Return the files of `model`, by name, without the truth.

    Args:
        messy: the same object as real data come: triangles twice with both windings, one visual a
            solid, y-up meshes turned by a fixed joint, the body as the last link, hidden faces left
            open, thin panels as sheets.
    """
    contents: dict[str, str] = {}
    visuals: dict[str, list[str]] = {}
    for link, sheets, T_link_object in _posed(model, messy):
        # Messy meshes stay in the object's frame: each visual's origin takes the pivot away.
        T_mesh_object = transform(_turn(messy).T) if messy else T_link_object
        meshes = _meshes(link, sheets, T_mesh_object, messy)
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
    model: Model, folder: Path, *, object_id: str, category: str, messy: bool = False
) -> None:
    """Write the files of `model` and its truth into a folder.

    Args:
        messy: as in `model_files`.

    Raises:
        MachineFault: the folder cannot be written to.
    """
    contents = model_files(model, object_id=object_id, category=category, messy=messy)
    contents[TRUTH_NAME] = truth_file(model, object_id=object_id, category=category, messy=messy)
    try:
        make_folder(folder)
        for name, data in contents.items():
            within(folder, name).write_bytes(data)
    except OSError as error:
        raise MachineFault(cannot_write(folder, error)) from error


def truth_file(model: Model, *, object_id: str, category: str, messy: bool = False) -> bytes:
    """Return what `solids.json` holds."""
    truth = {link.name: _link_truth(link, sheets, T) for link, sheets, T in _posed(model, messy)}
    header = {"object_id": object_id, "category": category, "messy": messy, "links": truth}
    return f"{json.dumps(header, separators=(',', ':'))}\n".encode()


def _turn(messy: bool) -> Array:
    """Return the rotation (3, 3) from the object's frame to that of its root link."""
    return rotation_from_rpy(_YUP_RPY).round() if messy else np.eye(3)


def _posed(model: Model, messy: bool) -> Iterator[tuple[ModelLink, list[bool], Array]]:
    """Yield the links, which of their solids are sheets, and T_link_object."""
    pivot = {joint.child: np.asarray(joint.origin, np.float64) for joint in model.joints}
    limit = _SHEET_LIMIT * float(np.max(model.bounds[1] - model.bounds[0]))
    for link in model.links:
        sheets = [messy and s.sheet is not None and s.sheet.thickness <= limit for s in link.solids]
        at = pivot.get(link.name, np.zeros(3))
        yield link, sheets, invert_rigid(transform(_turn(messy), at))


def _link_truth(link: ModelLink, sheets: list[bool], T_link_object: Array) -> dict[str, list]:
    cells, slabs = [], []
    for solid, as_sheet in zip(link.solids, sheets, strict=True):
        here = solid.moved(T_link_object)
        if as_sheet and here.sheet is not None:
            thickness = round(here.sheet.thickness, 12)
            triangles = _rounded(here.sheet.triangles)
            backed = here.sheet.seen != 0
            slabs.append({"triangles": triangles, "thickness": thickness, "backed": backed})
            continue
        for planes, box in zip(here.half_spaces, here.cell_bounds, strict=True):
            cells.append({"box": _rounded(box), "half_spaces": _rounded(planes)})
    return {"cells": cells, "sheets": slabs}


def _rounded(array: Array) -> list:
    return (array.round(12) + 0.0).tolist()


def _meshes(
    link: ModelLink, sheets: list[bool], T_mesh_object: Array, messy: bool
) -> dict[str, str]:
    """The link's OBJ files by name: one of all solids, or one a solid where `messy`."""
    if not messy:
        meshes = [(s.moved(T_mesh_object).vertices, s.faces) for s in link.solids]
        return {f"{link.name}.obj": obj_text(meshes)}
    texts = {}
    cells = _Cells.of(s for s, as_sheet in zip(link.solids, sheets, strict=True) if not as_sheet)
    for k, (solid, as_sheet) in enumerate(zip(link.solids, sheets, strict=True)):
        if as_sheet and solid.sheet is not None:
            vertices = solid.sheet.drawn.reshape(-1, 3)
            faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        else:
            # Every second solid keeps all its faces, so that no two drop their common one.
            vertices, faces = solid.vertices, cells.seen_faces(solid) if k % 2 else solid.faces
        if len(faces) == 0:
            continue
        both = np.stack([faces, faces[:, ::-1]], axis=1).reshape(-1, 3)
        texts[f"{link.name}-{k}.obj"] = obj_text([(apply(T_mesh_object, vertices), both)])
    return texts


@dataclass(frozen=True, eq=False)
class _Cells:
    """The convex cells of several solids: whose each is, its planes (m, 4), its box (C, 2, 3)."""

    owners: tuple[Solid, ...]
    planes: tuple[Array, ...]
    boxes: Array

    @staticmethod
    def of(solids: Iterable[Solid]) -> "_Cells":
        cells = [
            (s, *cell) for s in solids for cell in zip(s.half_spaces, s.cell_bounds, strict=True)
        ]
        owners, planes, boxes = zip(*cells, strict=True) if cells else ((), (), ())
        return _Cells(owners, planes, np.array(boxes).reshape(-1, 2, 3))

    def seen_faces(self, solid: Solid) -> NDArray[np.int32]:
        """The faces of a solid without those that lie wholly on or in a cell of another solid."""
        corners = solid.vertices[solid.faces]
        normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= norm(normals)[:, None]
        outside = corners + 1e-6 * normals[:, None]
        lowest, highest = outside.min(axis=(0, 1)) - 1e-6, outside.max(axis=(0, 1)) + 1e-6
        meets = np.all((self.boxes[:, 0] <= highest) & (self.boxes[:, 1] >= lowest), axis=1)
        hidden = np.zeros(len(corners), bool)
        for c in np.flatnonzero(meets):
            if self.owners[c] is solid:
                continue
            planes, (low, high) = self.planes[c], self.boxes[c]
            near = np.all((outside >= low - 1e-7) & (outside <= high + 1e-7), axis=(1, 2)) & ~hidden
            if near.any():
                over = product(outside[near], planes[:, :3].T) - planes[:, 3]
                hidden[np.flatnonzero(near)[np.all(over <= 1e-7, axis=(1, 2))]] = True
        return solid.faces[~hidden]


def _urdf(model: Model, object_id: str, files: dict[str, list[str]], R: Array, messy: bool) -> str:
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
        name: [Visual(file, -turned(R.T, pivot[name]) if messy else np.zeros(3)) for file in own]
        for name, own in files.items()
    }
    if messy:  # As PartNet-Mobility has it: an empty base first, the body last.
        links = {ROOT_NAME: [], **links}
        links[body] = links.pop(body)
    return urdf_text(object_id, links, joints)
