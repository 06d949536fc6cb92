"""Where bodies, geoms and frames of an MJCF stand, by our arithmetic."""

from typing import Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.geometry import cross, rotation_about, rotation_from_quaternion, transform
from articugen.core.portable import arctan2, dot, norm, product
from articugen.sources.mjcf.document import TURNS, Document

_AXES = dict(zip("xyz", np.eye(3), strict=True))


def place(element: Any, document: Document) -> Floats:
    """Return (4, 4) `T_parent_element`, by the element's pos and whatever says how it is turned."""
    at = document.numbers(element, "pos", (3,), "0 0 0")
    turns = [name for name in TURNS if element.get(name) is not None]
    if len(turns) > 1:
        raise document.refuse(element, f"has {' and '.join(turns)}; keep one")
    name = turns[0] if turns else "quat"
    if name == "quat":
        return transform(quaternion(element, name, document), at)
    count = {"axisangle": 4, "xyaxes": 6}.get(name, 3)
    values = np.array(document.numbers(element, name, (count,)))
    if name == "axisangle":
        axis = unit(element, values[:3], document)
        return transform(rotation_about(axis, values[3] * document.unit), at)
    if name == "zaxis":
        return transform(_turn_of_z(unit(element, values, document)), at)
    if name == "xyaxes":
        x = unit(element, values[:3], document)
        y = unit(element, values[3:] - x * dot(x, values[3:]), document)
        return transform(np.stack([x, y, cross(x, y)], axis=1), at)
    turn = np.eye(3)
    for letter, angle in zip(document.eulerseq, values * document.unit, strict=True):
        step = rotation_about(_AXES[letter.lower()], angle)
        turn = product(turn, step) if letter.islower() else product(step, turn)
    return transform(turn, at)


def ends(element: Any, document: Document) -> tuple[Floats, float]:
    """Return (4, 4) where a geom stands that is given by its two ends, and half their distance."""
    start, end = np.reshape(document.numbers(element, "fromto", (6,)), (2, 3))
    turn = _turn_of_z(unit(element, start - end, document))
    return transform(turn, (start + end) / 2.0), float(norm(start - end)) / 2.0


def quaternion(element: Any, attribute: str, document: Document) -> Floats:
    """Return (3, 3) of an attribute that is a quaternion of any length, by default no turn."""
    q = np.array(document.numbers(element, attribute, (4,), "1 0 0 0"))
    return rotation_from_quaternion(unit(element, q, document))


def unit(element: Any, vector: Floats, document: Document) -> Floats:
    """Return a vector at the length 1; InvalidSource where it has none."""
    length = norm(vector)
    if not length > 1e-12:
        raise document.refuse(element, "a direction or rotation of it is zero; correct it")
    return vector / length


def _turn_of_z(direction: Floats) -> Floats:
    """Return (3, 3) the least turn of z to a unit vector."""
    axis = cross((0.0, 0.0, 1.0), direction)
    sine = norm(axis)
    axis = axis / sine if sine > 1e-10 else np.array([1.0, 0.0, 0.0])
    return rotation_about(axis, arctan2(sine, direction[2]))
