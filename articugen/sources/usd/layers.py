"""The layers of a model, held in memory with every name in them replaced: OpenUSD opens no file.

A layer names others: sublayers, references, payloads, in variants too. We look up each name,
confined to the model's folder, read it through `ModelFiles` (so that it counts in the digest) and
replace it by the name of the layer in memory. Nothing is left for OpenUSD to look for on the disk
or the net.
"""

import io
import os
import posixpath
import re
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from articugen.core.errors import InvalidSource
from articugen.meshes import openusd as pxr
from articugen.meshes.model_files import MAX_MODEL_BYTES, ModelFiles, quoted

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MAX_LAYERS = 1_000

_CRATE = b"PXR-USDC"
_TEXT = (b"#usda", b"#sdf")
_ANONYMOUS = re.compile(r"anon:0x[0-9a-f]+:")


@dataclass(frozen=True)
class Place:
    """Place of a layer: a file, or a file inside of a .usdz file."""

    file: Path
    inside: str = ""

    @property
    def label(self) -> str:
        return f"{self.file.name}[{self.inside}]" if self.inside else self.file.name


class Layers:
    """Layers of a model, from its main file on, whose Sdf.Layer is `root`."""

    def __init__(self, path: Path, files: ModelFiles) -> None:
        """Read them all, from the main file at `path` on; InvalidSource if one is missing,
        elsewhere or damaged, or there are too many."""
        self._files = files
        self._packages: dict[Path, zipfile.ZipFile] = {}
        self._names: dict[Place, dict[str, Place]] = {}
        self._open: dict[Place, Any] = {}
        first = self._first_of(Path(os.path.realpath(path)))
        todo = [first]
        for place in todo:  # grows while it is walked
            if place in self._open:
                continue
            if len(self._open) >= MAX_LAYERS:
                raise InvalidSource(
                    f"{first.file}: is made of more than {MAX_LAYERS:,} layers; flatten it"
                )
            layer = self._open[place] = _opened(self._bytes(place), place)
            _refuse_clips(layer, place)
            names = filter(None, layer.GetCompositionAssetDependencies())
            self._names[place] = {name: self._named(name, place) for name in sorted(names)}
            todo += self._names[place].values()
        for place, names in self._names.items():
            for name, other in names.items():
                self._open[place].UpdateCompositionAssetDependency(
                    name, self._open[other].identifier
                )
        self.root = self._open[first]

    def _named(self, name: str, by: Place) -> Place:
        """Return where the layer is that a layer calls `name`."""
        where = f"{by.file}: its layer {quoted(name)}"
        # an absolute path; a scheme, a drive, or arguments for a file format; a file in a package
        if name.startswith(("/", "\\", "`", "~")) or ":" in name or name.endswith("]"):
            raise InvalidSource(
                f"{where} is named by an absolute path, on the network or by an expression, and "
                "nothing outside of the model is read; save it in its folder and name it there"
            )
        if by.inside:
            inside = posixpath.normpath(posixpath.join(posixpath.dirname(by.inside), name))
            if inside not in self._packages[by.file].namelist():
                raise InvalidSource(f"{where} is not in the package; pack it again")
            return Place(by.file, inside)
        inside = os.path.relpath(by.file.parent / name, self._files.folder)
        place = self._files.find(inside, str(by.file))
        if place is None:
            raise InvalidSource(f"{where} is missing; put it there")
        return self._first_of(place)

    def _first_of(self, file: Path) -> Place:
        """Return the layer that a file is, or the first one of a package."""
        if file.suffix.lower() != ".usdz":
            return Place(file)
        if file not in self._packages:
            self._packages[file] = _package(self._files.read(file), file)
        names = self._packages[file].namelist()
        if not names or not names[0].lower().endswith(SUFFIXES[:3]):
            raise InvalidSource(f"{file}: the package does not begin with a layer; pack it again")
        return Place(file, names[0])

    def _bytes(self, place: Place) -> bytes:
        if not place.inside:
            return self._files.read(place.file)
        try:
            return self._packages[place.file].read(place.inside)
        except (zipfile.BadZipFile, EOFError, KeyError) as error:
            raise InvalidSource(f"{place.file}: is damaged ({error}); get it again") from None


def plainly(text: str) -> str:
    """Return an error of OpenUSD without the addresses by which it knows layers in memory."""
    return " ".join(_ANONYMOUS.sub("", text).split())[:300]


def _refuse_clips(layer: Any, place: Place) -> None:
    """Value clips name layers too, and not among the dependencies that a layer lists."""

    def look(path: Any) -> None:
        if not (path.IsPrimPath() or path.IsPrimVariantSelectionPath()):
            return
        spec = layer.GetObjectAtPath(path)
        if spec.HasInfo("clips") or spec.HasInfo("clipSets"):
            raise InvalidSource(
                f"{place.file}: {path}: has value clips; export the model without animation"
            )

    layer.Traverse("/", look)


def _package(data: bytes, file: Path) -> zipfile.ZipFile:
    """Return a .usdz: a zip archive of files that are not compressed, as the format demands."""
    try:
        package = zipfile.ZipFile(io.BytesIO(data))
    except (zipfile.BadZipFile, ValueError) as error:
        raise InvalidSource(f"{file}: is no package ({error}); get it again") from None
    for info in package.infolist():
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
            raise InvalidSource(
                f"{file}: is compressed or encrypted, as no .usdz is; pack it again"
            )
    if sum(info.file_size for info in package.infolist()) > MAX_MODEL_BYTES:
        raise InvalidSource(f"{file}: holds more than {MAX_MODEL_BYTES // 2**20} MiB; simplify it")
    return package


def _opened(data: bytes, place: Place) -> Any:
    """Return the layer that these bytes are."""
    try:
        if data.startswith(_CRATE):
            return _from_crate(data, place)
        if not data.startswith(_TEXT):
            raise InvalidSource(f"{place.file}: is no USD layer; export it again")
        layer = pxr.Sdf.Layer.CreateAnonymous(f"{place.label}.usda")
        if layer.ImportFromString(data.decode()):
            return layer
        reason = "no layer"
    except UnicodeDecodeError:
        reason = "not UTF-8"
    except pxr.Tf.ErrorException as error:
        reason = plainly(str(error.args[0].commentary if error.args else error))
    raise InvalidSource(f"{place.file}: OpenUSD cannot read it ({reason}); export it again")


def _from_crate(data: bytes, place: Place) -> Any:
    layer = pxr.Sdf.Layer.CreateAnonymous(f"{place.label}.usdc")
    with tempfile.NamedTemporaryFile(suffix=".usdc") as file:  # which has no other way in
        file.write(data)
        file.flush()
        if not layer.Import(file.name):
            raise InvalidSource(f"{place.file}: OpenUSD cannot read it; export it again")
    return layer
