"""Models as text: OBJ meshes and the URDF that joins them, for whoever writes one."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from articugen.core.arrays import Floats


@dataclass(frozen=True, eq=False)
class Visual:
    """A mesh of a link.

    Attributes:
        file: beside the URDF.
        origin: (3,) where the mesh's frame stands in the link's, metres; `rpy` is how it is turned,
            which is not written where it is None.
        rgba: (4,) its colour in 0 .. 1, or None.
    """

    file: str
    origin: ArrayLike = (0.0, 0.0, 0.0)
    rgba: tuple[float, float, float, float] | None = None
    rpy: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint, as a URDF has it: in the frame of its parent, rad and metres.

    Attributes:
        origin: (3,) where the child's frame stands at q = 0; `rpy` is how it is turned.
        axis: (3,) unit direction, None for a fixed joint.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: ArrayLike
    rpy: tuple[float, float, float] = (0, 0, 0)
    axis: ArrayLike | None = None
    lower: float = 0.0
    upper: float = 0.0


def obj_text(pieces: Iterable[tuple[Floats, NDArray[np.integer]]]) -> str:
    """Return one OBJ file of meshes (vertices (n, 3), triangles (m, 3)).

    To nanometres: finer than any use, coarser than the last bits in which machines differ.
    """
    lines, base = [], 1
    for vertices, faces in pieces:
        lines += [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in (vertices.round(9) + 0.0).tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + base).tolist()]
        base += len(vertices)
    return "\n".join(lines) + "\n"


def urdf_text(name: str, links: Mapping[str, Sequence[Visual]], joints: Iterable[Joint]) -> str:
    """Return a URDF of links, by name, and joints, in their order."""
    elements = [_link(link, visuals) for link, visuals in links.items()]
    tree = "\n".join([*elements, *map(_joint, joints)])
    return f'<?xml version="1.0"?>\n<robot name="{escape(name)}">\n{tree}\n</robot>\n'


def _numbers(values: ArrayLike) -> str:
    return " ".join(f"{round(float(v), 12) + 0.0:.15g}" for v in np.ravel(values))


def _link(name: str, visuals: Sequence[Visual]) -> str:
    if not visuals:
        return f'  <link name="{name}"/>'
    lines = [f'  <link name="{name}">']
    for visual in visuals:
        turn = "" if visual.rpy is None else f' rpy="{_numbers(visual.rpy)}"'
        lines += [
            "    <visual>",
            f'      <origin xyz="{_numbers(visual.origin)}"{turn}/>',
            f'      <geometry><mesh filename="{visual.file}"/></geometry>',
        ]
        if visual.rgba is not None:
            colour = f'<color rgba="{_numbers(visual.rgba)}"/>'
            lines.append(f'      <material name="{name}">{colour}</material>')
        lines.append("    </visual>")
    return "\n".join([*lines, "  </link>"])


def _joint(joint: Joint) -> str:
    lines = [
        f'  <joint name="{joint.name}" type="{joint.kind}">',
        f'    <parent link="{joint.parent}"/>',
        f'    <child link="{joint.child}"/>',
        f'    <origin xyz="{_numbers(joint.origin)}" rpy="{" ".join(map(repr, joint.rpy))}"/>',
    ]
    if joint.axis is not None:
        limits = f'lower="{_numbers(joint.lower)}" upper="{_numbers(joint.upper)}"'
        lines.append(f'    <axis xyz="{_numbers(joint.axis)}"/>')
        lines.append(f'    <limit {limits} effort="10" velocity="10"/>')
    return "\n".join([*lines, "  </joint>"])
