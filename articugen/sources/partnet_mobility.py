"""PartNet-Mobility models, as SAPIEN publishes them: one folder with mobility.urdf a model.

`semantics.txt` names the parts, `meta.json` the category. `mobility_v2.json` holds the annotators'
own joints, of which the URDF was made.
"""

import hashlib
from dataclasses import replace
from os.path import isfile
from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.core.records import ArticulatedObject
from articugen.meshes.model_files import MAX_TEXT_BYTES, ModelFiles, quoted
from articugen.sources.folders import meta_category, model_in
from articugen.sources.refs import CategorySettings, Found, ObjectRef
from articugen.sources.urdf import load_object

URDF = "mobility.urdf"

KNOWN_MISSING = "new-*.obj"
"""Meshes that URDFs of the data set name though they are empty and were never published."""


def detect(path: Path) -> Found | None:
    """Return the model that a folder with mobility.urdf and meta.json is."""
    return model_in(path) if isfile(path / URDF) and isfile(path / "meta.json") else None


def find_at(child: Path) -> list[Found]:
    """Return the model that a folder with a mobility.urdf is."""
    return [model_in(child)] if isfile(child / URDF) else []


def load(ref: ObjectRef, settings: CategorySettings) -> ArticulatedObject:
    """Return one model, or InvalidSource; a note says where meta.json has another category."""
    folder = ref.location
    files = ModelFiles(folder)
    # semantics.txt: the name of each link's part; a line is `link_0 hinge rotation_door`
    table = [line.split() for line in (_text(files, "semantics.txt") or "").splitlines()]
    semantics = {words[0]: words[2] for words in table if len(words) == 3}
    options = {"root": folder, "missing_ok": KNOWN_MISSING, "semantics": semantics}
    obj = load_object(ref, settings, folder / URDF, **options)
    notes = list(obj.notes)
    name = meta_category(folder)
    if name and settings.model_cat and name not in settings.model_cat:
        notes.append(f"meta.json calls it {quoted(name)}, it is read as {ref.category}")
    for beside in ("meta.json", "mobility_v2.json"):  # they count in the digest
        _text(files, beside)
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
