"""Shape2Motion (the Motion Dataset) models, in the raw layout or in the URDF form of A-NCSH.

Raw: `part_objs/none_motion.obj`, `part_objs/<dof_name>.obj`, ... and `motion_attributes.json`, a
tree of `{dof_name, motion_type, center, direction, children}` in the coordinates of the meshes and
without any limits. URDF form: one `.urdf` with the meshes beside it; it says +-3.1415 where the raw
data has no limit.
"""

from collections.abc import Iterator
from dataclasses import replace
from os.path import isdir, isfile
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from articugen.core.errors import InvalidSource
from articugen.core.geometry import transform
from articugen.core.portable import norm
from articugen.core.records import ArticulatedObject, Floats, Joint, JointKind, Link, Mesh
from articugen.core.yaml_files import fault_in
from articugen.meshes.model_files import MAX_NAME_BYTES, MAX_TEXT_BYTES, ModelFiles, quoted
from articugen.meshes.read import read_mesh
from articugen.meshes.scenes import check_size
from articugen.sources.folders import ending_in, model_in
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_shortest
from articugen.sources.xml_check import MAX_LINKS, MAX_NUMBER

_ATTRIBUTES = "motion_attributes.json"
_NO_LIMIT = 3.1415  # A-NCSH writes this limit, with either sign, for every revolute joint

_KINDS = {
    "none": JointKind.FIXED,
    "rotation": JointKind.REVOLUTE,
    "translation": JointKind.PRISMATIC,
}


def _is_a_name(text: str) -> str:
    if not text.isprintable() or not 1 <= len(text.encode()) <= MAX_NAME_BYTES:
        raise ValueError(f"a name has 1 to {MAX_NAME_BYTES} bytes and no control characters")
    return text


_Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]
_Vector = tuple[_Number, _Number, _Number]


class _Dof(BaseModel):
    """One node of motion_attributes.json; the root is the part that does not move."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    dof_name: Annotated[str, AfterValidator(_is_a_name)]
    motion_type: Literal["none", "rotation", "translation", "spiral"]
    center: _Vector
    direction: _Vector
    children: tuple["_Dof", ...] | None = ()


def detect(path: Path) -> Found | None:
    """Return the model that a folder of the raw layout is; one of the URDF form looks like any
    URDF's."""
    return model_in(path) if isfile(path / _ATTRIBUTES) and isdir(path / "part_objs") else None


def find_at(child: Path) -> list[Found]:
    """Return the model in either form that a folder is."""
    forms = (_ATTRIBUTES, "*.urdf")
    is_model = any(isfile(path) for form in forms for path in child.glob(form))
    return [model_in(child)] if is_model else []


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Return one model, with limits of -inf and inf where the data set has none; InvalidSource if
    anything is amiss in the folder, or a joint is a spiral."""
    raw = (ref.location / _ATTRIBUTES).is_file()
    return (_load_raw if raw else _load_urdf_form)(ref, settings)


def _load_urdf_form(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    missing = f"has neither {_ATTRIBUTES} nor a .urdf file; add one"
    obj = load_shortest(ref, settings, ref.location, missing)
    unlimited = [
        joint.name
        for joint in obj.joints
        if joint.kind == JointKind.REVOLUTE
        and np.allclose((-joint.lower, joint.upper), _NO_LIMIT, rtol=0.0, atol=1e-4)
    ]
    notes = (f"limits of +-{_NO_LIMIT} taken as none: {', '.join(unlimited)}",) if unlimited else ()
    joints = [
        replace(j, lower=-np.inf, upper=np.inf) if j.name in unlimited else j for j in obj.joints
    ]
    return replace(obj, joints=tuple(joints), notes=(*obj.notes, *notes))


def _load_raw(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    folder = ref.location
    files = ModelFiles(folder)
    path = folder / _ATTRIBUTES
    try:
        root = _Dof.model_validate_json(files.read(path, MAX_TEXT_BYTES))
    except ValidationError as error:
        raise InvalidSource(f"{path}: {fault_in(error)}; correct it there") from None
    dofs = list(_walk(root))
    if len(dofs) >= MAX_LINKS:
        raise InvalidSource(f"{path}: more than {MAX_LINKS:,} parts; split the model")
    names = {root.dof_name}
    for dof, _, _ in dofs:
        if dof.dof_name in names:
            raise InvalidSource(f"{path}: two parts are called {dof.dof_name!r}; rename one")
        names.add(dof.dof_name)
    links = [Link(root.dof_name, _part(files, "none_motion", np.zeros(3)))]
    joints: list[Joint] = []
    faces = len(links[0].mesh.faces)
    for dof, parent, parent_center in dofs:
        center = np.array(dof.center)
        links.append(Link(dof.dof_name, _part(files, dof.dof_name, center)))
        joints.append(_joint(dof, parent, center - parent_center, path))
        faces += len(links[-1].mesh.faces)
        check_size(folder, faces=faces)
    used = {"none_motion", *(link.name for link in links)}
    unused = sorted(p.name for p in ending_in(folder / "part_objs", ".obj") if p.stem not in used)
    notes = (f"meshes without a joint, left out: {', '.join(unused)}",) if unused else ()
    return ref.object_of(settings, links, joints, files.sha256(), notes)


def _walk(dof: _Dof, center: Floats | None = None) -> Iterator[tuple[_Dof, str, Floats]]:
    """Yield every dof below `dof` with its parent's name and centre, parents first.

    The root's frame is the model's own, whatever centre the file gives it.
    """
    center = np.zeros(3) if center is None else center
    for child in dof.children or ():
        yield child, dof.dof_name, center
        yield from _walk(child, np.array(child.center))


def _part(files: ModelFiles, name: str, center: Floats) -> Mesh:
    """Return the mesh of one part, in a frame that is the model's moved to `center`."""
    by = f"{files.folder / _ATTRIBUTES}: part {quoted(name)}"
    path = files.find(f"part_objs/{name}.obj", by) or files.find(f"part_objs/{name}.OBJ", by)
    if path is None:
        raise InvalidSource(f"{by}: part_objs/{name}.obj is missing; add the file")
    mesh = read_mesh(path, files)
    return replace(mesh, vertices=mesh.vertices - center)


def _joint(dof: _Dof, parent: str, offset: Floats, path: Path) -> Joint:
    if dof.motion_type == "spiral":
        raise InvalidSource(
            f"{path}: {dof.dof_name!r} is a spiral joint, which turns and slides at once; leave "
            "this object out, or make it a rotation or a translation"
        )
    kind = _KINDS[dof.motion_type]
    length = norm(dof.direction)
    if kind != JointKind.FIXED and not length > 1e-12:
        raise InvalidSource(f"{path}: {dof.dof_name!r} has a zero direction; give it one")
    limit = 0.0 if kind == JointKind.FIXED else np.inf
    return Joint(
        name=dof.dof_name,
        kind=kind,
        parent=parent,
        child=dof.dof_name,
        T_parent_joint=transform(translation=offset),
        axis=np.array(dof.direction) / length if length > 1e-12 else np.array([1.0, 0.0, 0.0]),
        lower=-limit,
        upper=limit,
    )
