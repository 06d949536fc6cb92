"""One object at any joint state: as it is stored, made again from its source, or the nearest."""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import InvalidArgument
from articugen.core.geometry import apply, invert_rigid
from articugen.core.records import JointKind, Mesh
from articugen.core.schema import Instance
from articugen.instance import again
from articugen.instance.maker import Maker
from articugen.meshes.marching_cubes import zero_level
from articugen.meshes.simpler import simpler
from articugen.pictures.portrait import AJAR

SAME = 1e-9  # radians or metres by which joint values of one state may differ
PART_VOXELS = 96  # along the unit frame's edge, of part meshes
WITHIN = 1e-4  # of those, unit frame, what is drawn lies


@dataclass(frozen=True)
class Joint:
    """A joint that one may move.

    Attributes:
        name: in the model's file; "" where a shard has none.
        lower, upper: its range, rad or m from the canonical pose, which is in it.
        follows: the joint that drives it, or "".
    """

    name: str
    kind: JointKind
    lower: float
    upper: float
    follows: str = ""

    @property
    def unit(self) -> str:
        return "" if self.kind == JointKind.PRISMATIC else "°"

    @property
    def per_unit(self) -> float:
        """Radians in a degree; lengths are those of the model, which may not state its unit."""
        return 1.0 if self.kind == JointKind.PRISMATIC else float(np.radians(1.0))


@dataclass(frozen=True, eq=False)
class Seen:
    """Object at some joint values.

    Attributes:
        q: (J,) the values that it has, rad or m.
        state: which stored state it is; None for one that was made for these values.
        asked: whether it is at the values that were asked for, not at those of the nearest state.
        why: the sentence that says why it is not; "" where it is.
    """

    instance: Instance
    q: Floats
    state: int | None
    asked: bool = True
    why: str = ""


@dataclass(eq=False)
class Shown:
    """One object.

    Attributes:
        object_id: whatever its source calls it.
        joints: those that move, in part order.
        states: (n, J) the joint values of the states that there are, rad or m; 0 is canonical.
        read: gives the instance of a state.
        image_size: pixels along the edge of what its depth cameras see.
        split: "train" or "test"; "" where it is in no data set.
        maker: makes it at any other state; None where its source is not there.
        why: the sentence that says so; "" where it is.
    """

    object_id: str
    joints: Sequence[Joint]
    states: Floats
    read: Callable[[int], Instance]
    _: KW_ONLY
    image_size: int
    split: str = ""
    maker: Maker | None = None
    why: str = ""

    def at_state(self, state: int) -> Seen:
        """Return one of its states, as it is stored or as `generate` would store it."""
        return Seen(self.read(state), self.states[state], state)

    def at(self, q: Floats) -> Seen:
        """Return the object at joint values (J,), rad or m. Joints that follow another are put
        where that puts them.

        Raises:
            ArticugenError: nothing can be made there; the sentence says why.
        """
        apart = np.abs(self.states - q).max(axis=1, initial=0.0)
        state = int(apart.argmin())
        if apart[state] <= SAME:
            return self.at_state(state)
        if self.maker is None:
            return self._nearest_to(q, self.why)
        drivers = zip(self.joints, q.tolist(), strict=True)
        try:
            instance = self.maker.at({joint.name: v for joint, v in drivers if not joint.follows})
        except InvalidArgument as error:  # few states span a frame that others stick out of
            return self._nearest_to(q, str(error))
        return Seen(instance.instance, np.array(list(instance.state.values())), None)

    def _nearest_to(self, q: Floats, why: str) -> Seen:
        near = self.nearest(q)
        return Seen(self.read(near), self.states[near], near, asked=False, why=why)

    def nearest(self, q: Floats) -> int:
        """Return the state that differs least from `q`, each joint by its range."""
        span = np.array([joint.upper - joint.lower for joint in self.joints])
        return int((np.abs(self.states - q) / np.where(span > 0.0, span, 1.0)).sum(axis=1).argmin())

    @cached_property
    def ajar(self) -> int:
        """The state that is nearest to a little open: what opens shut looks as if nothing moved."""
        far = [max(joint.lower, joint.upper, key=abs) for joint in self.joints]
        return self.nearest(AJAR * np.array(far))

    @cached_property
    def part_meshes(self) -> tuple[Mesh, ...]:
        """Return a mesh of each part in the canonical pose, unit frame: its own solid's surface;
        from the finest stored grid where the source is not there; empty where that holds nothing
        of it.

        Raises:
            RejectedInstance: a part is too small to have any.
        """
        if self.maker is not None:
            return tuple(again.part_meshes(self.maker.prepared, PART_VOXELS, within=WITHIN))
        first, meshes = self.read(0), list[Mesh]()
        if not first.occupancy:
            return ()
        label = first.occupancy[max(first.occupancy)]
        for part, back in enumerate(invert_rigid(first.part_motion)):
            posed = zero_level(np.where(label == part + 1, 1.0, -1.0))
            mesh = Mesh(apply(back, posed.vertices), posed.faces)
            # a triangle a voxel takes a browser fifty times as long
            meshes.append(simpler(mesh, WITHIN) if len(mesh.faces) else mesh)
        return tuple(meshes)
