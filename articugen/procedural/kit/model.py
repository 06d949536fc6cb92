"""What a generator builds: links of solids and the joints between them, all drawn in one place.

Everything is given in the object's own frame at q = 0 (right-handed, z up, metres): no generator
needs to think in link frames. `writer` takes care of those.
"""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from articugen.core.arrays import Floats
from articugen.core.geometry import bounds
from articugen.procedural.kit.solids import Solid

ROOT_NAME = "base"  # the empty link on which a messy model stands


@dataclass(frozen=True, eq=False)
class ModelLink:
    """A rigid body: the union of `solids`, drawn where it stands at q = 0."""

    name: str
    semantic: str
    solids: tuple[Solid, ...]


@dataclass(frozen=True, eq=False)
class ModelJoint:
    """A joint, as it stands at q = 0.

    Attributes:
        parent, child: link names.
        origin: (3,) a point on the axis, in the object's frame.
        axis: (3,) unit direction; a revolute joint turns right-handed about it.
        lower, upper: limits of q, rad or m.
    """

    name: str
    kind: Literal["fixed", "revolute", "prismatic"]
    parent: str
    child: str
    origin: ArrayLike
    axis: ArrayLike = (0.0, 0.0, 1.0)
    lower: float = 0.0
    upper: float = 0.0


@dataclass(frozen=True, eq=False)
class Model:
    """One procedural object. `links[0]` is the fixed body; each other link hangs on one joint.

    Joints come in topological order: a joint after the one that its parent hangs on.
    """

    links: tuple[ModelLink, ...]
    joints: tuple[ModelJoint, ...]
    bounds: Floats = field(init=False)

    def __post_init__(self) -> None:
        hung = [self.links[0].name]
        if any(link.name == ROOT_NAME for link in self.links):
            raise ValueError(f"a link may not be called {ROOT_NAME}: messy models have one")
        for joint in self.joints:
            if joint.parent not in hung or joint.child in hung:
                raise ValueError(f"joint {joint.name}: its parent must come first, its child once")
            hung.append(joint.child)
        if sorted(hung) != sorted(link.name for link in self.links):
            raise ValueError("each link but the first must hang on one joint")
        points = np.concatenate([s.vertices for link in self.links for s in link.solids])
        object.__setattr__(self, "bounds", bounds(points))

    @staticmethod
    def of(body: ModelLink, moving: Iterable[tuple[ModelLink, ModelJoint]]) -> "Model":
        """Build a model of its fixed body and of what moves: links, each with its joint."""
        moving = tuple(moving)
        return Model((body, *(link for link, _ in moving)), tuple(joint for _, joint in moving))


def moving_part(
    name: str,
    semantic: str,
    solids: Iterable[Solid],
    at: ArrayLike,
    axis: ArrayLike,
    upper: float,
    *,
    slides: bool = False,
) -> tuple[ModelLink, ModelJoint]:
    """Return a link that hangs on the link `body`, and its joint, which turns about `axis` through
    `at` by 0 to `upper`, rad, or `slides` along it by as many metres; the joint is called
    `<name>_hinge` or `<name>_slide`."""
    joint = f"{name}_slide" if slides else f"{name}_hinge"
    kind = "prismatic" if slides else "revolute"
    link = ModelLink(name, semantic, tuple(solids))
    return link, ModelJoint(joint, kind, "body", name, at, axis, 0.0, upper)


def first_sound(draw: Callable[[], Model]) -> Model:
    """Return the first model that is drawn with convex cells, which outlines that cross have not;
    a draw may also give up by ValueError."""
    for _ in range(1000):
        with suppress(ValueError):
            model = draw()
            if all(len(s.half_spaces) for link in model.links for s in link.solids):
                return model
    raise ValueError("none of 1,000 draws is sound")
