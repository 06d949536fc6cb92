"""Base colours of mesh files, as their materials and textures state them, and their means over
faces.

Of an OBJ that is its material's Kd, times the texture (map_Kd); glTF and COLLADA are read in
`materials`. Colours are read where somebody wants them (`with_looks`) alone, for their files count
in a model's hash.
"""

import os
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np

from articugen.core.arrays import Bools, Bytes, Floats, Indices
from articugen.core.errors import InvalidSource, MachineFault
from articugen.core.texture import Texture, between, texels
from articugen.meshes import pixels
from articugen.meshes.model_files import MAX_TEXT_BYTES, ModelFiles, quoted

MAX_TEXTURE_BYTES = 32 * 2**20
_FARTHEST = 1e6  # a texture's repetitions, beyond which its places are no numbers
_PATIENCE = 300  # seconds by the clock until it is the machine's fault that nothing comes
_UNDECODED = (pixels.UNREADABLE, -signal.SIGXCPU, -signal.SIGSEGV, -signal.SIGABRT)
_SPREAD = [(a, b, 12 - a - b) for k in (1, 2) for a in range(k, 12, 3) for b in range(k, 12 - a, 3)]
"""Centres of the 16 equal triangles that a triangle is cut into: weights of its corners, x 12."""


class Painted(NamedTuple):
    """Colours (F, 3) sRGB of faces, and the texture of which they are the means."""

    colours: Bytes
    texture: Texture | None = None

    def of(self, faces: Bools) -> "Painted":
        """Return those of some faces, in their order."""
        return Painted(self.colours[faces], self.texture and self.texture.of(faces))


class Material(NamedTuple):
    """Material of a mesh: sRGB from 0 to 1, and a texture."""

    kd: tuple[float, ...]
    texture: Path | None = None


_WHITE = np.full((1, 1, 3), 255, np.uint8)  # lies on faces with colours at their corners alone
GREY = Material((0.5, 0.5, 0.5))  # of faces without a material, where others have one


class Looks:
    """Materials and textures of one object: each file is read once."""

    def __init__(self) -> None:
        self._files: dict[Path, bytes | memoryview] = {}
        self._libraries: dict[Path, dict[bytes, Material]] = {}
        self._textures: dict[Path, Bytes | None] = {}
        self._missing: dict[str, None] = {}  # in order

    def notes(self) -> tuple[str, ...]:
        """Return a note where files could not be read."""
        some = ", ".join(map(quoted, list(self._missing)[:5]))
        return (f"{len(self._missing)} materials or textures not read: {some}",) if some else ()

    def miss(self, name: str) -> None:
        """Note what could not be read."""
        self._missing[name] = None

    def inside(self, place: Path, data: bytes | memoryview) -> Path | None:
        """Take a texture that lies inside a mesh file, and is called `place`; None if too large."""
        if len(data) > MAX_TEXTURE_BYTES:
            return self.miss(place.name)
        self._files[place] = data
        return place

    def materials(self, obj: bytes, path: Path, files: ModelFiles) -> dict[bytes, Material]:
        """Read the libraries that an OBJ names, a file a line, and their textures undecoded."""
        known: dict[bytes, Material] = {}
        for line in obj.split(b"\nmtllib ")[1:]:
            place = self.find(line.partition(b"\n")[0].strip(), path, files, MAX_TEXT_BYTES)
            if place and place not in self._libraries:
                self._libraries[place] = self._library(place, files)
            known |= self._libraries[place] if place else {}
        return known

    def of_obj(self, obj: bytes, path: Path, files: ModelFiles) -> Painted | None:
        """Return what the fans of an OBJ's polygons show; None where it has no known material."""
        known, materials = self.materials(obj, path, files), [GREY]
        uv, corners, which = [], [], []
        for line in obj.split(b"\n") if known else ():
            key, _, rest = line.partition(b" ")
            if key == b"usemtl":
                materials.append(known.get(rest.strip(), GREY))
            elif key == b"vt":
                uv.append((*_numbers(rest.split()[:2]), np.nan, np.nan)[:2])
            elif key == b"f":
                polygon = [_which(word, len(uv)) for word in rest.partition(b"#")[0].split()]
                for second, third in pairwise(polygon[1:]):
                    corners.append((polygon[0], second, third))
                    which.append(len(materials) - 1)
        places = np.array([*uv, (np.nan, np.nan)])[np.clip(corners, -1, len(uv)).astype(np.intp)]
        return self.painted(materials, np.array(which, np.intp), places)

    def painted(
        self,
        materials: Sequence[Material],
        which: Indices,
        places: Floats,
        corners: Floats | None = None,
    ) -> Painted | None:
        """Return what faces show: `which` (F,) of the materials they have, the `places` (F, 3, 2)
        of their corners in its texture, v up, nan for none, and the colours at their `corners`
        (F, 3, 3), which those of the material are multiplied by. None where all are GREY itself."""
        used = np.unique(which).tolist()
        if all(materials[n] is GREY for n in used):
            return None
        colours = np.array([material.kd for material in materials])[which]
        tint = np.repeat(colours[:, None], 3, axis=1)
        pictures, shown = [_WHITE], np.full(len(which), -1, np.intp)
        if corners is not None:
            tint *= corners
            colours *= between(corners, np.ones(3)) / 3.0
            shown[np.ptp(corners, axis=1).any(axis=1)] = 0
        number = {t: k for k, t in enumerate(dict.fromkeys(materials[n].texture for n in used))}
        textures = np.array([number.get(material.texture, -1) for material in materials])[which]
        for texture in filter(None, number):
            if texture not in self._textures:
                self._textures[texture] = decoded(self._files[texture])
            rows = np.flatnonzero(textures == number[texture])
            rows = rows[(np.abs(places[rows]) < _FARTHEST).all(axis=(1, 2))]  # nan is none
            if (picture := self._textures[texture]) is None:
                self.miss(texture.name)
            else:
                colours[rows] = _means(picture, places[rows], tint[rows])
                shown[rows] = len(pictures)
                pictures.append(picture)
        if (shown < 0).all():
            return Painted(in_bytes(colours))
        places = np.where(shown[:, None, None] > 0, places, 0.0)  # the others may be no numbers
        return Painted(in_bytes(colours), Texture(tuple(pictures), shown, places, tint))

    def find(
        self, name: bytes | str, beside: Path, files: ModelFiles, most: int = MAX_TEXTURE_BYTES
    ) -> Path | None:
        """Read the file of that name in the folder of `beside`; of a path of another machine, which
        may run Windows, its last name counts. None where it cannot be read."""
        there = PureWindowsPath(os.fsdecode(name))
        there = beside.resolve().parent / (there.name if there.anchor else there.as_posix())
        try:
            place = files.find(os.path.relpath(there, files.folder))
            if place and place not in self._files:
                self._files[place] = files.read(place, most)
        except InvalidSource:
            place = None
        if place is None:
            self.miss(os.fsdecode(name))
        return place

    def _library(self, path: Path, files: ModelFiles) -> dict[bytes, Material]:
        known: dict[bytes, Material] = {}
        name = b""
        for line in bytes(self._files[path]).replace(b"\t", b" ").splitlines():
            key, _, rest = line.strip().partition(b" ")
            rest = rest.strip()
            if key == b"newmtl":
                name, known[rest] = rest, Material((1.0, 1.0, 1.0))
            elif key == b"Kd" and name and (kd := rgb_of(rest.split()[:3])):
                known[name] = known[name]._replace(kd=kd)
            elif key == b"map_Kd" and name and rest:
                file = rest.split()[-1] if rest.startswith(b"-") else rest  # after options
                texture = self.find(file, path, files)
                known[name] = known[name]._replace(texture=texture)
        return known


_LOOKS = ContextVar["Looks | None"]("_LOOKS", default=None)
wanted_looks = _LOOKS.get  # None where nobody wants them


@contextmanager
def with_looks(*, wanted: bool) -> Iterator[Looks]:
    """Meanwhile have mesh files of one object read with their colours, or without."""
    looks = Looks()
    token = _LOOKS.set(looks if wanted else None)
    try:
        yield looks
    finally:
        _LOOKS.reset(token)


def decoded(data: bytes | memoryview) -> Bytes | None:
    """Decode a texture to (h, w, 3) sRGB of at most 512 x 512, in a process of its own; None where
    it is none, or takes more than that may. Raises MachineFault where no process can run."""
    command = [sys.executable, "-I", pixels.__file__]
    try:
        done = subprocess.run(
            command, check=False, input=data, capture_output=True, timeout=_PATIENCE
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise MachineFault(f"{command[-1]}: cannot run ({error}); see to it") from error
    if done.returncode in _UNDECODED:
        return None
    if done.returncode:
        why = done.stderr.decode(errors="replace")[-200:]
        raise MachineFault(f"{command[-1]}: ended with {done.returncode} ({why}); see to it")
    width, height = struct.unpack_from("<II", done.stdout)
    return np.frombuffer(done.stdout, np.uint8, offset=8).reshape(height, width, 3)


def _means(picture: Bytes, places: Floats, tint: Floats) -> Floats:
    """Return (n, 3), from 0 to 1, the mean of a picture that repeats over triangles (n, 3, 2) of
    its plane, v up, times the `tint` (n, 3, 3) at their corners."""
    total = np.zeros((len(places), 3))
    for weights in 1.0 * np.array(_SPREAD):
        total += texels(picture, between(places, weights) / 12.0) * between(tint, weights)
    return total / (12.0 * 255.0 * len(_SPREAD))


def _which(corner: bytes, known: int) -> int:
    """Return which of the `known` places in a texture a corner of an OBJ names; -1 for none."""
    try:
        number = int(corner.split(b"/")[1])
    except (IndexError, ValueError):
        return -1
    number = number + known if number < 0 else number - 1
    return number if 0 <= number < known else -1


def rgb_of(words: Sequence[Any]) -> tuple[float, ...] | None:
    """Return three numbers from 0 to 1 of as many words, or of one that stands for all; or None."""
    numbers = tuple(min(max(0.0, number), 1.0) for number in _numbers(words))
    return {1: numbers * 3, 3: numbers}.get(len(numbers))


def _numbers(words: Sequence[Any]) -> tuple[float, ...]:
    try:
        return tuple(map(float, words))
    except (TypeError, ValueError, OverflowError):
        return ()


def in_bytes(colour: Any) -> Bytes:
    """Return colours of 0 to 1 as bytes."""
    return np.round(255.0 * np.asarray(colour)).astype(np.uint8)
