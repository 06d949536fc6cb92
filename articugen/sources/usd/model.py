"""One USD file to links, joints and triangles. Runs in a process of its own, see `apart`."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import InvalidSource
from articugen.core.records import Joint, Link, Mesh
from articugen.meshes import openusd as pxr
from articugen.meshes import read
from articugen.meshes.model_files import MAX_NAME_BYTES, ModelFiles, quoted
from articugen.sources.shapes import joined
from articugen.sources.usd.layers import Layers, plainly
from articugen.sources.usd.physics import WORLD, PhysicsJoint, Stage, body_of, read_joint
from articugen.sources.usd.shapes import Shapes
from articugen.sources.usd.transforms import Places
from articugen.sources.usd.tree import Tree
from articugen.sources.xml_check import MAX_LINKS, MAX_NUMBER

MAX_PRIMS = 200_000

_Z_UP = np.eye(3)
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


class Model(NamedTuple):
    """Contents of a file.

    Attributes:
        links: each in its own frame, metres; the fixed one first.
        joints: each after the one its parent hangs on.
        sha256: the digest of all layers.
        notes: what a user should know.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    sha256: str
    notes: tuple[str, ...]


def read_model(path: Path, root: Path, wanted: str = "meshes") -> Model:
    """Read a model from its main layer, or a package, at `path`; its layers may not leave `root`.

    Args:
        wanted: as `read.wanted` has it; without "meshes" a link's is a stand-in where it has one.

    Raises:
        InvalidSource: anything amiss with it.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    files = ModelFiles(path.parent, root)
    layers = Layers(path, files)
    if wanted == "hash":
        return Model((Link("world", read.STAND_IN),), (), files.sha256(), ())
    return _Reading(path, _stage(layers, path), wanted == "meshes").model(files.sha256())


def _stage(layers: Layers, path: Path) -> Any:
    try:
        stage = pxr.Usd.Stage.Open(layers.root, None)
    except pxr.Tf.ErrorException as error:
        raise InvalidSource(
            f"{path}: OpenUSD cannot open it ({plainly(str(error))}); export it again"
        ) from None
    faults = stage.GetCompositionErrors() if hasattr(stage, "GetCompositionErrors") else ()
    if faults:
        text = sorted(plainly(str(fault)) for fault in faults)[0]
        raise InvalidSource(f"{path}: its layers do not fit together ({text}); export it again")
    return stage


class _Reading:
    """Reader of one stage."""

    def __init__(self, path: Path, stage: Any, with_meshes: bool) -> None:
        self._path, self._stage, self._with_meshes = path, stage, with_meshes
        self._places = Places(str(path))
        self._shapes = Shapes(path, self._places)
        self._notes: list[str] = []

    def model(self, sha256: str) -> Model:
        bodies, jointed, shapes = self._found()
        numbers = {prim.GetPath(): k for k, prim in enumerate(bodies, 1)}
        if not pxr.UsdGeom.StageHasAuthoredMetersPerUnit(self._stage):
            self._notes.append("does not state its unit: taken as centimetres, as USD has it")
        metres = float(pxr.UsdGeom.GetStageMetersPerUnit(self._stage))
        if not 1e-9 <= metres <= 1e6:
            raise InvalidSource(f"{self._path}: its unit of {metres:g} m is none; correct it")
        up = _Z_UP if pxr.UsdGeom.GetStageUpAxis(self._stage) == pxr.UsdGeom.Tokens.z else _Y_UP
        physics = Stage(str(self._path), self._places, numbers, up, metres)
        both = [(prim, joint) for prim in jointed if (joint := read_joint(prim, physics))]
        joints = [joint for _, joint in both]
        names, joint_names = self._names([None, *bodies]), self._names([prim for prim, _ in both])
        tree = Tree(str(self._path), names, joints, joint_names, _holders(bodies, joints))
        meshes = self._meshes(shapes, physics, tree.origins)
        self._note_what_is_left_out(jointed)
        links, notes = tuple(map(Link, names, meshes)), (*tree.notes, *self._notes)
        return Model(links, tuple(tree.joints), sha256, notes)

    def _found(self) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the prims that are bodies, joints and shapes, in the default prim where the file
        names one; InvalidSource for too many, or none."""
        bodies, joints, shapes = list[Any](), list[Any](), list[Any]()
        top = self._stage.GetDefaultPrim() or self._stage.GetPseudoRoot()
        for number, prim in enumerate(pxr.Usd.PrimRange(top, pxr.Usd.TraverseInstanceProxies())):
            if number >= MAX_PRIMS:
                raise InvalidSource(f"{self._path}: has more than {MAX_PRIMS:,} prims; simplify it")
            if prim.IsA(pxr.UsdPhysics.Joint):
                joints.append(prim)
            elif self._shapes.shown(prim):
                shapes.append(prim)
            if prim.HasAPI(pxr.UsdPhysics.RigidBodyAPI) and body_of(prim) == prim:
                bodies.append(prim)
        for what, prims in (("rigid bodies", bodies), ("joints", joints)):
            if len(prims) >= MAX_LINKS:
                raise InvalidSource(
                    f"{self._path}: has more than {MAX_LINKS:,} {what}; simplify it"
                )
        if not shapes:
            raise InvalidSource(
                f"{self._path}: shows no shape; add meshes, or name the file that has the whole "
                "model"
            )
        return bodies, joints, shapes

    def _names(self, prims: Sequence[Any]) -> list[str]:
        """Return a name of each prim, the shown one where it has one; those that share one by their
        paths. None is the world, whose name nobody else gets."""
        plain = [prim.GetDisplayName() or prim.GetName() if prim else _WORLD_NAME for prim in prims]
        count = Counter(plain)
        taken = {_WORLD_NAME, *(name for name in plain if count[name] == 1)}
        names: list[str] = []
        for prim, name in zip(prims, plain, strict=True):
            unique = name
            if prim and (count[name] > 1 or name == _WORLD_NAME):
                unique = ".".join(str(prim.GetPath()).split("/")[2:]) or prim.GetName()
                while unique in taken:
                    unique += "~"
                taken.add(unique)
            if len(unique.encode()) > MAX_NAME_BYTES:
                raise InvalidSource(
                    f"{self._path}: the name {quoted(unique)} has more than {MAX_NAME_BYTES} bytes"
                    "; shorten it"
                )
            names.append(unique)
        return names

    def _meshes(self, shapes: list[Any], physics: Stage, origins: Floats) -> list[Mesh]:
        """Return the meshes of each link, in its frame."""
        meshes: list[list[Any]] = [[] for _ in origins]
        for prim in shapes:
            body = body_of(prim)
            meshes[WORLD if body is None else physics.bodies.get(body.GetPath(), WORLD)].append(
                prim
            )
        if not self._with_meshes:
            return [read.STAND_IN if prims else joined(()) for prims in meshes]
        return [
            joined(self._placed(prim, physics, origin) for prim in prims)
            for prims, origin in zip(meshes, origins, strict=True)
        ]

    def _placed(self, prim: Any, physics: Stage, origin: Floats) -> Mesh:
        mesh = self._shapes.triangles(prim)
        vertices = physics.to_metres(mesh.vertices)
        if not (np.abs(vertices) <= MAX_NUMBER).all():
            raise InvalidSource(
                f"{self._path}: {prim.GetPath()}: reaches beyond {MAX_NUMBER:,.0f} m; correct its "
                "scale or metersPerUnit"
            )
        return Mesh(vertices - origin, mesh.faces)

    def _note_what_is_left_out(self, joints: list[Any]) -> None:
        if self._shapes.left_out:
            kinds = ", ".join(sorted(self._shapes.left_out))
            self._notes.append(f"of kinds that are not read, left out: {kinds}")
        following = [  # driven by another joint, for which each simulator has a schema of its own
            prim.GetName()
            for prim in joints
            if any("Mimic" in str(name) for name in prim.GetAppliedSchemas())
        ]
        if following:
            self._notes.append(
                f"joints that follow others, read as moving freely: {', '.join(following)}"
            )


_WORLD_NAME = "world"


def _holders(bodies: Sequence[Any], joints: Sequence[PhysicsJoint]) -> list[int]:
    """Bodies in the order in which they hold what hangs on nothing: articulation roots, then those
    that no joint moves, then the others."""
    moved = {joint.bodies[1] for joint in joints}

    def rank(number: int) -> tuple[bool, bool]:
        root = bodies[number - 1].HasAPI(pxr.UsdPhysics.ArticulationRootAPI)
        return not root, number in moved

    return sorted(range(1, len(bodies) + 1), key=rank)
