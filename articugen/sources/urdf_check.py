"""What a URDF must be before yourdfpy sees it; each fault is one sentence: file, element, cure.

yourdfpy guesses where it should refuse: it retries broken XML with a recovering parser, takes
floating and planar joints for fixed ones and drops what it cannot find. So the tree is checked here
against the rules of the format (wiki.ros.org/urdf/XML), and stripped of all that is not used.
"""

import math
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from articugen.core.errors import InvalidSource
from articugen.core.records import JointKind
from articugen.meshes.model_files import quoted
from articugen.meshes.xml_strict import drop_default_namespaces, parse_xml
from articugen.sources.xml_check import MAX_LINKS, MAX_VISUALS, MIN_SIZE, Check

_READ = tuple(map(str, JointKind))
_ANY_READ = f"{', '.join(_READ[:-1])} or {_READ[-1]}"
_REFUSED = ("planar", "floating", "spherical")
_UNUSED = (
    *("inertial", "collision", "material", "transmission", "gazebo"),
    *("dynamics", "calibration", "safety_controller"),
)


def checked_robot(data: bytes, path: Path) -> tuple[Any, list[str]]:
    """Return `<robot>` element (lxml) of a sound URDF, and its links with collision shapes only.

    Elements that are not used are removed, numbers are rewritten plainly. Stray text between
    elements is harmless and accepted, and so are commas between numbers.

    Raises:
        InvalidSource: the first fault found.
    """
    robot = parse_xml(data, path)
    drop_default_namespaces(robot)
    _check_root(robot, path)
    if any("www.ros.org/wiki/xacro" in str(element.tag) for element in robot.iter()):
        raise InvalidSource(f"{path}: is xacro source; expand it first: xacro in.xacro > out.urdf")
    unseen = [
        link.get("name", "")
        for link in robot.findall("link")
        if link.find("visual") is None and link.find("collision") is not None
    ]
    _keep_colours(robot)
    for element in list(robot.iter(*_UNUSED)):
        element.getparent().remove(element)
    robot.set("name", robot.get("name", ""))
    check = _Check(path, ("link", "joint"))
    check.count(robot.findall("link"), "links", MAX_LINKS)
    check.count(robot.findall("joint"), "joints", MAX_LINKS)
    check.count(robot.findall("link/visual"), "visuals", MAX_VISUALS)
    links = check.named(robot.findall("link"))
    if not links:
        raise InvalidSource(f"{path}: <robot> has no <link>; add at least one")
    joints = check.named(robot.findall("joint"))
    for link in links.values():
        check.link(link)
    for joint in joints.values():
        check.joint(joint)
    _check_tree(check, list(links), joints)
    _check_mimics(check, joints)
    return robot, unseen


def _keep_colours(robot: Any) -> None:
    """Give the shapes of visuals the rgba of their materials, of which some are named elsewhere."""
    named = {m.get("name"): m for m in robot.iter("material") if m.find("color") is not None}
    for visual in robot.iterfind("link/visual"):
        material = visual.find("material")
        if material is not None and material.find("color") is None:
            material = named.get(material.get("name"))
        for shape in visual.iterfind("geometry/*"):
            if material is not None and (rgba := material.find("color").get("rgba")):
                shape.set("rgba", rgba)


def _check_root(robot: Any, path: Path) -> None:
    if robot.tag == "robot":
        return
    if robot.tag.rpartition("}")[2] == "robot":
        raise InvalidSource(
            f"{path}: the root element <{robot.prefix}:robot> has a prefix; write the elements "
            "without it"
        )
    raise InvalidSource(
        f"{path}: the root element is <{robot.tag}>, not <robot>, so it is not a URDF; convert it "
        "or leave it out"
    )


class _Check(Check):
    """The rules for single elements of a URDF."""

    def link(self, link: Any) -> None:
        for visual in link.findall("visual"):
            self.origin(visual)
            geometry = self.child(visual, "geometry", required=True)
            if len(geometry) != 1:
                raise self.refuse(geometry, f"<geometry> holds {len(geometry)} shapes; keep one")
            self.shape(geometry[0])

    def shape(self, shape: Any) -> None:
        if shape.tag == "mesh":
            if not shape.get("filename"):
                raise self.refuse(shape, "<mesh> has no filename; name the file")
            scale = self.numbers(shape, "scale", (1, 3), "1")
            if any(abs(x) < MIN_SIZE for x in scale):
                raise self.refuse(shape, "<mesh> has a zero scale, or nearly; give it another")
            return
        sizes = {
            "box": {"size": (3,)},
            "cylinder": {"radius": (1,), "length": (1,)},
            "capsule": {"radius": (1,), "length": (1,)},
            "sphere": {"radius": (1,)},
        }.get(shape.tag)
        if sizes is None:
            raise self.refuse(
                shape,
                f"<{shape.tag}> is not a shape of URDF; use box, cylinder, capsule, sphere or mesh",
            )
        for attribute, counts in sizes.items():
            if not all(x >= MIN_SIZE for x in self.numbers(shape, attribute, counts)):
                raise self.refuse(shape, f"<{shape.tag}> {attribute} is not positive; make it so")

    def joint(self, joint: Any) -> None:
        kind = joint.get("type")
        if kind in _REFUSED:
            raise self.refuse(
                joint,
                f"type {quoted(kind)} has more than one degree of freedom and is not read; make it "
                f"{_ANY_READ}",
            )
        if kind not in _READ:
            raise self.refuse(joint, f"unknown type {quoted(kind or '')}; make it {_ANY_READ}")
        for tag in ("parent", "child"):
            if not self.child(joint, tag, required=True).get("link"):
                raise self.refuse(joint, f"<{tag}> names no link; add link=")
        self.origin(joint)
        axis = self.child(joint, "axis")
        direction = [1.0]
        if axis is not None:
            direction = self.numbers(axis, "xyz", (3,), "1 0 0", most=math.inf)
        if kind != "fixed" and not math.hypot(*direction) > 1e-12:
            raise self.refuse(joint, "<axis> is zero; give it a direction")
        self.limit(joint, kind)
        mimic = self.child(joint, "mimic")
        if mimic is not None:
            self.numbers(mimic, "multiplier", (1,), "1")
            self.numbers(mimic, "offset", (1,), "0")

    def limit(self, joint: Any, kind: str) -> None:
        """Compute where the joint ends; what says nothing of that (force, speed) is not examined.

        Ends beyond MAX_NUMBER are how simulators say that there is none.
        """
        if kind not in ("revolute", "prismatic"):
            for limit in joint.findall("limit"):
                joint.remove(limit)
            return
        limit = self.child(joint, "limit")
        if limit is None:
            return
        for attribute in set(limit.attrib) - {"lower", "upper"}:
            del limit.attrib[attribute]
        (lower,) = self.numbers(limit, "lower", (1,), "0", infinite=True)
        (upper,) = self.numbers(limit, "upper", (1,), "0", infinite=True)
        if lower > upper:
            raise self.refuse(
                joint, f"lower limit {lower:g} is above the upper limit {upper:g}; swap them"
            )
        if lower == math.inf or upper == -math.inf:
            raise self.refuse(
                joint, f"its limits {lower:g} and {upper:g} leave no place; correct them"
            )

    def origin(self, element: Any) -> None:
        origin = self.child(element, "origin")
        if origin is not None:
            self.numbers(origin, "xyz", (3,), "0 0 0")
            self.numbers(origin, "rpy", (3,), "0 0 0")


def _check_tree(check: _Check, links: list[str], joints: dict[str, Any]) -> None:
    """Check that every link but one, the root, is the child of one joint, and all hang on the
    root."""
    known = set(links)
    parent_of: dict[str, str] = {}
    hangs_on: dict[str, str] = {}
    for name, joint in joints.items():
        parent, child = (joint.find(tag).get("link") for tag in ("parent", "child"))
        for link in (parent, child):
            if link not in known:
                raise check.refuse(
                    joint, f"unknown link {quoted(link)}; add the link or correct it"
                )
        if child in parent_of:
            raise check.refuse(
                joint,
                f"link {child!r} is already the child of joint {hangs_on[child]!r}; a link has one"
                " parent, remove one of the joints",
            )
        parent_of[child], hangs_on[child] = parent, name
    ring = _ring(parent_of)
    if ring:
        loop = sorted(hangs_on[link] for link in ring)
        raise check.refuse(
            joints[loop[0]], f"the joints {', '.join(loop)} form a loop; remove one of them"
        )
    roots = [link for link in links if link not in parent_of]
    if len(roots) > 1:
        raise InvalidSource(
            f"{check.path}: links {', '.join(map(repr, roots[:5]))} are all roots; join them with "
            "fixed joints"
        )


def _check_mimics(check: _Check, joints: dict[str, Any]) -> None:
    """Check that each mimic leads, over any number of others, to a joint that moves by itself."""
    leads_to: dict[str, str] = {}
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is None or joint.get("type") == "fixed":
            continue
        target = leads_to[name] = mimic.get("joint") or ""
        if target not in joints:
            raise check.refuse(
                joint, f"mimics the unknown joint {quoted(target)}; correct its name"
            )
        if joints[target].get("type") == "fixed":
            raise check.refuse(
                joint, f"mimics {quoted(target)}, which is fixed; remove the <mimic>"
            )
    for name in _ring(leads_to)[:1]:
        raise check.refuse(joints[name], f"its <mimic> leads back to {quoted(name)}; remove one")


def _ring(leads_to: dict[str, str]) -> list[str]:
    """Return names that lead to one another in a circle; [] where there is none."""
    try:
        TopologicalSorter({name: [other] for name, other in leads_to.items()}).prepare()
    except CycleError as error:
        return sorted(set(error.args[1]))
    return []
