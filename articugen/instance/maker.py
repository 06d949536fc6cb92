"""A model at any joint state: `load` it, `Maker` it, ask what is inside.

`Maker` is `instance.py` for people: what it makes of a recipe's own states is, to the byte, what
`generate` writes for them, and what it makes of any other state lies in the same unit frame.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from articugen import fusion
from articugen.core.arrays import Bytes, Floats
from articugen.core.errors import InvalidArgument, InvalidSource
from articugen.core.recipe import Recipe, load_recipe
from articugen.core.records import (
    ArticulatedObject,
    Joint,
    JointKind,
    JointState,
    LabelledMesh,
    Mesh,
)
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.core.yaml_files import unlisted
from articugen.fusion.isosurface import extract_mesh
from articugen.instance import articulation
from articugen.instance.articulation import Canonical
from articugen.instance.make import make_instance
from articugen.instance.preparing import Prepared, pose, prepare
from articugen.instance.swept import swept_box
from articugen.meshes.mesh_file import export
from articugen.sources import readers
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source
from articugen.store.rows import Row, RowJoint

ANY_CATEGORY = "object"  # of a model that does not state what it is
MOST_VOXELS = 1024
"""Along an edge of what a mesh is made from: the field of more takes 8 GiB and up."""

_TIE = 1e-9

_SAME = 1e-12
"""Joint values that differ by no more, relatively, are one: shards hold them in another unit."""


@dataclass(frozen=True, eq=False)
class Model:
    """A model as its source gives it.

    Attributes:
        obj: its links and joints, metres, with the limits of its URDF.
        canonical, movable: the source's choice of canonical pose and of moving joints, see
            `articulation.resolve`.
        clips_to_limits: whether joints stay inside those limits where a recipe leaves it open.
        ref: where it is read again, with its colours, for a recipe that asks for them.
    """

    obj: ArticulatedObject
    canonical: Canonical = "zero"
    movable: tuple[str, ...] = ()
    clips_to_limits: bool = True
    ref: ObjectRef | None = None

    @property
    def object_id(self) -> str:
        return self.obj.object_id

    @property
    def category(self) -> str:
        return self.obj.category

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Joints of its file that can move."""
        return tuple(joint for joint in self.obj.joints if joint.kind != JointKind.FIXED)

    def __repr__(self) -> str:
        faces = sum(len(link.mesh.faces) for link in self.obj.links)
        links = f"{len(self.obj.links)} links, {faces:,} faces"
        head = f"Model({self.object_id}, {self.category}: {links}"
        return "\n".join([head, *(f"  {joint!r}" for joint in self.joints)]) + ")"


def load(source: str | Path, object_id: str | None = None, *, category: str | None = None) -> Model:
    """Read a model, from anything that `generate` takes as a source.

    Args:
        source: a URDF file, the folder of a model, a folder of models, or a source's name.
        object_id: which of them, where there are several.
        category: what it is, where it does not say so. It chooses the recipe, and decides random
            numbers: to come to the data of a `generate`, name the same.

    Raises:
        InvalidSource: there is no such model, or it cannot be read; the sentence says why.
    """
    ref, *others = models(source, category, object_id)
    if others:
        raise InvalidSource(
            f"{source}: holds {1 + len(others)} models; name one, as in "
            f"load({str(source)!r}, {ref.object_id!r})"
        )
    settings, clips = ref.settings, open_source(str(source)).clips
    return Model(readers.load(ref), settings.canonical, settings.movable, clips, ref)


def models(
    source: str | Path, category: str | None = None, object_id: str | None = None
) -> tuple[ObjectRef, ...]:
    """Return the models that a source holds, all of them or the one that is asked for.

    Args:
        source, category, object_id: as in `load`.

    Raises:
        InvalidSource: there is no such source or model.
    """
    ids = () if object_id is None else (object_id,)
    source = str(source)
    if source.lower().endswith(".urdf") and not Path(source).exists():
        raise InvalidSource(f"{source}: there is no such file; correct its path")
    opened = open_source(source)
    try:
        categories = opened.categories([category or "all"])
    except InvalidSource:
        if category or opened.yaml:
            raise
        categories = (ANY_CATEGORY,)
    return tuple(
        ref
        for name, (taken, out_of) in opened.share_out(categories, ids, ()).items()
        for ref in opened.objects(name, ids=taken, exclude=out_of)
    )


class MadeMesh(Mesh):
    """A watertight mesh in the unit frame: `vertices` (V, 3), `faces` (F, 3), outwards."""

    def export(self, path: str | Path) -> None:
        """Write it as .ply, .obj, .stl or .glb.

        Raises:
            ArticugenError: another ending, or the file cannot be written.
        """
        export(self, Path(path))

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices):,} vertices, {len(self.faces):,} faces)"


class Made(Row):
    """An instance that can be asked about any point: a `Row` with its field.

    Its samples (`surface`, `uniform`, `grids` and so on) are made when the first is asked for. At a
    state that is not the recipe's, its `state_index` is the number of the recipe's states: no index
    of them.
    """

    def __init__(self, prepared: Prepared, index: int) -> None:
        """Made by a `Maker`; `index` counts the states of `prepared`."""
        super().__init__(self._arrays, prepared.recipe.fields(), category=prepared.obj.category)
        self._prepared, self._index = prepared, index
        self._known |= {
            "object_id": prepared.obj.object_id,
            "state_index": index,
            "center": prepared.unit.center,
            "scale": prepared.unit.scale,
        }

    @property
    def state(self) -> dict[str, float]:
        """The joint values by name, rad or m from the canonical pose."""
        q = self._prepared.states[self._index].q.tolist()
        names = (joint.name for joint in self._prepared.obj.moving_joints)
        return dict(zip(names, q, strict=True))

    @cached_property
    def joints(self) -> tuple[RowJoint, ...]:
        """Joint j moves part j + 1. Their states are those that were asked for, to the bit."""
        states = self.state.values()
        pairs = zip(super().joints, states, strict=True)
        return tuple(replace(joint, state=state) for joint, state in pairs)

    def _which(self) -> str:
        known = self._index <= self._prepared.recipe.articulation.states
        return super()._which() if known else "at a state of its own"

    @cached_property
    def instance(self) -> Instance:
        """The `records.Instance` that a shard would hold."""
        return make_instance(self._prepared, self._index)

    @cached_property
    def _posed(self) -> tuple[LabelledMesh, fusion.PosedFields]:
        return pose(self._prepared, self._index)

    def labels(self, points: NDArray[Any]) -> Bytes:
        """Return (n,) at `points` (n, 3), unit frame: 0 free, k + 1 material of part k, 255
        enclosed, which no view sees and no part holds.

        Raises:
            InvalidArgument: they are not points, or not in the unit cube.
        """
        points = np.asarray(points, np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InvalidArgument(f"labels of points (n, 3), not of an array {points.shape}")
        if not (np.abs(points) <= 0.5 + _TIE).all():
            raise InvalidArgument(
                "labels of points in the unit frame, all of whose coordinates lie in [-0.5, 0.5]; "
                "bring metres there with (x - center) / scale"
            )
        return self._posed[1].labels(points)

    def mesh(
        self, resolution: int = 128, of: Literal["material", "visible"] = "material"
    ) -> MadeMesh:
        """Return the parts' material as a watertight mesh, unit frame, from `resolution`^3 voxels;
        `visible`: with the space that no view sees.

        Raises:
            InvalidArgument: that is no number from 8 to 1,024; or of something else.
            RejectedInstance: all of it lies between the voxels' centres.
        """
        if not isinstance(resolution, int | np.integer) or not 8 <= resolution <= MOST_VOXELS:
            raise InvalidArgument(
                f"a mesh of {resolution!r} voxels along an edge; give a number from 8 to "
                f"{MOST_VOXELS:,}"
            )
        if of not in fusion.SOLIDS:
            raise InvalidArgument(f"a mesh of {of!r}; it is of the material, or what is visible")
        mesh = extract_mesh(self._posed[1].solid(of), resolution)
        return MadeMesh(mesh.vertices, mesh.faces)

    def _arrays(self, names: Sequence[str]) -> list[Any]:
        arrays = self.instance.arrays()
        return [arrays[name] for name in names]


class Maker(Sequence[Made]):
    """Makes instances of one object, all in one unit frame.

    `maker[i]` is instance i of what `generate` makes with the same recipe, seed and category, to
    the byte; `maker[0]` is the canonical pose.

    Attributes:
        obj: the object with the recipe's joints: they are 0 in the canonical pose.
        recipe: how instances are made.
        seed: the master seed.
    """

    def __init__(
        self,
        obj: Model | ArticulatedObject,
        recipe: str | Path | Mapping[str, Any] | Recipe | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            obj: as `load` gives it.
            recipe: a name, a path, the keys of a recipe, or None for the category's own.

        Raises:
            InvalidArgument: `obj` is no model.
            InvalidRecipe: there is no such recipe, or it makes no sense.
            NotOfCategory: nothing of the object moves.
            RejectedInstance: nothing can be made of it.
        """
        if not isinstance(obj, Model | ArticulatedObject):
            raise InvalidArgument(f"{obj!r} is no model; load one of a file or folder by ag.load")
        model = obj if isinstance(obj, Model) else Model(obj)
        recipe = load_recipe(recipe, model.category)
        self.recipe = recipe.for_source(clips_to_limits=model.clips_to_limits)
        self.seed = seed
        again = model.ref if self.recipe.shows_colours else None
        self.obj = articulation.resolve(
            readers.load(again, colours=True) if again else model.obj,
            self.recipe.articulation,
            canonical=model.canonical,
            movable=model.movable,
        )

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Joints that move, in part order: joint j moves part j + 1. `lower` and `upper` are the
        range that states are sampled from, rad or m from the canonical pose."""
        return self.obj.moving_joints

    @cached_property
    def prepared(self) -> Prepared:
        """Preparation that all instances share; it takes a second or more."""
        return prepare(self.obj, self.recipe, self.seed)

    def __len__(self) -> int:
        """Return the recipe's states, and the canonical one."""
        return self.recipe.articulation.states + 1

    @overload
    def __getitem__(self, index: int) -> Made: ...
    @overload
    def __getitem__(self, index: slice) -> list[Made]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        if index not in range(-len(self), len(self)):
            raise IndexError(f"{self.obj.object_id}: no state {index}, there are {len(self)}")
        return Made(self.prepared, range(len(self))[index])

    def __iter__(self) -> Iterator[Made]:
        return (self[i] for i in range(len(self)))

    def at(self, state: Mapping[str, float] | None = None, /, **joints: float) -> Made:
        """Return the object at a joint state.

        Args:
            state, joints: values by joint name, rad or m from the canonical pose, as
                `row.joints[k].state` has them; joints that are not named are 0. Names that are no
                Python names go into `state`. At a state of the recipe's it is that instance.

        Raises:
            InvalidArgument: no such joint, another value than a joint that follows has there, a
                value outside its range; or the object would stick out of the unit frame.
        """
        if not isinstance(state, Mapping | None):
            raise InvalidArgument(
                f"{self.obj.object_id}: {state!r} names no joint; give values by name, as in "
                f"at({self.joints[0].name}=0.1)"
            )
        values = {**(state or {}), **joints}
        for name, value in values.items():
            self._check(name, value)
        driven = articulation.driven_state(self.obj, values)
        for joint, q in zip(self.joints, driven.q.tolist(), strict=True):
            if joint.mimic and not abs(values.get(joint.name, q) - q) <= _TIE * max(1.0, abs(q)):
                raise InvalidArgument(
                    f"{self.obj.object_id}: joint {joint.name!r} follows {joint.mimic.joint!r}, "
                    f"which puts it at {q:.9g}; give that alone"
                )
        for index, known in enumerate(self.prepared.states):
            if np.allclose(driven.q, known.q, rtol=_SAME, atol=0.0):
                return self[index]
        return self._made(driven)

    def random(self, count: int = 1, *, rng: int | np.random.Generator | None = None) -> list[Made]:
        """Return the object at joint states that are uniform in its ranges, or raise, as `at`.

        Args:
            rng: the same seed draws the same; None draws others each time.
        """
        rng = np.random.default_rng(rng)
        states = [articulation.sample_joint_state(self.obj, rng=rng) for _ in range(count)]
        return [self._made(state) for state in states]

    def _check(self, name: str, value: float) -> None:
        known = {joint.name: joint for joint in self.joints}
        joint = known.get(name)
        if joint is None:
            moving = unlisted("moving joint", str(name), known)
            raise InvalidArgument(f"{self.obj.object_id}: {moving}")
        unit = "m" if joint.kind == JointKind.PRISMATIC else "rad"
        if np.ndim(value) or np.asarray(value).dtype.kind not in "iuf":
            raise InvalidArgument(
                f"{self.obj.object_id}: joint {name!r} at {value!r} is no number; give one, {unit} "
                "from the canonical pose"
            )
        lower, upper = min(joint.lower, 0.0), max(joint.upper, 0.0)
        if not lower - _TIE <= value <= upper + _TIE:
            raise InvalidArgument(
                f"{self.obj.object_id}: joint {name!r} at {value:.9g} {unit} is outside its range, "
                f"{lower:.9g} to {upper:.9g}; choose one in it, or widen articulation in the recipe"
            )

    def _made(self, state: JointState) -> Made:
        """Its random points are those of no state of the recipe's; the same for the same state."""
        p = self._prepared_for(state)
        q = state.q.astype("<f8").tobytes().hex()
        rng = generator(self.seed, self.obj.category, self.obj.object_id, "at", q)
        seed = int(rng.integers(2**62))
        return Made(replace(p, states=(*p.states, state), seed=seed), len(p.states))

    def _prepared_for(self, state: JointState) -> Prepared:
        """Views that hold the object at `state`: the recipe's, where they do."""
        p = self.prepared
        box = _box(p, [state])
        if np.abs(box).max() > 0.5 + _TIE:
            pairs = zip(self.joints, state.q.tolist(), strict=True)
            values = ", ".join(f"{joint.name}={q:g}" for joint, q in pairs)
            raise InvalidArgument(
                f"{self.obj.object_id}: at {values} it sticks out of the unit "
                f"frame, which the recipe's {len(p.states)} states span; raise padding or "
                "articulation.states in the recipe"
            )
        if _holds(self._box, box):
            return p
        wide, wide_box = self._wide
        if _holds(wide_box, box):
            return wide
        return prepare(self.obj, self.recipe, self.seed, reach=[state])

    @cached_property
    def _box(self) -> Floats:
        """(2, 3) what the recipe's views hold, unit frame."""
        return _box(self.prepared, self.prepared.states)

    @cached_property
    def _wide(self) -> tuple[Prepared, Floats]:
        """The same with views that hold the ends of all joints' ranges, and what they hold."""
        ends = [(j.name, (j.lower, j.upper)) for j in self.joints if j.mimic is None]
        together = [{name: end[side] for name, end in ends} for side in (0, 1)]
        alone = [{name: value} for name, end in ends for value in end]
        reach = [articulation.driven_state(self.obj, values) for values in (*together, *alone)]
        wide = prepare(self.obj, self.recipe, self.seed, reach=reach)
        return wide, _box(wide, (*wide.states, *reach))

    def __repr__(self) -> str:
        head = f"Maker({self.obj.object_id}, {self.obj.category}, recipe {self.recipe.name}, seed"
        return "\n".join([f"{head} {self.seed}", *(f"  {j!r}" for j in self.joints)]) + ")"


def _box(p: Prepared, states: Iterable[JointState]) -> Floats:
    """Return (2, 3) the box of the object in all these states, unit frame."""
    motions = articulation.motions_of(p.obj, states, p.canonical)
    return swept_box(p.mesh, p.unit.rigid_to_unit(motions))


def _holds(box: Floats, other: Floats) -> bool:
    return bool((box[0] <= other[0] + _TIE).all() and (other[1] <= box[1] + _TIE).all())
