"""PartNet-Mobility models, as SAPIEN publishes them: one folder with mobility.urdf a model.

`semantics.txt` names the parts, `meta.json` the category, `mobility_v2.json` holds the annotators'
own joints; the URDF was made from it, and people change the URDF afterwards.
"""

import hashlib
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from os.path import isfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from articugen.core.errors import InvalidSource
from articugen.core.portable import dot, norm
from articugen.core.records import ArticulatedObject, Joint, JointKind
from articugen.meshes.model_files import MAX_TEXT_BYTES, ModelFiles, quoted
from articugen.sources.folders import meta_category, visible
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_urdf
from articugen.sources.urdf_check import MAX_NUMBER

URDF = "mobility.urdf"

KNOWN_MISSING = "new-*.obj"
"""Meshes that URDFs of the data set name though they are empty and were never published."""

_TOLERANCE = 1e-3  # limits (rad or m) and cosines that differ by less are the same


def detect(path: Path) -> Found | None:
    """Return the model that a folder with mobility.urdf and meta.json is."""
    return _found(path) if isfile(path / URDF) and isfile(path / "meta.json") else None


def find(base: Path) -> list[Found]:
    """Return the folders in `base` that have a mobility.urdf."""
    return [model for folder in visible(base) for model in find_at(folder)]


def find_at(child: Path) -> list[Found]:
    """Return the model that a folder with a mobility.urdf is."""
    return [_found(child)] if isfile(child / URDF) else []


def _found(folder: Path) -> Found:
    return Found(folder.name, folder, folder.name, category=meta_category(folder))


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Return one model; its notes say where URDF, annotation and category disagree.

    Raises:
        InvalidSource: anything amiss in the folder.
    """
    folder = ref.location
    files = ModelFiles(folder)
    # semantics.txt: the name of each link's part; a line is `link_0 hinge rotation_door`
    table = [line.split() for line in (_text(files, "semantics.txt") or "").splitlines()]
    obj = load_urdf(
        folder / URDF,
        object_id=ref.object_id,
        category=ref.category,
        source=ref.source,
        root=folder,
        missing_ok=KNOWN_MISSING,
        semantics={words[0]: words[2] for words in table if len(words) == 3},
        T_world_root=settings.turn,
    )
    notes = list(obj.notes)
    meta = _json(files, "meta.json")
    name = meta.get("model_cat") if isinstance(meta, dict) else None
    if name is not None and settings.model_cat and name not in settings.model_cat:
        notes.append(f"meta.json calls it {quoted(str(name))}, it is read as {ref.category}")
    notes += _differences(obj, _annotation(files))
    both = hashlib.sha256(f"{obj.sha256} {files.sha256()}".encode()).hexdigest()
    return replace(obj, notes=tuple(notes), sha256=both)


def _text(files: ModelFiles, name: str) -> str | None:
    """Return the text of one of the files beside the URDF, None where there is none."""
    path = files.find(name)
    if path is None:
        return None
    try:
        return files.read(path, MAX_TEXT_BYTES).decode()
    except UnicodeDecodeError:
        raise InvalidSource(f"{path}: is not UTF-8 text; get the model again") from None


def _json(files: ModelFiles, name: str) -> Any:
    text = _text(files, name)
    try:
        return None if text is None else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidSource(
            f"{files.folder / name}: not JSON ({error}); get the model again"
        ) from None


_Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]


class _Limit(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    a: _Number = 0.0
    b: _Number = 0.0
    no_limit: bool = Field(default=False, alias="noLimit")
    rotates: bool = False


class _Axis(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    direction: tuple[_Number, _Number, _Number] = (0.0, 0.0, 1.0)


class _JointData(BaseModel):
    model_config = ConfigDict(frozen=True)

    axis: _Axis = _Axis()
    limit: _Limit = _Limit()


class _Annotated(BaseModel):
    """One part of mobility_v2.json. `limit` is in degrees for a hinge, in metres for a slider."""

    model_config = ConfigDict(frozen=True)

    joint: str
    data: _JointData = Field(default=_JointData(), alias="jointData")


_ANNOTATION = TypeAdapter(list[_Annotated])


def _annotation(files: ModelFiles) -> list[_Annotated]:
    """Return the parts of mobility_v2.json that became links, in the order of the links."""
    data = _json(files, "mobility_v2.json")
    try:
        parts = _ANNOTATION.validate_python([] if data is None else data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise InvalidSource(
            f"{files.folder / 'mobility_v2.json'}: {where}: {first['msg']}; get the model again"
        ) from None
    return [part for part in parts if part.joint != "junk"]


def _differences(obj: ArticulatedObject, parts: Sequence[_Annotated]) -> tuple[str, ...]:
    """One sentence for each way in which joints of the URDF differ from the annotated ones."""
    by_child = {joint.child: joint for joint in obj.joints}
    found: dict[str, list[str]] = defaultdict(list)
    for k, part in enumerate(parts):
        joint = by_child.get(f"link_{k}")
        if joint is None:
            found["in mobility_v2.json, not in the URDF"].append(f"link_{k} ({part.joint})")
        elif str(joint.kind) != _kind(part):
            remark = f"{joint.kind} in the URDF but not in mobility_v2.json"
            found[remark].append(f"{joint.name} ({_words(part)})")
        elif joint.kind != JointKind.FIXED and not _same_motion(joint, part):
            urdf = f"URDF {_range(joint.lower, joint.upper)}"
            found["other axis or limits in mobility_v2.json"].append(
                f"{joint.name} ({_words(part)}; {urdf})"
            )
    return tuple(f"{remark}: {', '.join(names)}" for remark, names in found.items())


def _kind(part: _Annotated) -> str:
    """What the annotation makes of a part; "screw" is what no URDF joint can say."""
    limit = part.data.limit
    if part.joint in ("free", "heavy", "static"):
        return "fixed"
    if part.joint == "hinge":
        return "continuous" if limit.no_limit else "revolute"
    return "prismatic" if part.joint == "slider" and not limit.rotates else "screw"


def _ends(part: _Annotated) -> NDArray[np.float64]:
    """Return (2,) the annotated limits, rad or m, ascending."""
    ends = np.sort((part.data.limit.a, part.data.limit.b))
    return np.radians(ends) if part.joint == "hinge" else ends


def _words(part: _Annotated) -> str:
    limited = _kind(part) in ("revolute", "prismatic") and not part.data.limit.no_limit
    return f"{_kind(part)} {_range(*_ends(part))}" if limited else _kind(part)


def _same_motion(joint: Joint, part: _Annotated) -> bool:
    """Whether axis and limits agree: either sign of the axis, and for a hinge up to whole turns."""
    direction = np.array(part.data.axis.direction)
    cosine = float(dot(direction, joint.axis)) / max(float(norm(direction)), 1e-12)
    if abs(cosine) < 1.0 - _TOLERANCE:
        return False
    limits = np.array((joint.lower, joint.upper))
    if part.data.limit.no_limit or not np.isfinite(limits).all():
        return part.data.limit.no_limit and bool(np.isinf(limits).all())
    shift = limits - np.sort(np.sign(cosine) * _ends(part))
    if part.joint == "hinge":
        shift -= 2.0 * np.pi * np.round(shift[0] / (2.0 * np.pi))
    return bool(np.abs(shift).max() < _TOLERANCE)


def _range(lower: float, upper: float) -> str:
    return f"{lower:.4g} to {upper:.4g}"
