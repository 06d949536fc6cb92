"""What the command `discover` does: the joints of objects, from clouds, grids or a data set, set
beside the truth where there is one."""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen import discovery
from articugen.core.arrays import Ints
from articugen.core.errors import ArticugenError, InvalidArgument, InvalidSource
from articugen.core.geometry import invert_rigid, motions_apart, twist_ends
from articugen.core.records import Floats, JointKind
from articugen.discovery import KINDS, Discovery, FoundJoint
from articugen.discovery.clouds import surfaces_of
from articugen.discovery.frames import frame_of_faces
from articugen.discovery.groups import Groups, agreement, group_instances
from articugen.discovery.shared import Category, SharedJoint, discover_shared
from articugen.meshes.points import shape_of_file
from articugen.store.dataset import DataSet
from articugen.store.dataset import open as open_data_set
from articugen.store.rows import Row

Pose = str | os.PathLike[str] | NDArray[Any]
"""A cloud (n, 3) or an occupancy grid (R, R, R), or a file of one."""

PIVOT, AXIS = 0.03, 5.0  # a joint is right within these: unit frame, degrees


@dataclass(frozen=True)
class Judged:
    """Agreement of an object's joints with a discovery: how many of all are right.

    Attributes:
        count: as many joints were found as there are.
        kind: they are of their kinds; `axis`: within AXIS, `pivot`: and PIVOT of the true ones.
        states: and their mean error is within AXIS or PIVOT.
        turned, slid: the mean error of the states of revolute (radians) and prismatic joints (unit
            frame) of the right kind; None where there are none.
        apart: the mean E of the joints over the states that are there, see `motions_apart`; None
            where nothing is seen of what they move.
    """

    count: bool
    kind: bool
    axis: bool
    pivot: bool
    states: bool
    turned: float | None
    slid: float | None
    apart: float | None = None


@dataclass(frozen=True, eq=False)
class ObjectJoints:
    """Joints of one object: a discovery, or `why` there is none; `judged` where the truth is known;
    `seconds` of one core."""

    object_id: str
    found: Discovery | None
    why: str
    judged: Judged
    seconds: float


def discover(
    poses: Sequence[Pose],
    *,
    normals: Sequence[NDArray[Any]] | None = None,
    cameras: Sequence[Sequence[float]] | Floats | None = None,
    joints: Sequence[str] = (),
) -> Discovery:
    """Find the joints of one object from several poses of it; see `articugen.discovery.discover`,
    and `discover_views` for those of which one camera each saw what there is.

    Args:
        poses: two or more, in one frame, turned any way: clouds (n, 3) or occupancy grids (R, R,
            R), which stand for the cube [-0.5, 0.5]^3; arrays, or .ply, .npy, .npz or .xyz files.
        normals: of the points of clouds, (n, 3) of unit length, out of the material. Few joints are
            missed where they are given.
        cameras: (K, 3) where the one that saw each cloud was, instead of normals.
        joints: one or more kinds that the object may have, "revolute", "prismatic"; () is both.

    Raises:
        InvalidArgument: nothing can be found in them, or there is no such kind.
        InvalidSource: a file cannot be read.
    """
    if cameras is not None and normals is not None:
        raise InvalidArgument("cameras give normals of their own; leave out `normals`")
    kinds = _kinds(joints)
    surfaces = surfaces_of([_cloud(pose) for pose in poses], normals)
    R = frame_of_faces(surfaces) if surfaces else np.eye(3)
    turned = [surface.points @ R.T for surface in surfaces]
    if cameras is None:
        outward = None if normals is None else [surface.normals @ R.T for surface in surfaces]
        outcome = discovery.discover_chains(turned, normals=outward, kinds=kinds)
    else:
        eyes = np.asarray(cameras, np.float64)
        eyes = eyes @ R.T if eyes.shape[-1:] == (3,) else eyes  # or is refused
        outcome = discovery.discover_views(turned, eyes, kinds=kinds)
    back = [replace(j, axis=j.axis @ R, pivot=j.pivot @ R) for j in outcome.joints]
    return replace(outcome, joints=tuple(back), points=surfaces[outcome.reference].points)


def discover_all(
    data: str | os.PathLike[str] | DataSet,
    *,
    poses: int | None = None,
    view: int | None = None,
    joints: Sequence[str] = (),
    on_object: Callable[[ObjectJoints, int], None] = lambda _found, _objects: None,
) -> list[ObjectJoints]:
    """Find the joints of each object of a data set from its surface points and their normals, and
    judge them.

    Args:
        data: a data set, its folder or one of its shards.
        poses: how many of each object's instances, the first ones; None is all.
        view: of which of its cameras each instance gives what it sees; None gives all surfaces.
        joints: as for `discover`.
        on_object: called for each object, with the number of all.

    Raises:
        CorruptShard: the data cannot be read.
        InvalidArgument: there is no such kind of joint.
    """
    _kinds(joints)
    data = data if isinstance(data, DataSet) else open_data_set(Path(data))
    all_found = []
    for object_id, its in data.by_object():
        rows = list(its[:poses])
        clouds = _whole(rows) if view is None else _seen(rows, view)
        began, why, outcome = time.process_time(), "", None
        try:
            outcome = discover(joints=joints, **clouds)
        except InvalidArgument as error:
            why = str(error)
        took = time.process_time() - began
        judged = _judged(outcome, rows, view)
        all_found.append(ObjectJoints(object_id, outcome, why, judged, took))
        on_object(all_found[-1], len(data.objects))
    return all_found


def _whole(rows: Sequence[Row]) -> dict[str, Any]:
    clouds = [np.asarray(row.surface.points, np.float64) for row in rows]
    normals = [np.asarray(row.surface.normals, np.float64) for row in rows]
    return {"poses": clouds, "normals": normals}


def _seen(rows: Sequence[Row], view: int) -> dict[str, Any]:
    count = min(len(row.partial.points) for row in rows)
    if not 0 <= view < count:
        raise InvalidArgument(f"view {view} is none of the {count} that the data set has, from 0")
    clouds = [np.asarray(row.partial.points[view], np.float64) for row in rows]
    T = np.array([row.partial.T_camera_world[view] for row in rows])
    return {"poses": clouds, "cameras": invert_rigid(T)[:, :3, 3]}


@dataclass(frozen=True, eq=False)
class SharedJudged:
    """Agreement of a shared joint with the truth of a data set: by how many degrees the axis and by
    how much of the unit frame the pivot is off (medians over the objects; of slides None), the
    correlation of the states, and the IoU of the points that the joint moves."""

    axis: float
    pivot: float | None
    states: float
    iou: float


@dataclass(frozen=True, eq=False)
class CategoryJoints:
    """Joints that a data set's objects share: how many there are in `truth`, and of each that was
    found, by its number, how it is `judged` where the truth has one of its kind there."""

    category: Category
    objects: list[str]
    truth: int
    judged: Mapping[int, SharedJudged]
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Return it as plain numbers and texts."""
        category = self.category
        numbers = [
            {
                **{"kind": str(joint.kind), "axis": joint.axis.tolist(), "score": joint.score},
                **{"margin": joint.margin, "pivots": joint.pivot.tolist()},
                "states": joint.states.tolist(),
                "judged": vars(self.judged[j]) if j in self.judged else None,
            }
            for j, joint in enumerate(category.joints)
        ]
        stretch, shift = category.stretch.tolist(), category.shift.tolist()
        return {"objects": self.objects, "joints": numbers, "stretch": stretch, "shift": shift}


def discover_category(
    data: str | os.PathLike[str] | DataSet, *, joints: Sequence[str] = ()
) -> CategoryJoints:
    """Find the joints that a data set's objects share from the last instance of each, by its
    surface points and normals alone, and judge them.

    Args:
        data: a data set, its folder or one of its shards.
        joints: as for `discover`.

    Raises:
        CorruptShard: the data cannot be read.
        InvalidArgument: the objects are few, or there is no such kind of joint.
    """
    kinds = _kinds(joints)
    data = data if isinstance(data, DataSet) else open_data_set(Path(data))
    rows = [its[-1] for _, its in data.by_object()]
    began = time.process_time()
    category = discover_shared(
        [row.surface.points for row in rows], [row.surface.normals for row in rows], kinds=kinds
    )
    took = time.process_time() - began
    truth = min((len(row.joints) for row in rows), default=0)
    label = np.concatenate([row.surface.part for row in rows])
    part = np.concatenate(category.part)
    judged = dict[int, SharedJudged]()
    for j, f in _matched(part, len(category.joints), label, truth).items():
        if all(row.joints[j].kind == str(category.joints[f].kind) for row in rows):
            both, any_ = ((label == j + 1) & (part == f + 1)), ((label == j + 1) | (part == f + 1))
            judged[f] = _shared(category.joints[f], j, rows, float(both.sum() / any_.sum()))
    return CategoryJoints(category, list(data.objects), truth, judged, took)


def _shared(joint: SharedJoint, j: int, rows: Sequence[Row], iou: float) -> SharedJudged:
    true = [row.joints[j] for row in rows]
    along = np.array([joint.axis @ one.axis for one in true])
    states = np.array([one.state_unit for one in true]) * np.sign(along[0])
    off = [axes_apart(joint.of(i), one.axis, one.pivot) for i, one in enumerate(true)]
    leans = float(np.degrees(np.arccos(np.clip(np.abs(along), 0.0, 1.0)).mean()))
    varies = np.ptp(states) > 0.0 and np.ptp(joint.states) > 0.0
    like = float(np.corrcoef(states, joint.states)[0, 1]) if varies else 0.0
    turns = joint.kind == JointKind.REVOLUTE
    return SharedJudged(leans, float(np.median(off)) if turns else None, like, iou)


@dataclass(frozen=True, eq=False)
class ObjectGroups:
    """A data set's instances in groups, by the object that each shows, as their clouds have it;
    their keys (object id, state index), and the `groups.agreement` with the data set's objects."""

    groups: Groups
    keys: list[tuple[str, int]]
    agreement: tuple[float, float, float]

    def as_json(self) -> list[list[dict[str, Any]]]:
        """Return for each group its instances."""
        members: list[list[dict[str, Any]]] = [[] for _ in range(self.count)]
        for number, (name, state) in zip(self.groups.number.tolist(), self.keys, strict=True):
            members[number].append({"object": name, "state_index": state})
        return members

    @property
    def count(self) -> int:
        return int(self.groups.number.max(initial=-1)) + 1


def group_all(data: str | os.PathLike[str] | DataSet) -> ObjectGroups:
    """Group a data set's instances by the object that they show, from their surface points and
    normals alone, and compare the groups with the objects that the data set names.

    Args:
        data: a data set, its folder or one of its shards.

    Raises:
        CorruptShard: the data cannot be read.
    """
    data = data if isinstance(data, DataSet) else open_data_set(Path(data))
    keys: list[tuple[str, int]] = []

    def clouds() -> Iterator[tuple[Floats, Floats]]:
        for row in data:
            keys.append((row.object_id, row.state_index))
            surface = row.surface
            yield np.asarray(surface.points, np.float64), np.asarray(surface.normals, np.float64)

    groups = group_instances(clouds())
    _, truth = np.unique([name for name, _ in keys], return_inverse=True)
    return ObjectGroups(groups, keys, agreement(groups.number, truth))


def _kinds(joints: Sequence[str]) -> tuple[JointKind, ...]:
    named = {str(kind): kind for kind in KINDS}
    joints = [joints] if isinstance(joints, str) else joints
    for name in joints:
        if name not in named:
            raise InvalidArgument(f"no joint that can be found is {name!r}: {', '.join(named)}")
    return tuple(named[name] for name in joints) or KINDS


def _cloud(pose: Pose) -> Floats:
    name = "a grid"
    if isinstance(pose, str | os.PathLike):
        name, pose = str(pose), shape_of_file(Path(pose))[0]
    array = np.asarray(pose)
    if array.dtype.kind not in "biuf":
        raise InvalidArgument(
            f"a {type(pose).__name__} is no pose; give clouds (n, 3), grids or files of them, of "
            "rows [row.surface.points for row in rows] and as normals their row.surface.normals"
        )
    if array.ndim != 3:
        return array
    filled = np.pad(array > 0, 1)
    if not filled.any():
        raise InvalidSource(f"{name}: no voxel of the grid is occupied")
    inner = filled.copy()
    for axis in range(3):
        inner &= np.roll(filled, 1, axis) & np.roll(filled, -1, axis)
    return (np.argwhere(filled & ~inner) - 0.5) / max(array.shape) - 0.5


def _judged(discovery: Discovery | None, rows: Sequence[Row], view: int | None = None) -> Judged:
    """Judge a discovery by the truth of the rows, the first of which is pose 0, where the states
    are known; from what a `view` sees."""
    first = rows[discovery.reference if discovery else 0]
    truth, joints = first.joints, discovery.joints if discovery else ()
    states = np.array([[joint.state_unit for joint in row.joints] for row in rows])
    states -= [joint.state_unit for joint in truth]
    points, part = first.surface.points, first.surface.part
    if view is not None:
        points, part = first.partial.points[view], first.partial.part[view]
    points = np.asarray(points, np.float64)
    of = _matched(discovery.part, len(joints), part, len(truth)) if discovery else {}
    apart = list[float]()
    kind = axis = pivot = near = discovery is not None
    errors: dict[str, list[float]] = {"revolute": [], "prismatic": []}
    for j, true in enumerate(truth):
        match = joints[of[j]] if j in of else None
        if (part == j + 1).any():
            apart.append(_apart(match, true, states[:, j], points[part == j + 1]))
        if match is None or str(match.kind) != true.kind:
            kind = axis = pivot = near = False
            continue
        along = float(match.axis @ true.axis)
        axis &= bool(np.degrees(np.arccos(min(abs(along), 1.0))) <= AXIS)
        if match.kind == JointKind.REVOLUTE:
            pivot &= axes_apart(match, true.axis, true.pivot) <= PIVOT
        off = float(np.nanmean(np.abs(np.sign(along) * match.states - states[:, j])))
        near &= bool(off <= (np.radians(AXIS) if match.kind == JointKind.REVOLUTE else PIVOT))
        errors[true.kind].append(off)
    means = [float(np.mean(some)) if some else None for some in (*errors.values(), apart)]
    return Judged(len(joints) == len(truth), kind, axis, pivot, near, *means)


def _apart(match: FoundJoint | None, true: Any, states: Floats, points: Floats) -> float:
    """Return E of a joint as found, over the states (P,) since pose 0."""
    pivot = true.pivot if true.kind == "revolute" else None
    truth = twist_ends(np.asarray(true.axis), pivot, [states.min(), states.max()])
    ends = np.zeros((2, 6))
    if match is not None:
        pivot = match.pivot if match.kind == JointKind.REVOLUTE else None
        known = match.states[np.isfinite(match.states)]
        ends = twist_ends(match.axis, pivot, [known.min(), known.max()])
    return motions_apart(truth, ends, points)


def axes_apart(joint: FoundJoint, axis: Floats, pivot: Floats) -> float:
    """Return how far a found axis is from a true one, beside the part that it turns."""
    there = pivot + ((joint.pivot - pivot) @ axis) * axis
    off = there - joint.pivot
    return float(np.linalg.norm(off - (off @ joint.axis) * joint.axis))


def _matched(part: Ints, count: int, truth: NDArray[np.uint8], joints: int) -> Mapping[int, int]:
    """Match true joints with `count` that were found, by the number of points that their parts have
    in common."""
    both = (part > 0) & (truth > 0) & (truth <= joints)  # some objects may have more
    pairs = part[both] - 1, truth[both].astype(int) - 1
    common = np.zeros((joints, count), np.int64)
    np.add.at(common, pairs[::-1], 1)
    of: dict[int, int] = {}
    while common.size and common.max() > 0:
        j, f = np.unravel_index(int(common.argmax()), common.shape)
        of[int(j)] = int(f)
        common[j, :], common[:, f] = 0, 0
    return of


def as_json(discovery: Discovery | None) -> list[dict[str, Any]]:
    """Return the joints as plain numbers and texts."""
    return [
        {
            "kind": str(joint.kind),
            "parent": joint.parent,
            "axis": joint.axis.tolist(),
            "pivot": joint.pivot.tolist(),
            "states": [None if np.isnan(q) else q for q in joint.states.tolist()],
            "score": joint.score,
            "points": int((discovery.part == j + 1).sum()),
        }
        for j, joint in enumerate(discovery.joints)
    ] if discovery else []  # fmt: skip


def share(objects: Sequence[ObjectJoints], name: str) -> float:
    """Return the share of objects all of whose joints are right in `name` of `Judged`."""
    return float(np.mean([getattr(one.judged, name) for one in objects])) if objects else 0.0


def mean_error(objects: Sequence[ObjectJoints], name: str) -> float | None:
    """Return the mean of `turned`, `slid` or `apart` over the objects that have it."""
    values = [getattr(o.judged, name) for o in objects if getattr(o.judged, name) is not None]
    return float(np.mean(values)) if values else None


def check_poses(paths: Sequence[Path], *, option: str = "") -> None:
    """Raise InvalidArgument where files are neither a data set nor several poses, or no data set,
    which an `option` needs."""
    is_cloud = paths[0].is_file() and paths[0].suffix != ".h5"
    if option and (len(paths) > 1 or is_cloud):
        raise InvalidArgument(f"{option}: give one data set's folder or shard, no files of clouds")
    if len(paths) == 1 and is_cloud:
        raise InvalidArgument(
            f"{paths[0]}: one pose shows no motion; give two or more, or the folder of a data set"
        )
    if len(paths) > 1 and any(path.is_dir() or path.suffix == ".h5" for path in paths):
        raise ArticugenError("give one data set or shard, or two or more clouds or grids")
