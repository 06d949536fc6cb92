"""An MJCF file as one tree, with what it includes, elements with the defaults of their class."""

from collections.abc import Mapping
from math import pi
from pathlib import Path, PurePosixPath
from typing import Any

from articugen.core.errors import InvalidSource
from articugen.meshes.model_files import MAX_TEXT_BYTES, ModelFiles, quoted
from articugen.meshes.xml_strict import parse_xml
from articugen.sources.xml_check import MAX_LETTERS, MAX_LINKS, MAX_VISUALS, Check

TURNS = ("euler", "axisangle", "xyaxes", "zaxis")  # each stands for a quat

_PLACE = ("pos", "quat", *TURNS)
_OF_CLASSES = {
    "equality": ("active",),
    "geom": (*_PLACE, "type", "size", "fromto", "mesh", "group", "rgba", "material", "contype",
             "conaffinity"),
    "joint": ("type", "pos", "axis", "range", "limited", "ref"),
    "material": ("rgba",),
    "mesh": ("scale", "refpos", "refquat"),
}  # fmt: skip
"""By tag, what of a default class counts."""

_MOST = {
    "body": MAX_LINKS, "joint": MAX_LINKS, "frame": MAX_LINKS,
    "geom": MAX_VISUALS, "mesh": MAX_VISUALS,
}  # fmt: skip
_MADE = ("attach", "replicate", "composite", "flexcomp", "mesh[@builtin]")


class Document(Check):
    """A file with all that it includes, and the rules for its elements.

    Attributes:
        root, world: the <mujoco> element (lxml) and its one <worldbody>. Geoms, joints and meshes
            have all their attributes; the file of a mesh begins at the main file's folder.
        unit: radians of the file's unit of angles.
        eulerseq: three of "xyz", about turning axes, or "XYZ", about those at rest.
        autolimits: whether a joint with a range is limited.
    """

    def __init__(self, path: Path, files: ModelFiles) -> None:
        """Read it; InvalidSource for the first fault found."""
        super().__init__(path, ("worldbody", *_MOST))
        self.root = root = parse_xml(files.read(path, MAX_TEXT_BYTES), path)
        self._include(files)
        worlds = root.findall("worldbody")
        if root.tag != "mujoco" or not worlds:
            raise InvalidSource(f"{path}: is no <mujoco> with a <worldbody>; name the main file")
        self.world = worlds[0]
        self.world.set("name", "world")
        self.world.extend([child for other in worlds[1:] for child in other])
        for element in (element for tag in _MADE for element in root.iterfind(f".//{tag}")):
            what = f"a <{element.tag}> that MuJoCo builds"
            raise self.refuse(element, f"{what} is not read; save the model with MuJoCo first")
        for tag, most in _MOST.items():
            self.count(list(root.iter(tag)), f"<{tag}>", most)
        settings: dict[str, str] = {"angle": "degree", "eulerseq": "xyz", "coordinate": "local"}
        for compiler in root.findall("compiler"):
            folder = compiler.get("assetdir")
            settings |= ({"meshdir": folder} if folder else {}) | dict(compiler.attrib)
        if settings["coordinate"] != "local" or settings["angle"] not in ("degree", "radian"):
            raise InvalidSource(f"{path}: has angles or coordinates that no MuJoCo has; correct it")
        self.unit = pi / 180.0 if settings["angle"] == "degree" else 1.0
        self.eulerseq = settings["eulerseq"]
        if len(self.eulerseq) != 3 or set(self.eulerseq.lower()) - set("xyz"):
            raise InvalidSource(f"{path}: its eulerseq is not three of xyz; correct it")
        self.autolimits = settings.get("autolimits") != "false"
        for mesh in root.iterfind("asset/mesh[@file]"):
            file = PurePosixPath(mesh.get("file").replace("\\", "/"))
            mesh.set("name", mesh.get("name") or file.stem)
            file = file.name if settings.get("strippath") == "true" else file
            mesh.set("file", str(PurePosixPath(settings.get("meshdir", ""), file)))
        self._write_defaults()

    def _include(self, files: ModelFiles) -> None:
        """Put the elements of other files, whose names begin at the main one, in their place."""
        done, total = {self.path.resolve()}, 0
        while (element := self.root.find(".//include")) is not None:
            name = element.get("file", "").replace("\\", "/")
            place = files.find(name, str(self.path))
            if place is None or place in done:
                what = "is included a second time" if place else "does not exist"
                raise InvalidSource(f"{self.path}: {quoted(name)} {what}; remove the <include>")
            data = files.read(place, MAX_TEXT_BYTES)
            total += len(data)
            if total > MAX_TEXT_BYTES:
                raise InvalidSource(f"{place}: all files included are too large; simplify them")
            done.add(place)
            above, at = element.getparent(), element.getparent().index(element)
            above[at : at + 1] = list(parse_xml(data, place))

    def _write_defaults(self) -> None:
        """Give elements what they lack and their class has, and geoms their material's rgba."""
        classes = {"main": dict[str, Mapping[str, str]].fromkeys(_OF_CLASSES, {})}
        for element in self.root.iter("default"):
            above = element.getparent()
            name = element.get("class", "" if above.tag == "default" else "main")
            if not name or (name in classes) != (name == "main"):
                raise self.refuse(element, f"a second default class {quoted(name)}; rename it")
            defaults = classes[name] = dict(classes[above.get("class", "main")])
            if above.tag != "default":  # as older versions have it, by any name
                classes["main"] = defaults
            for child in (child for tag in _OF_CLASSES for child in element.findall(tag)):
                defaults[child.tag] = merged = _merged(defaults, child.tag, child)
                if max(map(len, merged.values()), default=0) > MAX_LETTERS:
                    raise self.refuse(child, "has an endless attribute; correct it")
        class_of = {None: "main"}
        for element in self.root.iter("*"):
            parent = element.getparent()
            class_of[element] = element.get("childclass", class_of[parent])
            tag = "equality" if getattr(parent, "tag", "") == "equality" else element.tag
            if tag in _OF_CLASSES and parent.tag != "default":
                name = element.get("class", class_of[parent])
                if name not in classes:
                    raise self.refuse(element, f"unknown class {quoted(name)}; add or correct it")
                element.attrib.update(_merged(classes[name], tag, element))
        materials = {m.get("name"): m for m in self.root.iterfind("asset/material[@rgba]")}
        for geom in self.root.iterfind(".//geom[@material]"):
            if "rgba" not in geom.attrib and geom.get("material") in materials:
                rgba = self.numbers(materials[geom.get("material")], "rgba", (4,))
                geom.set("rgba", " ".join(map(repr, rgba)))


def _merged(of: Mapping[str, Mapping[str, str]], tag: str, element: Any) -> dict[str, str]:
    """Return the attributes that count, an element's own first; of a size the numbers that are
    missing are the class's."""
    attributes = {key: element.get(key) for key in _OF_CLASSES[tag] if key in element.attrib}
    defaults = of[tag]
    turned = TURNS if attributes.keys() & {"quat", *TURNS} else ()
    merged = {key: value for key, value in defaults.items() if key not in turned} | attributes
    words = attributes.get("size", "").split()
    if words and "size" in defaults:
        merged["size"] = " ".join(words + defaults["size"].split()[len(words) :])
    return merged
