"""Bodies of an MJCF as links, its hinges and slides as joints.

MuJoCo moves meshes to their centres as it compiles, and geoms with them; here both stay as in the
file. A link's frame is its body's, moved to where its joint is.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.arrays import Floats, grouped
from articugen.core.errors import InvalidSource
from articugen.core.geometry import apply, joint_motion, transform
from articugen.core.portable import product, turned
from articugen.core.records import Joint, JointKind, Mesh, Mimic
from articugen.meshes.model_files import MAX_NAME_BYTES, ModelFiles, quoted
from articugen.sources.mjcf.document import Document
from articugen.sources.mjcf.geoms import NO_SURFACE, Geoms, seen
from articugen.sources.mjcf.places import place, unit
from articugen.sources.shapes import Shapes, joined


class Model:
    """Contents of a file.

    Attributes:
        links: meshes by name, that of the world first.
        joints: each after the one that it hangs on; several of one body have massless links
            between them.
        notes: what a user should know.
    """

    def __init__(self, path: Path, files: ModelFiles) -> None:
        """Read it; InvalidSource for the first fault found."""
        self._document = document = Document(path, files)
        self.links: dict[str, Mesh] = {}
        self.joints: list[Joint] = []
        self._rest: dict[str, float] = {}  # of each that moves, its `ref`
        self.notes: list[str] = []
        world = document.world
        self._within = {world: (world, np.eye(4))}  # of bodies and frames the body, `T_body_frame`
        bodies: dict[Any, tuple[Any, Floats]] = {}  # what each hangs on, `T_parent_body`
        for element in world.iter("body", "frame"):
            parent, T = self._frame_of(element)
            T = product(T, place(element, document))
            if element.tag == "body":
                bodies[element] = parent, T
                parent, T = element, np.eye(4)
            self._within[element] = parent, T
        named = [e for e in world.iter("worldbody", "body", "joint") if e.get("name")]
        self._names = {
            "body": set(document.named(e for e in named if e.tag != "joint")),
            "joint": set(document.named(e for e in named if e.tag == "joint")),
        }
        geoms = self._by_body("geom")
        shown = {body: seen(of, document) for body, of in geoms.items()}
        kinds = [geom.get("type", "sphere") for of in shown.values() for geom in of]
        alike = ("sphere" if kind == "ellipsoid" else kind for kind in kinds)
        self._shapes = Shapes(path, files, alike)
        self._geoms = Geoms(document, self._shapes)
        joints = self._by_body("joint", "freejoint")
        self._links = {world: ("world", np.zeros(3))}  # of each body, and its frame in the body's
        for body in (world, *bodies):
            if body in bodies:
                self._links[body] = self._hang(body, *bodies[body], joints.get(body, []))
            self._show(body, shown.get(body, []))
        absent = {e.tag for e in document.root.iterfind("tendon")} | set(self._couple())
        absent |= {f"a {g.get('type')}" for g in world.iter("geom") if g.get("type") in NO_SURFACE}
        if absent:
            self.notes.append(f"not read, left out: {', '.join(sorted(absent))}")

    def _frame_of(self, element: Any) -> tuple[Any, Floats]:
        """Return the body that an element belongs to, and (4, 4) the frame there that it is in."""
        parent = element.getparent()
        if parent not in self._within:
            raise self._document.refuse(element, f"is in a <{parent.tag}>; move it into a body")
        return self._within[parent]

    def _by_body(self, *tags: str) -> dict[Any, list[Any]]:
        return grouped((self._frame_of(e)[0], e) for e in self._document.world.iter(*tags))

    def _name(self, tag: str, name: str) -> str:
        """Return `name`, or one like it where a body or joint has that."""
        while name in self._names[tag]:
            name += "~"
        if len(name.encode()) > MAX_NAME_BYTES:
            raise InvalidSource(f"{self._document.path}: {quoted(name)} is too long; shorten names")
        self._names[tag].add(name)
        return name

    def _show(self, body: Any, geoms: list[Any]) -> None:
        """Add the link of a body, of all that it shows."""
        name, origin = self._links[body]
        back = transform(translation=-origin)
        placed = ((*self._geoms.mesh(geom), self._frame_of(geom)[1]) for geom in geoms)
        shapes = ((mesh, kind, product(back, frame, T)) for mesh, kind, T, frame in placed)
        self.links[name] = self._shapes.link(f"{self._document.path}: body {quoted(name)}", shapes)

    def _hang(self, body: Any, parent: Any, T: Floats, joints: list[Any]) -> tuple[str, Floats]:
        """Add the joints of a body, a fixed one where it has none, and return what it is called and
        (3,) where its link's frame is in the body's."""
        above, origin = self._links[parent]
        name = body.get("name") or self._name("body", f"body_{len(self._links)}")
        T = product(transform(translation=-origin), T)
        moving = [j for j in joints if j.tag == "joint" and j.get("type") != "free"]
        if len(moving) < len(joints):
            self.notes.append(f"{name}: moves freely, taken as fixed where it stands")
        if not moving:
            joint_name, x = self._name("joint", name), np.array([1.0, 0.0, 0.0])
            self.joints.append(Joint(joint_name, JointKind.FIXED, above, name, T, x))
        at = np.zeros(3)
        for joint in moving:
            joint_name = joint.get("name") or self._name("joint", name)
            child = name if joint is moving[-1] else self._name("body", joint_name)
            kind, lower, upper, rest = self._reach(joint)
            self._rest[joint_name] = rest
            pivot, axis = self._line(joint)
            back = joint_motion(kind != JointKind.PRISMATIC, axis, -rest)
            T = product(T, transform(translation=pivot - at), back)
            self.joints.append(Joint(joint_name, kind, above, child, T, axis, lower, upper))
            self.links[child] = joined(())
            above, at, T = child, pivot, np.eye(4)
        return name, at

    def _couple(self) -> Iterator[str]:
        """Let joints follow others by the linear equalities of two; yield what the others are.

        MuJoCo counts both states from `ref`; coefficients are of radians, whatever the file has.
        """
        document, drivers = self._document, dict[str, str]()
        number = {j.name: k for k, j in enumerate(self.joints) if j.kind != JointKind.FIXED}
        for equality in document.root.iterfind("equality/*"):
            if equality.get("active") == "false":
                continue
            name, driver = equality.get("joint1"), equality.get("joint2")
            if equality.tag != "joint" or driver is None:
                yield f"a <{equality.tag}> of <equality>"
                continue
            for one in (name, driver):
                if one not in number:
                    raise document.refuse(equality, f"unknown joint {quoted(str(one))}; correct it")
            terms = document.numbers(equality, "polycoef", (1, 2, 3, 4, 5), "0 1")
            offset, multiplier, *higher = [*terms, 1.0] if len(terms) == 1 else terms
            last = driver
            while last in drivers and last != name:
                last = drivers[last]
            if any(higher) or name in drivers or last == name:
                yield f"an equality of {quoted(name)}"
                continue
            drivers[name] = driver
            offset += self._rest[name] - multiplier * self._rest[driver]
            joint = self.joints[number[name]]
            self.joints[number[name]] = replace(joint, mimic=Mimic(driver, multiplier, offset))

    def _line(self, joint: Any) -> tuple[Floats, Floats]:
        """Return a point (3,) of a joint's axis and its direction (3,), in its body's frame."""
        document, frame = self._document, self._frame_of(joint)[1]
        axis = np.array(document.numbers(joint, "axis", (3,), "0 0 1"))
        axis = turned(frame[:3, :3], unit(joint, axis, document))
        return apply(frame, document.numbers(joint, "pos", (3,), "0 0 0")), axis

    def _reach(self, joint: Any) -> tuple[JointKind, float, float, float]:
        """Return a joint's kind, its ends, and its state where its body stands as it is drawn."""
        document, word = self._document, joint.get("type", "hinge")
        if word not in ("hinge", "slide"):
            raise document.refuse(joint, f"its type is {quoted(word)}; make it hinge or slide")
        scale = document.unit if word == "hinge" else 1.0
        rest = document.numbers(joint, "ref", (1,), "0")[0] * scale
        lower, upper = document.numbers(joint, "range", (2,), "0 0", infinite=True)
        limited = {"true": True, "auto": document.autolimits and lower != upper}
        if not limited.get(joint.get("limited", "auto")):
            kind = JointKind.CONTINUOUS if word == "hinge" else JointKind.PRISMATIC
            return kind, -np.inf, np.inf, rest
        if not lower < upper:
            raise document.refuse(joint, "its range has no length; name the lesser end first")
        kind = JointKind.REVOLUTE if word == "hinge" else JointKind.PRISMATIC
        return kind, lower * scale, upper * scale, rest
